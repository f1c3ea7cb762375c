"""Is a recording's map right, and does mapping it as a whole make it right? See README.md."""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.common import (
    add_engine,
    available,
    cached_run,
    check,
    focal_of,
    parser_of,
    place_of,
    publish,
    run_cases,
    table,
)
from torchslam.batch import DONE, Columns
from torchslam.batch.result_store import RUNS
from torchslam.batch.rows import short_name
from torchslam.calibration.find_camera import find_camera, with_stated_std
from torchslam.config import Config
from torchslam.data import open_sequence, read_trajectory
from torchslam.data.sequence import Calibrated
from torchslam.data.trajectories import nearest, write_trajectory
from torchslam.errors import TrajectoryError
from torchslam.evaluation import MIN_POSES, evaluate
from torchslam.geometry import umeyama
from torchslam.global_mapping.recording import MappedRun, Mapping, run_recording
from torchslam.system.online_run import OnlineRun
from torchslam.system.run import Run
from torchslam.system.slam import SLAM
from torchslam.types import Trajectory

HERE = Path(__file__).parent
NAMES = ["garden", "office_loop", "courthouse"]
MODES = (Mapping.ONLINE, Mapping.GLOBAL)
HEADER = "sequence | mapping | posed | error | pairs that agree | breaks | focal length (px) | CPU (s)"
GROUNDTRUTH = "groundtruth.txt"
SAME_TIME = 1e-3
"""Seconds: poses of two programs are of the same image within it."""
NEAR, WIDE = 0.02, 0.05
"""Distances, as ratios of the extent of the peer's path, within which positions count; the alignment uses the first."""
_SAMPLES, _STEPS = 2000, 20
_DPI = 80
_STYLES = {"ground truth": "0.6", "online": "tab:orange", "global": "tab:blue"}


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--sequences", nargs="+", default=NAMES, metavar="NAME")
    parser.add_argument(
        "--peer", type=Path, metavar="DIR", help="of another program, as DIR/NAME/trajectory.txt"
    )
    parser.add_argument("--unknown-camera", action="store_true", help="do not use given cameras")
    parser.add_argument("--limit", type=int, metavar="N", help="only the first N frames")
    add_engine(parser, "global_mapping")
    options = parser.parse_args()
    output = options.output.absolute()
    cases = [
        {
            "sequence": name,
            "name": label_of(name, options),
            "unknown": options.unknown_camera,
            "limit": options.limit,
            "output": str(output),
        }
        for name in available(options.sequences)
    ]
    found = run_cases(attempt, cases, options, lambda columns: print(columns["name"], columns["status"]))
    check(found)
    rows, text = list[list[str]](), ""
    for case, columns in zip(cases, found, strict=True):
        folder = output / RUNS / case["name"]
        rows += [cells(case["sequence"], outcome, folder, options.peer) for outcome in columns["outcomes"]]
        if (folder / GROUNDTRUTH).exists():
            place = output if options.no_readme else HERE
            picture = draw(folder, place / f"{case['name']}.png")
            text += f"\n![{case['sequence']} from above]({picture.name})\n"
    publish(table(HEADER, rows) + text, options, __file__)


def label_of(name: str, options: argparse.Namespace) -> str:
    """The name of the results of a sequence with the options that change them."""
    words = [short_name(name.removeprefix("synthetic:"))]
    words += ["unknown"] if options.unknown_camera else []
    words += [str(options.limit)] if options.limit else []
    return "_".join(words)


def attempt(case: Columns) -> Columns:
    """Map a sequence in both ways unless that was done before; returns the `outcomes` of both. Never raises.

    case: `sequence`; `name` of the results; `unknown`: whether a given camera is ignored; `limit`: number of frames;
        `output`: folder of the results
    """

    def work(folder: Path) -> Columns:
        torch.set_num_threads(1)
        return {"status": DONE, "outcomes": mapped(case, folder)}

    settings = [str(case["unknown"]), str(case["limit"])]
    return cached_run(case["name"], case["sequence"], settings, work, case["output"], HERE)


def mapped(case: Columns, folder: Path) -> list[Columns]:
    """Map frame by frame, and as a whole; writes the trajectories and returns the outcome of either mapping."""
    device = torch.device("cpu")
    start = time.process_time()
    sequence = open_sequence(
        place_of(case["sequence"]), "auto" if case["unknown"] else None, limit=case["limit"]
    )
    config = Config()
    if sequence.calibrated is not Calibrated.GIVEN:
        sequence, _ = find_camera(sequence, config, folder, device)
    config = with_stated_std(config, sequence)
    before = time.process_time() - start
    outcomes = []
    for mode in MODES:
        start = time.process_time()
        made = run_recording(OnlineRun(SLAM(sequence.camera, config), sequence), sequence, mode)
        seconds = before + time.process_time() - start
        if not made.failure:
            write_trajectory(folder / f"{mode.value}.txt", made.trajectory)
        outcomes.append(outcome_of(mode, made, seconds, sequence.groundtruth))
    if sequence.groundtruth is not None:
        write_trajectory(folder / GROUNDTRUTH, sequence.groundtruth)
    return outcomes


def outcome_of(mode: Mapping, run: MappedRun, seconds: float, groundtruth: Trajectory | None) -> Columns:
    """The figures of a mapping as JSON values; `ate_m` is None without ground truth or map."""
    checked = run.check
    return {
        "mapping": mode.value,
        "kept": (run.kept or mode).value,
        "posed": len(run.trajectory),
        "frames": len(run.results) + len(run.skipped),
        "failure": run.failure,
        "ate_m": ate_of(run, groundtruth),
        "pairs": None if checked is None else [checked.agreeing, checked.pairs],
        "breaks": None if checked is None else [str(each) for each in checked.breaks],
        "focal": focal_of(run),
        "cpu_s": seconds,
    }


def ate_of(run: Run, groundtruth: Trajectory | None) -> float | None:
    """ATE in meters, if it can be computed."""
    if groundtruth is None or run.failure:
        return None
    try:
        return evaluate(run.trajectory, groundtruth).ate_m
    except TrajectoryError:
        return None


def cells(name: str, outcome: Columns, folder: Path, peer: Path | None) -> list[str]:
    """A row of the table."""
    mapping, kept, pairs, breaks = (outcome[key] for key in ("mapping", "kept", "pairs", "breaks"))
    return [
        name,
        mapping if mapping == kept else f"{mapping}, but {kept} was kept",
        f"{outcome['posed']} of {outcome['frames']}",
        error_of(name, outcome, folder, peer),
        f"{pairs[0] / pairs[1]:.1%} of {pairs[1]}" if pairs and pairs[1] else "not checked",
        "" if breaks is None else str(len(breaks)),
        outcome["focal"],
        f"{outcome['cpu_s']:.0f}",
    ]


def error_of(name: str, outcome: Columns, folder: Path, peer: Path | None) -> str:
    """ATE, or else the difference to the peer."""
    if outcome["failure"]:
        return str(outcome["failure"])
    if outcome["ate_m"] is not None:
        return f"ATE {outcome['ate_m']:.3g} m"
    path = None if peer is None else peer / name / "trajectory.txt"
    if path is None or not path.is_file():
        return "nothing to compare with"
    errors = difference(read_trajectory(folder / f"{outcome['mapping']}.txt"), read_trajectory(path))
    if errors is None:
        return "too few common images"
    shares = (f"{float((errors < limit).double().mean()):.0%} within {limit:.0%}" for limit in (NEAR, WIDE))
    return f"median {float(errors.median()):.2%} of the extent, {', '.join(shares)}"


def difference(estimate: Trajectory, peer: Trajectory) -> Float[Tensor, " N"] | None:
    """Distances of the positions of common images after a robust alignment, as ratios of the extent of the peer's path.

    The extent is the diagonal of the box around all positions. None where too few images are common.
    """
    index, apart = nearest(estimate.timestamps.double(), peer.timestamps.double())
    same = apart < SAME_TIME
    if int(same.sum()) < MIN_POSES:
        return None
    source, target = estimate.positions_w[same].double(), peer.positions_w[index[same]].double()
    extent = (peer.positions_w.amax(0) - peer.positions_w.amin(0)).norm().double()
    return robust_errors(source, target, NEAR * extent) / extent


def robust_errors(
    source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"], near: Float[Tensor, ""]
) -> Float[Tensor, " N"]:
    """Distances after the similarity with which most points are near, which those that are not hardly change.

    The best of random triples by truncated squares, then iteratively reweighted least squares with a Cauchy kernel.
    """
    draws = torch.rand(_SAMPLES, len(source), generator=torch.Generator().manual_seed(0))
    rows = draws.topk(MIN_POSES, dim=1).indices
    errors = _distances(umeyama(source[rows], target[rows]), source, target)
    best = (errors / near).square().clamp(max=1.0).sum(-1).argmin()
    found = errors[best]
    for _ in range(_STEPS):
        weights = 1 / (1 + (found / near).square())
        found = _distances(umeyama(source, target, weights), source, target)
    return found


def _distances(
    similarity: tuple[Tensor, Tensor, Tensor], source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"]
) -> Float[Tensor, "*batch N"]:
    s, R, t = similarity
    return (s[..., None, None] * (source @ R.mT) + t[..., None, :] - target).norm(dim=-1)


def draw(folder: Path, path: Path) -> Path:
    """Draw the true path and the aligned ones from above, in the plane of the two largest extents of the true one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    truth = read_trajectory(folder / GROUNDTRUTH)
    paths: dict[str, Tensor] = {"ground truth": truth.positions_w}
    for mode in MODES:
        if (file := folder / f"{mode.value}.txt").exists():
            with contextlib.suppress(TrajectoryError):  # too few poses to align
                paths[mode.value] = evaluate(read_trajectory(file), truth).aligned.positions_w
    center = truth.positions_w.mean(0)
    axes = torch.linalg.svd(truth.positions_w - center, full_matrices=False).Vh[:2]
    figure, plot = plt.subplots(figsize=(6, 5), dpi=_DPI)
    for label, positions_w in paths.items():
        _line(plot, (positions_w - center) @ axes.mT, label)
    plot.set_aspect("equal", "datalim")
    plot.set_xlabel("m")
    plot.set_ylabel("m")
    plot.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=_DPI)
    plt.close(figure)
    return path


def _line(plot: Any, points: Float[Tensor, "N 2"], label: str) -> None:
    width = 3.0 if label == "ground truth" else 1.2
    plot.plot(*points.mT.tolist(), color=_STYLES[label], linewidth=width, label=label)


if __name__ == "__main__":
    main()
