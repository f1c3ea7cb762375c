"""Build a map from approximate poses: average rotations, triangulate tracks, adjust coarse to fine, add points.

Rotation averaging: Chatterjee and Govindu, "Efficient and robust large-scale rotation averaging", 2013; here the given
rotations are measurements too, with a standard deviation estimated from how well they agree with the relative ones.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, KeypointNoise, passes_gate, so3_exp, so3_log, transform
from torchslam.geometry.camera_measurement import FOCAL, intrinsics_directions
from torchslam.geometry.robust import robustify
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import adjust_all
from torchslam.mapping.new_points import fuse, triangulate_against
from torchslam.optim import BundleProblem, bundle_adjust
from torchslam.refine.tracks import Pair, Tracks, make_map, triangulate_tracks
from torchslam.types import FrameFeatures

# Scales of the kernel, in pixels of the pyramid level: residuals of given poses can be tens of pixels.
KERNEL_WIDTHS = 20.0, 6.0, 2.45
GATE = 3.0  # in units of the last scale: observations further off are not added to the map
ITERATIONS = 20
TOLERANCE = 1e-4  # relative cost decrease; the adjustment of the map follows


def align_rotations(T_cw: Float[Tensor, "K 4 4"], pairs: list[Pair]) -> Float[Tensor, "K 4 4"]:
    """Replace the rotations of given poses by averaged relative ones of the matches; camera centers stay."""
    known = [pair for pair in pairs if pair.R_21 is not None]
    if not known:
        return T_cw
    first, second = (torch.tensor([getattr(p, name) for p in known]) for name in ("first", "second"))
    R_21 = torch.stack([pair.R_21 for pair in known if pair.R_21 is not None])
    device = T_cw.device
    R_cw = average_rotations(T_cw[:, :3, :3], first.to(device), second.to(device), R_21)
    centers_w = -(T_cw[:, :3, :3].mT @ T_cw[:, :3, 3:])
    aligned = T_cw.clone()
    aligned[:, :3, :3], aligned[:, :3, 3:] = R_cw, -R_cw @ centers_w
    return aligned


def adjust_coarse_to_fine(
    views: list[FrameFeatures],
    T_cw: Float[Tensor, "K 4 4"],
    tracks: Tracks,
    camera: Camera,
    config: Config,
    free_focal: bool,
) -> tuple[Float[Tensor, "K 4 4"], Camera, Tracks, Float[Tensor, "N 3"]]:
    """Adjust inaccurate poses with the points of the tracks, under kernels of decreasing width.

    Args:
        views: Of the keyframes.
        T_cw: Approximate poses.
        tracks: Of the keyframes.
        camera: Of the keyframes.
        config: For the size of the images.
        free_focal: Adjust the focal length too, before a wrong one rejects matches.

    Returns:
        The poses, the camera, the consistent tracks and their points.
    """
    pixels = torch.stack([view.keypoints for view in views])[tracks.keyframe, tracks.keypoint]
    scales, information = (
        torch.stack([getattr(view, name) for view in views])[tracks.keyframe, tracks.keypoint]
        for name in ("scales", "information")
    )
    noise = KeypointNoise(scales, information)
    parallax = config.mapping.min_parallax_deg
    for width in KERNEL_WIDTHS:
        points_w, good = triangulate_tracks(tracks, pixels, T_cw, camera, parallax)
        rows = good[tracks.track]
        problem = BundleProblem(
            T_cw,
            points_w,
            tracks.keyframe[rows],
            tracks.track[rows],
            pixels[rows],
            camera,
            weights=noise[rows].weights,
        )
        free = intrinsics_directions(camera, [FOCAL]) if free_focal and width < KERNEL_WIDTHS[0] else False
        solution = bundle_adjust(problem, "cauchy", width, free, "detached", ITERATIONS, TOLERANCE)
        T_cw, camera = solution.T_cw, solution.camera
    points_w, good = triangulate_tracks(tracks, pixels, T_cw, camera, parallax)
    points_c = transform(T_cw[tracks.keyframe], points_w[tracks.track][:, None])[:, 0]
    near = passes_gate(noise.squared_reprojection(points_c, pixels, camera), (GATE * KERNEL_WIDTHS[-1]) ** 2)
    inliers = tracks.select(near & good[tracks.track])
    observed = torch.stack([view.keypoints for view in views])[inliers.keyframe, inliers.keypoint]
    return T_cw, camera, inliers, triangulate_tracks(inliers, observed, T_cw, camera, 0.0)[0]


def densify(slam_map: Map, camera: Camera, config: Config) -> None:
    """Add points along epipolar lines and observations by projection that the first matches missed; adjust the map."""
    for keyframe in range(slam_map.num_keyframes):
        neighbors = slam_map.covisible_keyframes(keyframe, 2 * config.mapping.num_partners)
        triangulate_against(slam_map, keyframe, neighbors[: config.mapping.num_partners], camera, config)
        slam_map.update_appearance(slam_map.index_tensor(keyframe))
        fuse(slam_map, keyframe, neighbors, camera, config)
    adjust_all(slam_map, camera, config.bundle_adjustment)


def build_map(
    views: list[FrameFeatures],
    T_cw: Float[Tensor, "K 4 4"],
    tracks: Tracks,
    camera: Camera,
    config: Config,
    free_focal: bool = False,
) -> tuple[Map, Camera]:
    """Build the adjusted map of keyframes with approximate poses; return it with its camera."""
    T_cw, camera, inliers, points_w = adjust_coarse_to_fine(views, T_cw, tracks, camera, config, free_focal)
    made = make_map(views, T_cw, inliers, points_w)
    adjust_all(made, camera, config.bundle_adjustment)
    densify(made, camera, config)
    return made, camera


MAX_ROTATION_STEPS = 20
RELATIVE_STD = math.radians(0.3)  # of a relative rotation of two views
# From the median length of a 3-vector to the standard deviation of a component, approximately.
MAD = 1.4826 / 1.54


def average_rotations(
    R_cw: Float[Tensor, "K 3 3"],
    first: Int[Tensor, " M"],
    second: Int[Tensor, " M"],
    R_21: Float[Tensor, "M 3 3"],
) -> Float[Tensor, "K 3 3"]:
    """Average given rotations with relative ones R_21 from views `first` to views `second`."""
    if len(first) == 0:
        return R_cw
    given, count = R_cw, len(R_cw)
    residuals = so3_log(R_21 @ R_cw[first] @ R_cw[second].mT)
    given_std = max(RELATIVE_STD, MAD * float(residuals.norm(dim=-1).median()) / math.sqrt(2))
    eye = torch.eye(3, dtype=R_cw.dtype, device=R_cw.device)
    for _ in range(MAX_ROTATION_STEPS):
        residuals = so3_log(R_21 @ R_cw[first] @ R_cw[second].mT)
        from_given = so3_log(given @ R_cw.mT)
        weights = _cauchy_weights(residuals, 2 * RELATIVE_STD) / RELATIVE_STD**2
        own = _cauchy_weights(from_given, 3 * given_std) / given_std**2
        # The residual of an edge changes by R_21 w_1 - w_2, that of a given rotation by -w.
        A = R_cw.new_zeros(count, count, 3, 3)
        W = weights[:, None, None]
        diagonal = A.new_zeros(count, 3, 3)
        diagonal.index_add_(0, first, W * eye).index_add_(0, second, W * eye)
        diagonal += own[:, None, None] * eye
        A[range(count), range(count)] = diagonal
        A.index_put_((first, second), -W * R_21.mT, accumulate=True)
        A.index_put_((second, first), -W * R_21, accumulate=True)
        b = own[:, None] * from_given
        b.index_add_(0, first, -weights[:, None] * (R_21.mT @ residuals[..., None])[..., 0])
        b.index_add_(0, second, weights[:, None] * residuals)
        step = torch.linalg.solve(A.transpose(1, 2).reshape(3 * count, 3 * count), b.flatten()).view(count, 3)
        R_cw = so3_exp(step) @ R_cw
        if float(step.abs().max()) < 1e-8:
            break
    return R_cw


def _cauchy_weights(residuals: Float[Tensor, "N 3"], scale: float) -> Float[Tensor, " N"]:
    """The Cauchy weights of residuals."""
    return robustify(residuals.square().sum(-1), "cauchy", residuals.new_tensor(scale)).weight
