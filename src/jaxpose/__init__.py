"""A camera trajectory as a pure, differentiable function of time."""

from importlib.metadata import version

__version__ = version("jaxpose")
