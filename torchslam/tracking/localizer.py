"""Pose estimation against a map: PnP near a predicted pose or by RANSAC, guided matching, robust refinement."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    CHI_SQUARE_95,
    KeypointNoise,
    SharedCamera,
    UndistortedKeypoints,
    passes_gate,
    start_pose,
)
from torchslam.map.map import Map
from torchslam.optim.frame_pose import FramePose, FrameProblem, RobustKernel, nearby_pose
from torchslam.tracking.data_association import (
    MATURE_OBSERVATIONS,
    Projected,
    coverage_ratio,
    explained_ratio,
    grid_weights,
    match_projected_points,
    project_points,
    select_mature,
    subsample_per_cell,
)
from torchslam.tracking.matcher import DescriptorMatcher
from torchslam.tracking.pose_validation import MIN_INLIER_RATIO
from torchslam.types import FrameFeatures, MatchIndices, PoseEstimate

REFINE_RADIUS_PX = 5.0
"""Search radius around points projected with the estimated pose, pixels of the finest pyramid level. Tried at this
value only."""
THRESHOLD_PX = 3.0
"""Inlier threshold of the initial pose, pixels of reduced images: twice that of two views, since map points have errors
as well. Tried at this value only."""
MIN_MATCHES = 20
"""Matches with which a pose is tried, and mature ones with which the others are left out. Tried at this value only."""
MIN_INLIERS = 20
"""Matches and inliers without which a frame has no pose. Tried at this value only."""
LOCAL_KEYFRAMES = 12
"""Keyframes of the local map besides the reference keyframe. Tried at this value only."""
OUTLIER_GATE_FACTOR = 4.0
"""Factor on the chi-square gate before the first refinement: matches up to twice as far off may become inliers."""


class Localizer:
    """Estimates the pose of a frame from matches with map points; stateless, and does not change the map."""

    def __init__(self, camera: SharedCamera, config: Config) -> None:
        self.camera = camera
        self.guided_matcher = DescriptorMatcher(config.matching)
        self.threshold_px = THRESHOLD_PX * config.features.reduction(camera.current.size)
        self.seed = config.seed

    def locate(
        self,
        slam_map: Map,
        view: FrameFeatures,
        candidates: Iterable[MatchIndices],
        local_points: Int[Tensor, " N"],
        expected_T_cw: Float[Tensor, "4 4"] | None = None,
    ) -> PoseEstimate | None:
        """Estimate the pose of a frame by PnP, then refine it against the local points; None without a pose.

        Sets of matches are tried in turn until enough of their matches are inliers; the estimate with the most inliers
        is returned. Local points are ids, ascending. An expected pose is tried before RANSAC.
        """
        best: PoseEstimate | None = None
        for pairs in candidates:
            estimate = self._locate(slam_map, view, pairs, local_points, expected_T_cw)
            if estimate is not None and (best is None or estimate.inliers > best.inliers):
                best = estimate
            if best is not None and best.inliers >= MIN_INLIER_RATIO * best.matches:
                break
        return best

    def _locate(
        self,
        slam_map: Map,
        view: FrameFeatures,
        pairs: MatchIndices,
        local_points: Tensor,
        expected_T_cw: Tensor | None,
    ) -> PoseEstimate | None:
        """PnP by the matches, then guided matching of all local points, then robust refinement."""
        point_ids, keypoints = pairs.first, pairs.second
        if len(point_ids) < MIN_MATCHES:
            return None
        chosen = select_mature(slam_map.points["times_found"][point_ids], MIN_MATCHES)
        chosen = chosen[subsample_per_cell(view.keypoints[keypoints[chosen]], self.camera.current.size)]
        undistorted = self.camera.undistortion(view.keypoints)
        points_w = slam_map.positions_w[point_ids[chosen]]
        seen, size = undistorted[keypoints[chosen]], self.camera.current.size
        T_cw = None
        if expected_T_cw is not None:
            T_cw = nearby_pose(expected_T_cw, points_w, seen, self.threshold_px)
        if T_cw is None:
            T_cw = start_pose(points_w, seen, size, self.threshold_px, self.seed)
        if T_cw is None:
            return None
        candidates = self._local_points_with(slam_map, point_ids, local_points)
        near = self.project(slam_map, candidates, T_cw, view)
        guided = match_projected_points(slam_map, near, view, REFINE_RADIUS_PX, self.guided_matcher)
        ids, at, noise = guided.first, guided.second, view.noise[guided.second]
        if len(ids) < MIN_INLIERS:
            return None
        weights = weights_of(pairs, guided, len(view.mask))
        noise = noise if weights is None else noise.with_explicit_information().scaled(weights)
        refined, errors, inliers = self._refine(
            slam_map, T_cw, ids, view.keypoints[at], undistorted[at], noise
        )
        if int(inliers.sum()) < MIN_INLIERS:
            return None
        seen_ids = ids[inliers]
        return PoseEstimate(
            refined.T_cw,
            seen_ids,
            at[inliers],
            matches=len(ids),
            covariance=refined.covariance(),
            depth=float(refined.linearization.depths[inliers].median()),
            error=float(errors.median()) / slam_map.noise_variance,
            coverage_ratio=coverage_ratio(slam_map, near, seen_ids, size),
            explained_ratio=explained_ratio(view, at[inliers], size),
            weights=None if weights is None else weights[inliers],
            expected=near.ids,
        )

    def project(
        self, slam_map: Map, point_ids: Int[Tensor, " N"], T_cw: Float[Tensor, "4 4"], view: FrameFeatures
    ) -> Projected:
        """The points that a view at a pose should observe, see `project_points`."""
        return project_points(slam_map, point_ids, T_cw, self.camera.current, view.scale_range)

    def _local_points_with(self, slam_map: Map, point_ids: Tensor, local_points: Tensor) -> Tensor:
        """The local points, or those around the matched points if these are elsewhere in the map."""
        if len(local_points):
            at = torch.searchsorted(local_points, point_ids).clamp_(max=len(local_points) - 1)
            if bool((local_points.index_select(0, at) == point_ids).all()):
                return local_points
        keyframe = int(slam_map.count_observed(point_ids).argmax())
        return slam_map.observed_points(slam_map.neighborhood(keyframe, LOCAL_KEYFRAMES))

    def _refine(
        self,
        slam_map: Map,
        T_cw: Tensor,
        ids: Tensor,
        pixels: Tensor,
        undistorted: UndistortedKeypoints,
        noise: KeypointNoise,
    ) -> tuple[FramePose, Float[Tensor, " N"], Bool[Tensor, " N"]]:
        """The pose, the squared errors in units of the noise, and the inliers.

        First by the matches within the widened gate around T_cw, mature points alone if there are enough of them, then
        by the inliers of that pose.
        """
        problem = FrameProblem(slam_map.positions_w[ids], undistorted.xy, undistorted.whitened(noise))
        linearization = problem.linearize(T_cw)
        mask = passes_gate(linearization.squared / noise.gate_factor**2, OUTLIER_GATE_FACTOR * CHI_SQUARE_95)
        old = mask & (slam_map.points["times_found"][ids] >= MATURE_OBSERVATIONS)
        if int(old.sum()) >= MIN_MATCHES:
            mask = old
        weights = grid_weights(pixels, self.camera.current.size)
        kernels: tuple[RobustKernel, ...] = ("cauchy", "huber")
        for kernel in kernels:
            refined = problem.minimize(linearization, weights * mask, kernel)
            linearization = refined.linearization
            errors = linearization.squared / noise.gate_factor**2
            mask = passes_gate(errors)
            if int(mask.sum()) < 6:
                break
        return refined, errors, mask


def weights_of(pairs: MatchIndices, guided: MatchIndices, keypoints: int) -> Float[Tensor, " M"] | None:
    """Weights of guided matches: the matcher's where it found the same pair, else their median; None without."""
    if pairs.weights is None:
        return None
    points = torch.full((keypoints,), -1, device=pairs.first.device).index_put((pairs.second,), pairs.first)
    weights = pairs.weights.new_zeros(keypoints).index_put((pairs.second,), pairs.weights)
    is_same = points[guided.second] == guided.first
    return torch.where(is_same, weights[guided.second], pairs.weights.median())
