"""What the ruler of view.html knows of each point: an image point that shows it, and the error of its position."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.io.viewer.arrays import encoded
from torchslam.map.map import NO_POINT, Map
from torchslam.map.observation_index import first_of_each

PIXEL_STEPS = 65535
"""Steps of a pixel over the image, of 16 bits: hundredths of a pixel."""
FACTOR_STEPS = 127
"""Steps of an entry of the factor of a covariance, over the largest one of the point: half a percent is enough."""


def of_points(
    slam_map: Map,
    point_ids: Int[Tensor, " P"],
    S_shown_map: Float[Tensor, "4 4"],
    session: int,
    size: tuple[int, int],
) -> dict[str, Any]:
    """Return an image point and the error of each point, encoded for the page.

    Args:
        slam_map: the map.
        point_ids: rows of the points that are shown.
        S_shown_map: similarity from the map to the view.
        session: number of the session whose frames are meant.
        size: (width, height) of its images.

    Returns:
        seen_frame, seen_pixel: (P,), (P, 2) as by `clearest_observations`, pixels in steps
        error_step, error_factor: (P,), (P, 6) as by `error_factors`; of the float32 of a step, the upper 16 bits
    """
    if len(point_ids) == 0:  # the table may have no columns yet
        kinds = {
            "seen_frame": "int32",
            "seen_pixel": "uint16",
            "error_step": "uint16",
            "error_factor": "int8",
        }
        return {name: encoded([], kind) for name, kind in kinds.items()}
    frames, pixels = clearest_observations(slam_map, point_ids, session, size)
    steps = PIXEL_STEPS / (torch.tensor(size, dtype=torch.float64, device="cpu") - 1).clamp(min=1)
    sR = S_shown_map[:3, :3]
    error_step, error_factor = error_factors(
        sR @ slam_map.points["covariances_w"][point_ids].double() @ sR.mT
    )
    return {
        "seen_frame": encoded(frames, "int32"),
        "seen_pixel": encoded((pixels * steps).round().clamp(0, PIXEL_STEPS), "uint16"),
        "error_step": encoded(error_step.bfloat16().view(torch.int16).numpy().view(np.uint16), "uint16"),
        "error_factor": encoded(error_factor, "int8"),
    }


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
