"""Cameras and points from photographs: features that several see, and poses that agree with them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
