"""Calibrate by alternating runs and intrinsics estimation: a run with the known camera, the camera from its graph.

A wrong camera makes a run choose wrong matches and outliers, so one estimate is not enough. The rounds use the first
frames of a sequence, and more while these do not determine the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from torchslam.calibration.intrinsics import IntrinsicsEstimate, estimate_intrinsics
from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera
from torchslam.system.front_end import Extractor, FrontEnd, WithFeatures, image_extractor
from torchslam.system.run import Run
from torchslam.system.slam import SLAM
from torchslam.types import Features, Frame

# Focal lengths in image widths that are tried in addition to the first one.
GUESSES = 0.6, 1.2, 1.7
INITIAL_FRAMES, MAX_FRAMES = 80, 800
MIN_KEYFRAMES = 3  # of a map that can choose between focal lengths
# Relative change of the focal length that discrete decisions of a run cause, and change in standard errors that does
# not justify another run.
MIN_CHANGE, MIN_CHANGE_IN_STD = 5e-3, 0.3
# Relative error below which no more frames are used: for an unknown camera, and for one to be refined.
TARGET_STD, TARGET_STD_REFINED = 0.01, 0.005
MAX_ROUNDS = 10
# Relative error and change of the focal length below which no other guess is tried.
CONFIDENT_STD, CONFIDENT_CHANGE = 0.05, 0.15


@dataclass(frozen=True)
class CalibrationRound:
    """A run over the first frames and the estimate from its graph, which is None without a map."""

    camera: Camera
    frames: int
    run: Run
    estimate: IntrinsicsEstimate | None

    @property
    def cost(self) -> float:
        """Cost per observation with the estimated camera, higher with unposed frames; infinite without a map."""
        if self.estimate is None:
            return math.inf
        return self.estimate.cost * (self.frames / len(self.run.trajectory)) ** 2

    @property
    def is_confident(self) -> bool:
        """Whether the estimate confirms the focal length of the run."""
        if self.estimate is None or not self.estimate.is_determined:
            return False
        off = math.log(float(self.estimate.camera.focal) / float(self.camera.focal))
        return self.estimate.focal_std < CONFIDENT_STD and abs(off) < CONFIDENT_CHANGE


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated camera.

    Attributes:
        camera: The best known one.
        estimate: From the last run; None if it has no map.
        rounds: All rounds, initial guesses first.
    """

    camera: Camera
    estimate: IntrinsicsEstimate | None
    rounds: list[CalibrationRound]

    @property
    def is_determined(self) -> bool:
        """Whether the images determine the focal length."""
        return self.estimate is not None and self.estimate.is_determined


class CachedExtractor:
    """An extractor that processes every image once: features do not depend on the camera."""

    def __init__(self, extractor: Extractor) -> None:
        self.extractor = extractor
        self.features: dict[int, Features] = {}

    def __call__(self, frame: Frame) -> Features:
        if frame.index not in self.features:
            self.features[frame.index] = self.extractor(frame)
        return self.features[frame.index]


def calibrate(
    sequence: Sequence,
    config: Config,
    radial: int = 2,
    guess: bool = True,
    device: torch.device | str = "cpu",
    extractor: FrontEnd | None = None,
    on_progress: Callable[[CalibrationRound], None] | None = None,
) -> CalibrationResult:
    """Estimate the camera of a sequence from its images.

    Args:
        sequence: With the camera to start from.
        config: Of the runs.
        radial: Maximum number of distortion coefficients; each must lower the cost.
        guess: Whether the camera is a guess: then other focal lengths are tried, the principal point may move, and no
            map is made where one of them and a rotation explain the matches.
        device: Of torch.
        extractor: Front end; the configured one if None.
        on_progress: Receives every round.

    Raises:
        KeyboardInterrupt: A run was interrupted.
    """
    config = replace(config, camera=replace(config.camera, guessed=guess))
    cached = None
    if not sequence.brings_features:
        cached = CachedExtractor(image_extractor(config, device, extractor))
    rounds: list[CalibrationRound] = []
    start = sequence.camera.to(torch.float64).to(device)

    def run_round(camera: Camera, frames: int) -> CalibrationRound:
        part = sequence.part(stop=frames)
        source = part if cached is None else WithFeatures(part, cached)
        run = SLAM(camera, config, extractor).run(source)
        if run.interrupted:
            raise KeyboardInterrupt
        estimate = None if run.failure else estimate_intrinsics(run.graph, start, radial, guess)
        rounds.append(CalibrationRound(camera, frames, run, estimate))
        if on_progress is not None:
            on_progress(rounds[-1])
        return rounds[-1]

    most = min(len(sequence), MAX_FRAMES)
    frames = min(INITIAL_FRAMES, most)
    last = run_round(start, frames)
    while guess and frames < most and last.run.map.num_keyframes < MIN_KEYFRAMES:
        frames = min(2 * frames, most)
        last = run_round(start, frames)
    tried = [last]
    for share in GUESSES if guess else ():
        if tried[-1].is_confident:
            break
        tried.append(run_round(_scaled(start, share * start.width / float(start.focal)), frames))
    last = tried[-1] if tried[-1].is_confident else min(tried, key=lambda each: each.cost)
    for _ in range(MAX_ROUNDS):
        if (
            last.estimate is None
        ):  # also if the camera only rotated, which a wrong camera mistakes for translation
            break
        camera = last.estimate.camera
        moved = abs(math.log(float(camera.focal) / float(last.camera.focal)))
        converged = moved < max(MIN_CHANGE, MIN_CHANGE_IN_STD * last.estimate.focal_std)
        if converged and last.estimate.num_radial == _num_distorted(last.camera, start):
            if last.estimate.focal_std < (TARGET_STD if guess else TARGET_STD_REFINED) or frames == most:
                break
            frames = min(2 * frames, most)
        last = run_round(camera, frames)
    return CalibrationResult(start if last.estimate is None else last.estimate.camera, last.estimate, rounds)


def _scaled(camera: Camera, factor: float) -> Camera:
    return camera.with_params(torch.cat([factor * camera.params[:2], camera.params[2:]]))


def _num_distorted(camera: Camera, start: Camera) -> int:
    """The number of distortion coefficients that differ from those of the start."""
    own, given = (torch.cat([c.params, c.params.new_zeros(2)])[4:6] for c in (camera, start))
    return int((own != given).sum())
