"""Planar alignment: `python -m jaxpose.experiments.planar`."""
