"""A simulated submap: keyframes that look at a point cloud, frames between them, and a tracking state."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, se3_inverse, transform
from torchslam.map.atlas import Submap, TrackingState
from torchslam.types import FrameFeatures, PoseEstimate

CAMERA = Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240))
EVERY = 3  # frames from keyframe to keyframe


def path(frames: int) -> Tensor:
    """(F, 4, 4) T_cw of a walk sideways in front of the cloud, the first at the origin."""
    s = torch.arange(frames, dtype=torch.float64)[:, None] / 10
    return se3_exp(s * torch.tensor([[-0.4, 0.05, 0.1, 0.02, -0.1, 0.03]], dtype=torch.float64))


def view_of(
    index: int, T_cw: Tensor, points_w: Tensor, generator: torch.Generator, session: int = 0
) -> FrameFeatures:
    """Features that see point i at keypoint i, with half a pixel of noise, at scales of 1 to 3 px."""
    pixels, _ = CAMERA.project(transform(T_cw, points_w))
    count = len(points_w)
    return FrameFeatures(
        index=index,
        timestamp=10.0 * session + 0.1 * index,
        keypoints=pixels + 0.5 * torch.randn(count, 2, generator=generator, dtype=torch.float64),
        scales=1 + 2 * torch.rand(count, generator=generator, dtype=torch.float64),
        angles=torch.rand(count, generator=generator, dtype=torch.float64),
        descriptors=torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8),
        mask=torch.ones(count, dtype=torch.bool),
        session=session,
    )


def estimate_at(
    T_cw: Tensor,
    point_ids: Tensor,
    keypoints: Tensor,
    *,
    matches: int | None = None,
    **values: float | Tensor,
) -> PoseEstimate:
    """A certain pose estimate at T_cw (4, 4) whose matches are all inliers; `values` override fields."""
    certain: dict[str, float | Tensor] = {
        "covariance": 1e-6 * torch.eye(6, dtype=T_cw.dtype),
        "depth": 4.0,
        "error": 1.0,
        "coverage_ratio": 1.0,
    }
    count = len(point_ids) if matches is None else matches
    return PoseEstimate(T_cw, point_ids, keypoints, count, **(certain | values))  # type: ignore[arg-type]


def random_covariances(count: int, size: int, generator: torch.Generator) -> Tensor:
    """(count, size, size) covariances."""
    root = torch.randn(count, size, size, generator=generator, dtype=torch.float64)
    return 1e-4 * (root @ root.mT + torch.eye(size, dtype=torch.float64))


def simulated_submap(
    seed: int = 0, frames: int = 14, points: int = 40, number: int = 0, session: int = 0
) -> Submap:
    """Every third frame is a keyframe and sees most of the points; the frames between refer to the one before."""
    generator = torch.Generator().manual_seed(seed)
    cloud_w = torch.rand(points, 3, generator=generator, dtype=torch.float64) * 2 - 1
    cloud_w[:, 2] += 4.0
    T_cw = path(frames)
    submap = Submap.empty(number, CAMERA.params.double())
    slam_map = submap.map
    ids = torch.full((points,), -1)
    for index in range(frames):
        view = view_of(index, T_cw[index], cloud_w, generator, session)
        seen = torch.nonzero(torch.rand(points, generator=generator) < 0.8)[:, 0]
        if index % EVERY == 0:
            keyframe = slam_map.add_keyframe(view, T_cw[index])
            new = seen[ids[seen] < 0]
            ids[new] = slam_map.add_points(
                cloud_w[new], view.descriptors[new], keyframe, random_covariances(len(new), 3, generator)
            )
            slam_map.add_observations(keyframe, seen, ids[seen])
        seen = seen[ids[seen] >= 0]
        T_cr = T_cw[index] @ se3_inverse(slam_map.T_cw[keyframe])
        submap.posed_frames.add(view, estimate_at(T_cw[index], ids[seen], seen), T_cr, keyframe)
    everyone = torch.arange(slam_map.num_keyframes)
    slam_map.update_appearance(everyone)
    slam_map.keyframes["covariances"][:] = random_covariances(len(everyone), 6, generator)
    last = int(everyone[-1])
    submap.tracking = TrackingState(
        T_cr=T_cw[-1] @ se3_inverse(slam_map.T_cw[last]),
        reference=last,
        reference_size=10,
        motions=(T_cw[-1] @ se3_inverse(T_cw[-2]))[None],
        intervals=torch.zeros_like(T_cw[0, :1, 0]),
        last_inlier_points=slam_map.observed_points(everyone[-1:]),
        local_keyframes=everyone.flip(0),
        local_points=slam_map.observed_points(everyone),
    )
    return submap


def reprojection_errors(submap: Submap) -> Tensor:
    """(O, 2) pixels, keyframe by keyframe, of all observations by the map."""
    seen = submap.map.observations()
    points_c = transform(
        submap.map.T_cw[seen.keyframe_index], submap.map.positions_w[seen.point_index][:, None]
    )
    return CAMERA.project(points_c[:, 0])[0] - seen.pixels
