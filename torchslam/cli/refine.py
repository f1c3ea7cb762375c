"""Refine the poses of another program from the images and write them in their original format.

The input is a COLMAP model, a transforms.json or a TUM trajectory, for example of a phone, a network or another SLAM
system. Features are matched and triangulated; then poses, points and, where the images contradict it, the focal length
are adjusted. The results are those of `torchslam run`, in the frame and unit of the given poses, or in meters with one
of the options for metric scale; refined/ has the poses in their original format, with covariances. Images without a
pose and poses without an image are ignored.

Exit status: 0 done, 2 an error, 3 no map could be built from the images.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import torch

from torchslam.cli import arguments
from torchslam.data import Sequence
from torchslam.data.calibration import CALIBRATION, check_replaceable, is_found, write_calibration
from torchslam.data.formats.given_poses import read_poses
from torchslam.data.sequence import Calibrated
from torchslam.data.synthetic.sequence import is_synthetic
from torchslam.errors import ConfigError, SequenceError
from torchslam.geometry.camera_measurement import with_radial_terms
from torchslam.io.report import compute_metrics, summary
from torchslam.io.results import prepare
from torchslam.io.write_run import source_of, write_run
from torchslam.refine import CameraChoice, RefinementResult, refine_poses
from torchslam.refine.files import write_refined
from torchslam.system.metric_run import run_in_meters
from torchslam.utils.console import say, table, warn

MAX_CONTRADICTED = 0.5
"""Share of image pairs that contradict the given poses, beyond which a remark says so. Tried at this value only."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam refine`."""
    arguments.add_sequence(parser)
    parser.add_argument(
        "--poses",
        required=True,
        metavar="FILE|DIR",
        help="TUM trajectory, COLMAP model (folder with images.bin or images.txt), or transforms.json. Its camera is "
        "used unless --camera is given",
    )
    arguments.add_output(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace the results in the folder")
    camera = parser.add_mutually_exclusive_group()
    camera.add_argument(
        "--refine-camera",
        action="store_true",
        help="refine the focal length wherever the images determine it, not only where they contradict the given one",
    )
    camera.add_argument("--fix-camera", action="store_true", help="keep the camera fixed")
    parser.add_argument(
        "--refine-distortion", action="store_true", help="also refine k1 and k2, if the images require them"
    )
    arguments.add_metric(parser)
    arguments.add_device(parser)
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam refine`; returns the exit status."""
    if options.fix_camera and options.refine_distortion:
        raise ConfigError("--refine-distortion cannot be combined with --fix-camera")
    given = read_poses(options.poses, with_camera=options.camera is None)
    calibration = given.calibration
    if is_synthetic(options.path):  # which is opened with a camera of its own alone
        sequence = arguments.sequence(options)
        if calibration is not None:
            sequence = sequence.with_camera(calibration.camera(sequence.size))
    else:
        sequence = arguments.sequence(options, calibration)
    if sequence.known_length is None:
        raise SequenceError(f"{sequence.name}: a live source has no poses to refine")
    if sequence.calibrated is Calibrated.MISSING:
        say("no calibration found; estimating intrinsics from the images")
    sequence = sequence.with_guess()
    is_guess = sequence.calibrated is Calibrated.GUESSED
    choice = CameraChoice.FREE if options.refine_camera or is_guess else CameraChoice.IF_CONTRADICTED
    if options.fix_camera:
        choice = CameraChoice.FIXED
    # Coefficients of the distortion that may be found.
    radial = 2 if options.refine_distortion or (is_guess and not options.fix_camera) else 0
    config = arguments.config(options)
    # What a dataset brings along counts where it is asked for alone: the unit of the given poses stays otherwise.
    sources = arguments.metric_sources(replace(config.metric, own=False), sequence)
    prepare(options.output, options.overwrite, resume=False)
    check_replaceable(options.output / CALIBRATION)
    refined = refine_poses(sequence, given, config, choice, radial, options.device, on_progress=say)
    refined = replace(refined, run=run_in_meters(refined.run, sequence, sources))
    metrics = _write(refined, sequence, options)
    words = f"{len(given)} from {given.path}"
    if refined.without_image:
        words += f"; {refined.without_image} have no image"
    if refined.without_pose:
        words += f"; {refined.without_pose} of {len(sequence)} images have no pose"
    if refined.kept:
        words += "; the images do not improve on them: kept"
    rows = {"poses": words} | summary(metrics)
    if not refined.run.failure:
        rows["check"] = refined.check
        rows["refined"] = str(write_refined(options.output / "refined", refined))
    rows["results"] = str(options.output)
    if "online ATE" in rows:
        rows["ATE as given"] = rows.pop("online ATE")
    print(f"\n{sequence.name}\n{table(rows)}")
    contradicted = 1 - refined.agreeing
    remarks = [
        f"{contradicted:.0%} of the image pairs contradict the given poses, in every convention that was tried: only "
        "their frame and unit were used"
    ] * (contradicted > MAX_CONTRADICTED)
    for line in [*remarks, *(metrics["metric"] or {}).get("remarks", ()), *metrics.get("unmeasured", ())]:
        warn(line)
    if refined.run.failure:
        say(refined.run.failure)
        return 3
    return 0


def _write(refined: RefinementResult, sequence: Sequence, options: argparse.Namespace) -> dict[str, Any]:
    """Evaluate and write the refined run; returns the metrics."""
    finished = refined.run
    camera = _describe_camera(refined, sequence, options.fix_camera)
    metrics = compute_metrics(finished, sequence, camera, warn)
    metrics |= {
        "focal_px": [float(sequence.camera.focal), float(finished.camera.focal)],
        "without_pose": refined.without_pose,
        "without_image": refined.without_image,
        "rounds": refined.rounds,
    } | source_of(options.path, options.fps, sequence)
    path = options.output / CALIBRATION
    if not torch.equal(finished.camera.params.cpu(), sequence.camera.params):
        write_calibration(path, finished.camera, [camera])
    elif is_found(path):
        path.unlink()
    write_run(finished, sequence, metrics, options.output, viewer=False)
    return metrics


def _describe_camera(refined: RefinementResult, sequence: Sequence, is_fixed: bool) -> str:
    """Return how the camera was determined."""
    found, focal = refined.run.calibration, float(refined.run.camera.focal)
    origin = "as given" if sequence.calibrated is Calibrated.GIVEN else "a guess"
    params = with_radial_terms(refined.run.camera).params.cpu()
    if torch.equal(params, with_radial_terms(sequence.camera).params):
        words = f"focal length {focal:.1f} px, {origin}"
        return words if is_fixed or refined.run.failure else f"{words}; the images do not contradict it"
    std = "" if found is None else f" ± {focal * found.focal_std:.1f}"
    return f"focal length {focal:.1f}{std} px from the images, {float(sequence.camera.focal):.1f} {origin}"
