"""Event cameras: simulation, events sorted by pixel, residuals, motion by contrast maximisation."""

from jaxpose.events.pixel_index import PixelIndex as PixelIndex
from jaxpose.events.pixel_index import cumulative_polarity as cumulative_polarity
from jaxpose.events.pixel_index import index_by_pixel as index_by_pixel
from jaxpose.events.residuals import change_residual as change_residual
from jaxpose.events.simulation import log_intensity as log_intensity
from jaxpose.events.simulation import mosaic_mask as mosaic_mask
from jaxpose.events.simulation import simulate as simulate
from jaxpose.events.types import GAMMA as GAMMA
from jaxpose.events.types import AnyArray as AnyArray
from jaxpose.events.types import Events as Events
from jaxpose.events.types import FloatArray as FloatArray
from jaxpose.events.types import Mosaic as Mosaic
