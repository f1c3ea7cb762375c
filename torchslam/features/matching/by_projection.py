"""Binary descriptors matched near predictions, for every frame of a run: `features.match_projected` of one image, with
the same answers in fewer calls."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.features.matching.brute_force import SCALE_TOLERANCE
from torchslam.features.matching.hamming import hamming_between
from torchslam.features.matching.radius_search import nearest_bits, window_pairs
from torchslam.types import FrameFeatures
from torchslam.utils.indexing import true_indices


def match_within(
    expected: FrameFeatures, view: FrameFeatures, radius: Tensor, ratio: float | None, max_distance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (m,), ascending, of expected keypoints and of a view's that match, nearest descriptors within a radius, and
    their distances (m,), bits.

    expected: keypoints, scales and descriptors (M, 32) uint8 as they should appear in the view; radius: (M,) pixels
    ratio, max_distance: as of `match_projected`
    """
    rows, columns, bits = len(expected.mask), len(view.mask), 8 * view.descriptors.shape[-1]
    if rows == 0 or columns == 0:
        return (nobody := torch.zeros(0, dtype=torch.int64, device=radius.device)), nobody, nobody.float()
    row, column = window_pairs(
        expected.keypoints[None], radius[None], expected.mask[None], view.keypoints[None], view.mask[None]
    )
    factor = view.scales.index_select(0, column) / expected.scales.index_select(0, row)
    alike = true_indices((factor <= SCALE_TOLERANCE) & (factor * SCALE_TOLERANCE >= 1))
    row, column = row.index_select(0, alike), column.index_select(0, alike)
    distance = hamming_between(expected.descriptors, row, view.descriptors, column)
    return nearest_bits(row, column, distance, rows, view.scales, ratio, min(max_distance, bits))
