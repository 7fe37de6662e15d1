"""What photographs share, before anything is trained: poses that agree with it, and where the scene is."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.noisy_nerf.options import Config, Problem, middle
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.files import atomic
from jaxpose.files.schema import FARTHEST_M, numbers, rigid_transforms
from jaxpose.files.untrusted import read_npz
from jaxpose.structure import adjust, find_tracks, relative_exposures

# [%] of the points along each axis that the scene's core holds: all but strays, where scenes end; else what
# is near, as what is far is drawn together.
_CORE = {"depth": (0.5, 99.5), "disparity": (10.0, 90.0)}
_MARGIN = 1.3  # times the extent of the points, as surfaces without features go on
_NEARER, _FARTHER = 0.7, 1.3  # times the depths that 98% of observations have
_MOST = 0.75  # of the observations; at least 0.87 with calibrated poses, 0.6 to 0.82 where off as by features
_BRIGHTEST = 1e3  # times brighter than others
_VARY = 0.05  # spread of exposures; 0.006 to 0.034, of shading, where all photographs are exposed alike
_WHAT = "the registration of a run"


class Registered(NamedTuple):
    """Poses that agree with what the photographs share, and the scene that they show."""

    T_world_cam: Float[np.ndarray, "n 4 4"]  # where `supported`; else as at the start
    supported: Bool[np.ndarray, " n"]
    centre: tuple[float, float, float]  # of the scene's core [scene units]
    half: tuple[float, float, float]  # of its sides
    near: float  # depth at which the scene begins [scene units]
    far: float
    points: int
    noise_px: float
    given: bool  # these are the poses of the data, as the photographs agree with them
    exposure: Float[np.ndarray, "n 3"]  # how many times brighter than the average; 1 where all are alike

    @property
    def varied(self) -> bool:
        """Whether photographs are exposed differently."""
        return bool(np.any(self.exposure != 1))


def register(config: Config, problem: Problem, on_update: OnUpdate) -> Registered | None:
    """Find poses by features of the photographs alone; None where these share too little.

    Poses that the data state stay where most of what the photographs share agrees with them: no pose by
    features is as good as a calibrated one.
    """
    photographs = problem.train
    tracks = find_tracks(
        photographs.rgb,
        photographs.camera,
        photographs.mask,
        lambda what, done, total: on_update(Update(f"matching photographs: {what}", done, total, what)),
    )
    error = lambda width, median: on_update(
        Update("adjusting poses", state={"width": f"{width:.2f} px", "error": f"{median:.2f} px"})
    )
    bundle = adjust(tracks, problem.T_start, middle(photographs), error)
    if bundle is None:
        return None
    low, high = np.percentile(bundle.points, _CORE[photographs.spacing], axis=0)
    near, far = np.percentile(bundle.depth, (1, 99))
    centre, half = (low + high) / 2, np.maximum(_MARGIN * (high - low) / 2, 1e-2 * (far - near))
    is_open = photographs.spacing == "disparity"
    given = config.noise == "none" and bundle.start_agrees > _MOST
    exposure = relative_exposures(photographs.rgb, photographs.camera, tracks)
    if np.log(exposure).std() < _VARY:
        exposure = np.ones_like(exposure)
    return Registered(
        problem.T_start if given else bundle.T_world_cam,
        bundle.supported,
        _three(centre),
        _three(half),
        _NEARER * near,
        max(photographs.far, far) if is_open else _FARTHER * far,
        len(bundle.points),
        bundle.noise_px,
        given,
        exposure,
    )


def summary(problem: Problem, registered: Registered | None) -> dict[str, Any]:
    """The registration in numbers, for `results.json`."""
    if registered is None:
        nothing = dict.fromkeys(("noise_px", "given_poses_kept", "rotation_error_deg", "exposure_stops"))
        return {"photographs": 0, "points": 0, **nothing}
    truth = problem.train.T_world_cam
    known = np.isfinite(truth).all()
    error = trajectory_error.pose_errors(registered.T_world_cam, truth).rotation_deg if known else None
    return {
        "photographs": int(registered.supported.sum()),
        "points": registered.points,
        "noise_px": registered.noise_px,
        "given_poses_kept": registered.given,
        "rotation_error_deg": error,
        "exposure_stops": float(np.ptp(np.log2(registered.exposure).mean(axis=1))),
    }


def save(path: Path, registered: Registered) -> None:
    """Write a registration to a file that `load` reads; a far that may be infinite as its disparity."""
    content = registered._asdict()
    content["far_disparity"] = 1 / content.pop("far")
    content |= {"supported": registered.supported.astype(np.uint8), "given": np.uint8(registered.given)}
    with atomic.atomic(path) as temporary:
        np.savez(temporary, **content)


def load(path: Path, count: int) -> Registered:
    """Read the registration of so many photographs; DataError for another file."""
    content = read_npz(path, _WHAT)
    number = lambda key, shape=(), **limits: numbers(path, content, key, shape, **limits)
    T = number("T_world_cam", (count, 4, 4))
    rigid_transforms(path, "T_world_cam", T)
    supported = number("supported", (count,), least=0, most=1)
    half = number("half", (3,), above=0, most=FARTHEST_M)
    near = float(number("near", above=0, most=FARTHEST_M))
    disparity = float(number("far_disparity", least=0, most=1 / near))
    far = 1 / disparity if disparity else np.inf
    centre = number("centre", (3,), least=-FARTHEST_M, most=FARTHEST_M)
    points = int(number("points", whole=True, least=0))
    noise_px = float(number("noise_px", least=0))
    given = bool(number("given", least=0, most=1))
    exposure = number("exposure", (count, 3), above=0, most=_BRIGHTEST)
    return Registered(
        T, supported > 0, _three(centre), _three(half), near, far, points, noise_px, given, exposure
    )


def _three(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
