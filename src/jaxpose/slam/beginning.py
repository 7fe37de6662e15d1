"""The state of a run before its first frame: of single frames, of a recording, of a second pass.

A pose is registered from where the IMU predicts it, and stays a few hundredths of the prediction's error away
from where the image alone would have it. A clock or a mounting that was told wrongly makes errors that always
go the same way, and a run finds both short by as much: so all is tracked again with what was found.
"""

import jax
import numpy as np
from jaxtyping import Float

from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.estimate import Posterior
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera
from jaxpose.imu import GRAVITY_WORLD, Gravity
from jaxpose.scenes.voxel_blocks import BlockConfig, unpacked
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.initial_pose import first_pose
from jaxpose.slam.loops.types import no_loops
from jaxpose.slam.map.backend import framed_field
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.tracking.predict import GYRO_BIAS_SIGMA
from jaxpose.slam.types import Motion, SlamState, no_frames

_DEFAULT = SlamConfig()
_KEPT_ERROR = 0.05  # of a prediction's error that registered poses keep: experiments/estimate.md


def init(
    camera: Camera,
    config: SlamConfig = _DEFAULT,
    *,
    T_world_cam: Float[np.ndarray, "4 4"] | None = None,
    T_body_cam: Float[np.ndarray, "4 4"] | None = None,
    gravity_world: Gravity = GRAVITY_WORLD,
    duration_s: float | None = None,
) -> SlamState:
    """A SLAM run before its first frame.

    Args:
        camera: intrinsics of colour and depth, which are registered to each other.
        config: settings of the run.
        T_world_cam: pose of the first camera. By default the world is upright by the readings that come with
            the first frame, or is the first camera's frame where there are none.
        T_body_cam: camera to IMU; by default the IMU is where the camera is.
        gravity_world: gravity [m/s^2] in the world.
        duration_s: length of the sequence, which the paper's frames of reference (all but `anchored`) need.

    Returns:
        The state to call `step` with.

    Raises:
        ValueError: for a pose that is no rigid transform, or a frame of reference without a duration.
    """
    given = {"T_world_cam": T_world_cam, "T_body_cam": T_body_cam}
    poses = {name: None if T is None else _rigid(name, T) for name, T in given.items()}
    if config.uses_field and config.frame != "anchored" and duration_s is None:
        raise ValueError(f"slam.init: frame {config.frame} expected duration_s [s] of the sequence, got None")
    framed = framed_field(config)
    return SlamState(
        camera=camera,
        config=config,
        T_body_cam=np.eye(4) if poses["T_body_cam"] is None else poses["T_body_cam"],
        gravity_world=np.asarray(gravity_world, np.float64),
        T_world_cam_first=poses["T_world_cam"],
        duration_s=np.nan if duration_s is None else float(duration_s),
        imu_offset_s=0.0,
        passes=0,
        frames=no_frames(np.zeros(0)),
        imu=None,
        motion=Motion(np.zeros(6), np.zeros(3), np.zeros(3), GYRO_BIAS_SIGMA, np.zeros(3)),
        params=None if framed is None else jax.jit(framed.field.init)(jax.random.key(config.seed)),
        exposure=np.ones(3, np.float32),
        max_depth=0.0,
        thumbnails=np.zeros((0, 2, 12, 16)),
        keyframe_depths=np.zeros((0, 12, 16)),
        features=None,
        keyframe_features=(),
        loops=no_loops(),
        settled=0,
        pending=np.zeros(0, int),
        coarser_at=np.zeros(0, int),
        images=(),
        readings=(),
        grid=None,
        map=None,
    )


def begin(recording: Recording, config: SlamConfig = _DEFAULT) -> SlamState:
    """The state of a recording's run before its first frame; DataError as `run` says."""
    t = recording.t
    if len(t) < 2:
        raise DataError(f"{recording.name}: expected at least 2 frames, got {len(t)}")
    if config.uses_gyroscope:
        if recording.imu is None:
            raise DataError(
                f"{recording.name}: --imu {config.imu} needs inertial readings, and there are none"
            )
        first, last = (float(recording.imu.t[k]) for k in (0, -1))
        if last < t[0] or first > t[-1]:
            raise DataError(
                f"{recording.name}: expected inertial readings between {t[0]:.3f} and {t[-1]:.3f} s (the "
                f"frames), got them between {first:.3f} and {last:.3f} s"
            )
    return init(
        recording.camera,
        config,
        T_world_cam=first_pose(recording).T_world_cam,
        T_body_cam=recording.T_body_cam,
        gravity_world=recording.gravity_world,
        duration_s=float(t[-1] - t[0]),
    )


def told_wrongly(state: SlamState, found: Posterior) -> bool:
    """Whether clock or mounting of the IMU were told so wrongly that what was found of them is short of it.

    Args:
        state: a run after its last frame.
        found: by its batch pass.

    Returns:
        Whether what poses keep of the error is more than one sigma of what was found.
    """
    sensors = found.sensors
    off = [
        sensors.offset_s - state.imu_offset_s,
        *rigid.log(rigid.inverse(state.T_body_cam) @ sensors.T_body_cam),
    ]
    sigma = np.array([sensors.offset_sigma_s, *sensors.T_body_cam_sigma])
    return bool((_KEPT_ERROR * np.abs(off) > sigma)[sigma > 0].any())


def begun_again(state: SlamState, found: Posterior) -> SlamState:
    """The state before the first frame of a second pass, with the clock and mounting that the first found.

    Args:
        state: the first pass after its last frame.
        found: by its batch pass.

    Returns:
        The state, in the same map of an earlier run if the first pass began in one.
    """
    again = init(
        state.camera,
        state.config,
        T_world_cam=state.T_world_cam_first,
        T_body_cam=found.sensors.T_body_cam,
        gravity_world=state.gravity_world,
        duration_s=state.duration_s,
    )._replace(imu_offset_s=found.sensors.offset_s, passes=state.passes + 1)
    if (earlier := state.earlier) is None:
        return again
    assert isinstance(state.grid, BlockConfig)
    begun = MapState(unpacked(state.grid, earlier.coords, earlier.values), ())
    return again._replace(
        grid=state.grid, map=begun, earlier=earlier, exposure=np.float32(state.frames.exposure[0])
    )


def _rigid(name: str, T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    T = np.asarray(T, np.float64)
    good = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    if not good or not rigid.is_rotation(T[:3, :3], tolerance=1e-3):
        raise ValueError(f"slam.init: expected {name} to be a rigid transform (4, 4), got {T.tolist()}")
    return T
