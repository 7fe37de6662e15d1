"""Scenes: point to geometry and colour, one family a file."""

from jaxpose.scenes.base import SceneField as SceneField
from jaxpose.scenes.grid import GridConfig as GridConfig
from jaxpose.scenes.grid import box as box
from jaxpose.scenes.grid import grid as grid
from jaxpose.scenes.grid import grow as grow
from jaxpose.scenes.grid import merge as merge
from jaxpose.scenes.grid import node_positions as node_positions
from jaxpose.scenes.grid import node_shape as node_shape
from jaxpose.scenes.mlp import NerfConfig as NerfConfig
from jaxpose.scenes.mlp import nerf as nerf
