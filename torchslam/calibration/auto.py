"""The camera of a run: as given, or found by the images before the run begins."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from torchslam.calibration import Round, calibrate, estimate_intrinsics
from torchslam.calibration.report import contradiction, describe_camera
from torchslam.config import Config
from torchslam.data import Sequence
from torchslam.data.camera_argument import parse_camera
from torchslam.data.sequence import Calibrated
from torchslam.errors import ConfigError
from torchslam.io.calibration_file import check_replaceable, write_calibration
from torchslam.io.results import CALIBRATION
from torchslam.system.run import Run

RADIAL = 2
"""Coefficients of the distortion that may be found."""


def find_camera(
    sequence: Sequence,
    config: Config,
    output: Path,
    device: torch.device,
    radial: int,
    resume: bool = False,
    on_progress: Callable[[str], None] = lambda words: None,
) -> tuple[Sequence, str]:
    """The sequence with the camera that its images ask for, and what there is to say of it; the file is written.

    radial: how many coefficients of the distortion are free
    resume: take the camera of the run that this one goes on with
    told:   what there is to say while it is looked for, line by line
    """
    if config.features.kind == "simulated":
        raise ConfigError("simulated features are made with the camera: there is none to be found")
    path = output / CALIBRATION
    check_replaceable(path)
    if resume and path.exists():
        found = parse_camera(str(path), sequence.size)
        return sequence.with_camera(found), f"as {path} says"
    with warnings.catch_warnings():  # the run itself will say which frames cannot be read
        warnings.simplefilter("ignore", UserWarning)
        calibrated = calibrate(
            sequence,
            config,
            radial,
            sequence.calibrated is Calibrated.GUESSED,
            device,
            on_progress=lambda done: on_progress(_describe_round(done)),
        )
    description = describe_camera(calibrated)
    frames = calibrated.rounds[-1].frames
    remarks = [
        description,
        f"{len(calibrated.rounds)} runs, the last over {frames} of {len(sequence)} frames",
    ]
    if calibrated.refined is not None:
        remarks.append(f"relative standard error of the focal length: {calibrated.refined.std:.2g}")
    write_calibration(path, calibrated.camera, remarks)
    on_progress(description)
    return sequence.with_camera(calibrated.camera.to("cpu")), description


def camera_remark(finished: Run, found: str) -> str:
    """What there is to say of the camera of a run: how it was found, and what the run has against its focal length.

    found: by `find_camera`, empty where the camera was given. Only a first session that was finished is asked.
    """
    against = ""
    if not (finished.failure or finished.interrupted or finished.session):
        against = contradiction(finished.camera, estimate_intrinsics(finished.graph))
    if found:
        return "; but over all frames ".join(filter(None, (found, against)))
    return f"{against}; --refine-camera looks for a better one" if against else ""


def _describe_round(done: Round) -> str:
    focal, refined = float(done.camera.focal), done.refined
    asks = (
        "no map" if refined is None else f"{float(refined.camera.focal):.0f} px, {refined.std:.1%} uncertain"
    )
    return f"{done.frames} frames with {focal:.0f} px ask for {asks}"
