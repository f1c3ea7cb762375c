"""Find the camera of a sequence before a run, and describe it: uncertainty, and whether the images contradict it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from torchslam.calibration import Round, calibrate, estimate_intrinsics
from torchslam.calibration.intrinsics import Refinement
from torchslam.calibration.rounds import FoundCamera
from torchslam.config import Config
from torchslam.data import Sequence
from torchslam.data.camera_argument import parse_camera
from torchslam.data.sequence import Calibrated
from torchslam.errors import ConfigError
from torchslam.geometry import Camera
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


# When the images contradict a given focal length: by so many standard errors and this share, or by a larger share
# with a cost that is lower by a share of its own.
CERTAIN, NOTABLE = 3.0, 0.01
LARGE, LOWER = 0.03, 0.02
SUFFERS = "poses and map may be badly wrong with it"
OPEN = "pure rotation, a straight way and a plane leave it open"


def describe_camera(calibrated: FoundCamera) -> str:
    """The camera that was found and its standard errors, or that it is not determined and how wrong it may be."""
    camera, refined = calibrated.camera, calibrated.refined
    if refined is None:
        return (
            f"unknown: no map could be made; the focal length of {float(camera.focal):.0f} px is a guess, which may be "
            "wrong by a factor of two"
        )
    if not refined.is_determined:
        wrong = f"{200 * refined.std:.0f} %" if refined.std < 0.5 else "a factor of two"
        return (
            f"not determined by the motion ({OPEN}): the focal length of {float(camera.focal):.0f} px may be wrong "
            f"by {wrong}"
        )
    terms = zip(camera.params[4:6].tolist(), refined.k_std, ("k1", "k2"), strict=False)
    bends = [f"{name} {k:.3f} ± {std:.3f}" for k, std, name in terms]
    return ", ".join([f"focal length {_focal(refined, refined.std)}", *(bends or ["no other distortion"])])


def contradiction(given: Camera, refined: Refinement) -> str:
    """That the images agree better with another focal length than the given one, empty where they do not.

    refined: with the focal length alone free
    """
    was, focal = float(given.focal), float(refined.camera.focal)
    off = abs(math.log(focal / was))
    lower = 1 - refined.cost / refined.cost_before if refined.cost_before > 0 else 0.0
    certain = off > max(NOTABLE, CERTAIN * refined.given_rest)
    if not certain and not (off > LARGE and lower > LOWER):
        return ""
    if not refined.is_determined:
        return (
            f"the images contradict a focal length of {was:.0f} px and do not say which is right; {SUFFERS}"
        )
    better = "the images agree better with a focal length of"
    if off <= LARGE:
        return f"{better} {_focal(refined, refined.given_rest)} than with {was:.0f}"
    # A run chooses its matches by the camera it has: far off, they lead only most of the way to the right one.
    return f"{better} {focal:.0f} px or {'more' if focal > was else 'less'} than with {was:.0f}; {SUFFERS}"


def _focal(refined: Refinement, std: float) -> str:
    focal = float(refined.camera.focal)
    error = focal * std
    return f"{focal:.0f} ± {error:.0f} px" if error >= 1 else f"{focal:.1f} ± {error:.1f} px"
