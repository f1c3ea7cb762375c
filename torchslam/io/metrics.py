"""The figures of a run with what the ground truth and the images say of it, as metrics.json has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from torchslam.calibration.find_camera import camera_remark
from torchslam.data import Sequence
from torchslam.errors import TrajectoryError
from torchslam.evaluation import ate_apart, evaluate
from torchslam.io.report import metrics
from torchslam.system.run import Run
from torchslam.types import Trajectory

Errors = TypeVar("Errors")


def compute_metrics(
    finished: Run, sequence: Sequence, camera: str, log: Callable[[str], None] = lambda words: None
) -> dict[str, Any]:
    """The figures of a run, against ground truth where there is one and the run has poses to compare.

    camera: what there is to say of it before the run, as by `find_camera`; told: why there is no evaluation, if so
    """

    def measured(measure: Callable[[Trajectory], Errors]) -> Errors | None:
        if sequence.groundtruth is None or finished.failure:
            return None
        try:
            return measure(sequence.groundtruth)
        except TrajectoryError as error:
            log(f"no evaluation: {error}")
            return None

    figures = metrics(
        finished,
        measured(lambda truth: evaluate(finished.trajectory, truth)),
        measured(lambda truth: ate_apart(finished.online_parts, truth)),
    )
    return figures | {"camera": camera_remark(finished, camera), "dropped": sequence.dropped}
