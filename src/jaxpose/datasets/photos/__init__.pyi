from . import blender as blender
from . import llff as llff
from .transforms_json import write_transforms as write_transforms
