from .bundle import Bundle as Bundle
from .bundle import adjust as adjust
from .exposure import evenly_exposed as evenly_exposed
from .exposure import matching_exposure as matching_exposure
from .exposure import relative_exposures as relative_exposures
from .tracks import Tracks as Tracks
from .tracks import find_tracks as find_tracks
