"""Inertial sensors: types and noise, integration, residuals on a pose function, simulation, filtering."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
