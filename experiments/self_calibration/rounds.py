"""SLAM and calibration in turns: a run with the camera as known, the camera from the run's graph, and again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.self_calibration.calibration import calibrate, parameters
from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.evaluation import MIN_POSES, evaluate
from torchslam.front_end import Extractor
from torchslam.geometry import Camera
from torchslam.slam import SLAM
from torchslam.values import Features, Frame, Trajectory

# The discrete choices of a run move its answer by about this much.
_SETTLED = 2e-3


@dataclass(frozen=True)
class Round:
    """One run and what its graph says of the camera.

    camera:     of the run; calibrated: the camera under which its graph costs least
    errors:     (n,) standard errors of `parameters(calibrated)`; empty where there was no map
    ate_m:      NaN where too few frames were posed
    """

    camera: Camera
    calibrated: Camera
    errors: Tensor
    posed: int
    frames: int
    ate_m: float


class Remembered:
    """An extractor that reads every image once: features do not depend on the camera."""

    def __init__(self, extractor: Extractor) -> None:
        self.extractor = extractor
        self.features: dict[int, Features] = {}

    def __call__(self, frame: Frame) -> Features:
        if frame.index not in self.features:
            self.features[frame.index] = self.extractor(frame)
        return self.features[frame.index]


def one_round(
    sequence: Sequence, camera: Camera, config: Config, extractor: Extractor, num_radial: int
) -> Round:
    """Run the sequence with `camera`, and calibrate the camera on what the run leaves behind."""
    run = SLAM(camera, config, extractor).run(sequence)
    ate_m = trajectory_error(run.trajectory, sequence)
    if run.failure:
        return Round(camera, camera, torch.zeros(0), 0, len(sequence), ate_m)
    cost = calibrate(run.graph, num_radial)
    return Round(
        camera, cost.graph.camera, cost.standard_errors, len(run.trajectory), len(sequence), ate_m
    )  # fmt: skip


def rounds(
    sequence: Sequence,
    camera: Camera,
    config: Config,
    extractor: Extractor,
    num_radial: int = 0,
    most: int = 6,
) -> Iterator[Round]:
    """Rounds from `camera` on, until the focal length moves by less than 0.2 %, or there is no map to calibrate on."""
    for _ in range(most):
        done = one_round(sequence, camera, config, extractor, num_radial)
        yield done
        change = parameters(done.calibrated, num_radial) - parameters(camera, num_radial)
        if not len(done.errors) or float(change[0].abs()) < _SETTLED:
            return
        camera = done.calibrated


def trajectory_error(trajectory: Trajectory, sequence: Sequence) -> float:
    """ATE in metres, NaN where it cannot be had."""
    if sequence.groundtruth is None or len(trajectory) < MIN_POSES:
        return float("nan")
    return evaluate(trajectory, sequence.groundtruth).ate_m
