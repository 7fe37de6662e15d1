"""What the SLAM experiments print: progress, then numbers with their protocol."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxpose.experiments.outcome import SMOKE, cost_text, markdown_table
from jaxpose.experiments.progress import Update
from jaxpose.experiments.slam.calibration import calibration_lines
from jaxpose.slam import Progress

_COLUMNS: tuple[str, ...] = ("IMU", "ATE [cm]", "RPE [cm]", "RPE [deg]", "frames lost", "s / frame")


def tracking_update(mode: str, progress: Progress) -> Update:
    """How far tracking is, in words.

    Args:
        mode: of the IMU, and what the run is for.
        progress: the frame that was tracked.

    Returns:
        The update to show.
    """
    frames = progress.state.frames
    loss = float(frames.loss[progress.index])
    state = {"loss": f"{loss:.2f}"} if math.isfinite(loss) else {}  # the first frame has none
    if math.isfinite(progress.ground_truth_error):
        state["off"] = f"{100 * progress.ground_truth_error:.1f} cm"
    state["lost"] = str(int(frames.lost[: progress.index + 1].sum()))
    return Update(f"tracking, IMU {mode}", progress.index + 1, progress.count, "frames", state)


def table(by_mode: dict[str, dict[str, Any]]) -> str:
    """Results of several IMU modes side by side, as the paper's table 13 has them, in Markdown."""
    rows = [_COLUMNS]
    for mode, results in by_mode.items():
        rpe = results.get("rpe")
        rows.append((
            mode,
            _cm(results.get("ate_rmse_m")),
            _cm(rpe and rpe["translation_rmse_m"]),
            "-" if rpe is None else f"{rpe['rotation_rmse_deg']:.3f}",
            f"{results['frames_lost']} of {results['frames']}",
            f"{results['seconds_per_frame']:.2f}",
        ))  # fmt: skip
    return markdown_table(rows)


def report(folder: Path, results: dict[str, Any]) -> str:
    """The numbers of a run, each with its protocol, and where everything is."""
    if "modes" in results:
        modes = results["modes"]
        lines = [_heading(next(iter(modes.values())), "all IMU modes"), "", table(modes), ""]
        lines += ["  ATE: RMSE over all frames after SE(3) alignment; RPE: RMSE from one frame to the next;"]
        lines += ["  s / frame: median after the first two, which compile"]
        lines += [_line("IMU readings", modes["combined"]["imu"]["readings"])]
        lines += _ending(folder, results, modes["none"]["notes"], "comparison.png")
        return "\n".join(lines)
    lines = [_heading(results, f"IMU {results['imu']['mode']}"), ""]
    if results["imu"]["mode"] != "none":
        lines.append(_line("IMU readings", results["imu"]["readings"]))
    if "ate_rmse_m" in results:
        lines += _against_ground_truth(results)
    else:
        lines.append(_line("ATE", "no ground truth to compare with"))
    lines += [
        _line(
            "lost",
            f"{results['frames_lost']} of {results['frames']} frames, "
            f"{results['frames_uncertain']} uncertain",
        ),
        *_loops(results),
        *_bundle(results),
        _line(
            "time per frame",
            f"{results['seconds_per_frame']:.3f} s  median after the first two, which compile; "
            f"{results['seconds_per_frame_mean_with_compilation']:.3f} s mean of all",
        ),
        _line("iterations", f"{results['iterations_mean']:.1f}  mean per frame"),
        _line(
            "final field",
            f"{_cm(results['field_rmse_m'])} cm, {results['field_rmse_deg']:.3f} deg  "
            "RMSE to the tracked poses",
        ),
    ]
    if "line_delay" in results:
        found = results["line_delay"]
        text = f"{found['line_delay_us']:.1f} +- {found['sigma_us']:.1f} us  from row to row"
        unused = "" if found["observed"] else ", not used: this motion says nothing of it"
        lines.append(_line("line delay", text + unused))
    if "calibration" in results:
        lines += [_line(*line) for line in calibration_lines(results["calibration"])]
    if "degrees_of_freedom" in results:
        dof = results["degrees_of_freedom"]
        lines.append(_line(
            "effective DOF",
            f"{dof['before_mean']:.2f}, {dof['after_mean']:.2f} in the intrinsic frame  "
            f"components of [2 alpha / gamma, v / |v|] above {dof['threshold']:g}, mean of all motions",
        ))  # fmt: skip
    lines += _map(results["map"])
    return "\n".join(lines + _ending(folder, results, results["notes"], "trajectory.png"))


def _heading(results: dict[str, Any], imu: str) -> str:
    data = results["data"]
    width, height = data["size"]
    smoke = SMOKE if results["smoke"] else ""
    return (
        f"{results['experiment']}: {data['name']}, {results['frames']} frames of {width}x{height} at "
        f"{data['rate_hz']:.3g} Hz, {imu}, frame {results['reference_frame']}, "
        f"seed {results['seed']}{smoke}"
    )


def _against_ground_truth(results: dict[str, Any]) -> list[str]:
    used = f"{results['frames_with_ground_truth']} of {results['frames']} frames"
    lines = [
        _line(
            "ATE-RMSE",
            f"{_cm(results['ate_rmse_m'])} cm  SE(3) alignment, {used}; "
            f"at most {_cm(results['ate_max_m'])} cm",
        ),
        _line("rotation RMSE", f"{results['rotation_rmse_deg']:.3f} deg  after the same alignment"),
        _line(
            "ATE of the field", f"{_cm(results['field_ate_rmse_m'])} cm  the final field at the frames' times"
        ),
    ]
    rpe = results["rpe"]
    if rpe is not None:
        lines.insert(2, _line(
            "RPE-RMSE",
            f"{_cm(rpe['translation_rmse_m'])} cm, {rpe['rotation_rmse_deg']:.3f} deg  "
            "from one frame to the next",
        ))  # fmt: skip
    return lines


def _bundle(results: dict[str, Any]) -> list[str]:
    """Whether keyframes were adjusted together at the end."""
    bundle = results.get("bundle")  # runs made before it was tried have none
    if bundle is None:
        return []
    if bundle["taken"]:
        moved = f"by up to {_cm(bundle['moved_max_m'])} cm"
        return [
            _line("bundle", f"{bundle['keyframes']} keyframes adjusted together, which moved them {moved}")
        ]
    worse = f"{bundle['depths_apart']:.2f} times as far apart"
    lines = [_line("bundle", f"not taken: depth images are {worse} where features have the keyframes")]
    if "inflation" in bundle:  # which is not known of runs made before it was
        times = f"{bundle['inflation'] ** 0.5:.1f} times as large as tracked"
        lines.append(_line("sigmas by images", f"{times}, which is what features say against them"))
    return lines


def _loops(results: dict[str, Any]) -> list[str]:
    """The loops of a run, and what the trajectory would be without them."""
    loops = results["loops"]
    if not loops["found"]:
        return [_line("loops", "none found")]
    moved = f"{_cm(loops['moved_max_m'])} cm"
    text = f"{loops['believed']} of {loops['found']} believed, which moved the camera by up to {moved}"
    if "ate_rmse_without_loops_m" in results:
        text += f"; ATE-RMSE {_cm(results['ate_rmse_without_loops_m'])} cm without: motions as tracked"
    return [_line("loops", text)]


def _map(quality: dict[str, Any]) -> list[str]:
    """The map at frames it was made from, and at those held out."""
    words = []
    for kind, name in (("mapped", "mapped frames"), ("held_out", "held-out frames")):
        numbers = quality[kind]
        if numbers is not None:
            depth, share = _cm(numbers["depth_l1_m"]), f"{numbers['depth_coverage']:.1%}"
            words.append(
                f"{numbers['psnr']:.2f} dB, depth L1 {depth} cm over {share} of the depth at "
                f"{numbers['frames']} {name}"
            )
    if not words:
        return []
    return [_line("map", "; ".join(words)), _line("", quality["protocol"])]


def _ending(folder: Path, results: dict[str, Any], notes: Sequence[str], picture: str) -> list[str]:
    lines = [_line("cost", cost_text(results)), *(_line("note", note) for note in notes)]
    pictures = sorted(str(path.relative_to(folder)) for path in folder.glob("*.png"))
    return [*lines, _line("pictures", ", ".join(pictures) or picture), _line("written to", str(folder))]


def _line(name: str, text: str) -> str:
    return f"  {name:<17} {text}"


def _cm(metres: float | None) -> str:
    return "-" if metres is None else f"{100 * metres:.2f}"
