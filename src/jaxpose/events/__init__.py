"""Event cameras: simulation, events sorted by pixel, residuals, motion by contrast maximisation."""

from jaxpose.events.pixel_index import Streams as Streams
from jaxpose.events.pixel_index import by_pixel as by_pixel
from jaxpose.events.pixel_index import level_at as level_at
from jaxpose.events.residuals import change_residual as change_residual
from jaxpose.events.simulation import log_intensity as log_intensity
from jaxpose.events.simulation import mosaic_mask as mosaic_mask
from jaxpose.events.simulation import simulate as simulate
from jaxpose.events.types import GAMMA as GAMMA
from jaxpose.events.types import AnyArray as AnyArray
from jaxpose.events.types import Events as Events
from jaxpose.events.types import FloatArray as FloatArray
from jaxpose.events.types import Mosaic as Mosaic
