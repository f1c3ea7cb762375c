"""Can the system find the camera of its images, and how certain is it? See README.md."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from experiments.common import (
    PosedSequence,
    add_engine,
    cached_run,
    check,
    parser_of,
    place_of,
    run_cases,
    table,
    write_between,
)
from torchslam.batch import DONE, Columns
from torchslam.batch.result_store import RECORD, RUNS, read_record
from torchslam.calibration import search_focal
from torchslam.calibration.find_camera import GUESS_STD, LEAST_STD, STD_FACTOR, camera_remark, with_stated_std
from torchslam.config import Config, load_config
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.evaluation import MIN_POSES, evaluate
from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.view_graph_focal import ViewGraphFocal
from torchslam.global_mapping.recording import map_recording
from torchslam.system.front_end import Simulated, true_poses
from torchslam.system.run import Run
from torchslam.system.slam import SLAM

HERE = Path(__file__).parent
WRONG = 1.2  # how far off a given focal length is that a run should warn of
HEADER = (
    "sequence | by pairs: f (px) | over all frames: f (px), k1, k2 | of COLMAP, else given | off, by pairs"
    " | off, over all frames | posed | ATE (m) | ATE, given camera (m) | CPU (s)"
)


@dataclass(frozen=True)
class Case:
    """A sequence to find the camera of.

    peer:   COLMAP's focal length, from images with the principal point given and no distortion but for the drone's;
            None: the given one is the reference
    frames: only the first so many
    """

    name: str
    peer: float | None = None
    frames: int | None = None
    overrides: tuple[str, ...] = ()

    @property
    def simulated(self) -> bool:
        return "features.kind=simulated" in self.overrides


SIMULATED = ("features.kind=simulated", "simulated.points_per_view=300", "simulated.noise_px=0.5")
CASES = {
    "simulated": Case("synthetic:room", frames=120, overrides=SIMULATED),
    "rendered": Case("synthetic:room"),
    "redkitchen": Case("redkitchen", 540.32),
    "kitti07": Case("kitti07", 685.42),
    "machine_hall": Case("machine_hall"),
    "shelf_bin": Case("shelf_bin"),
    "fr2_desk_20": Case("fr2_desk_20"),
    "drone": Case("drone.mp4", 553.29),
}


def wide_angle() -> Camera:
    """A camera with the distortion of a wide-angle lens, for the simulated cases."""
    return Camera.radial_tangential(460.0, 460.0, 319.5, 239.5, -0.28, 0.07, 0.0, 0.0, size=(640, 480))


def scaled(camera: Camera, factor: float) -> Camera:
    """The camera with `factor` times the focal length."""
    return camera.with_params(torch.cat([factor * camera.params[:2], camera.params[2:]]))


def open_case(case: Case) -> tuple[Sequence, Sequence | None, Config]:
    """The sequence as if nothing were known of its camera; with the given one, if there is."""
    config = load_config(None, case.overrides)
    path = place_of(case.name)
    unknown = open_sequence(path, "auto", limit=case.frames)
    if case.simulated:
        known: Sequence | None = open_sequence(path, limit=case.frames)
        assert known is not None
        T_cw = true_poses(known)
        known = PosedSequence(known.name, wide_angle(), se3_inverse(T_cw), known.timestamps)
        known = Simulated(config, wide_angle(), T_cw).of(known)
        return known.with_camera(unknown.camera), known, config
    known = open_sequence(path, limit=case.frames) if Path(path).suffix != ".mp4" else None
    return unknown, known, config


def found(label: str, case: Case) -> list[str]:
    """Find the camera of a case, run with it and with the given one, and return the row of the table."""
    unknown, known, config = open_case(case)
    start = time.process_time()
    search = search_focal(unknown, config)
    sequence = with_found(unknown, search)
    run = recorded(sequence, config)
    seconds = time.process_time() - start
    given = None if known is None else recorded(known, config)
    reference = case.peer or (math.nan if known is None else float(known.camera.focal))
    row = [
        label,
        describe_search(search),
        describe_run(run.calibration),
        f"{reference:.1f}",
        "" if search is None or not search.success else off(sequence.camera, reference),
        "" if run.calibration is None else off(run.calibration.camera, reference),
        f"{len(run.trajectory)} of {len(unknown)}",
        error_of(run, unknown),
        "" if given is None or known is None else error_of(given, known),
        f"{seconds:.0f}",
    ]
    print(" | ".join(row), flush=True)
    return row


def with_found(unknown: Sequence, search: ViewGraphFocal | None) -> Sequence:
    """The sequence with the camera that pairs gave, and the error that a run states for it; else with the guess."""
    if search is None or not search.success:
        return unknown.with_camera(unknown.camera, std=GUESS_STD)
    params = unknown.camera.params
    focal = search.focal.to(params).expand(2)
    camera = unknown.camera.with_params(torch.cat([focal, params[2:]]))
    return unknown.with_camera(camera, std=max(LEAST_STD, STD_FACTOR * float(search.std)))


def recorded(sequence: Sequence, config: Config) -> Run:
    """A run as `torchslam run` makes it: online, then as a whole where frames were lost or the check says so."""
    config = with_stated_std(config, sequence)
    online = SLAM(sequence.camera, config).run(sequence)
    return map_recording(sequence, online, config, sequence.camera).run


def describe_search(search: ViewGraphFocal | None) -> str:
    """The focal length by pairs with its standard error."""
    if search is None or not search.success:
        return f"not determined by {0 if search is None else len(search.errors)} pairs"
    focal = float(search.focal)
    return f"{focal:.1f} ± {focal * float(search.std):.1f} ({len(search.errors)})"


def describe_run(found: CameraMeasurement | None) -> str:
    """Focal length and distortion of the final adjustment, with their standard errors."""
    if found is None:
        return "no map"
    focal = float(found.camera.focal)
    terms = zip(found.camera.params[4:6].tolist(), found.radial_std, strict=False)
    words = [f"{focal:.1f} ± {focal * found.focal_std:.1f}", *(f"{k:.3f} ± {std:.3f}" for k, std in terms)]
    return ", ".join(words)


def off(camera: Camera, reference: float) -> str:
    """How far the focal length is from the reference."""
    return f"{100 * (float(camera.focal) / reference - 1):+.1f} %"


def error_of(run: Run, sequence: Sequence) -> str:
    """ATE in meters."""
    if sequence.groundtruth is None or len(run.trajectory) < MIN_POSES:
        return ""
    return f"{evaluate(run.trajectory, sequence.groundtruth).ate_m:.3g}"


def warned(label: str, case: Case) -> None:
    """Remarks of runs whose focal lengths are too large and too small."""
    _, known, config = open_case(case)
    if known is None:
        return
    for factor in (1 / WRONG, 1.0, WRONG):
        camera = scaled(known.camera.to(torch.float64), factor)
        run = SLAM(camera, config).run(known.with_camera(camera))
        said = run.failure or camera_remark(run, "") or "nothing"
        print(f"{label}, given {float(camera.focal):.1f} px: {said}", flush=True)


def attempt(case: Columns) -> Columns:
    """Find the camera of a case unless that was done before; returns its row as `cells`. Never raises.

    case: its `label`; `output`: folder of the results
    """

    def work(folder: Path) -> Columns:
        torch.set_num_threads(1)
        return {"status": DONE, "cells": found(case["label"], CASES[case["label"]])}

    return cached_run(case["label"], case["label"], [], work, case["output"], HERE)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("labels", nargs="*", choices=[[], *CASES], help="cases to run; all by default")
    parser.add_argument(
        "--warnings", action="store_true", help="what runs with a wrong focal length say, instead"
    )
    add_engine(parser, "self_calibration")
    arguments = parser.parse_args()
    labels = [label for label in CASES if not arguments.labels or label in arguments.labels]
    if arguments.warnings:
        torch.set_num_threads(1)
        for label in labels:
            warned(label, CASES[label])
        return
    output = arguments.output.absolute()
    cases = [{"label": label, "output": str(output)} for label in labels]
    check(run_cases(attempt, cases, arguments, lambda columns: print(columns["name"], columns["status"])))
    records = [read_record(output / RUNS / label / RECORD) for label in CASES]
    text = table(HEADER, [record["cells"] for record in records if record])
    write_between(HERE / "README.md", text)


if __name__ == "__main__":
    main()
