"""A sequence with a true path from elsewhere than from where its images are."""

from __future__ import annotations

from torch import Tensor

from torchslam.data.sequence import Sequence, Transformed
from torchslam.types import Trajectory


class WithTruth(Transformed):
    """The frames of a sequence with another ground truth, at the times of its own clock."""

    def __init__(self, whole: Sequence, groundtruth: Trajectory) -> None:
        super().__init__(whole, groundtruth=groundtruth)

    def pose(self, index: int) -> Tensor | None:
        return Sequence.pose(self, index)
