"""The map: points, keyframes and the observations that associate them; covisibility queries; snapshots.

Points are marked invalid, not removed, so that a row stays valid until the submap is compacted. The table of keyframes
holds for each keypoint the row of the point that it observes, or -1 (the data association).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.geometry import KeypointNoise, se3_inverse
from torchslam.map.observation_index import ObservationIndex, first_of_each, top_rows
from torchslam.map.table import KEYFRAMES, POINTS, Table
from torchslam.optim import Marginals
from torchslam.types import Features, FrameFeatures, Observations, Trajectory
from torchslam.utils.indexing import distinct, ranks_among

NO_POINT = -1
"""Instead of the row of a point: a keypoint that observes none, or a point that is not replaced."""
MIN_SHARED = 15  # points that two keyframes share, to count as covisible
# Median of squared errors after an adjustment, in units of the stated noise, where that is right: points are fitted to
# the pixels, and ORB is precise to half its scale. 0.05 to 0.26 with ORB on real sequences, 0.4 to 0.6 with XFeat,
# blurred images or a rolling shutter.
_ADJUSTED_SQUARED_ERROR = 0.2
_MAX_NOISE_VARIANCE = 4.0  # beyond it, errors are not noise
_PRIOR_ADJUSTMENTS, _REMEMBERED_ADJUSTMENTS = 3, 20
"""Adjustments as which the prior counts, and over which the moving average reaches. Tried at these values only."""
SESSION_BITS = 40  # of a key, below the number of the session: more frames than a session has
KEYPOINT_COLUMNS = "keypoints", "detected", "scales", "angles", "descriptors", "mask", "information"
"""Columns of a keyframe that are attributes of `FrameFeatures`, with a row per keypoint."""


class Map:
    """Points and keyframes in one coordinate frame.

    In shapes K is the number of keyframes and L that of all points, removed ones included.

    Attributes:
        points: One row per point, see `table.POINTS`.
        keyframes: One row per keyframe, see `table.KEYFRAMES`.
        images: Of the keyframes, by key, if the matcher needs them; not saved.
        version: Changes when rows are renumbered.
        noise_variance: Of keypoints, at least 1, in units of what the feature extractor states; poses are judged by it.
    """

    def __init__(self) -> None:
        self.points = Table(POINTS)
        self.keyframes = Table(KEYFRAMES)
        self.images: dict[int, Shaped[Tensor, "1 1 H W"]] = {}
        self.version = 0
        self.noise_variance = 1.0
        self._index: ObservationIndex | None = None  # None: not built yet

    @property
    def num_keyframes(self) -> int:
        """The number of keyframes."""
        return len(self.keyframes)

    @property
    def num_points(self) -> int:
        """The number of valid points."""
        return int(self.points["is_valid"].sum()) if len(self.points) else 0

    @property
    def T_cw(self) -> Float[Tensor, "K 4 4"]:
        """The poses of the keyframes, world to camera."""
        return self.keyframes["T_cw"]

    @property
    def positions_w(self) -> Float[Tensor, "L 3"]:
        """The positions of all points, removed ones included."""
        return self.points["positions_w"]

    def index_tensor(self, *keyframes: int) -> Int[Tensor, " R"]:
        """Return rows of keyframes as a tensor on the device of the map."""
        return torch.tensor(keyframes, device=self.T_cw.device)

    @property
    def keys(self) -> Int[Tensor, " K"]:
        """The keys of the keyframes, session and frame index in one number: renumbering rows does not change them."""
        return key_of(self.keyframes["session"], self.keyframes["frame_index"])

    def key(self, keyframe: int) -> int:
        """Return the key of a keyframe."""
        return key_of(*(int(self.keyframes[name][keyframe]) for name in ("session", "frame_index")))

    def row(self, key: int) -> int:
        """Return the row of the keyframe with this key, or -1."""
        if self.num_keyframes == 0:
            return -1
        rows = torch.nonzero(self.keys == key)
        return int(rows[0]) if len(rows) else -1

    def valid_points(self) -> Int[Tensor, " N"]:
        """Return the rows of the valid points."""
        return torch.nonzero(self.points["is_valid"])[:, 0]

    def point_features(self, point_ids: Int[Tensor, " N"]) -> Features:
        """Return points as features without pixels, a batch of one, for matching by descriptor."""
        points = self.points
        ones = torch.ones_like(points["scale_distance"][point_ids])[None]
        return Features(
            keypoints=ones.new_zeros(1, len(point_ids), 2),
            scores=ones,
            scales=ones,
            angles=points["angles"][point_ids][None],
            descriptors=points["descriptors"][point_ids][None],
            mask=points["is_valid"][point_ids][None],
        )

    def features(self, keyframes: Int[Tensor, " B"], rows: Int[Tensor, "B N"] | None = None) -> Features:
        """Return the features of keyframes as a batch: all keypoints, or some rows of each."""
        at = (keyframes,) if rows is None else (keyframes[:, None], rows)
        names = ("keypoints", "scales", "angles", "descriptors", "mask")
        keypoints, scales, angles, descriptors, mask = (self.keyframes[name][at] for name in names)
        return Features(keypoints, torch.ones_like(scales), scales, angles, descriptors, mask)

    def keypoint_noise(
        self, keyframes: int | Int[Tensor, "*#batch"], keypoints: Int[Tensor, "*#batch"]
    ) -> KeypointNoise:
        """Return the noise of keypoints of the given keyframes."""
        table = self.keyframes
        return KeypointNoise(
            table["scales"][keyframes, keypoints], table["information"][keyframes, keypoints]
        )

    def scale_ranges(self, keyframes: Int[Tensor, " B"]) -> tuple[Float[Tensor, "B 1"], Float[Tensor, "B 1"]]:
        """Return the finest and the coarsest keypoint scale of keyframes, pixels."""
        scales, mask = self.keyframes["scales"][keyframes], self.keyframes["mask"][keyframes]
        finest = scales.masked_fill(~mask, torch.inf).amin(1, keepdim=True)
        return finest, scales.masked_fill(~mask, 0.0).amax(1, keepdim=True)

    def keyframe_rows(self, session: int) -> Int[Tensor, " K"]:
        """Return the rows of the keyframes of one session, in order of time."""
        if self.num_keyframes == 0:
            return torch.zeros(0, dtype=torch.int64, device="cpu")
        rows = torch.nonzero(self.keyframes["session"] == session)[:, 0]
        return rows[torch.argsort(self.keyframes["timestamp"][rows], stable=True)]

    def keyframe_trajectory(self, session: int = 0) -> Trajectory:
        """Return the keyframes of one session, camera to world, in order of time."""
        rows = self.keyframe_rows(session)
        if len(rows) == 0:
            return Trajectory.empty()
        return Trajectory(self.keyframes["timestamp"][rows], se3_inverse(self.T_cw[rows]))

    def center_covariances_w(self) -> Float[Tensor, "K 3 3"]:
        """Return the covariances of the camera centers of the keyframes, zero where unknown."""
        R_cw = self.T_cw[:, :3, :3]
        return R_cw.mT @ self.keyframes["covariances"][:, :3, :3] @ R_cw

    def add_keyframe(self, view: FrameFeatures, T_cw: Float[Tensor, "4 4"]) -> int:
        """Add a keyframe without observations and with unknown covariance; return its row."""
        if view.image is not None:
            self.images[key_of(view.session, view.index)] = view.image
        ids = self.keyframes.append(
            T_cw=T_cw[None],
            covariances=T_cw.new_zeros(1, 6, 6),
            session=torch.tensor([view.session], device=T_cw.device),
            frame_index=torch.tensor([view.index], device=T_cw.device),
            timestamp=torch.tensor([view.timestamp], dtype=torch.float64, device=T_cw.device),
            point_ids=torch.full((1, len(view.mask)), NO_POINT, device=T_cw.device),
            **{name: getattr(view, name)[None] for name in KEYPOINT_COLUMNS},
        )
        return int(ids[0])

    def add_points(
        self,
        positions_w: Float[Tensor, "N 3"],
        descriptors: Shaped[Tensor, "N D"],
        keyframe: int,
        covariances_w: Float[Tensor, "N 3 3"] | None = None,
        from_initialization: bool = False,
    ) -> Int[Tensor, " N"]:
        """Add points that a keyframe created, and return their rows; covariances are zero, or None, where unknown.

        `update_appearance` completes the points once they are observed.
        """
        n, like = len(positions_w), positions_w
        frame_index = self.keyframes["frame_index"][keyframe].expand(n)
        return self.points.append(
            positions_w=positions_w,
            covariances_w=like.new_zeros(n, 3, 3) if covariances_w is None else covariances_w,
            descriptors=descriptors,
            colors=torch.zeros(n, 3, dtype=torch.uint8, device=like.device),
            view_directions_w=like.new_zeros(n, 3),
            scale_distance=like.new_zeros(n),
            angles=like.new_zeros(n),
            last_seen_frame=frame_index,
            first_keyframe=torch.full((n,), keyframe, device=like.device),
            from_initialization=torch.full((n,), from_initialization, device=like.device),
            times_observed=torch.zeros(n, dtype=torch.int64, device=like.device),
            times_visible=torch.ones(n, dtype=torch.int64, device=like.device),
            times_found=torch.ones(n, dtype=torch.int64, device=like.device),
            is_valid=torch.ones(n, dtype=torch.bool, device=like.device),
            replaced_by=torch.full((n,), NO_POINT, device=like.device),
        )

    def add_observations(
        self,
        keyframe: int | Int[Tensor, " N"],
        keypoint_index: Int[Tensor, " N"],
        point_ids: Int[Tensor, " N"],
    ) -> None:
        """Add observations of points by keypoints, none of which observes a point yet, of one or N keyframes."""
        self._index_of_points.add(point_ids, keyframe * self._keypoints + keypoint_index)
        self.keyframes["point_ids"][keyframe, keypoint_index] = point_ids
        self._count(point_ids, 1)

    def scale_information(
        self,
        keyframe: int | Int[Tensor, " N"],
        keypoint_index: Int[Tensor, " N"],
        weights: Float[Tensor, " N"],
    ) -> None:
        """Multiply the information of keypoints of one or N keyframes by weights."""
        self.keyframes["information"][keyframe, keypoint_index] *= weights[:, None]

    def remove_observations(
        self, keyframe_index: Int[Tensor, " O"], keypoint_index: Int[Tensor, " O"]
    ) -> None:
        """Remove observations, given by keyframe and keypoint."""
        table = self.keyframes["point_ids"]
        point_ids = table[keyframe_index, keypoint_index]
        self._index_of_points.remove(point_ids, keyframe_index * self._keypoints + keypoint_index)
        self._count(point_ids, -1)
        table[keyframe_index, keypoint_index] = NO_POINT

    @property
    def _keypoints(self) -> int:
        return self.keyframes["point_ids"].shape[1]

    @property
    def _index_of_points(self) -> ObservationIndex:
        if self._index is None:
            self._index = ObservationIndex(self.keyframes["point_ids"])
        return self._index

    @property
    def _observations(self) -> Tensor:
        """The point of each keypoint, (K * N,): a flat view, whose rows are the slots of the index."""
        return self.keyframes["point_ids"].view(-1)

    def _count(self, point_ids: Tensor, step: int) -> None:
        self.points["times_observed"].index_add_(0, point_ids, torch.full_like(point_ids, step))

    def observations(
        self, keyframes: Int[Tensor, " B"] | None = None, as_detected: bool = False
    ) -> Observations:
        """Return all observations by the given keyframes, or by all, with pixels of a global shutter or as detected."""
        if keyframes is None:
            keyframes = torch.arange(self.num_keyframes, device=self.T_cw.device)
        table = self.keyframes["point_ids"][keyframes]
        row, keypoint = torch.nonzero(table >= 0, as_tuple=True)
        keyframe = keyframes[row]
        return Observations(
            keyframe,
            keypoint,
            table[row, keypoint],
            self.keyframes["detected" if as_detected else "keypoints"][keyframe, keypoint],
            self.keyframes["scales"][keyframe, keypoint],
            self.keyframes["information"][keyframe, keypoint],
        )

    def count_observed(
        self, point_ids: Int[Tensor, " N"], keyframes: Int[Tensor, " B"] | None = None
    ) -> Int[Tensor, " K"]:
        """Count how many of the distinct points each of the keyframes, by default of all, observes."""
        _, slots = self._index_of_points.observations_of(point_ids)
        counts = torch.bincount(slots // self._keypoints, minlength=self.num_keyframes)
        return counts if keyframes is None else counts[keyframes]

    def observers_and_scales(
        self, point_ids: Int[Tensor, " N"]
    ) -> tuple[Int[Tensor, "N R"], Float[Tensor, "N R"]]:
        """Return the observing keyframes of points, padded with NO_POINT, and the keypoint scales, pixels."""
        slots = self._index_of_points.padded_slots(point_ids).long()
        keyframes = torch.where(slots >= 0, slots // self._keypoints, NO_POINT)
        return keyframes, self.keyframes["scales"][keyframes, slots % self._keypoints]

    def frame_features(self, keyframe: int) -> FrameFeatures:
        """Return the features of a keyframe."""
        table = self.keyframes
        columns: dict[str, Any] = {name: table[name][keyframe] for name in KEYPOINT_COLUMNS}
        return FrameFeatures(
            index=int(table["frame_index"][keyframe]),
            timestamp=float(table["timestamp"][keyframe]),
            session=int(table["session"][keyframe]),
            image=self.images.get(self.key(keyframe)) if self.images else None,
            **columns,
        )

    def neighborhood(self, keyframe: int, count: int) -> Int[Tensor, " R"]:
        """Return a keyframe and the at most `count` most covisible ones."""
        near = self.covisible_keyframes(keyframe, count)
        return torch.cat([near.new_tensor([keyframe]), near])

    def covisibility_union(self, keyframes: Int[Tensor, " B"], count: int) -> Int[Tensor, " R"]:
        """Return keyframes and the at most `count` most covisible ones of each, ascending."""
        table = self.keyframes["point_ids"][keyframes]
        ids = torch.nonzero(torch.bincount(table[table >= 0]))[:, 0]
        which, slots = self._index_of_points.observations_of(ids)
        observers = slots // self._keypoints
        takes_part = torch.bincount(observers, minlength=self.num_keyframes) > 0
        takes_part[keyframes] = True
        columns, column = torch.nonzero(takes_part)[:, 0], takes_part.cumsum(0) - 1
        own, width = column[keyframes], len(columns)
        cells = which * width + column[observers]
        sees = torch.bincount(cells, minlength=len(ids) * width).view(len(ids), width).float()
        shared = (sees[:, own].T @ sees).long().scatter_(1, own[:, None], 0)  # exact: far below 2**24
        enough = torch.nonzero((shared >= MIN_SHARED).any(0))[:, 0]
        ranked = torch.sort(shared[:, enough], dim=1, descending=True, stable=True)
        is_near = ranked.values[:, :count] >= MIN_SHARED
        return torch.unique(torch.cat([keyframes, columns[enough][ranked.indices[:, :count][is_near]]]))

    def covisible_keyframes(
        self, keyframe: int, count: int, min_shared: int = MIN_SHARED
    ) -> Int[Tensor, " R"]:
        """Return at most `count` keyframes that share most points with a keyframe, best first, without itself."""
        row = self.keyframes["point_ids"][keyframe]
        shared = self.count_observed(row[row >= 0])
        shared[keyframe] = 0
        return top_rows(shared, count, min_shared)

    def observation_mask(
        self, keyframes: Int[Tensor, " B"], point_ids: Int[Tensor, " N"]
    ) -> Bool[Tensor, "B N"]:
        """Test which of the keyframes observe which of the distinct points."""
        column = torch.zeros(len(self.points) + 1, dtype=torch.int64, device=point_ids.device)
        column[point_ids] = torch.arange(1, len(point_ids) + 1, device=point_ids.device)
        # NO_POINT reads the last entry, which stays zero.
        seen = column[self.keyframes["point_ids"][keyframes]]
        found = torch.zeros(len(keyframes), len(point_ids) + 1, dtype=torch.bool, device=point_ids.device)
        return found.scatter_(1, seen, True)[:, 1:]

    def observed_points(self, keyframes: Int[Tensor, " B"]) -> Int[Tensor, " N"]:
        """Return the points that at least one of the keyframes observes, ascending."""
        table = self.keyframes["point_ids"][keyframes].flatten()
        return distinct(table[table >= 0])

    def append(self, other: Map) -> tuple[int, int]:
        """Append keyframes and points of a map in the same coordinate frame; return the offsets of their rows."""
        keyframes, points = len(self.keyframes), len(self.points)
        self.images |= other.images
        self.noise_variance = max(self.noise_variance, other.noise_variance)
        rows = other.points.columns()
        rows["first_keyframe"] = rows["first_keyframe"] + keyframes
        rows["replaced_by"] = torch.where(rows["replaced_by"] >= 0, rows["replaced_by"] + points, NO_POINT)
        self.points.append(**rows)
        rows = other.keyframes.columns()
        rows["point_ids"] = torch.where(rows["point_ids"] >= 0, rows["point_ids"] + points, NO_POINT)
        self.keyframes.append(**rows)
        self.mark_renumbered()
        return keyframes, points

    def update_noise(self, squared_errors: Float[Tensor, " O"]) -> None:
        """Update the variance of keypoints by the squared errors of an adjustment, in units of the stated noise.

        A moving average of medians: a tenth of outliers does not matter. The first adjustments weigh more; the prior,
        that the feature extractor states the truth, counts as much as `_PRIOR_ADJUSTMENTS` of them.
        """
        adjustments = _PRIOR_ADJUSTMENTS + min(self.num_keyframes, _REMEMBERED_ADJUSTMENTS)
        self.set_noise(squared_errors, 1 / adjustments)

    def set_noise(self, squared_errors: Float[Tensor, " O"], rate: float = 1.0) -> None:
        """Set the variance of keypoints by the squared errors of a map at its minimum, or move it there by a share."""
        if len(squared_errors) == 0:
            return
        found = float(squared_errors.median()) / _ADJUSTED_SQUARED_ERROR
        variance = self.noise_variance + rate * (found - self.noise_variance)
        self.noise_variance = min(max(variance, 1.0), _MAX_NOISE_VARIANCE)

    def mark_renumbered(self) -> None:
        """Rebuild the index on the next query and raise the version, after rows were renumbered."""
        self._index = None
        self.version += 1

    def remove_points(self, point_ids: Int[Tensor, " N"]) -> None:
        """Mark points invalid and remove their observations; the rows stay until the submap is compacted."""
        if len(point_ids) == 0:
            return
        _, slots = self._index_of_points.observations_of(point_ids)
        self._index_of_points.clear(point_ids)
        self._observations.scatter_(0, slots, NO_POINT)
        self.points["is_valid"][point_ids] = False
        self.points["times_observed"][point_ids] = 0

    def remove_masked_observations(self, observations: Observations, mask: Bool[Tensor, " O"]) -> None:
        """Remove the observations of a mask, and their points that fewer than two keyframes still observe."""
        self.remove_observations(observations.keyframe_index[mask], observations.keypoint_index[mask])
        touched = torch.unique(observations.point_index[mask])
        self.remove_points(touched[self.points["times_observed"][touched] < 2])

    def merge_points(self, old: Int[Tensor, " N"], new: Int[Tensor, " N"]) -> None:
        """Merge points: the observations of the old points become those of the new, and the old are removed.

        Several may be merged into one; none of the new points may be among the old. A keyframe that observes both keeps
        one observation: that of the new point, or that at the first keypoint.
        """
        if len(old) == 0:
            return
        index, count = self._index_of_points, len(self.points)
        replacement = torch.unique(new)
        which, held = index.observations_of(replacement)
        taken = (held // self._keypoints) * count + replacement[which]  # pairs of keyframe and new point
        which, slots = index.observations_of(old)
        order = torch.argsort(slots)  # of several keypoints the first comes first
        slots, inherited = slots[order], new[which[order]]
        wanted = (slots // self._keypoints) * count + inherited
        kept = first_of_each(wanted) & ~torch.isin(wanted, taken)
        self.remove_points(old)
        self._observations.scatter_(0, slots[kept], inherited[kept])
        index.add(inherited[kept], slots[kept])
        self._count(inherited[kept], 1)
        self.points["replaced_by"][old] = new
        for counter in ("times_visible", "times_found"):
            self.points[counter].index_add_(0, new, self.points[counter][old])

    def follow_merges(self, point_ids: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """Return the points that points were merged into; others stay as they are."""
        merged = self.points["replaced_by"][point_ids]
        while bool((merged >= 0).any()):
            point_ids = torch.where(merged >= 0, merged, point_ids)
            merged = self.points["replaced_by"][point_ids]
        return point_ids

    def update_appearance(self, keyframes: Int[Tensor, " B"]) -> None:
        """Update view direction, scale, angle and descriptor of the keyframes' points from the newest observation.

        `scale_distance` is keypoint scale times distance: from distance d the point is expected at scale_distance / d.
        """
        seen = self.observations(torch.sort(keyframes).values)  # the newest keyframe comes last and wins
        if len(seen) == 0:
            return
        ids = distinct(seen.point_index)
        which = ranks_among(seen.point_index, ids)
        rows = torch.arange(len(seen), device=keyframes.device)
        row = torch.zeros_like(ids).scatter_reduce(0, which, rows, "amax", include_self=False)
        keyframe, keypoint = seen.keyframe_index[row], seen.keypoint_index[row]
        centers_w = se3_inverse(self.T_cw[keyframe])[:, :3, 3]
        rays_w = self.positions_w[ids] - centers_w
        distance = torch.linalg.vector_norm(rays_w, dim=-1)
        self.points["view_directions_w"][ids] = rays_w / distance[:, None].clamp(min=1e-12)
        self.points["scale_distance"][ids] = distance * seen.scales[row]
        self.points["angles"][ids] = self.keyframes["angles"][keyframe, keypoint]
        self.points["descriptors"][ids] = self.keyframes["descriptors"][keyframe, keypoint]

    def reset_last_seen(self) -> None:
        """Reset `last_seen_frame` of all points, since a new session numbers its frames from 0."""
        if len(self.points):
            self.points["last_seen_frame"][:] = -1

    def set_covariances(
        self, keyframes: Int[Tensor, " B"], point_ids: Int[Tensor, " N"], marginals: Marginals
    ) -> None:
        """Store the covariances of keyframes and points; where they are zero, the old ones stay."""
        for column, rows, covariances in (
            (self.keyframes["covariances"], keyframes, marginals.frames),
            (self.points["covariances_w"], point_ids, marginals.points),
        ):
            known = covariances.diagonal(dim1=-2, dim2=-1).sum(-1) > 0
            column[rows[known]] = covariances[known]


_Number = TypeVar("_Number", int, Tensor)


def key_of(sessions: _Number, frames: _Number) -> _Number:
    """Return the keys of frames of sessions: numbers, or tensors of one shape, int64."""
    return (sessions << SESSION_BITS) + frames


def feature_mismatch(slam_map: Map, view: FrameFeatures, to_map: bool) -> str:
    """Describe why a frame's features cannot be compared with the map's; empty if they can.

    to_map: whether frames become keyframes, which all need the same number of keypoints
    """
    if slam_map.num_keyframes == 0:
        return ""
    held, seen = slam_map.keyframes["descriptors"], view.descriptors
    if held.shape[-1] != seen.shape[-1] or held.dtype != seen.dtype:
        return f"its descriptors are {held.shape[-1]} x {held.dtype}, the frame's {seen.shape[-1]} x {seen.dtype}"
    known, said = slam_map.keyframes["information"].shape[-1], view.information.shape[-1]
    if to_map and known != said:
        kinds = {0: "none", 1: "a number", 3: "a matrix"}
        return f"its keypoints have {kinds[known]} as information, the frame's {kinds[said]}"
    if to_map and held.shape[1] != len(seen):
        return f"its keyframes have {held.shape[1]} keypoints, the frame {len(seen)}"
    return ""


_MUTABLE = ("T_cw", "covariances", "information", "point_ids")
"""The columns of a keyframe that later keyframes may change."""


@dataclass(frozen=True)
class MapSnapshot:
    """Copies of the columns that later keyframes may change, to restore the map when these are taken back.

    Rows must not be renumbered between `of` and `restore`.
    """

    points: dict[str, Shaped[Tensor, "L ..."]]
    keyframes: dict[str, Shaped[Tensor, "K ..."]]
    version: int
    noise_variance: float

    @classmethod
    @torch.inference_mode(False)
    def of(cls, slam_map: Map) -> MapSnapshot:
        """Copy the state of a map with at least one keyframe."""
        points, keyframes = slam_map.points, slam_map.keyframes
        return cls(
            {name: column.clone() for name, column in points.columns().items()},
            {name: keyframes[name].clone() for name in _MUTABLE},
            slam_map.version,
            slam_map.noise_variance,
        )

    @property
    def num_keyframes(self) -> int:
        return len(self.keyframes["T_cw"])

    def restore(self, slam_map: Map) -> None:
        """Restore the map to its state at the snapshot."""
        assert slam_map.version == self.version, "rows were renumbered since the snapshot"
        for key in slam_map.keys[self.num_keyframes :].tolist():
            slam_map.images.pop(key, None)
        slam_map.noise_variance = self.noise_variance
        slam_map.points.truncate(len(self.points["is_valid"]))
        slam_map.keyframes.truncate(self.num_keyframes)
        for table, columns in ((slam_map.points, self.points), (slam_map.keyframes, self.keyframes)):
            for name, column in columns.items():
                table[name][:] = column
        slam_map.mark_renumbered()
        slam_map.version = self.version
