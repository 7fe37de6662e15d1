"""Time to pose: families of continuous trajectories behind one interface."""

from jaxpose.fields._bspline import bspline as bspline
from jaxpose.fields._bspline import control_points as control_points
from jaxpose.fields._bspline import control_points_along as control_points_along
from jaxpose.fields._per_frame import table as table
from jaxpose.fields._posenet import PoseNetConfig as PoseNetConfig
from jaxpose.fields._posenet import posenet as posenet
from jaxpose.fields._posenet import set_progress as set_progress
from jaxpose.fields._posenet import stop_rotation as stop_rotation
from jaxpose.fields.composition import anchored as anchored
from jaxpose.fields.composition import body_to_camera as body_to_camera
from jaxpose.fields.composition import in_frame as in_frame
from jaxpose.fields.composition import intrinsic as intrinsic
from jaxpose.fields.composition import piecewise_geodesic as piecewise_geodesic
from jaxpose.fields.composition import refine as refine
from jaxpose.fields.fitting import FitResult as FitResult
from jaxpose.fields.fitting import fit as fit
from jaxpose.fields.projection import project_onto_poses as project_onto_poses
from jaxpose.fields.types import Params as Params
from jaxpose.fields.types import PoseField as PoseField
from jaxpose.fields.types import PoseFn as PoseFn
