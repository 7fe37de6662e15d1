from . import euroc as euroc
from . import plain as plain
from . import replica as replica
from . import scannet as scannet
from . import sevenscenes as sevenscenes
from . import tum as tum
from .registry import find_format as find_format
from .registry import load_recording as load_recording
