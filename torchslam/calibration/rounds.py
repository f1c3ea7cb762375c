"""Runs and refinements in turns: a run with the camera as known, the camera from the run's graph, and again.

A wrong camera makes a run choose its matches and outliers wrongly, so its graph alone does not lead all the way. The
rounds use the first frames of a sequence, and more of them while these do not determine the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchslam.calibration.intrinsics import Refinement, estimate_intrinsics
from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera
from torchslam.system.front_end import Extractor, FrontEnd, WithFeatures, image_extractor
from torchslam.system.run import Run
from torchslam.system.slam import SLAM
from torchslam.types import Features, Frame

# Focal lengths in widths of the image that are tried beside the first one; the first map decides.
GUESSES = 0.6, 1.2, 1.7
INITIAL_FRAMES, MAX_FRAMES = 80, 800
MIN_KEYFRAMES = 3  # a map of fewer does not decide
# Change of the focal length that the discrete choices of a run make by themselves, and that is not worth another run,
# as a share of its error.
MIN_CHANGE, MIN_CHANGE_IN_STD = 5e-3, 0.3
# Relative error with which more frames are not worth their time: of a camera from nothing, and of one to refine.
TARGET_STD, TARGET_STD_REFINED = 0.01, 0.005
MAX_ROUNDS = 10
CONFIDENT_STD, CONFIDENT_CHANGE = (
    0.05,
    0.15,
)  # relative error, and change of the focal length, with which no other guess is tried


@dataclass(frozen=True)
class Round:
    """A run over the first frames and what its graph says; refined is None where there was no map."""

    camera: Camera
    frames: int
    run: Run
    refined: Refinement | None

    @property
    def cost(self) -> float:
        """Per observation with the refined camera, higher where frames have no pose; infinite without a map."""
        if self.refined is None:
            return math.inf
        return self.refined.cost * (self.frames / len(self.run.trajectory)) ** 2

    @property
    def is_confident(self) -> bool:
        """Whether the images confirm the focal length of the run."""
        if self.refined is None or not self.refined.is_determined:
            return False
        off = math.log(float(self.refined.camera.focal) / float(self.camera.focal))
        return self.refined.std < CONFIDENT_STD and abs(off) < CONFIDENT_CHANGE


@dataclass(frozen=True)
class FoundCamera:
    """What the rounds came to.

    camera:  the best that is known
    refined: what the last run says of it; None where there is no map with that camera
    rounds:  all of them, the guesses first
    """

    camera: Camera
    refined: Refinement | None
    rounds: list[Round]

    @property
    def is_determined(self) -> bool:
        """Whether the images say what the focal length is."""
        return self.refined is not None and self.refined.is_determined


class CachedExtractor:
    """An extractor that looks at every image once: features do not depend on the camera."""

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
    on_progress: Callable[[Round], None] | None = None,
) -> FoundCamera:
    """Find the camera of a sequence, started at the one it has.

    radial: how many coefficients of the distortion may be fitted, where the residuals ask for them
    guess:  the sequence's camera is a guess: other focal lengths are tried, and its principal point may move
    extractor: front end, the configured one if None
    told:   of every round

    Raises KeyboardInterrupt where that ends a run.
    """
    cached = None
    if not sequence.brings_features:
        cached = CachedExtractor(image_extractor(config, device, extractor))
    rounds: list[Round] = []
    start = sequence.camera.to(torch.float64).to(device)

    def one(camera: Camera, frames: int) -> Round:
        part = sequence.part(stop=frames)
        looked = part if cached is None else WithFeatures(part, cached)
        run = SLAM(camera, config, extractor).run(looked)
        if run.interrupted:
            raise KeyboardInterrupt
        refined = None if run.failure else estimate_intrinsics(run.graph, start, radial, guess)
        rounds.append(Round(camera, frames, run, refined))
        if on_progress is not None:
            on_progress(rounds[-1])
        return rounds[-1]

    most = min(len(sequence), MAX_FRAMES)
    frames = min(INITIAL_FRAMES, most)
    last = one(start, frames)
    while guess and frames < most and last.run.map.num_keyframes < MIN_KEYFRAMES:
        frames = min(2 * frames, most)
        last = one(start, frames)
    tried = [last]
    for share in GUESSES if guess else ():
        if tried[-1].is_confident:
            break
        tried.append(one(_scaled(start, share * start.width / float(start.focal)), frames))
    last = tried[-1] if tried[-1].is_confident else min(tried, key=lambda each: each.cost)
    for _ in range(MAX_ROUNDS):
        if last.refined is None:  # also where a rotation that a wrong camera took for a motion shows as one
            break
        camera = last.refined.camera
        moved = abs(math.log(float(camera.focal) / float(last.camera.focal)))
        settled = moved < max(MIN_CHANGE, MIN_CHANGE_IN_STD * last.refined.std)
        if settled and last.refined.num_radial == _num_distorted(last.camera, start):
            if last.refined.std < (TARGET_STD if guess else TARGET_STD_REFINED) or frames == most:
                break
            frames = min(2 * frames, most)
        last = one(camera, frames)
    return FoundCamera(start if last.refined is None else last.refined.camera, last.refined, rounds)


def _scaled(camera: Camera, factor: float) -> Camera:
    return camera.with_params(torch.cat([factor * camera.params[:2], camera.params[2:]]))


def _num_distorted(camera: Camera, start: Camera) -> int:
    """How many coefficients of the distortion differ from those of the start."""
    own, given = (torch.cat([c.params, c.params.new_zeros(2)])[4:6] for c in (camera, start))
    return int((own != given).sum())
