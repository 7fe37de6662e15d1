from . import blender as blender
from . import colmap as colmap
from . import llff as llff
from . import plain as plain
from .registry import find_format as find_format
from .registry import load_photographs as load_photographs
from .transforms_json import write_transforms as write_transforms
