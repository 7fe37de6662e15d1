"""Options of the noisy-pose experiment, and the photographs and disturbed poses that they name."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import pdist

from jaxpose.datasets.origin import far_origin, moved
from jaxpose.datasets.photos.registry import load_photographs
from jaxpose.datasets.photos.sigmas import read_sigmas
from jaxpose.datasets.photos.transforms_json import stated
from jaxpose.datasets.synthetic import pose_noise
from jaxpose.datasets.synthetic.orbit import DIAMETER, orbit
from jaxpose.datasets.types import Photographs, every, take
from jaxpose.errors import DataError
from jaxpose.experiments.checks import (
    check_finite,
    check_least,
    check_positive,
    check_run_folder,
    check_unused,
)
from jaxpose.experiments.devices import DeviceConfig, Precision, check_devices
from jaxpose.experiments.training_loop import CHUNK, NetConfig
from jaxpose.geometry import rigid

Pose = Literal["posenet", "per_frame", "bspline", "spline_reset"]
Preset = Literal["fast", "joint", "paper"]
ShutterMode = Literal["known", "estimate", "ignore"]
Study = Literal["fields", "encoding", "size", "spline", "ablations"]
ORBIT = Path("orbit")
_FAR = 100.0  # times the cameras' extent: a world so far from its origin is worked on near it
_WIDTHS = {"fast": 100, "joint": 100, "paper": 400}  # [px]
_SMOKE_WIDTH, _SMOKE_VIEWS = 24, 8


# The options of the first screen of help.
GROUPS = {
    "data": ("data", "focal_px", "image_width"),
    "poses": ("noise", "noise_translation", "pose"),
    "training": ("preset", "steps", "seed", "study"),
    "run": ("out", "name", "resume", "smoke", "json"),
}


@dataclass(frozen=True)
class Config:
    """Settings of a run; photographs and these are all that a result depends on."""

    # A folder in the layout of Blender, nerfstudio, instant-ngp, LLFF or COLMAP, or of images alone (with
    # --noise unknown); "orbit": an object made on the fly.
    data: Path = ORBIT
    # The pose field. spline_reset: a pose per image, reset to a smoothing spline every 100 steps.
    pose: Pose = "posenet"
    # fast: poses by features that photographs share, then a scene of planes with the pose field; joint: all
    # by the colours, with a small network for CPUs; paper: so with BARF's network and the paper's schedule.
    preset: Preset = "fast"
    # Of the poses that the run starts from. "none": as the data has them, unless the photographs contradict
    # them; "unknown": all in one place.
    noise: Literal["correlated", "independent", "none", "unknown"] = "correlated"
    noise_translation: float = 0.2  # largest deviation, as a share of the largest distance between cameras
    noise_rotation_deg: float = 0.0  # [deg] largest deviation
    noise_sigma: float = 0.15  # of independent noise, BARF's [rad and scene units]
    # A table of how sure the poses are that the run starts from, which then weigh as much as that says and
    # hold the world: lines of image, sigma of position [scene units] and of rotation [deg]; image * is every
    # other one. None: nothing is known of it.
    pose_sigmas: Path | None = None
    # Which side of the camera's pose the noise is on, and the field that undoes it: the supplement's formula
    # has the world's, where turning goes about the world's origin; on the camera's it turns out of view.
    side: Literal["world", "camera"] = "world"
    every: int = 1  # use every n-th training image
    focal_px: float | None = None  # [px] of images alone, as they are on disk; None: what their EXIF says
    image_width: int | None = None  # [px] images are reduced to; None: 100, with preset paper 400
    orbit_views: int = 100  # photographs of the object that is made on the fly
    # [us] from a row to the next, [ms] of each row, both about the middle row's middle, which a photograph's
    # time is. The orbit is photographed so; of other data it is what the camera has.
    line_delay_us: float = 0.0
    exposure_ms: float = 0.0  # [ms] for which each row is exposed, about its own time
    # Each ray from the poses of its own row's exposure; "estimate": both numbers are found, from nothing on
    # the orbit, else from those given; "ignore": the orbit is trained as if it had neither.
    shutter: ShutterMode = "known"
    seed: int = 0  # of the noise, the network's start, the rays
    steps: int | None = None  # None: 4000, with preset joint 5000, paper 200,000
    rays: int | None = None  # per step; None: 1024, with preset paper 4096
    net: NetConfig = NetConfig()
    spline_knots: int = 25  # of both splines
    spline_smoothing: float = 1e-3  # of spline_reset: scipy's bound on the sum of squares, per dimension
    test_pose_steps: int = 100  # of test-time refinement of each held-out pose; 0: none
    # Of products in the scene's network on a GPU; a CPU has float32 alone. Poses are float32 in any case.
    precision: Precision = "tensorfloat32"
    devices: DeviceConfig = DeviceConfig()
    study: Study | None = None  # runs of table 11 (fields), 3 (encoding), 12 (size), 10 (spline) side by side
    resume: bool = False  # go on where a killed run stopped
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    out: Path | None = None  # exactly this folder; None: outputs/noisy_nerf/<name or timestamp>
    name: str | None = None  # of the folder within outputs/noisy_nerf
    json: bool = False  # print the results as JSON and nothing else

    def __post_init__(self):
        check_least(
            self,
            noise_translation=0, noise_rotation_deg=0, noise_sigma=0, seed=0, test_pose_steps=0,
            every=1, orbit_views=4, image_width=8, steps=CHUNK, rays=1, spline_knots=2,
        )  # fmt: skip
        check_positive(self, "spline_smoothing", "focal_px")
        if self.noise_rotation_deg > 180:
            raise ValueError(f"--noise-rotation-deg: expected at most 180, got {self.noise_rotation_deg:g}")
        if self.steps is not None and self.steps % CHUNK:
            raise ValueError(f"--steps: expected a multiple of {CHUNK}, got {self.steps}")
        sigmas_in = None if self.pose_sigmas is None else self.pose_sigmas.parent
        check_run_folder(self, None if self.data == ORBIT else self.data, sigmas_in)
        check_devices(self)
        if self.study is not None and self.preset == "fast":
            raise ValueError(
                "--study: expected --preset joint or paper, which find poses by the field alone, got fast"
            )
        self._check_unused()
        self._check_shutter()

    def _check_shutter(self):
        check_finite(self, "line_delay_us")
        check_least(self, exposure_ms=0)
        given = self.line_delay_us != 0 or self.exposure_ms != 0
        if self.shutter == "ignore" and (self.data != ORBIT or not given):
            raise ValueError("--shutter ignore: expected the orbit with --line-delay-us or --exposure-ms")
        moves = self.shutter == "estimate" or (given and self.shutter == "known")
        if moves and (self.study is not None or self.pose not in ("posenet", "bspline")):
            found = self.pose if self.study is None else f"--study {self.study}"
            raise ValueError(f"--shutter {self.shutter}: expected --pose posenet or bspline, got {found}")

    def _check_unused(self):
        if self.noise != "correlated":
            check_unused(self, ("noise_translation", "noise_rotation_deg"), f"with --noise {self.noise}")
        if self.noise == "unknown":
            check_unused(self, ("pose_sigmas",), "with --noise unknown")
        if self.preset != "fast":
            check_unused(self, ("pose_sigmas",), f"with --preset {self.preset}, which knows no features")
        if self.noise != "independent":
            check_unused(self, ("noise_sigma",), f"with --noise {self.noise}")
        if self.data == ORBIT:
            check_unused(self, ("focal_px",), "without --data")
        else:
            check_unused(self, ("orbit_views",), "with --data")
        if self.study is None and self.pose != "posenet":
            check_unused(
                self, [f"net.{name}" for name in self.net.__dataclass_fields__], f"with --pose {self.pose}"
            )
        if self.study is None and self.pose not in ("bspline", "spline_reset"):
            check_unused(self, ("spline_knots",), f"with --pose {self.pose}")
        if self.study is None and self.pose != "spline_reset":
            check_unused(self, ("spline_smoothing",), f"with --pose {self.pose}")


# What a run's numbers do not depend on.
_INCIDENTAL = ("devices", "resume", "out", "name", "study", "json")


def resume_fingerprint(config: Config) -> dict[str, Any]:
    """The settings that a resumed run must share with the one it resumes."""
    return {f.name: getattr(config, f.name) for f in fields(config) if f.name not in _INCIDENTAL}


class Problem(NamedTuple):
    """Photographs to train on and held out, and the poses that the training starts from."""

    train: Photographs
    held_out: Photographs
    T_start: Float[np.ndarray, "n 4 4"]  # camera-to-world
    extent: float  # largest distance between true cameras [scene units]; NaN where none is known
    metadata: dict[str, Any]  # the data and the noise in words and numbers
    origin: np.ndarray = np.zeros(3)  # (3,) of the poses' world in that of the data
    # Of `T_start`, position [scene units] and rotation [rad], where they are stated.
    sigmas: Float[np.ndarray, "n 2"] | None = None


def load(config: Config) -> Problem:
    """Read or make the photographs and disturb their poses.

    DataError or OSError for what cannot be used.
    """
    train, held_out = _photographs(config)
    train = every(train, config.every)
    if len(train.t) < 4:
        raise DataError(f"{config.data}: expected at least 4 images to train on, got {len(train.t)}")
    if config.noise != "unknown" and not np.isfinite(train.T_world_cam).all():
        raise DataError(
            f"{config.data}: expected poses for --noise {config.noise}, got none: --noise unknown"
        )
    extent = DIAMETER if config.data == ORBIT else float(pdist(train.T_world_cam[:, :3, 3]).max())
    origin = far_origin(train.T_world_cam, _FAR * extent)
    train, held_out = (p._replace(T_world_cam=moved(p.T_world_cam, -origin)) for p in (train, held_out))
    T_start, words = disturbed(config, train, extent)
    sigmas, of_sigmas = None, ()
    if config.pose_sigmas is not None:
        sigmas, of_sigmas = read_sigmas(config.pose_sigmas, train.files)
    strange = sorted({seen.kind for seen in train.lenses if stated(seen) is None})
    unwritten = [
        f"transforms.json has no lens {kind}: trajectory.txt alone holds the poses" for kind in strange
    ]
    metadata = {
        "data": "synthetic orbit" if config.data == ORBIT else train.name,
        "images": len(train.t),
        "held_out": len(held_out.t),
        "size": (train.camera.width, train.camera.height),
        "extent": extent,
        "noise": words,
        "notes": (*train.notes, *unwritten, *of_sigmas),
    }
    return Problem(train, held_out, T_start, extent, metadata, origin, sigmas)


def _photographs(config: Config) -> tuple[Photographs, Photographs]:
    width = _SMOKE_WIDTH if config.smoke else config.image_width or _WIDTHS[config.preset]
    if config.data == ORBIT:
        line_delay_s, exposure_s = 1e-6 * config.line_delay_us, 1e-3 * config.exposure_ms
        views = _SMOKE_VIEWS if config.smoke else config.orbit_views
        return orbit(views, width, line_delay_s=line_delay_s, exposure_s=exposure_s)
    if not config.data.exists():
        raise DataError(f"{config.data}: expected a folder of photographs, or orbit, got nothing")
    train, held_out = load_photographs(config.data, width=width, focal_px=config.focal_px)
    if config.smoke:
        train, held_out = (
            take(train, np.arange(min(_SMOKE_VIEWS, len(train.t)))),
            take(held_out, np.arange(min(1, len(held_out.t)))),
        )
    return train, held_out


def middle(photographs: Photographs) -> float:
    """Depth of the middle of the scene, where a world that is not known yet has its origin.

    Turns on the world's side then go about what the cameras look at. About the cameras themselves, turning
    and moving shift an image alike, the scene explains away what differs, and the poses do not come apart.
    """
    near, far = photographs.near, photographs.far
    return 2 / (1 / near + 1 / far) if photographs.spacing == "disparity" else (near + far) / 2


def disturbed(config: Config, train: Photographs, extent: float) -> tuple[Float[np.ndarray, "n 4 4"], str]:
    """The poses to start from, and what was done to them."""
    ground_truth = train.T_world_cam
    if config.noise == "none":
        return ground_truth, "none: the poses of the data"
    if config.noise == "unknown":
        T_same = np.tile(np.eye(4), (len(ground_truth), 1, 1))
        T_same[:, 2, 3] = -middle(train)
        if train.turns is None:
            return T_same, "poses unknown: all start in one place"
        T_same[:, :3, :3] = train.turns
        return T_same, "poses unknown: all start in one place, turned as the gyroscope says"
    if config.noise == "independent":
        T_noise = pose_noise.independent(len(ground_truth), config.noise_sigma, config.seed)
        words = f"independent, twists of N(0, {config.noise_sigma:g}^2) [scene units and rad]"
    else:
        T_noise = pose_noise.correlated(
            train.t,
            translation=config.noise_translation * extent,
            rotation_deg=config.noise_rotation_deg,
            seed=config.seed,
        )
        words = (
            f"correlated, at most {100 * config.noise_translation:g}% of the cameras' extent "
            f"and {config.noise_rotation_deg:g} degrees"
        )
    words += f", on the {config.side}'s side, seed {config.seed}"
    if config.side == "camera":
        return ground_truth @ T_noise, words
    # World-to-camera this is T_c,w . T_noise, as in the supplement's section 6.
    return rigid.inverse(T_noise) @ ground_truth, words


# Label and variant of PoseNet in the order of table 3; coarse to fine opens its bands as BARF's scene does.
_ENCODING = {
    "linear_coupled": NetConfig(octaves=0, coupled=True),
    "sin2_coupled": NetConfig(octaves=2, coupled=True),
    "sin5_coupled": NetConfig(octaves=5, coupled=True),
    "sin10_coupled": NetConfig(octaves=10, coupled=True),
    "sin2": NetConfig(octaves=2),
    "sin5": NetConfig(octaves=5),
    "sin10": NetConfig(octaves=10),
    "sigmoid": NetConfig(activation="sigmoid"),
    "sin10_coarse_to_fine": NetConfig(octaves=10, window=(0.1, 0.5)),
}
_SIZE = {
    f"layers{layers}_width{width}": NetConfig(layers=layers, width=width)
    for layers in (8, 4)
    for width in (256, 128)
}
_SPLINE = [(25, 1e-3), (25, 1e-2), (25, 1e-1), (25, 1.0), (75, 1e-3), (50, 1e-3)]  # knots and smoothing


def _fields(config: Config) -> dict[str, Config]:
    return {pose: replace(config, pose=pose) for pose in get_args(Pose)}


def _encoding(config: Config) -> dict[str, Config]:
    return {label: replace(config, pose="posenet", net=net) for label, net in _ENCODING.items()}


def _size(config: Config) -> dict[str, Config]:
    return {label: replace(config, pose="posenet", net=net) for label, net in _SIZE.items()}


def _spline(config: Config) -> dict[str, Config]:
    return {
        f"knots{knots}_smoothing{smoothing:.0e}".replace("-", "m").replace("+", ""): replace(
            config, pose="spline_reset", spline_knots=knots, spline_smoothing=smoothing
        )
        for knots, smoothing in _SPLINE
    }


def _ablations(config: Config) -> dict[str, Config]:
    sizes = _size(config)
    del sizes["layers8_width256"]  # it is sin5
    return _encoding(config) | sizes | _spline(config)


_STUDIES: dict[Study, Callable[[Config], dict[str, Config]]] = {
    "fields": _fields,
    "encoding": _encoding,
    "size": _size,
    "spline": _spline,
    "ablations": _ablations,
}


def studies(config: Config, study: Study) -> dict[str, Config]:
    """Runs side by side: the pose fields of table 11, the ablations of tables 3 (encoding), 12, 10 (spline).

    Args:
        config: what they share.
        study: which runs.

    Returns:
        The config of each run, by its label.
    """
    return {label: replace(run, study=None) for label, run in _STUDIES[study](config).items()}
