"""The robust estimators, and the minimal solver that has no fixed number of solutions, as operators of a graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchslam.geometry.absolute_pose import attach_absolute_pose, find_absolute_pose
from torchslam.geometry.essential import five_point
from torchslam.geometry.operators import attaching, empty, fresh, operator
from torchslam.geometry.precision import full_precision
from torchslam.geometry.relative_pose import attach_relative_pose
from torchslam.geometry.relative_pose_search import find_relative_pose

_CAMERAS = "str model_1, int[] size_1, str model_2, int[] size_2, float threshold, str kernel"


@full_precision
def _absolute_pose(*given: Any) -> tuple[Tensor, ...]:
    return fresh(find_absolute_pose(*given))


def _absolute_pose_like(
    points_w: Tensor, pixels: Tensor, params: Tensor, mask: Tensor, *_: Any
) -> tuple[Tensor, ...]:
    B, N = mask.shape
    success = empty((B,), mask)
    return empty((B, 4, 4), points_w), success, empty((B, N), pixels), empty((B,), pixels)


@full_precision
def _relative_pose(*given: Any) -> tuple[Tensor, ...]:
    return fresh(find_relative_pose(*given))


def _relative_pose_like(inputs: Sequence[Tensor], mask: Tensor, *_: Any) -> tuple[Tensor, ...]:
    (B, N), x = mask.shape, inputs[0]
    return (
        empty((B, 4, 4), x),
        empty((B, 3), x),
        empty((B,), x, torch.int64),
        empty((B,), x),
        empty((B,), mask),
        empty((B,), mask),
        empty((B, N), mask),
        empty((B, N), mask),
        empty((3, B), x),
        empty((B, 4, 4), x),
    )


def _five_point(x_1: Tensor, x_2: Tensor) -> tuple[Tensor, ...]:
    return fresh(five_point(x_1, x_2))


def _five_point_like(x_1: Tensor, x_2: Tensor) -> tuple[Tensor, ...]:
    rows = torch.library.get_ctx().new_dynamic_size()
    return empty((rows, 3, 3), x_1), empty((rows,), x_1, torch.int64)


operator("five_point", "(Tensor x_1, Tensor x_2) -> (Tensor, Tensor)", _five_point, _five_point_like)
operator(
    "absolute_pose",
    "(Tensor points_w, Tensor pixels, Tensor params, Tensor mask, str model, int[] size, float threshold, int seed, "
    "float confidence, int max_samples) -> (Tensor, Tensor, Tensor, Tensor)",
    _absolute_pose,
    _absolute_pose_like,
)
operator(
    "relative_pose",
    f"(Tensor[] inputs, Tensor mask, {_CAMERAS}, str wanted, int seed, float confidence, int min_samples, "
    f"int max_samples) -> ({', '.join(10 * ['Tensor'])})",
    _relative_pose,
    _relative_pose_like,
)
attaching("attached_absolute_pose", "str model, int[] size", full_precision(attach_absolute_pose))
attaching("attached_relative_pose", _CAMERAS, full_precision(attach_relative_pose))
