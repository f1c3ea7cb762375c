"""What the ruler of view.html knows of each point: an image point that shows it, and the error of its position."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.map.map import NO_POINT, Map
from torchslam.map.observation_index import first_of_each

FACTOR_STEPS = 127
"""Steps of an entry of the factor of a covariance, over the largest one of the point: half a percent is enough."""


def clearest_observations(
    slam_map: Map, point_ids: Int[Tensor, " N"], session: int, size: tuple[int, int]
) -> tuple[Int[Tensor, " N"], Float[Tensor, "N 2"]]:
    """Return one observation of each point by a keyframe of a session: of a fine scale, and far from the border.

    Args:
        slam_map: the map.
        point_ids: rows of points.
        session: number of the session.
        size: (width, height) of its images.

    Returns:
        Index of the frame in the sequence, -1 for points that the session does not observe; and pixels.
    """
    seen = slam_map.observations(slam_map.keyframe_rows(session).to(slam_map.T_cw.device))
    half = torch.tensor(size, dtype=seen.pixels.dtype, device=seen.pixels.device) / 2
    off_center = ((seen.pixels + 0.5) / half - 1).square().sum(dim=-1) / 2  # 1 in the corners
    order = torch.argsort(seen.scales * (1 + off_center), stable=True)
    chosen = order[first_of_each(seen.point_index[order])]
    row = point_ids.new_full((len(slam_map.points),), NO_POINT)
    row[seen.point_index[chosen]] = chosen
    row = row[point_ids]
    known = row != NO_POINT
    frames, pixels = torch.full_like(row, -1), seen.pixels.new_zeros(len(row), 2)
    frames[known] = slam_map.keyframes["frame_index"][seen.keyframe_index[row[known]]]
    pixels[known] = seen.pixels[row[known]]
    return frames, pixels


def error_factors(
    covariances: Float[Tensor, "N 3 3"],
) -> tuple[Float[Tensor, " N"], Int[Tensor, "N 6"]]:
    """Return covariances as numbers of steps, of their Cholesky factors L.

    Returns:
        Length of a step, 0 where the covariance is unknown; and the entries of L on and below the diagonal, row by row.
    """
    largest = covariances.diagonal(dim1=-2, dim2=-1).amax(dim=-1)
    known = (largest > 0) & covariances.isfinite().all(dim=-1).all(dim=-1)
    eye = torch.eye(3, dtype=covariances.dtype, device=covariances.device)
    scaled = torch.where(known[:, None, None], covariances / largest[:, None, None], eye)
    # A depth that is much less certain than the rest leaves rounding errors in the other directions.
    L, failed = torch.linalg.cholesky_ex(scaled + 1e-9 * eye)
    known = known & (failed == 0)
    steps = (L.clamp(-1, 1) * FACTOR_STEPS).round().to(torch.int64)
    low, column = torch.tril_indices(3, 3, device="cpu").unbind()
    length = torch.where(known, largest.clamp(min=0).sqrt() / FACTOR_STEPS, 0.0)
    return length, torch.where(known[:, None], steps[:, low, column], 0)
