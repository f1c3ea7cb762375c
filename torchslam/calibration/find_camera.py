"""Find the camera of a sequence before a run, and describe it: uncertainty, and whether the images contradict it.

The focal length of an unknown camera comes from pairs of images, within a bounded time. Fundamental matrices of images
at several distances in time, around places spread over the recording, need no camera; the focal length turns them into
essential matrices (`geometry.view_graph_focal`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.data import Sequence
from torchslam.data.calibration import CALIBRATION, check_replaceable, read_numbers, write_calibration
from torchslam.data.sequence import Calibrated
from torchslam.errors import ConfigError, FrameError
from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.view_graph_focal import ViewGraphFocal, focal_from_pairs
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.optim.sensor_estimate import keyframe_evidence
from torchslam.system.front_end import Extractor, image_extractor
from torchslam.system.run import Run
from torchslam.tracking.data_association import match_views
from torchslam.types import FrameFeatures

PLACES = 20
"""Places of the recording at which images are matched; about the number from which the focal length is stable."""
OFFSETS = 0, 2, 5, 12, 30
"""Images of a place, in frames from its first: some pairs have a parallax at any speed and frame rate."""
NUM_KEYPOINTS = 1500
"""SIFT keypoints of an image, for matches between images 30 frames apart. Tried at this value only."""
THRESHOLD_PX = 1.0
"""Distance from the epipolar line; as fundamental matrices of SIFT are usually estimated."""
CONFIDENCE, MAX_SAMPLES = 0.9999, 2000
"""Of MAGSAC, and its largest number of samples. Tried at these values only."""
MIN_MATCHES = 40
"""Matches that agree with a fundamental matrix: its noise is known then."""
MAX_PAIRS = 100
"""Pairs that are used, those furthest apart in time first: they have most parallax."""
LEAST_STD = 0.05
"""Relative standard deviation of a camera by pairs of images: distortion, of which they know little, is in it."""
STD_FACTOR = 2.0
"""On the stated error of such a focal length: on six recordings they are off by up to three of them."""
GUESS_STD = 0.15
"""The same where pairs do not determine the focal length: phones and webcams have 0.7 to 1 widths, the guess 0.85."""
ROUGH_STD = 0.1
"""The same of a given camera that is to be refined."""
OPTIONS = GRAPH_OPTIONS.replace(iterations=400, tolerance=1e-6, backward="detached")
"""Of the adjustment with a camera that may be far off: all depths change with it, in up to 200 iterations. Tried at
these values only."""


def search_focal(
    sequence: Sequence,
    config: Config,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, most: None,
    extract: Extractor | None = None,
) -> ViewGraphFocal | None:
    """Find the focal length by pairs of images; unreadable images are left out, the run itself reports them.

    Args:
        sequence: with a guessed camera, of which the principal point and fy / fx are used.
        config: of the run.
        device: of torch.
        progress: called with the number of images done, and of all.
        extract: extracts SIFT features of an image, at least `NUM_KEYPOINTS`, the strongest first; None: SIFT with
            this number.

    Returns:
        fx with its standard error, and `success` if the pairs determine it; None if no two images could be matched.
    """
    settings = replace(config.features, kind="sift", num_keypoints=NUM_KEYPOINTS)
    config = replace(config, features=settings)
    if sequence.brings_features:
        extract = None
    elif extract is None:
        extract = image_extractor(config, device)
    last = max(len(sequence) - 1 - OFFSETS[-1], 0)
    starts = sorted({round(last * place / max(PLACES - 1, 1)) for place in range(PLACES)})
    wanted = sorted(
        {start + offset for start in starts for offset in OFFSETS if start + offset < len(sequence)}
    )
    views: dict[int, FrameFeatures] = {}
    for done, index in enumerate(wanted):
        progress(done, len(wanted))
        try:
            frame = sequence[index]
        except FrameError:
            continue
        with torch.inference_mode():
            features = frame.features if extract is None else extract(frame)
        assert features is not None
        if extract is not None:
            features = features.rows(slice(NUM_KEYPOINTS))
        views[index] = FrameFeatures.of(frame, features, sequence.camera.params.double())
    matched: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor] | None] = {}
    scale = config.features.reduction(sequence.camera.size)
    for start in starts:
        around = [start + offset for offset in OFFSETS if start + offset in views]
        for one, other in combinations(around, 2):
            if (one, other) not in matched:
                matched[one, other] = _fundamental(views[one], views[other], config, scale)
    widest = sorted(matched, key=lambda pair: pair[0] - pair[1])
    chosen = [pair for pair in (matched[ends] for ends in widest) if pair is not None][:MAX_PAIRS]
    return _solve(chosen, sequence.camera, scale) if chosen else None


def _fundamental(
    one: FrameFeatures, other: FrameFeatures, config: Config, scale: float
) -> tuple[Tensor, Tensor, Tensor] | None:
    """F (3, 3) and the matches (M, 2) of either image that agree with it; None if there are too few."""
    at_1, at_2 = match_views(one, other, config.matching)
    if len(at_1) < MIN_MATCHES:
        return None
    pixels_1, pixels_2 = one.keypoints[at_1].cpu(), other.keypoints[at_2].cpu()
    try:
        F, mask = cv2.findFundamentalMat(
            pixels_1.numpy(), pixels_2.numpy(), cv2.USAC_MAGSAC, THRESHOLD_PX * scale, CONFIDENCE, MAX_SAMPLES
        )
    except cv2.error:  # OpenCV raises for some degenerate matches
        return None
    if F is None or F.shape != (3, 3) or np.count_nonzero(mask) < MIN_MATCHES:
        return None
    agreeing = torch.from_numpy(mask[:, 0] > 0)
    return torch.from_numpy(F), pixels_1[agreeing], pixels_2[agreeing]


def _solve(pairs: list[tuple[Tensor, Tensor, Tensor]], camera: Camera, scale: float) -> ViewGraphFocal:
    """fx by all pairs, in images that are scaled in height so that their pixels are square."""
    ratio = float(camera.fx / camera.fy)
    stretch = torch.tensor([1.0, ratio, 1.0], dtype=torch.float64, device="cpu")
    F = torch.stack([pair[0] for pair in pairs]).double() / (stretch[:, None] * stretch)
    pixels_1, pixels_2 = (
        torch.nn.utils.rnn.pad_sequence([pair[side] for pair in pairs], batch_first=True).double()
        * stretch[:2]
        for side in (1, 2)
    )
    mask = torch.nn.utils.rnn.pad_sequence(
        [torch.ones(len(pair[1]), dtype=torch.bool, device="cpu") for pair in pairs], batch_first=True
    )
    return focal_from_pairs(
        F,
        pixels_1,
        pixels_2,
        mask,
        camera.params[2:4].detach().cpu().double() * stretch[:2],
        (camera.width, round(camera.height * float(stretch[1]))),
        threshold=THRESHOLD_PX * scale,
    )


def find_camera(
    sequence: Sequence,
    config: Config,
    output: Path | None,
    device: torch.device | str,
    resume: bool = False,
    on_progress: Callable[[str], None] = lambda words: None,
    extract: Extractor | None = None,
) -> tuple[Sequence, str]:
    """Find the focal length of an unknown camera from pairs of images.

    Args:
        sequence: With a guessed camera to start from, or none.
        config: Of the run.
        output: Folder into which the calibration file is written; None: no file is written.
        device: Of torch.
        resume: Use the camera of the resumed run, if there is one.
        on_progress: Receives messages.
        extract: As in `search_focal`.

    Returns the sequence with its camera and the error of this, and a description of the camera.
    """
    if config.features.kind == "simulated":
        raise ConfigError("simulated features are made with the camera, so it cannot be estimated")
    path = None if output is None else output / CALIBRATION
    if path is not None:
        check_replaceable(path)
    if path is not None and resume and path.exists():
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
    if path is not None:
        write_calibration(path, camera, [description], std)
    on_progress(description)
    return sequence.with_camera(camera, std=std), description


def describe_search(search: ViewGraphFocal | None, camera: Camera) -> str:
    """Describe the camera that pairs of images gave, or the reason why they do not determine it."""
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
        f"{pairs} image pairs do not determine it (pure rotation, straight motion and planes do not determine it): "
        f"the focal length of {focal:.0f} px is an initial guess"
    )


def with_stated_std(config: Config, sequence: Sequence) -> Config:
    """The configuration with the error of the camera that the sequence's calibration states, or that of a guess."""
    if sequence.camera_std is None:
        guessed = sequence.calibrated is Calibrated.GUESSED
        return replace(config, camera=replace(config.camera, guessed=guessed)) if guessed else config
    return replace(config, camera=replace(config.camera, std=sequence.camera_std, guessed=False))


def camera_remark(finished: Run, found: str) -> str:
    """Describe the camera of a run: its source, its error, and whether the run contradicts the given one.

    Only a complete first session can contradict an exact one. `found`: as `find_camera` describes it, empty for a
    given camera.
    """
    given = finished.given
    if given is not None and finished.calibration is not None:
        described = describe_calibration(finished.calibration)
        if found:
            return f"{found}; over all frames {described}"
        described += f" (given {float(given.camera.focal):.1f} px)"
        stated = finished.config.camera.std
        # The found focal length is the mean of the given one and that by the images alone, weighted by information.
        share = 1 - (finished.calibration.focal_std / given.focal_std) ** 2 if given.focal_std > 0 else 0.0
        departure = abs(_focal_ratio(given.camera, finished.calibration.camera))
        if departure <= LEAST_DEPARTURE * stated * share:
            return described
        better = better_camera(finished.graph, given.camera)
        if better is None or abs(_focal_ratio(given.camera, better.camera)) < MIN_SIGMAS * stated:
            return described
        return f"{described}; {contradiction(given.camera, better, finished.camera)}; {REMEDY}"
    better = None
    if not (finished.failure or finished.interrupted or finished.session):
        better = better_camera(finished.graph, finished.camera)
    against = "" if better is None else contradiction(finished.camera, better, finished.camera)
    if found:
        return "; but over all frames ".join(filter(None, (found, against)))
    return f"{against}; {REMEDY}" if against else ""


def describe_calibration(found: CameraMeasurement) -> str:
    """Describe the camera that the final adjustment of a run found, with its errors."""
    focal = float(found.camera.focal)
    described = f"focal length {_with_error(focal, focal * found.focal_std)} px"
    terms = zip(found.camera.params[4:6].tolist(), found.radial_std, ("k1", "k2"), strict=False)
    return described + "".join(f", {name} {k:.3f} ± {std:.3f}" for k, std, name in terms)


(MIN_SIGMAS, MIN_RATIO), (LARGE_SIGMAS, LARGE_RATIO) = (3.0, 0.01), (1.0, 0.03)
"""Standard errors and ratio by which the focal length of an estimate must be off, either line, where its camera
predicts better; else only its distortion does. Exact focal lengths of shelf_bin and kitti07 are off by at most 1.1
standard errors and 0.9 %; of eight that are 20 % off, on 20 to 30 rendered frames, seven are off by more than one.
From the larger ratio on the error is not stated: a run chooses matches that support its camera, and estimates of runs
with a focal length that is 10 % off are up to 3 % on that side of the truth."""
LEAST_DEPARTURE = 0.5 * MIN_SIGMAS
"""Stated standard deviations that the images alone must seem off before `better_camera` adjusts all keyframes. Tried at
this value only."""
REMEDY = "--refine-camera estimates a better one"


def better_camera(graph: ObservationGraph, given: Camera) -> CameraMeasurement | None:
    """Estimate the camera of a run's keyframes with a standard deviation of `ROUGH_STD` around the given one.

    None where stretches of the recording do not predict each other better with it, or where its focal length is that
    of the given one within its error.
    """
    evidence = keyframe_evidence(graph, CameraMeasurement.of(given, ROUGH_STD), OPTIONS)
    if evidence is None or not evidence.gain(given).is_worth():
        return None
    estimate = evidence.estimate()
    off = abs(_focal_ratio(given, estimate.camera))
    # By the images alone, with parameters that are held as given: the error of those is none of this comparison.
    std = estimate.prior.with_error(estimate.camera, estimate.covariance).focal_std
    is_other = off > max(MIN_RATIO, MIN_SIGMAS * std) or off > max(LARGE_RATIO, LARGE_SIGMAS * std)
    return estimate.measured if is_other else None


def contradiction(given: Camera, better: CameraMeasurement, used: Camera) -> str:
    """Describe that the images contradict a given focal length, by `better_camera`; `used`: the camera of the map."""
    was, focal, off = float(given.focal), float(better.camera.focal), _focal_ratio(given, better.camera)
    number = _with_error(focal, focal * better.focal_std)
    if abs(off) > LARGE_RATIO:
        number = f"{focal:.0f} px or {'more' if off > 0 else 'less'}"
    words = f"the images agree better with a focal length of {number} than with {was:.0f} px"
    is_far = abs(_focal_ratio(used, better.camera)) > LARGE_RATIO
    return f"{words}; poses and map may be badly wrong" if is_far else words


def _focal_ratio(given: Camera, found: Camera) -> float:
    """Logarithm of the ratio of the found to the given focal length."""
    return math.log(float(found.focal) / float(given.focal))


def _with_error(value: float, std: float) -> str:
    return f"{value:.0f} ± {std:.0f}" if std >= 1 else f"{value:.1f} ± {std:.1f}"
