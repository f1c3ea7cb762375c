"""Where is the camera now? Predict, match the local map, PnP near the prediction or by RANSAC, robust refinement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    Noise,
    Undistorted,
    Undistortion,
    fits,
    innovation_covariances,
    mahalanobis_squared,
    se3_inverse,
    start_pose,
    transform,
)
from torchslam.geometry.motion import reorthonormalized
from torchslam.geometry.robust import Kernel
from torchslam.solvers import RefinedPose, refine_pose
from torchslam.solvers.frame_pose import FramePose, FrameProblem, RobustKernel
from torchslam.solvers.nearby_pose import nearby_pose
from torchslam.tracking.correspondences import Projected, match_near, match_points, project_points
from torchslam.tracking.matcher import DescriptorMatcher, Matcher, Pairs, matcher_of
from torchslam.tracking.spread import SENIOR, coverage, explained, spread, trusted, voices
from torchslam.values import Tracked, View
from torchslam.world.map import Map
from torchslam.world.track import Track
from torchslam.world.world import World

MEMORY = 0.1  # share of the newest frame in what the track remembers: that of the last ten or so
NEGLIGIBLE = 1e-4  # share of the cost that a step promises: less moves the pose by hundredths of its noise
FAR = 4.0  # times the gate: twice as far off as what agrees may still turn out to


class Tracker:
    """Follows the camera against the local map: the keyframes around the reference keyframe and their points.

    It keeps nothing itself: where the camera was is the track of the world.

    counts: whether points remember when and how often they were seen; without it, tracking leaves the map as it is
    """

    counts = True

    def __init__(self, camera: Camera, config: Config, matcher: Matcher | None = None) -> None:
        self.camera = camera
        self.undistorted = Undistortion(camera)
        self.matcher = matcher_of(config.matching, matcher)
        self.own = DescriptorMatcher(config.matching)  # for what is guided to a few pixels
        self.settings = config.tracking
        self.matching = config.matching
        self.measurement = config.measurement
        self.least_share = config.judge.min_inlier_share
        self.seed = config.seed

    # --- the track -------------------------------------------------------------------------------------------

    def follow(self, world: World, keyframe: int) -> None:
        """Go on from a keyframe: the last frame is at its place."""
        T_cw = world.map.T_cw[keyframe]
        seen = world.map.keyframes["point_ids"][keyframe]
        world.track = replace(
            self._around(world.map, keyframe, T_cw),
            velocity=world.track.velocity,
            seen_last=seen[seen >= 0],
            error=world.track.error,
            explained=world.track.explained,
        )

    def _around(self, slam_map: Map, keyframe: int, T_cw: Tensor) -> Track:
        """A track that is at T_cw, seen from this keyframe; what is around the keyframe is the local map."""
        near = slam_map.covisible(keyframe, self.settings.local_keyframes)
        local_keyframes = torch.cat([near.new_tensor([keyframe]), near])
        recent = self.settings.recent_frames if self.counts else 0
        if recent:
            last_seen = slam_map.points["last_seen"]
            local_points = torch.nonzero((last_seen > last_seen.max() - recent) & slam_map.points["alive"])[
                :, 0
            ]
        else:
            local_points = slam_map.points_seen_by(local_keyframes)
        return Track(
            T_cr=T_cw @ se3_inverse(slam_map.T_cw[keyframe]),
            reference=keyframe,
            reference_size=well_observed(slam_map, keyframe, local_keyframes),
            velocity=None,
            seen_last=local_points[:0],
            local_keyframes=local_keyframes,
            local_points=local_points,
        )

    def predict(self, world: World) -> Tensor:
        """(4, 4) where the next frame should be: constant velocity."""
        if world.track.velocity is None or not self.settings.predict:
            return world.T_cw
        return reorthonormalized(world.track.velocity @ world.T_cw)

    # --- one frame -------------------------------------------------------------------------------------------

    def track(self, world: World, view: View, is_sure: bool = True) -> Tracked | None:
        """Locate the frame that comes after the last one; None when it cannot be located.

        is_sure: the last frames are believed, so that the pose is looked for next to where they lead
        """
        expected = self.predict(world)
        candidates = self._candidates(world, view, expected)
        tracked = self.locate(
            world.map, view, candidates, world.track.local_points, expected if is_sure else None
        )
        if tracked is None:
            world.track.velocity = None
            return None
        self.accept(world, view, tracked)
        return tracked

    def _candidates(self, world: World, view: View, T_cw: Tensor) -> Iterator[Pairs]:
        """Ever wider guesses of who matches whom: near the prediction, in a wider window, anywhere."""
        slam_map, track, settings = world.map, world.track, self.settings
        if settings.guided:
            alive = track.seen_last[slam_map.points["alive"][track.seen_last]]
            near = self._project(slam_map, alive, T_cw, view)
            yield match_near(slam_map, near, view, settings.radius_px, self.matcher, ratio=0.9)
            local = self._project(slam_map, track.local_points, T_cw, view)
            wide = settings.radius_px * settings.wide_radius_factor
            yield match_near(slam_map, local, view, wide, self.matcher, ratio=0.9)
        else:
            local = self._project(slam_map, track.local_points, T_cw, view)
        yield match_points(slam_map, local.ids, view, self.matching)
        yield match_points(slam_map, track.local_points, view, self.matching)

    def locate(
        self,
        slam_map: Map,
        view: View,
        candidates: Iterator[Pairs],
        local_points: Tensor,
        expected_T_cw: Tensor | None = None,
    ) -> Tracked | None:
        """The pose by the first of several sets of matches that gives one, refined against the local points (n,).

        expected_T_cw: (4, 4) where it is looked for first; None where nobody knows

        Where too few of the matches agree with a pose, the next sets are heard too, and most inliers win.
        """
        best: Tracked | None = None
        for pairs in candidates:
            tracked = self._locate(slam_map, view, pairs, local_points, expected_T_cw)
            if tracked is not None and (best is None or tracked.inliers > best.inliers):
                best = tracked
            if best is not None and best.inliers >= self.least_share * best.matches:
                break
        return best

    def _locate(
        self,
        slam_map: Map,
        view: View,
        pairs: Pairs,
        local_points: Tensor,
        expected_T_cw: Tensor | None,
    ) -> Tracked | None:
        """PnP over matches, then all local points near their projection, then robust refinement."""
        settings, point_ids, keypoints = self.settings, pairs.first, pairs.second
        if len(point_ids) < settings.min_matches:
            return None
        chosen = trusted(slam_map.points["times_found"][point_ids], settings.min_matches)
        chosen = chosen[spread(view.keypoints[keypoints[chosen]], self.camera.size)]
        undistorted = self.undistorted(view.keypoints)
        points_w, heard = slam_map.positions_w[point_ids[chosen]], undistorted[keypoints[chosen]]
        T_cw = self._start(points_w, heard, expected_T_cw)
        if T_cw is None:
            return None
        candidates = self._local_points_with(slam_map, point_ids, local_points)
        near = self._project(slam_map, candidates, T_cw, view)
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
        return Tracked(
            T_cw,
            seen,
            at[inliers],
            matches=len(ids),
            covariance=refined.covariance(),
            depth=float(refined.sighting.depths[inliers].median()),
            error=float(errors.median()),
            coverage=coverage(slam_map, near, seen, self.camera.size),
            explained=explained(view, at[inliers], self.camera.size),
            weights=None if weights is None else weights[inliers],
            expected=near.ids,
        )

    def _start(self, points_w: Tensor, seen: Undistorted, expected_T_cw: Tensor | None) -> Tensor | None:
        """The pose (4, 4) that most matches agree with: the one next to the expected one, or else by RANSAC."""
        threshold = self.settings.threshold_px
        T_cw = None if expected_T_cw is None else nearby_pose(expected_T_cw, points_w, seen, threshold)
        return start_pose(points_w, seen, self.camera.size, threshold, self.seed) if T_cw is None else T_cw

    def _project(self, slam_map: Map, point_ids: Tensor, T_cw: Tensor, view: View) -> Projected:
        max_angle = self.settings.max_view_angle_deg
        return project_points(slam_map, point_ids, T_cw, self.camera, max_angle, view.scale_range)

    def _local_points_with(self, slam_map: Map, point_ids: Tensor, local_points: Tensor) -> Tensor:
        """The local points, or those around what was matched where that is elsewhere in the map."""
        if len(local_points) and bool(torch.isin(point_ids, local_points).all()):
            return local_points
        return slam_map.points_seen_by(self.around(slam_map, point_ids))

    def around(self, slam_map: Map, point_ids: Tensor) -> Tensor:
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
        undistorted: Undistorted,
        noise: Noise,
    ) -> tuple[FramePose, Tensor, Tensor]:
        """The pose, the squared errors (n,) in units of the noise, and (n,) who agrees with the pose.

        By least squares on what is not far from agreeing with T_cw, old points alone if there are enough of them, then
        on all that agrees with that.
        """
        problem = FrameProblem(slam_map.positions_w[ids], undistorted.xy, undistorted.whitened(noise))
        sighting = problem.see(T_cw)
        mask = fits(sighting.squared / noise.margin**2, FAR * self.measurement.chi_square)
        old = mask & (slam_map.points["times_found"][ids] >= SENIOR)
        if int(old.sum()) >= self.settings.min_matches:
            mask = old
        weights = voices(pixels, self.camera.size)
        kernels: tuple[RobustKernel, ...] = ("cauchy", "huber")
        for kernel in kernels:
            refined = problem.minimize(sighting, weights * mask, kernel)
            sighting = refined.sighting
            errors = sighting.squared / noise.margin**2
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
        noise: Noise,
        errors: Tensor | None = None,
    ) -> Tensor:
        """(n,) whether points are seen where they should be, by the configured gate.

        errors: (n,) squared, in units of the noise, where they are known

        The pose was fitted to these very pixels, so its own uncertainty does not widen the gate.
        """
        chi_square, points = self.measurement.chi_square, slam_map.points
        by_noise = self.measurement.gate == "chi_square"
        if by_noise and errors is not None:
            return fits(errors, chi_square)
        points_c = transform(T_cw, points["positions_w"][ids])
        if by_noise:
            return fits(noise.squared_reprojection(points_c, pixels, self.camera), chi_square)
        projected, valid, J_c, _ = self.camera.project_with_jacobians(points_c)
        innovations = innovation_covariances(J_c @ T_cw[:3, :3], points["covariances_w"][ids], noise.spread)
        return valid & (mahalanobis_squared(projected - pixels, innovations) < chi_square)

    def accept(self, world: World, view: View, tracked: Tracked) -> None:
        """Take a frame over into the track: velocity, reference keyframe, counters of the points."""
        slam_map, track = world.map, world.track
        track.velocity = tracked.T_cw @ se3_inverse(world.T_cw)
        track.seen_last = tracked.point_ids
        track.error += MEMORY * (tracked.error - track.error)
        track.explained += MEMORY * (tracked.explained - track.explained)
        self._count(slam_map, view, tracked)
        shared = slam_map.observers(tracked.point_ids, track.local_keyframes)
        best = int(track.local_keyframes[shared.argmax()])
        if best == track.reference:
            track.T_cr = tracked.T_cw @ se3_inverse(slam_map.T_cw[best])
        else:
            world.track = replace(
                self._around(slam_map, best, tracked.T_cw),
                velocity=track.velocity,
                seen_last=track.seen_last,
                error=track.error,
                explained=track.explained,
            )

    def start_at(self, world: World, view: View, tracked: Tracked) -> None:
        """Begin a track anew, wherever in the map: at a frame that was located without one."""
        best = int(world.map.observers(tracked.point_ids).argmax())
        self._count(world.map, view, tracked)
        world.track = replace(
            self._around(world.map, best, tracked.T_cw), velocity=None, seen_last=tracked.point_ids
        )

    def expect(self, slam_map: Map, tracked: Tracked) -> None:
        """A frame is believed: the points that it should see were there to be seen."""
        if self.counts:
            expected = tracked.point_ids if tracked.expected is None else tracked.expected
            slam_map.points["times_visible"][expected] += 1

    def vouch(self, slam_map: Map, tracked: Tracked) -> None:
        """A frame is believed: it speaks for the points that it saw."""
        if self.counts:
            slam_map.points["times_found"][tracked.point_ids] += 1

    def _count(self, slam_map: Map, view: View, tracked: Tracked) -> None:
        """The points that a frame saw remember when that was."""
        if self.counts:
            slam_map.points["last_seen"][tracked.point_ids] = view.index


def refine_one(
    T_cw: Tensor,
    points_w: Tensor,
    pixels: Tensor,
    camera: Camera,
    weights: Tensor,
    mask: Tensor,
    kernel: Kernel,
) -> RefinedPose:
    """The pose of one frame (4, 4) by points (n, 3) at pixels (n, 2), as exactly as its noise is worth."""
    return refine_pose(
        T_cw[None],
        points_w[None],
        pixels[None],
        camera,
        weights=weights[None],
        mask=mask[None],
        kernel=kernel,
        scale=2.0,
        backward="detached",
        iterations=10,
        tolerance=NEGLIGIBLE,
    )


def weights_of(pairs: Pairs, guided: Pairs, keypoints: int) -> Tensor | None:
    """(n,) what a matcher gave to those of its pairs that a guided search found as well; None where it gave nothing.

    Pairs that the guided search alone found count as the median of the matcher's.
    """
    if pairs.weights is None:
        return None
    points = torch.full((keypoints,), -1, device=pairs.first.device).index_put((pairs.second,), pairs.first)
    weights = pairs.weights.new_zeros(keypoints).index_put((pairs.second,), pairs.weights)
    is_same = points[guided.second] == guided.first
    return torch.where(is_same, weights[guided.second], pairs.weights.median())


def well_observed(slam_map: Map, keyframe: int, local_keyframes: Tensor) -> int:
    """How many points of a keyframe three local keyframes see: what the next frames can be expected to see."""
    table = slam_map.keyframes["point_ids"]
    local = table[local_keyframes].flatten()
    counts = torch.bincount(local[local >= 0], minlength=len(slam_map.points))
    seen = table[keyframe]
    return int((counts[seen[seen >= 0]] >= min(3, len(local_keyframes))).sum())
