"""What photographs share, before anything is trained: poses that agree with it, and where the scene is."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxpose.evaluation import trajectory_error
from jaxpose.evaluation.consistency import MEDIAN_CHI2, variance_factor
from jaxpose.experiments.noisy_nerf.options import Config, Problem, middle
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.files import atomic
from jaxpose.files.schema import FARTHEST_M, numbers, rigid_transforms
from jaxpose.files.untrusted import read_npz
from jaxpose.geometry import rigid
from jaxpose.structure import Bundle, adjust, find_tracks, relative_exposures

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
    covariance: Float[np.ndarray, "n 6 6"]  # of right increments; NaN where none is known
    stated_off: float  # times its sigmas, that what was stated is off; NaN where nothing was

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
    information = None if problem.sigmas is None else _information(problem.sigmas)
    bundle = adjust(tracks, problem.T_start, middle(photographs), error, information)
    if bundle is None:
        return None
    low, high = np.percentile(bundle.points, _CORE[photographs.spacing], axis=0)
    near, far = np.percentile(bundle.depth, (1, 99))
    centre, half = (low + high) / 2, np.maximum(_MARGIN * (high - low) / 2, 1e-2 * (far - near))
    is_open = photographs.spacing == "disparity"
    given = config.noise == "none" and information is None and bundle.start_agrees > _MOST
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
        np.full_like(bundle.covariance, np.nan) if given else bundle.covariance,
        math.nan if information is None else _times_off(problem.T_start, bundle, information),
    )


def _information(sigmas: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 6 6"]:
    return np.repeat(sigmas**-2.0, 3, axis=1)[:, :, None] * np.eye(6)


def _times_off(
    T_start: Float[np.ndarray, "n 4 4"], bundle: Bundle, information: Float[np.ndarray, "n 6 6"]
) -> float:
    """How many times their sigmas poses were off, as far as features tell; NaN where they tell nothing."""
    off = rigid.log(rigid.inverse(T_start) @ bundle.T_world_cam)
    told = 6 - np.einsum("nij,nji->n", information, bundle.covariance)  # degrees of freedom
    known = told > 1
    if not known.any():
        return math.nan
    chi2 = np.einsum("ni,nij,nj->n", off, information, off)[known]
    return float(np.sqrt(np.median(chi2 / told[known]) / (MEDIAN_CHI2 / 6)))


class Sigmas(NamedTuple):
    """How sure poses are at the end, and why."""

    of_poses: Float[np.ndarray, "n 2"]  # position [scene units] and rotation [rad], of each axis
    more: float  # times what features say, by how far colours have moved the poses they found

    def numbers(self) -> dict[str, float]:
        """For `results.json`."""
        position, rotation = np.nanmedian(self.of_poses, axis=0).tolist()
        return {"position": position, "rotation_deg": math.degrees(rotation), "times_features": self.more}


def final_sigmas(registered: Registered, T_estimate: Float[np.ndarray, "n 4 4"]) -> Sigmas | None:
    """How sure poses are whose training began at registered ones, in whatever world they are.

    None where nothing is known of it.

    Errors of features are alike in neighbouring photographs, which no residual shows. Colours, which poses
    have followed since, do: covariances by features are as much larger as the poses have moved by them
    (median of squared distances over that of chi-squared), which is too large where colours know more.
    """
    known = np.isfinite(registered.covariance[:, 0, 0])
    if known.sum() < 3:
        return None
    found, covariance = registered.T_world_cam[known], registered.covariance[known]
    to_found = trajectory_error.procrustes(T_estimate[known], found)
    moved = rigid.log(rigid.inverse(found) @ trajectory_error.align(to_found, T_estimate[known]))
    more = variance_factor(moved, covariance)
    of_poses = np.full((len(T_estimate), 2), np.nan)
    of_poses[known] = np.sqrt(more * np.einsum("naiai->na", covariance.reshape(-1, 2, 3, 2, 3)) / 3)
    of_poses[:, 0] /= to_found.scale
    return Sigmas(of_poses, math.sqrt(more))


def summary(problem: Problem, registered: Registered | None) -> dict[str, Any]:
    """The registration in numbers, for `results.json`."""
    if registered is None:
        names = ("noise_px", "given_poses_kept", "rotation_error_deg", "exposure_stops", "stated_off")
        return {"photographs": 0, "points": 0, **dict.fromkeys(names)}
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
        "stated_off": registered.stated_off if math.isfinite(registered.stated_off) else None,
    }


def save(path: Path, registered: Registered) -> None:
    """Write a registration to a file that `load` reads; a far that may be infinite as its disparity."""
    content = registered._asdict()
    content["far_disparity"] = 1 / content.pop("far")
    content |= {"supported": registered.supported.astype(np.uint8), "given": np.uint8(registered.given)}
    content |= {name: np.nan_to_num(content[name]) for name in ("covariance", "stated_off")}  # 0 is none
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
    covariance = number("covariance", (count, 6, 6))
    covariance[~covariance.any(axis=(1, 2))] = np.nan
    stated_off = float(number("stated_off", least=0)) or math.nan
    return Registered(
        T, supported > 0, _three(centre), _three(half), near, far, points, noise_px, given, exposure,
        covariance, stated_off,
    )  # fmt: skip


def _three(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
