from .bundle import Bundle as Bundle
from .bundle import adjust as adjust
from .tracks import Tracks as Tracks
from .tracks import find_tracks as find_tracks
