"""What happens when a frame becomes a keyframe: observe, cull, triangulate, fuse, adjust."""

from __future__ import annotations

import torch

from torchslam.config import Config
from torchslam.errors import ConfigError
from torchslam.geometry import Camera, Undistortion, se3_inverse, triangulation_covariance
from torchslam.map.compaction import RowRemap, compact
from torchslam.map.map import Map
from torchslam.map.submap import Submap
from torchslam.mapping.async_bundle import AsyncBundleAdjustment
from torchslam.mapping.culling import cull_keyframes
from torchslam.mapping.fusion import fuse
from torchslam.mapping.new_points import triangulate_against
from torchslam.tracking.matcher import Matcher
from torchslam.types import FrameFeatures, PoseEstimate, TwoViewMap
from torchslam.utils.timing import Stopwatch

YOUNG = 3  # keyframes after its own for which a point is on trial


class Mapper:
    """Grows the map, keyframe by keyframe."""

    def __init__(
        self,
        camera: Camera,
        config: Config,
        clock: Stopwatch,
        matcher: Matcher | None = None,
        undistortion: Undistortion | None = None,
    ) -> None:
        """undistortion: of this camera, where somebody has one already"""
        self.camera = camera
        self.config = config
        self.clock = clock
        self.adjusting = AsyncBundleAdjustment(
            camera, config.bundle_adjustment, config.measurement.gate == "mahalanobis"
        )
        self.matcher = matcher
        self.undistortion = undistortion or Undistortion(camera)

    def start(self, slam_map: Map, start: TwoViewMap) -> tuple[int, int]:
        """Make the first map of two views, at the configured scale; returns the two keyframes."""
        factor = world_scale(start, self.config.scale)
        T_cw = start.T_cw.clone()
        T_cw[:3, 3] *= factor
        T_1w = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        points_w, camera = start.points_w * factor, self.camera
        spread_1 = start.reference.noise[start.keypoints_1].spread
        spread_2 = start.view.noise[start.keypoints_2].spread
        covariances_w = triangulation_covariance(T_1w, T_cw, points_w, spread_1, spread_2, camera, camera)
        first = slam_map.add_keyframe(start.reference, T_1w)
        second = slam_map.add_keyframe(start.view, T_cw)
        descriptors = start.view.descriptors[start.keypoints_2]
        ids = slam_map.add_points(points_w, descriptors, second, covariances_w, from_initialization=True)
        slam_map.observe(first, start.keypoints_1, ids)
        slam_map.observe(second, start.keypoints_2, ids)
        slam_map.refresh(slam_map.ids(first, second))
        return first, second

    def insert(
        self, slam_map: Map, view: FrameFeatures, tracked: PoseEstimate, delay: int | None = None
    ) -> int:
        """Make a tracked frame a keyframe; returns its index.

        delay: frames that are tracked before the adjustment around it is taken over, which has to be before the map
               changes; None: it is at once
        """
        settings = self.config.mapping
        with self.clock("mapping"):
            keyframe = slam_map.add_keyframe(view.weighed(tracked.keypoints, tracked.weights), tracked.T_cw)
            slam_map.observe(keyframe, tracked.keypoints, tracked.point_ids)
            if settings.cull:
                self.cull_recent_points(slam_map, keyframe)
            neighbours = slam_map.covisible(keyframe, 2 * settings.num_partners)
            last = range(keyframe - 1, max(keyframe - 1 - settings.num_partners, -1), -1)
            partners = neighbours if settings.triangulation_partners == "covisible" else slam_map.ids(*last)
            partners = partners[: settings.num_partners]
            normalize = self.undistortion.normalize
            triangulate_against(
                slam_map, keyframe, partners, self.camera, self.config, self.matcher, normalize
            )
            slam_map.refresh(slam_map.ids(keyframe))
            if settings.fuse:
                fuse(slam_map, keyframe, neighbours, self.camera, self.config)
        if self.config.bundle_adjustment.local:
            with self.clock("bundle"):
                self.adjusting.ask(slam_map, keyframe, view.index + delay if delay else None)
                if not delay:
                    self.adjusting.begin()
            if delay is None:
                self.take_over(slam_map)
        return keyframe

    def take_over(self, slam_map: Map) -> None:
        """Put the map to where the adjustment that was asked for has it."""
        with self.clock("bundle"):
            self.adjusting.take_over(slam_map)

    def tidy(self, world: Submap) -> RowRemap | None:
        """Take out what the world can do without: redundant keyframes, rows of dead points; returns where rows went.

        To be called when a keyframe was inserted and nobody holds rows of the map: after the frame went into the
        history. None if all rows stay.
        """
        with self.clock("mapping"):
            culled = cull_keyframes(world, self.config.keyframes) if self.config.mapping.cull else None
            compacted = compact(world)
        if culled is None or compacted is None:
            return culled or compacted
        return culled.then(compacted)

    def cull_recent_points(self, slam_map: Map, keyframe: int) -> None:
        """Kill young points that are rarely found where they should be visible, or that nobody else has seen."""
        points = slam_map.points
        young = torch.nonzero(points["first_keyframe"] >= keyframe - YOUNG)[:, 0]
        young = young[points["is_valid"][young]]
        age = keyframe - points["first_keyframe"][young]
        least = self.config.mapping.min_found_ratio
        is_rarely_found = points["times_found"][young] < least * points["times_visible"][young]
        is_lonely = (age >= 2) & (points["times_observed"][young] < 3) & ~points["from_initialization"][young]
        slam_map.invalidate(young[is_rarely_found | is_lonely])


def world_scale(start: TwoViewMap, kind: str) -> float:
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
