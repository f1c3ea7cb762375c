"""Where is the camera now? Predict, match the local map, PnP RANSAC, robust refinement."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    estimate_absolute_pose,
    innovation_covariances,
    mahalanobis_squared,
    se3_inverse,
    transform,
)
from torchslam.solvers import refine_pose
from torchslam.solvers.robust import Kernel
from torchslam.tracking.correspondences import Projected, match_near, match_points, project_points
from torchslam.values import Tracked, View
from torchslam.world.map import Map


class Tracker:
    """Follows the camera against the local map: the keyframes around the reference keyframe and their points."""

    def __init__(self, camera: Camera, config: Config, slam_map: Map) -> None:
        self.camera = camera
        self.config = config
        self.map = slam_map
        self.reference = -1  # keyframe
        self.reference_size = 0  # points of the reference keyframe that other keyframes see too
        # The last frame, seen from the reference: it moves with the map.
        self.T_cr = torch.eye(4, dtype=camera.params.dtype, device=camera.params.device)
        self.velocity: Tensor | None = None  # last motion, T_c_previous
        nobody = torch.empty(0, dtype=torch.int64, device=camera.params.device)
        self.seen_last, self.local_keyframes, self.local_points = nobody, nobody, nobody
        self.lost_for = 0

    # --- state -----------------------------------------------------------------------------------------------

    @property
    def T_cw(self) -> Tensor:
        """(4, 4) pose of the last tracked frame, by the map as it is now."""
        return self.T_cr @ self.map.T_cw[self.reference]

    def follow(self, keyframe: int) -> None:
        """Go on from a keyframe: the last frame is at its place."""
        self._set_reference(keyframe, self.map.T_cw[keyframe])
        self.lost_for = 0
        seen = self.map.keyframes["point_ids"][keyframe]
        self.seen_last = seen[seen >= 0]

    def _set_reference(self, keyframe: int, T_cw: Tensor) -> None:
        """The last frame is at T_cw, seen from this keyframe; what is around the keyframe becomes the local map."""
        self.T_cr = T_cw @ se3_inverse(self.map.T_cw[keyframe])
        self.reference = keyframe
        near = self.map.covisible(keyframe, self.config.tracking.local_keyframes)
        self.local_keyframes = torch.cat([near.new_tensor([keyframe]), near])
        self.reference_size = self._well_observed(keyframe)
        recent = self.config.tracking.recent_frames
        if recent:
            last_seen = self.map.points["last_seen"]
            self.local_points = torch.nonzero(
                (last_seen > last_seen.max() - recent) & self.map.points["alive"]
            )[:, 0]
        else:
            self.local_points = self.map.points_seen_by(self.local_keyframes)

    def _well_observed(self, keyframe: int) -> int:
        """How many points of a keyframe three local keyframes see: what the next frames can be expected to see."""
        table = self.map.keyframes["point_ids"]
        local = table[self.local_keyframes].flatten()
        counts = torch.bincount(local[local >= 0], minlength=len(self.map.points))
        seen = table[keyframe]
        return int((counts[seen[seen >= 0]] >= min(3, len(self.local_keyframes))).sum())

    def predict(self) -> Tensor:
        """(4, 4) where the next frame should be: constant velocity."""
        if self.velocity is None or not self.config.tracking.predict:
            return self.T_cw
        return self.velocity @ self.T_cw

    # --- one frame -------------------------------------------------------------------------------------------

    def track(self, view: View) -> Tracked | None:
        """Locate a frame; None when it cannot be located."""
        candidates = (
            self._relocalization_candidates(view) if self.lost_for else self._tracking_candidates(view)
        )
        for point_ids, keypoints in candidates:
            tracked = self._locate(view, point_ids, keypoints)
            if tracked is not None:
                self._accept(view, tracked)
                return tracked
        self.lost_for += 1
        self.velocity = None
        return None

    def _tracking_candidates(self, view: View) -> Iterator[tuple[Tensor, Tensor]]:
        """Ever wider guesses of who matches whom: near the prediction, in a wider window, anywhere."""
        settings, matching = self.config.tracking, self.config.matching
        T_cw = self.predict()
        if settings.guided:
            alive = self.seen_last[self.map.points["alive"][self.seen_last]]
            near = self._project(alive, T_cw, view)
            yield match_near(self.map, near, view, settings.radius_px, matching, ratio=0.9)
            local = self._project(self.local_points, T_cw, view)
            wide = settings.radius_px * settings.wide_radius_factor
            yield match_near(self.map, local, view, wide, matching, ratio=0.9)
        else:
            local = self._project(self.local_points, T_cw, view)
        yield match_points(self.map, local.ids, view, matching)
        yield match_points(self.map, self.local_points, view, matching)

    def _relocalization_candidates(self, view: View) -> Iterator[tuple[Tensor, Tensor]]:
        """The local map, then a few keyframes in turn, so that all are tried in the end at a bounded cost a frame."""
        yield match_points(self.map, self.local_points, view, self.config.matching)
        count = self.map.num_keyframes
        for offset in range(min(3, count)):
            keyframe = (count - 1 - 3 * (self.lost_for - 1) - offset) % count
            ids = self.map.points_seen_by(self.map.ids(keyframe))
            yield match_points(self.map, ids, view, self.config.matching)

    def _locate(self, view: View, point_ids: Tensor, keypoints: Tensor) -> Tracked | None:
        """PnP RANSAC over matches, then all local points near their projection, then robust refinement."""
        settings = self.config.tracking
        if len(point_ids) < settings.min_matches:
            return None
        pose = estimate_absolute_pose(
            self.map.positions_w[point_ids][None],
            view.keypoints[keypoints][None],
            self.camera,
            threshold=settings.threshold_px,
            seed=self.config.seed,
        )
        if not bool(pose.success[0]):
            return None
        T_cw = pose.T_cw[0]
        candidates = self._local_points_with(point_ids)
        near = self._project(candidates, T_cw, view)
        ids, at = match_near(self.map, near, view, settings.refine_radius_px, self.config.matching, ratio=0.9)
        if len(ids) < settings.min_inliers:
            return None
        T_cw, inliers = self._refine(T_cw, ids, view.keypoints[at], view.scales[at])
        tracked = Tracked(T_cw, ids[inliers], at[inliers], len(ids))
        if tracked.inliers < settings.min_inliers:
            return None
        self.map.points["times_visible"][near.ids] += 1
        return tracked

    def _project(self, point_ids: Tensor, T_cw: Tensor, view: View) -> Projected:
        max_angle = self.config.tracking.max_view_angle_deg
        return project_points(self.map, point_ids, T_cw, self.camera, max_angle, view.scale_range)

    def _local_points_with(self, point_ids: Tensor) -> Tensor:
        """The local points, and those that were just matched elsewhere in the map."""
        if len(self.local_points) and bool(torch.isin(point_ids, self.local_points).all()):
            return self.local_points
        keyframe = int(self.map.observers(point_ids).argmax())
        near = self.map.covisible(keyframe, self.config.tracking.local_keyframes)
        return self.map.points_seen_by(torch.cat([near.new_tensor([keyframe]), near]))

    def _refine(self, T_cw: Tensor, ids: Tensor, pixels: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
        """(4, 4) and (n,): the pose by robust least squares, once on all matches and once on those that agree."""
        points_w = self.map.positions_w[ids]
        mask = torch.ones(len(ids), dtype=torch.bool, device=ids.device)
        passes: tuple[tuple[Kernel, int], ...] = (("cauchy", 10), ("huber", 5))
        for kernel, iterations in passes:
            refined = refine_pose(
                T_cw[None],
                points_w[None],
                pixels[None],
                self.camera,
                weights=(scales**-2)[None],
                mask=mask[None],
                kernel=kernel,
                scale=2.0,
                iterations=iterations,
                backward="detached",
            )
            T_cw = refined.T_cw[0]
            mask = self._agrees(T_cw, ids, pixels, scales)
            if int(mask.sum()) < 6:
                break
        return T_cw, mask

    def _agrees(self, T_cw: Tensor, ids: Tensor, pixels: Tensor, scales: Tensor) -> Tensor:
        """(n,) whether points are seen where they should be, by the configured gate.

        The pose was fitted to these very pixels, so its own uncertainty does not widen the gate.
        """
        settings, points = self.config.tracking, self.map.points
        points_c = transform(T_cw, points["positions_w"][ids])
        if settings.gate == "chi_square":
            projected, valid = self.camera.project(points_c)
            errors = ((projected - pixels) ** 2).sum(-1)
            return valid & (errors < settings.chi_square * scales**2)
        projected, valid, J_c, _ = self.camera.project_with_jacobians(points_c)
        innovations = innovation_covariances(J_c @ T_cw[:3, :3], points["covariances_w"][ids], scales)
        return valid & (mahalanobis_squared(projected - pixels, innovations) < settings.chi_square)

    def _accept(self, view: View, tracked: Tracked) -> None:
        """Take the frame over into the state: velocity, reference keyframe, counters of the points."""
        was_lost, previous = self.lost_for > 0, self.T_cw
        self.lost_for = 0
        self.velocity = None if was_lost else tracked.T_cw @ se3_inverse(previous)
        self.seen_last = tracked.point_ids
        self.map.points["times_found"][tracked.point_ids] += 1
        self.map.points["last_seen"][tracked.point_ids] = view.index
        best = self._best_reference(tracked.point_ids, everywhere=was_lost)
        if best != self.reference:
            self._set_reference(best, tracked.T_cw)
        else:
            self.T_cr = tracked.T_cw @ se3_inverse(self.map.T_cw[self.reference])

    def _best_reference(self, point_ids: Tensor, everywhere: bool) -> int:
        """The local keyframe that shares most points with the frame; of all keyframes after being lost."""
        if everywhere:
            return int(self.map.observers(point_ids).argmax())
        shared = self.map.observers(point_ids, self.local_keyframes)
        return int(self.local_keyframes[shared.argmax()])
