"""Find the camera of a sequence before a run, and describe it: uncertainty, and whether the images contradict it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from torchslam.calibration.from_pairs import search_focal
from torchslam.calibration.intrinsics import IntrinsicsEstimate, estimate_intrinsics
from torchslam.config import CameraConfig, Config
from torchslam.data import Sequence
from torchslam.data.calibration import CALIBRATION, check_replaceable, read_numbers, write_calibration
from torchslam.data.sequence import Calibrated
from torchslam.errors import ConfigError
from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.view_graph_focal import ViewGraphFocal
from torchslam.system.front_end import Extractor
from torchslam.system.run import Run

LEAST_STD = 0.05
"""Relative standard deviation of a camera by pairs of images: distortion, of which they know little, is in it."""
STD_FACTOR = 2.0
"""On the stated error of such a focal length: on six recordings they are off by up to three of them."""
GUESS_STD = 0.15
"""The same where pairs do not determine the focal length: phones and webcams have 0.7 to 1 widths, the guess 0.85."""
ROUGH_STD = 0.1
"""The same of a given camera that is to be refined."""


def find_camera(
    sequence: Sequence,
    config: Config,
    output: Path,
    device: torch.device,
    resume: bool = False,
    on_progress: Callable[[str], None] = lambda words: None,
    extract: Extractor | None = None,
) -> tuple[Sequence, str]:
    """Find the focal length of an unknown camera from pairs of images, and write the calibration file.

    Args:
        sequence: With a guessed camera to start from, or none.
        config: Of the run.
        output: Folder of the calibration file.
        device: Of torch.
        resume: Use the camera of the resumed run, if there is one.
        on_progress: Receives messages.
        extract: As in `search_focal`.

    Returns:
        The sequence with its camera and the error of this, and a description of the camera.
    """
    if config.features.kind == "simulated":
        raise ConfigError("simulated features are made with the camera, so it cannot be estimated")
    path = output / CALIBRATION
    check_replaceable(path)
    if resume and path.exists():
        known = read_numbers(path)
        return sequence.with_camera(known.camera(sequence.size), std=known.std), f"from {path}"
    sequence = sequence.with_guess()
    search = search_focal(sequence, config, device, lambda done, most: None, extract)
    camera, std = sequence.camera, GUESS_STD
    if search is not None and search.success:
        ratio = search.focal.detach().to(camera.params) / camera.fx
        camera = camera.with_params(torch.cat([ratio * camera.params[:2], camera.params[2:]]))
        std = max(LEAST_STD, STD_FACTOR * float(search.std))
    description = describe_search(search, camera)
    write_calibration(path, camera, [description], std)
    on_progress(description)
    return sequence.with_camera(camera, std=std), description


def describe_search(search: ViewGraphFocal | None, camera: Camera) -> str:
    """Describe the camera that pairs of images gave, or say that they do not determine it."""
    focal = float(camera.focal)
    if search is None:
        return (
            f"unknown: no two images could be matched; the focal length of {focal:.0f} px is a guess, which may be "
            "wrong by a factor of two"
        )
    pairs = len(search.errors)
    if search.success:
        return f"focal length {_with_error(focal, focal * float(search.std))} px by {pairs} image pairs"
    return (
        f"{pairs} image pairs do not determine it ({DEGENERATE}): "
        f"the focal length of {focal:.0f} px is a guess to start with"
    )


def with_stated_std(config: Config, sequence: Sequence) -> Config:
    """The configuration with the error of the camera that the sequence's calibration states, or that of a guess."""
    if sequence.camera_std is None:
        guessed = sequence.calibrated is Calibrated.GUESSED
        return replace(config, camera=replace(config.camera, guessed=guessed)) if guessed else config
    return replace(config, camera=CameraConfig(std=sequence.camera_std))


def camera_remark(finished: Run, found: str) -> str:
    """Describe the camera of a run: how it was found, its error, and whether the run contradicts the given one.

    Only a complete first session can contradict an exact one.

    Args:
        finished: The run.
        found: Description by `find_camera`, empty for a given camera.
    """
    given = finished.given
    if given is not None and finished.calibration is not None:
        described = describe_calibration(finished.calibration)
        if found:
            return f"{found}; over all frames {described}"
        described += f" (given {float(given.camera.focal):.1f} px)"
        if not _may_contradict(given, finished.calibration):
            return described
        freely = estimate_intrinsics(finished.graph)  # without the prior
        words = contradiction(given.camera, freely) if given.departure(freely.camera) > MIN_SIGMAS else ""
        return f"{described}; {words}; {REMEDY}" if words else described
    against = ""
    if not (finished.failure or finished.interrupted or finished.session):
        against = contradiction(finished.camera, estimate_intrinsics(finished.graph))
    if found:
        return "; but over all frames ".join(filter(None, (found, against)))
    return f"{against}; {REMEDY}" if against else ""


def _may_contradict(given: CameraMeasurement, found: CameraMeasurement) -> bool:
    """Whether images that were free of the given camera might be off from it by `MIN_SIGMAS`.

    What they found together with it is in between, nearer to the one that is better known. To find it freely takes as
    long as the rounds of global mapping.
    """
    share = 1 - (found.focal_std / given.focal_std) ** 2 if given.focal_std > 0 else 0.0
    return given.departure(found.camera) > LEAST_DEPARTURE * MIN_SIGMAS * share


def describe_calibration(found: CameraMeasurement) -> str:
    """Describe the camera that the final adjustment of a run found, with its errors."""
    focal = float(found.camera.focal)
    described = f"focal length {_with_error(focal, focal * found.focal_std)} px"
    terms = zip(found.camera.params[4:6].tolist(), found.radial_std, ("k1", "k2"), strict=False)
    return described + "".join(f", {name} {k:.3f} ± {std:.3f}" for k, std, name in terms)


# The images contradict a given focal length if it is off by this many standard errors and this ratio, or by a larger
# ratio with a relative cost decrease. Tried at these values only.
MIN_SIGMAS, MIN_RATIO = 3.0, 0.01
LEAST_DEPARTURE = 0.5
"""Departure, as a ratio of the one that a contradiction needs, from which on that is looked for. Tried at this value
only."""
LARGE_RATIO, MIN_COST_RATIO = 0.03, 0.02  # the larger ratio and the decrease
REMEDY = "--refine-camera looks for a better one"
CONSEQUENCE = "poses and map may be badly wrong with it"
DEGENERATE = "pure rotation, straight motion and planes do not determine it"


def contradiction(given: Camera, estimate: IntrinsicsEstimate) -> str:
    """Describe how the images contradict a given focal length; empty if they do not.

    Args:
        estimate: with only the focal length free.
    """
    was, focal = float(given.focal), float(estimate.camera.focal)
    off = abs(math.log(focal / was))
    lower = 1 - estimate.cost / estimate.initial_cost if estimate.initial_cost > 0 else 0.0
    certain = off > max(MIN_RATIO, MIN_SIGMAS * estimate.conditional_focal_std)
    if not certain and not (off > LARGE_RATIO and lower > MIN_COST_RATIO):
        return ""
    if not estimate.is_determined:
        return f"the images contradict a focal length of {was:.0f} px and do not determine the right one; {CONSEQUENCE}"
    better = "the images agree better with a focal length of"
    if off <= LARGE_RATIO:
        return f"{better} {_focal(estimate, estimate.conditional_focal_std)} than with {was:.0f}"
    # A run with a camera far off chooses matches that support it, so the estimate falls short of the right one.
    return (
        f"{better} {focal:.0f} px or {'more' if focal > was else 'less'} than with {was:.0f}; {CONSEQUENCE}"
    )


def _focal(estimate: IntrinsicsEstimate, std: float) -> str:
    focal = float(estimate.camera.focal)
    return f"{_with_error(focal, focal * std)} px"


def _with_error(value: float, std: float) -> str:
    return f"{value:.0f} ± {std:.0f}" if std >= 1 else f"{value:.1f} ± {std:.1f}"
