from . import davis as davis
from . import eventnerf as eventnerf
from . import hdf5 as hdf5
from . import npz as npz
from . import ros as ros
from . import single_file as single_file
from .registry import find_format as find_format
from .registry import load_events as load_events
