"""Scenes: point to geometry and colour, one family a file."""

from jaxpose.scenes._nerf import NerfConfig as NerfConfig
from jaxpose.scenes._nerf import nerf as nerf
from jaxpose.scenes.types import SceneField as SceneField
from jaxpose.scenes.voxel_grid import GridConfig as GridConfig
from jaxpose.scenes.voxel_grid import bounding_grid as bounding_grid
from jaxpose.scenes.voxel_grid import grid as grid
from jaxpose.scenes.voxel_grid import grow as grow
from jaxpose.scenes.voxel_grid import merge as merge
from jaxpose.scenes.voxel_grid import node_positions as node_positions
from jaxpose.scenes.voxel_grid import node_shape as node_shape
