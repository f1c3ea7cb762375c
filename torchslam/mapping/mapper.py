"""Local mapping: when a frame becomes a keyframe, and what a keyframe does to the map.

A new keyframe observes, culls recent points, triangulates new ones, fuses duplicates and requests a local bundle
adjustment. `MapInitializer` builds the first map of a submap from two views.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config, KeyframesConfig
from torchslam.errors import ConfigError
from torchslam.geometry import SharedCamera, se3_inverse, transform, triangulation_covariance
from torchslam.geometry.transforms import pose_distance
from torchslam.map.atlas import Submap
from torchslam.map.compaction import RowRemap, compact, remove_keyframes
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import ApplyAt, AsyncBundleAdjustment
from torchslam.mapping.new_points import fuse, triangulate_against
from torchslam.tracking.tracker import Tracker
from torchslam.types import Explanation, FrameFeatures, Matcher, PoseEstimate, Reason, Rejection, TwoViewMap
from torchslam.utils.timing import Stopwatch

NUM_PARTNERS = 5
"""Keyframes against which new points are triangulated; twice as many are searched for duplicates. Tried at this value
only."""
DELAY_FRAMES = 2
"""Frames tracked before the result of a local bundle adjustment is applied, which a worker process computes meanwhile.
Tried from 0 to 3, with errors that differ by a tenth."""
MIN_FOUND_RATIO = 0.25
"""Ratio of the frames that found a point to those in which it was visible: ORB-SLAM's. Tried at this value only."""
MIN_POINTS = 80
"""Tracked points below which a frame becomes a keyframe, since they will soon be too few. Such a keyframe does not wait
for an adjustment of the whole map, and that around it is applied before the next frame: where they wait, 7 of 20 seeds
of office_loop are lost at a turn, here one. For that, tried at 60 as well, with which 8 are lost."""
RECENT_KEYFRAMES = 3
"""Number of keyframes after its first one for which a point may be culled."""
MIN_EXPLAINED_RATIO = 0.8
"""Ratio of the frames since the reference frame that must have a pose in a new map. Tried at this value only."""
MIN_POSE_SUPPORT = 0.5
"""Ratio of a frame's matches that must be inliers for the frame to support a new map: a majority."""
LIVE_MIN_OVERLAP = 0.4
"""Overlap above which keyframes wait for as many frames as a live camera is ahead, since late frames are dropped, and
for an adjustment of the whole map.

Half of the default `min_overlap`, so that tracking stays safe."""

MIN_COVERED_RATIO = 0.9
"""Ratio of a keyframe's points that other keyframes must observe."""
MIN_OBSERVERS = 3
"""Number of other keyframes that must observe each of these points."""
MAX_SCALE_RATIO = 1.25
"""Ratio of scales up to which an observation counts: one pyramid level (a factor of 1.2) coarser is accepted."""
NUM_NEWEST_KEPT = 8
"""Newest keyframes, which are never culled: their points are recent, and tracking continues from them."""
NUM_COVISIBLE = 20
"""Keyframes that are checked around each new one."""
_LEAST_BATCH, _BATCH_SHARE = 8, 16
"""Culling runs after this many new keyframes, or this part of the map: copying rows then costs O(1) per keyframe."""


class Mapper:
    """Inserts keyframes into a map."""

    def __init__(
        self, camera: SharedCamera, config: Config, clock: Stopwatch, matcher: Matcher | None = None
    ) -> None:
        self.camera = camera
        self.config = config
        self.clock = clock
        self.adjustment = AsyncBundleAdjustment(camera)
        self.matcher = matcher

    def start(self, slam_map: Map, start: TwoViewMap) -> tuple[int, int]:
        """Create the first map of two views at the configured scale; return the rows of the two keyframes."""
        factor = initial_scale(start, self.config.scale)
        T_cw = start.T_cw.clone()
        T_cw[:3, 3] *= factor
        T_1w = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        points_w, camera = start.points_w * factor, self.camera.current
        spread_1 = start.reference.noise[start.keypoints_1].sigma_or_covariance
        spread_2 = start.view.noise[start.keypoints_2].sigma_or_covariance
        covariances_w = triangulation_covariance(T_1w, T_cw, points_w, spread_1, spread_2, camera, camera)
        first = slam_map.add_keyframe(start.reference, T_1w)
        second = slam_map.add_keyframe(start.view, T_cw)
        descriptors = start.view.descriptors[start.keypoints_2]
        ids = slam_map.add_points(points_w, descriptors, second, covariances_w, from_initialization=True)
        slam_map.add_observations(first, start.keypoints_1, ids)
        slam_map.add_observations(second, start.keypoints_2, ids)
        slam_map.update_appearance(slam_map.index_tensor(first, second))
        return first, second

    def insert(
        self, slam_map: Map, view: FrameFeatures, estimate: PoseEstimate, apply_at: ApplyAt = ApplyAt.NOW
    ) -> int:
        """Insert a tracked frame as a keyframe: observe, cull points, triangulate, fuse, request local adjustment.

        Until the adjustment is applied (`apply_at`), the map must not change. Returns the row of the keyframe.
        """
        is_plain = self.config.paper.last_keyframe
        with self.clock("mapping"):
            keyframe = slam_map.add_keyframe(
                view.weighed(estimate.keypoints, estimate.weights), estimate.T_cw
            )
            slam_map.add_observations(keyframe, estimate.keypoints, estimate.point_ids)
            if not is_plain:
                self.cull_recent_points(slam_map, keyframe)
            neighbors = slam_map.covisible_keyframes(keyframe, 2 * NUM_PARTNERS)
            partners = slam_map.index_tensor(keyframe - 1) if is_plain else neighbors[:NUM_PARTNERS]
            normalize = self.camera.undistortion.normalize
            triangulate_against(
                slam_map, keyframe, partners, self.camera.current, self.config, self.matcher, normalize
            )
            slam_map.update_appearance(slam_map.index_tensor(keyframe))
            if not is_plain:
                here = slam_map.index_tensor(keyframe)
                fuse(slam_map, neighbors, here, self.camera.current, self.config)
        if not self.config.paper.unrefined:
            is_delayed = apply_at is ApplyAt.AFTER_DELAY
            with self.clock("bundle"):
                due = view.index + DELAY_FRAMES if is_delayed else None
                self.adjustment.request(slam_map, keyframe, due)
                if not is_delayed:
                    self.adjustment.start()
            if apply_at is ApplyAt.NOW:
                self.apply_adjustment(slam_map)
        return keyframe

    def apply_adjustment(self, slam_map: Map) -> None:
        """Wait for the pending local bundle adjustment and apply it to the map."""
        with self.clock("bundle"):
            self.adjustment.apply(slam_map)

    def cull_and_compact(self, submap: Submap) -> RowRemap | None:
        """Remove redundant keyframes and the rows of invalid points; return where rows went, or None if all stay.

        Renumbers rows, see `Map.version`.
        """
        with self.clock("mapping"):
            is_plain = self.config.paper.last_keyframe
            culled = None if is_plain else cull_keyframes(submap, self.config.keyframes)
            compacted = compact(submap)
        if culled is None or compacted is None:
            return culled or compacted
        return culled.then(compacted)

    def cull_recent_points(self, slam_map: Map, keyframe: int) -> None:
        """Remove recent points that are rarely found where visible, or that too few keyframes observe."""
        points = slam_map.points
        recent = torch.nonzero(points["first_keyframe"] >= keyframe - RECENT_KEYFRAMES)[:, 0]
        recent = recent[points["is_valid"][recent]]
        age = keyframe - points["first_keyframe"][recent]
        visible = points["times_visible"][recent].float()
        is_rarely_found = points["times_found"][recent] < MIN_FOUND_RATIO * visible
        is_seldom_observed = (points["times_observed"][recent] < 3) & ~points["from_initialization"][recent]
        is_unconfirmed = (age >= 2) & is_seldom_observed
        slam_map.remove_points(recent[is_rarely_found | is_unconfirmed])


def cull_keyframes(submap: Submap, settings: KeyframesConfig) -> RowRemap | None:
    """Remove redundant keyframes, a batch at a time; return where rows went, or None if nothing was removed.

    Candidates are covisible with those inserted since the last culling, the newest first. The first keyframe, the
    newest ones and the reference keyframe of tracking always stay.
    """
    slam_map, count = submap.map, submap.map.num_keyframes
    if count - submap.num_cull_checked < max(_LEAST_BATCH, count // _BATCH_SHARE):
        return None
    new = slam_map.index_tensor(*range(submap.num_cull_checked, count))
    candidates = slam_map.covisibility_union(new, NUM_COVISIBLE)
    may_go = (candidates > 0) & (candidates < count - NUM_NEWEST_KEPT)
    candidates = candidates[may_go & (candidates != submap.tracking.reference)].flip(0)
    removed = redundant_keyframes(submap, candidates, settings)
    renumbering = remove_keyframes(submap, torch.nonzero(removed)[:, 0]) if bool(removed.any()) else None
    submap.num_cull_checked = submap.map.num_keyframes
    return renumbering


def redundant_keyframes(
    submap: Submap, candidates: Int[Tensor, " R"], settings: KeyframesConfig
) -> Bool[Tensor, " K"]:
    """Return which keyframes, of the candidates, are redundant, decided one after the other."""
    removed = torch.zeros(submap.map.num_keyframes, dtype=torch.bool, device=candidates.device)
    for keyframe in candidates.tolist():
        removed[keyframe] = is_covered(submap.map, keyframe, removed) and has_keyframe_nearby(
            submap.map, keyframe, removed, settings
        )
    return removed


def is_covered(slam_map: Map, keyframe: int, removed: Bool[Tensor, " K"]) -> bool:
    """Whether enough remaining keyframes observe the points of a keyframe at a similar or finer scale."""
    seen = slam_map.observations(slam_map.index_tensor(keyframe))
    observers, scales = slam_map.observers_and_scales(seen.point_index)
    counts = (
        (observers >= 0)
        & (observers != keyframe)
        & ~removed[observers]
        & (scales <= MAX_SCALE_RATIO * seen.scales[:, None])
    )
    return float((counts.sum(1) >= MIN_OBSERVERS).double().mean()) >= MIN_COVERED_RATIO if len(seen) else True


def has_keyframe_nearby(
    slam_map: Map, keyframe: int, removed: Bool[Tensor, " K"], settings: KeyframesConfig
) -> bool:
    """Whether a remaining keyframe is so close that a frame at this pose would not become a keyframe."""
    covisible = slam_map.covisible_keyframes(keyframe, NUM_COVISIBLE)
    covisible = covisible[~removed[covisible]]
    T_cw = slam_map.T_cw[keyframe]
    seen = slam_map.observed_points(slam_map.index_tensor(keyframe))
    depth = transform(T_cw, slam_map.positions_w[seen])[:, 2].median()
    translation, rotation = pose_distance(T_cw, slam_map.T_cw[covisible], depth)
    return bool(((translation <= settings.max_translation) & (rotation <= settings.max_rotation_deg)).any())


def remove_masked_observations(
    submap: Submap, is_masked: Callable[[Float[Tensor, "N 2"]], Bool[Tensor, " N"]]
) -> None:
    """Remove observations of the local keyframes at pixels for which `is_masked` is true."""
    slam_map = submap.map
    seen = slam_map.observations(torch.sort(submap.tracking.local_keyframes).values, as_detected=True)
    slam_map.remove_masked_observations(seen, is_masked(seen.pixels))


def initial_scale(start: TwoViewMap, kind: str) -> float:
    """Return the factor from the unit baseline of a two-view map to the map unit.

    With "unit" the median depth in the first camera is one, with "groundtruth" the baseline has its true length.

    Raises:
        ConfigError: If the true poses are needed and not known.
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


class MapInitializer:
    """Initializes an empty submap from two views and checks it with the frames between them."""

    def __init__(self, tracker: Tracker, mapper: Mapper) -> None:
        self.tracker = tracker
        self.mapper = mapper

    def build(self, submap: Submap, start: TwoViewMap, views: list[FrameFeatures]) -> Rejection | None:
        """Build the first map of two views and pose the frames between them; return why it is rejected, or None.

        Tracking continues from the second view.
        """
        first, second = self.mapper.start(submap.map, start)
        self.tracker.reset_to_keyframe(submap, first)
        explained = [self._explains(submap, view) for view in views]
        self.tracker.reset_to_keyframe(submap, second)
        if sum(explained) < MIN_EXPLAINED_RATIO * len(explained):
            return Rejection.of(Reason.FRAMES_UNEXPLAINED, count=sum(explained), frames=len(explained))
        return None

    def _explains(self, submap: Submap, view: FrameFeatures) -> bool:
        """Pose a frame from before the map was initialized; return whether most of its matches are inliers."""
        view = self.tracker.at_middle_row(submap, view)
        estimate = self.tracker.track(submap, view)
        self.tracker.commit(submap, view, estimate)
        if estimate is None:
            return False
        self.tracker.count_found(submap.map, estimate)
        submap.posed_frames.add(view, estimate, submap.tracking.T_cr, submap.tracking.reference)
        return estimate.inliers > MIN_POSE_SUPPORT * estimate.matches


def overlap_with_reference(estimate: PoseEstimate, submap: Submap) -> float:
    """Observed points of a tracked frame as a ratio of those of its reference keyframe."""
    return estimate.inliers / max(submap.tracking.reference_size, 1)


def keyframe_reason(
    view: FrameFeatures, estimate: PoseEstimate, submap: Submap, settings: KeyframesConfig
) -> Explanation | None:
    """Return why a tracked frame should become a keyframe; None if it should not.

    Either it is far from all local keyframes, in translation relative to the scene depth or in rotation, or it observes
    too few points of its reference keyframe.
    """
    slam_map, tracking = submap.map, submap.tracking
    newest = slam_map.num_keyframes - 1
    age = abs(view.index - int(slam_map.keyframes["frame_index"][newest]))
    overlap = overlap_with_reference(estimate, submap)
    if age < 1 or (age < view.backlog and overlap > LIVE_MIN_OVERLAP):
        return None
    around = torch.cat([tracking.local_keyframes, tracking.local_keyframes.new_tensor([newest])])
    translation, rotation = pose_distance(estimate.T_cw, slam_map.T_cw[around], estimate.depth)
    has_moved, has_turned = translation > settings.max_translation, rotation > settings.max_rotation_deg
    if bool((has_moved | has_turned).all()):
        if bool(has_moved.all()):
            return Explanation.of(Reason.MOVED, ratio=float(translation.min()))
        return Explanation.of(Reason.TURNED, degrees=float(rotation[~has_moved].min()))
    if estimate.inliers < MIN_POINTS:
        return Explanation.of(Reason.FEW_POINTS, count=estimate.inliers)
    if overlap < settings.min_overlap:
        return Explanation.of(Reason.LOW_OVERLAP, ratio=overlap)
    return None
