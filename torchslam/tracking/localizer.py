"""Where is the camera, by guesses of who matches whom: PnP near an expected pose or by RANSAC, robust refinement."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    KeypointNoise,
    UndistortedKeypoints,
    Undistortion,
    fits,
    innovation_covariances,
    mahalanobis_squared,
    start_pose,
    transform,
)
from torchslam.map.map import Map
from torchslam.optim.core.numpy_backend import RobustKernel
from torchslam.optim.pose.frame_pose import FramePose, FrameProblem, nearby_pose
from torchslam.tracking.correspondences import Projected, match_near, project_points
from torchslam.tracking.match_selection import (
    MATURE_OBSERVATIONS,
    coverage_ratio,
    explained_ratio,
    grid_weights,
    select_mature,
    subsample_per_cell,
)
from torchslam.tracking.matcher import DescriptorMatcher, MatchIndices
from torchslam.types import FrameFeatures, PoseEstimate

OUTLIER_GATE_FACTOR = 4.0  # times the gate: twice as far off as what agrees may still turn out to


class Localizer:
    """Poses a frame by the points of a map, wherever in it; it keeps nothing and leaves the map as it is."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.camera = camera
        self.undistorted = Undistortion(camera)
        self.own = DescriptorMatcher(config.matching)  # for what is guided to a few pixels
        self.settings = config.tracking
        self.measurement = config.measurement
        self.least_share = config.pose_validation.min_inlier_ratio
        self.seed = config.seed

    def locate(
        self,
        slam_map: Map,
        view: FrameFeatures,
        candidates: Iterator[MatchIndices],
        local_points: Tensor,
        expected_T_cw: Tensor | None = None,
    ) -> PoseEstimate | None:
        """The pose by the first of several sets of matches that gives one, refined against the local points (n,).

        local_points:  ascending
        expected_T_cw: (4, 4) where it is looked for first; None where nobody knows

        Where too few of the matches agree with a pose, the next sets are heard too, and most inliers win.
        """
        best: PoseEstimate | None = None
        for pairs in candidates:
            estimate = self._locate(slam_map, view, pairs, local_points, expected_T_cw)
            if estimate is not None and (best is None or estimate.inliers > best.inliers):
                best = estimate
            if best is not None and best.inliers >= self.least_share * best.matches:
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
        """PnP over matches, then all local points near their projection, then robust refinement."""
        settings, point_ids, keypoints = self.settings, pairs.first, pairs.second
        if len(point_ids) < settings.min_matches:
            return None
        chosen = select_mature(slam_map.points["times_found"][point_ids], settings.min_matches)
        chosen = chosen[subsample_per_cell(view.keypoints[keypoints[chosen]], self.camera.size)]
        undistorted = self.undistorted(view.keypoints)
        points_w, heard = slam_map.positions_w[point_ids[chosen]], undistorted[keypoints[chosen]]
        T_cw = self._start(points_w, heard, expected_T_cw)
        if T_cw is None:
            return None
        candidates = self._local_points_with(slam_map, point_ids, local_points)
        near = self.project(slam_map, candidates, T_cw, view)
        guided = match_near(slam_map, near, view, settings.refine_radius_px, self.own, ratio=0.9)
        ids, at, noise = guided.first, guided.second, view.noise[guided.second]
        if len(ids) < settings.min_inliers:
            return None
        weights = weights_of(pairs, guided, len(view.mask))
        noise = noise if weights is None else noise.stated().weighed(weights)
        refined, errors, inliers = self._refine(
            slam_map, T_cw, ids, view.keypoints[at], undistorted[at], noise
        )
        if int(inliers.sum()) < settings.min_inliers:
            return None
        T_cw, seen = refined.T_cw, ids[inliers]
        return PoseEstimate(
            T_cw,
            seen,
            at[inliers],
            matches=len(ids),
            covariance=refined.covariance(),
            depth=float(refined.linearization.depths[inliers].median()),
            error=float(errors.median()),
            coverage_ratio=coverage_ratio(slam_map, near, seen, self.camera.size),
            explained_ratio=explained_ratio(view, at[inliers], self.camera.size),
            weights=None if weights is None else weights[inliers],
            expected=near.ids,
        )

    def _start(
        self, points_w: Tensor, seen: UndistortedKeypoints, expected_T_cw: Tensor | None
    ) -> Tensor | None:
        """The pose (4, 4) that most matches agree with: the one next to the expected one, or else by RANSAC."""
        threshold = self.settings.threshold_px
        T_cw = None if expected_T_cw is None else nearby_pose(expected_T_cw, points_w, seen, threshold)
        return start_pose(points_w, seen, self.camera.size, threshold, self.seed) if T_cw is None else T_cw

    def project(self, slam_map: Map, point_ids: Tensor, T_cw: Tensor, view: FrameFeatures) -> Projected:
        max_angle = self.settings.max_view_angle_deg
        return project_points(slam_map, point_ids, T_cw, self.camera, max_angle, view.scale_range)

    def _local_points_with(self, slam_map: Map, point_ids: Tensor, local_points: Tensor) -> Tensor:
        """The local points, or those around what was matched where that is elsewhere in the map."""
        if len(local_points) and _are_among(point_ids, local_points):
            return local_points
        return slam_map.points_seen_by(self.covisible_keyframes(slam_map, point_ids))

    def covisible_keyframes(self, slam_map: Map, point_ids: Tensor) -> Tensor:
        """(k,) the keyframe that sees most of the points (n,), and those that share most points with it."""
        keyframe = int(slam_map.observers(point_ids).argmax())
        near = slam_map.covisible(keyframe, self.settings.local_keyframes)
        return torch.cat([near.new_tensor([keyframe]), near])

    def _refine(
        self,
        slam_map: Map,
        T_cw: Tensor,
        ids: Tensor,
        pixels: Tensor,
        undistorted: UndistortedKeypoints,
        noise: KeypointNoise,
    ) -> tuple[FramePose, Tensor, Tensor]:
        """The pose, the squared errors (n,) in units of the noise, and (n,) who agrees with the pose.

        By least squares on what is not far from agreeing with T_cw, old points alone if there are enough of them, then
        on all that agrees with that.
        """
        problem = FrameProblem(slam_map.positions_w[ids], undistorted.xy, undistorted.whitened(noise))
        linearization = problem.linearize(T_cw)
        mask = fits(
            linearization.squared / noise.margin**2, OUTLIER_GATE_FACTOR * self.measurement.max_chi_square
        )
        old = mask & (slam_map.points["times_found"][ids] >= MATURE_OBSERVATIONS)
        if int(old.sum()) >= self.settings.min_matches:
            mask = old
        weights = grid_weights(pixels, self.camera.size)
        kernels: tuple[RobustKernel, ...] = ("cauchy", "huber")
        for kernel in kernels:
            refined = problem.minimize(linearization, weights * mask, kernel)
            linearization = refined.linearization
            errors = linearization.squared / noise.margin**2
            mask = self.agrees(slam_map, refined.T_cw, ids, pixels, noise, errors)
            if int(mask.sum()) < 6:
                break
        return refined, errors, mask

    def agrees(
        self,
        slam_map: Map,
        T_cw: Tensor,
        ids: Tensor,
        pixels: Tensor,
        noise: KeypointNoise,
        errors: Tensor | None = None,
    ) -> Tensor:
        """(n,) whether points are seen where they should be, by the configured gate.

        errors: (n,) squared, in units of the noise, where they are known

        The pose was fitted to these very pixels, so its own uncertainty does not widen the gate.
        """
        chi_square, points = self.measurement.max_chi_square, slam_map.points
        by_noise = self.measurement.gate == "chi_square"
        if by_noise and errors is not None:
            return fits(errors, chi_square)
        points_c = transform(T_cw, points["positions_w"][ids])
        if by_noise:
            return fits(noise.squared_reprojection(points_c, pixels, self.camera), chi_square)
        projected, valid, J_c, _ = self.camera.project_with_jacobians(points_c)
        innovations = innovation_covariances(J_c @ T_cw[:3, :3], points["covariances_w"][ids], noise.spread)
        return valid & (mahalanobis_squared(projected - pixels, innovations) < chi_square)


def weights_of(pairs: MatchIndices, guided: MatchIndices, keypoints: int) -> Tensor | None:
    """(n,) what a matcher gave to those of its pairs that a guided search found as well; None where it gave nothing.

    Pairs that the guided search alone found count as the median of the matcher's.
    """
    if pairs.weights is None:
        return None
    points = torch.full((keypoints,), -1, device=pairs.first.device).index_put((pairs.second,), pairs.first)
    weights = pairs.weights.new_zeros(keypoints).index_put((pairs.second,), pairs.weights)
    is_same = points[guided.second] == guided.first
    return torch.where(is_same, weights[guided.second], pairs.weights.median())


def _are_among(ids: Tensor, ascending: Tensor) -> bool:
    """Whether ids (n,) are all among others (m,), at least one; `isin` would sort them, which they are."""
    at = torch.searchsorted(ascending, ids).clamp_(max=len(ascending) - 1)
    return bool((ascending.index_select(0, at) == ids).all())
