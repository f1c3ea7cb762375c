"""From given poses to a map: rotations from the matches, points from the tracks, and both adjusted, ever closer."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.calibration.keyframes import FOCAL, directions
from torchslam.config import Config
from torchslam.geometry import Camera, KeypointNoise, fits, transform
from torchslam.map.map import Map
from torchslam.mapping.fusion import fuse
from torchslam.mapping.local_bundle import adjust_all
from torchslam.mapping.new_points import triangulate_against
from torchslam.optim import BundleProblem, bundle_adjust
from torchslam.refine.pairs import Pair
from torchslam.refine.rotations import average_rotations
from torchslam.refine.tracks import Tracks, make_map, triangulate_tracks
from torchslam.types import FrameFeatures

# Where the kernel lets go of a residual, in pixels of its level: given poses are off by tens of them.
KERNEL_WIDTHS = 20.0, 6.0, 2.45
GATE = 3.0  # of the last width: an observation further off does not go into the map
ITERATIONS = 20
TOLERANCE = 1e-4  # share of the cost; the last word has the adjustment of the map


def align_rotations(T_cw: Tensor, pairs: list[Pair]) -> Tensor:
    """(K, 4, 4) the given poses with rotations that the matches agree with; centres stay where they are."""
    known = [pair for pair in pairs if pair.R_21 is not None]
    if not known:
        return T_cw
    first, second = (torch.tensor([getattr(p, name) for p in known]) for name in ("first", "second"))
    R_21 = torch.stack([pair.R_21 for pair in known if pair.R_21 is not None])
    device = T_cw.device
    R_cw = average_rotations(T_cw[:, :3, :3], first.to(device), second.to(device), R_21)
    centres_w = -(T_cw[:, :3, :3].mT @ T_cw[:, :3, 3:])
    align_rotations = T_cw.clone()
    align_rotations[:, :3, :3], align_rotations[:, :3, 3:] = R_cw, -R_cw @ centres_w
    return align_rotations


def adjust_coarse_to_fine(
    views: list[FrameFeatures], T_cw: Tensor, tracks: Tracks, camera: Camera, config: Config, free_focal: bool
) -> tuple[Tensor, Camera, Tracks, Tensor]:
    """Poses (K, 4, 4), the camera, the tracks that agree with them, and their points (T, 3), from poses far off.

    free_focal: the focal length is adjusted as well: matches that a wrong one would rule out still count here
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
        free = directions(camera, [FOCAL]) if free_focal and width < KERNEL_WIDTHS[0] else False
        solution = bundle_adjust(problem, "cauchy", width, free, "detached", ITERATIONS, TOLERANCE)
        T_cw, camera = solution.T_cw, solution.camera
    points_w, good = triangulate_tracks(tracks, pixels, T_cw, camera, parallax)
    points_c = transform(T_cw[tracks.keyframe], points_w[tracks.track][:, None])[:, 0]
    near = fits(noise.squared_reprojection(points_c, pixels, camera), (GATE * KERNEL_WIDTHS[-1]) ** 2)
    kept = tracks.of(near & good[tracks.track])
    seen = torch.stack([view.keypoints for view in views])[kept.keyframe, kept.keypoint]
    return T_cw, camera, kept, triangulate_tracks(kept, seen, T_cw, camera, 0.0)[0]


def densify(slam_map: Map, camera: Camera, config: Config) -> None:
    """What the first matches missed: new points along epipolar lines, and points found again by their projections."""
    for keyframe in range(slam_map.num_keyframes):
        neighbours = slam_map.covisible(keyframe, 2 * config.mapping.num_partners)
        triangulate_against(slam_map, keyframe, neighbours[: config.mapping.num_partners], camera, config)
        slam_map.refresh(slam_map.ids(keyframe))
        fuse(slam_map, keyframe, neighbours, camera, config)
    adjust_all(slam_map, camera, config.bundle_adjustment)


def build_map(
    views: list[FrameFeatures],
    T_cw: Tensor,
    tracks: Tracks,
    camera: Camera,
    config: Config,
    free_focal: bool = False,
) -> tuple[Map, Camera]:
    """The adjusted map of keyframes whose poses T_cw (K, 4, 4) are only near the truth, and its camera."""
    T_cw, camera, kept, points_w = adjust_coarse_to_fine(views, T_cw, tracks, camera, config, free_focal)
    made = make_map(views, T_cw, kept, points_w)
    adjust_all(made, camera, config.bundle_adjustment)
    densify(made, camera, config)
    return made, camera
