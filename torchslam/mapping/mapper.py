"""What happens when a frame becomes a keyframe: observe, cull, triangulate, fuse, adjust."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.errors import ConfigError
from torchslam.geometry import Camera, se3_inverse, transform, triangulation_covariance
from torchslam.mapping.local_bundle import adjust
from torchslam.mapping.new_points import triangulate_against
from torchslam.stopwatch import Stopwatch
from torchslam.tracking.correspondences import match_near, project_points
from torchslam.values import Start, Tracked, View
from torchslam.world.map import Map


class Mapper:
    """Grows the map, keyframe by keyframe."""

    def __init__(self, camera: Camera, config: Config, slam_map: Map, clock: Stopwatch) -> None:
        self.camera = camera
        self.config = config
        self.map = slam_map
        self.clock = clock

    def start(self, start: Start) -> tuple[int, int]:
        """Make the first map of two views, at the configured scale; returns the two keyframes."""
        factor = world_scale(start, self.config.scale)
        T_cw = start.T_cw.clone()
        T_cw[:3, 3] *= factor
        T_1w = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        points_w, camera = start.points_w * factor, self.camera
        scales_1, scales_2 = start.reference.scales[start.keypoints_1], start.view.scales[start.keypoints_2]
        covariances_w = triangulation_covariance(T_1w, T_cw, points_w, scales_1, scales_2, camera, camera)
        first = self.map.add_keyframe(start.reference, T_1w)
        second = self.map.add_keyframe(start.view, T_cw)
        descriptors = start.view.descriptors[start.keypoints_2]
        ids = self.map.add_points(points_w, descriptors, second, covariances_w)
        self.map.observe(first, start.keypoints_1, ids)
        self.map.observe(second, start.keypoints_2, ids)
        self.map.refresh(self.map.ids(first, second))
        return first, second

    def insert(self, view: View, tracked: Tracked) -> int:
        """Make a tracked frame a keyframe; returns its index."""
        settings = self.config.mapping
        with self.clock("mapping"):
            keyframe = self.map.add_keyframe(view, tracked.T_cw)
            self.map.observe(keyframe, tracked.keypoints, tracked.point_ids)
            if settings.cull:
                self.cull_recent_points(keyframe)
            neighbours = self.map.covisible(keyframe, 2 * settings.neighbours)
            last = range(keyframe - 1, -1, -1)
            partners = neighbours.tolist() if settings.partners == "covisible" else last
            for neighbour in partners[: settings.neighbours]:
                triangulate_against(self.map, keyframe, neighbour, self.camera, self.config)
            self.map.refresh(self.map.ids(keyframe))
            if settings.fuse:
                self.fuse(keyframe, neighbours)
        if self.config.bundle.enabled:
            with self.clock("bundle"):
                wanted = self.config.tracking.gate == "mahalanobis"
                adjust(self.map, keyframe, self.camera, self.config.bundle, covariances=wanted)
        return keyframe

    def cull_recent_points(self, keyframe: int) -> None:
        """Kill young points that are rarely found where they should be visible, or that nobody else has seen."""
        points = self.map.points
        age = keyframe - points["born"]
        is_young = points["alive"] & (age <= 3)
        is_rarely_found = (
            points["times_found"] < self.config.mapping.min_found_share * points["times_visible"]
        )
        is_lonely = (age >= 2) & (points["times_observed"] < 3) & (points["born"] > 1)
        self.map.kill(torch.nonzero(is_young & (is_rarely_found | is_lonely))[:, 0])

    def fuse(self, keyframe: int, neighbours: Tensor) -> None:
        """Find the points of this keyframe in its neighbours and theirs in it; merge what turns out to be one point."""
        own = self.map.points_seen_by(self.map.ids(keyframe))
        self._merge([self._find_in(neighbour, own) for neighbour in neighbours.tolist()])
        self._merge([self._find_in(keyframe, self.map.points_seen_by(neighbours))])

    def _find_in(self, keyframe: int, point_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Match points (n,) that a keyframe does not see yet to its keypoints.

        Free keypoints see them from now on. Returns pairs (m,), (m,) of points that are one: found at a keypoint that
        sees another point already.
        """
        seen = self.map.keyframes["point_ids"][keyframe]
        new = point_ids[~torch.isin(point_ids, seen)]
        view, T_cw = self.map.view(keyframe), self.map.T_cw[keyframe]
        tracking = self.config.tracking
        projected = project_points(
            self.map, new, T_cw, self.camera, tracking.max_view_angle_deg, view.scale_range
        )
        ids, keypoints = match_near(self.map, projected, view, 3.0, self.config.matching, ratio=None)
        pixels, valid = self.camera.project(transform(T_cw, self.map.positions_w[ids]))
        errors = ((pixels - view.keypoints[keypoints]) ** 2).sum(-1)
        agrees = valid & (errors < tracking.chi_square * view.scales[keypoints] ** 2)
        ids, keypoints = ids[agrees], keypoints[agrees]
        taken = seen[keypoints]
        is_free = taken < 0
        self.map.observe(keyframe, keypoints[is_free], ids[is_free])
        return ids[~is_free], taken[~is_free]

    def _merge(self, pairs: list[tuple[Tensor, Tensor]]) -> None:
        """Merge pairs of points (m,), (m,): of those that are one, the one with most observations stays."""
        observed = self.map.points["times_observed"]
        heir: dict[int, int] = {}

        def last_heir(point: int) -> int:
            while point in heir:
                point = heir[point]
            return point

        for found, there in pairs:
            for pair in zip(found.tolist(), there.tolist(), strict=True):
                one, other = (last_heir(point) for point in pair)
                if one != other:
                    old, kept = (one, other) if observed[one] <= observed[other] else (other, one)
                    heir[old] = kept
        if heir:
            last = [last_heir(point) for point in heir.values()]
            self.map.replace(observed.new_tensor(list(heir)), observed.new_tensor(last))


def world_scale(start: Start, kind: str) -> float:
    """The factor from the unit baseline of a start to the lengths of the world.

    unit: the median depth in the first camera is one. groundtruth: the baseline has its true length.
    Raises ConfigError when the true poses are asked for and are not known.
    """
    if kind == "unit":
        return 1.0 / float(start.points_w[:, 2].median())
    truth_1, truth_2 = start.reference.T_cw_groundtruth, start.view.T_cw_groundtruth
    if truth_1 is None or truth_2 is None:
        raise ConfigError(
            'scale = "groundtruth" needs a sequence with ground truth at the first keyframes; use scale = "unit"'
        )
    true_baseline = torch.linalg.vector_norm(se3_inverse(truth_2)[:3, 3] - se3_inverse(truth_1)[:3, 3])
    return float(true_baseline / torch.linalg.vector_norm(start.T_cw[:3, 3]))
