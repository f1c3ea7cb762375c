"""The map: points, keyframes and the observations that associate them; covisibility queries; snapshots.

Points are marked invalid, not removed, so that a row stays valid until the submap is compacted. The table of keyframes
holds for each keypoint the row of the point that it observes, or -1 (the data association).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry import KeypointNoise, se3_inverse
from torchslam.map.observation_index import ObservationIndex, first_of_each, top_rows
from torchslam.map.table import KEYFRAMES, POINTS, Table
from torchslam.optim import Marginals
from torchslam.types import Features, FrameFeatures, Observations
from torchslam.utils.indexing import distinct, ranks_among

NO_POINT = -1
MIN_SHARED = 15  # points that two keyframes share, to count as covisible
SESSION_BITS = 40  # of a key, below the number of the session: more frames than a session has


class Map:
    """Points and keyframes in one coordinate frame."""

    def __init__(self) -> None:
        self.points = Table(POINTS)
        self.keyframes = Table(KEYFRAMES)
        self.images: dict[int, Tensor] = {}  # of keyframes, by key, where a matcher wants them; saved nowhere
        self._index: ObservationIndex | None = None  # of what the tables hold; None: not made yet
        self.version = 0  # of the rows: changes when they are renumbered

    @property
    def num_keyframes(self) -> int:
        return len(self.keyframes)

    @property
    def num_points(self) -> int:
        """The number of valid points."""
        return int(self.points["is_valid"].sum()) if len(self.points) else 0

    @property
    def T_cw(self) -> Tensor:
        """(K, 4, 4) poses of the keyframes, world to camera."""
        return self.keyframes["T_cw"]

    @property
    def positions_w(self) -> Tensor:
        """(L, 3) positions of all points, invalid ones included."""
        return self.points["positions_w"]

    def ids(self, *keyframes: int) -> Tensor:
        """Return rows of keyframes as a tensor (k,) on the device of the map."""
        return torch.tensor(keyframes, device=self.T_cw.device)

    @property
    def keys(self) -> Tensor:
        """(K,) keys of the keyframes, which stay the same when rows are renumbered: session and frame index in one."""
        return key_of(self.keyframes["session"], self.keyframes["frame_index"])

    def key(self, keyframe: int) -> int:
        """Return the key of a keyframe."""
        session, frame = self.keyframes["session"][keyframe], self.keyframes["frame_index"][keyframe]
        return (int(session) << SESSION_BITS) + int(frame)

    def row(self, key: int) -> int:
        """Return the row of the keyframe with this key, or -1."""
        if self.num_keyframes == 0:
            return -1
        rows = torch.nonzero(self.keys == key)
        return int(rows[0]) if len(rows) else -1

    def valid_points(self) -> Tensor:
        """Return the rows (L',) of the valid points."""
        return torch.nonzero(self.points["is_valid"])[:, 0]

    def point_features(self, point_ids: Tensor) -> Features:
        """Return points (n,) as features without pixels, a batch of one, for matching by descriptor."""
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

    def features(self, keyframes: Tensor, rows: Tensor | None = None) -> Features:
        """Return the features of keyframes (k,) as a batch: all keypoints, or the rows (k, n) of them."""
        at = (keyframes,) if rows is None else (keyframes[:, None], rows)
        names = ("keypoints", "scales", "angles", "descriptors", "mask")
        keypoints, scales, angles, descriptors, mask = (self.keyframes[name][at] for name in names)
        return Features(keypoints, torch.ones_like(scales), scales, angles, descriptors, mask)

    def noise(self, keyframes: Tensor, keypoints: Tensor) -> KeypointNoise:
        """Return the noise of keypoints (n,) of keyframes (n,)."""
        table = self.keyframes
        return KeypointNoise(
            table["scales"][keyframes, keypoints], table["information"][keyframes, keypoints]
        )

    def scale_ranges(self, keyframes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the finest and the coarsest keypoint scale of keyframes (k,), (k, 1) each."""
        scales, mask = self.keyframes["scales"][keyframes], self.keyframes["mask"][keyframes]
        finest = scales.masked_fill(~mask, torch.inf).amin(1, keepdim=True)
        return finest, scales.masked_fill(~mask, 0.0).amax(1, keepdim=True)

    def center_covariances_w(self) -> Tensor:
        """Return the covariances (K, 3, 3) of the keyframe positions, zero where unknown."""
        R_cw = self.T_cw[:, :3, :3]
        return R_cw.mT @ self.keyframes["covariances"][:, :3, :3] @ R_cw

    def add_keyframe(self, view: FrameFeatures, T_cw: Tensor) -> int:
        """Add a keyframe without observations and with unknown covariance; return its row."""
        if view.image is not None:
            self.images[(view.session << SESSION_BITS) + view.index] = view.image
        ids = self.keyframes.append(
            T_cw=T_cw[None],
            covariances=T_cw.new_zeros(1, 6, 6),
            session=torch.tensor([view.session], device=T_cw.device),
            frame_index=torch.tensor([view.index], device=T_cw.device),
            timestamp=torch.tensor([view.timestamp], dtype=torch.float64, device=T_cw.device),
            keypoints=view.keypoints[None],
            scales=view.scales[None],
            angles=view.angles[None],
            descriptors=view.descriptors[None],
            mask=view.mask[None],
            information=view.information[None],
            point_ids=torch.full((1, len(view.mask)), NO_POINT, device=T_cw.device),
        )
        return int(ids[0])

    def add_points(
        self,
        positions_w: Tensor,
        descriptors: Tensor,
        keyframe: int,
        covariances_w: Tensor | None = None,
        from_initialization: bool = False,
    ) -> Tensor:
        """Add points that a keyframe created; `refresh` sets their view directions and scales once they are observed.

        Args:
            positions_w: (n, 3)
            descriptors: (n, D)
            keyframe: The row of the keyframe.
            covariances_w: (n, 3, 3) of the positions, zero where unknown; all unknown if None.
            from_initialization: Whether the two-view initialization created them.

        Returns:
            Rows (n,) of the points.
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

    def observe(self, keyframe: int | Tensor, keypoint_index: Tensor, point_ids: Tensor) -> None:
        """Add observations of points (n,) by free keypoints (n,) of one keyframe or of keyframes (n,)."""
        self._index_of_points.add(point_ids, keyframe * self._keypoints + keypoint_index)
        self.keyframes["point_ids"][keyframe, keypoint_index] = point_ids
        self._count(point_ids, 1)

    def weigh(self, keyframe: int | Tensor, keypoint_index: Tensor, weights: Tensor) -> None:
        """Multiply the stated information of keypoints (n,) of one keyframe or of keyframes (n,) by weights (n,)."""
        self.keyframes["information"][keyframe, keypoint_index] *= weights[:, None]

    def forget(self, keyframe_index: Tensor, keypoint_index: Tensor) -> None:
        """Remove observations, given by keyframe (n,) and keypoint (n,)."""
        table = self.keyframes["point_ids"]
        point_ids = table[keyframe_index, keypoint_index]
        self._index_of_points.remove(point_ids, keyframe_index * self._keypoints + keypoint_index)
        self._count(point_ids, -1)
        table[keyframe_index, keypoint_index] = NO_POINT

    @property
    def _keypoints(self) -> int:
        """The number of keypoints per keyframe."""
        return self.keyframes["point_ids"].shape[1]

    @property
    def _index_of_points(self) -> ObservationIndex:
        if self._index is None:
            self._index = ObservationIndex(self.keyframes["point_ids"])
        return self._index

    @property
    def _observations(self) -> Tensor:
        """(K N,) the points that keypoints observe, as a flat view that the slots of the index refer to."""
        return self.keyframes["point_ids"].view(-1)

    def _count(self, point_ids: Tensor, step: int) -> None:
        self.points["times_observed"].index_add_(0, point_ids, torch.full_like(point_ids, step))

    def observations(self, keyframes: Tensor | None = None) -> Observations:
        """Return all observations by keyframes (k,), or by all keyframes."""
        if keyframes is None:
            keyframes = torch.arange(self.num_keyframes, device=self.T_cw.device)
        table = self.keyframes["point_ids"][keyframes]
        row, keypoint = torch.nonzero(table >= 0, as_tuple=True)
        keyframe = keyframes[row]
        return Observations(
            keyframe,
            keypoint,
            table[row, keypoint],
            self.keyframes["keypoints"][keyframe, keypoint],
            self.keyframes["scales"][keyframe, keypoint],
            self.keyframes["information"][keyframe, keypoint],
        )

    def observers(self, point_ids: Tensor, keyframes: Tensor | None = None) -> Tensor:
        """Count how many of the distinct points (n,) each keyframe observes: (K,), or (k,) for given keyframes."""
        _, slots = self._index_of_points.of(point_ids)
        counts = torch.bincount(slots // self._keypoints, minlength=self.num_keyframes)
        return counts if keyframes is None else counts[keyframes]

    def scales_of(self, point_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Return observing keyframes (n, w) of points (n,), padded with NO_POINT, and the keypoint scales (n, w)."""
        slots = self._index_of_points.padded_slots(point_ids).long()
        keyframes = torch.where(slots >= 0, slots // self._keypoints, NO_POINT)
        return keyframes, self.keyframes["scales"][keyframes, slots % self._keypoints]

    def view(self, keyframe: int) -> FrameFeatures:
        """Return the features of a keyframe."""
        row = {name: column[keyframe] for name, column in self.keyframes.columns().items()}
        names = ("keypoints", "scales", "angles", "descriptors", "mask", "information")
        return FrameFeatures(
            index=int(row["frame_index"]),
            timestamp=float(row["timestamp"]),
            session=int(row["session"]),
            image=self.images.get(self.key(keyframe)) if self.images else None,
            backlog=0,
            **{name: row[name] for name in names},
        )

    def shared(self, keyframes: Tensor) -> Tensor:
        """Return covisibility weights (k, K): points that keyframes (k,) share with every other one, 0 with itself."""
        table, count = self.keyframes["point_ids"][keyframes], self.num_keyframes
        ids = torch.nonzero(torch.bincount(table[table >= 0]))[:, 0]
        which, slots = self._index_of_points.of(ids)
        observers = slots // self._keypoints
        takes_part = torch.bincount(observers, minlength=count) > 0
        takes_part[keyframes] = True
        columns, column = torch.nonzero(takes_part)[:, 0], takes_part.cumsum(0) - 1
        width = len(columns)
        cells = which * width + column[observers]
        sees = torch.bincount(cells, minlength=len(ids) * width).view(len(ids), width).float()
        shared = (sees[:, column[keyframes]].T @ sees).long()  # exact: far below 2**24
        return (
            shared.new_zeros(len(keyframes), count)
            .index_copy_(1, columns, shared)
            .scatter_(1, keyframes[:, None], 0)
        )

    def covisible(self, keyframe: int, count: int, min_shared: int = MIN_SHARED) -> Tensor:
        """Return the keyframes (<= count,) that share most points with a keyframe, best first, without itself."""
        row = self.keyframes["point_ids"][keyframe]
        shared = self.observers(row[row >= 0])
        shared[keyframe] = 0
        return top_rows(shared, count, min_shared)

    def covisibility_union(self, keyframes: Tensor, count: int) -> Tensor:
        """Return keyframes (k,) and the at most `count` most covisible ones of each, ascending."""
        shared = self.shared(keyframes)
        columns = torch.nonzero((shared >= MIN_SHARED).any(0))[:, 0]
        ranked = torch.sort(shared[:, columns], dim=1, descending=True, stable=True)
        is_near = ranked.values[:, :count] >= MIN_SHARED
        return torch.unique(torch.cat([keyframes, columns[ranked.indices[:, :count][is_near]]]))

    def sees(self, keyframes: Tensor, point_ids: Tensor) -> Tensor:
        """Return (k, n) bool: whether keyframes (k,) observe distinct points (n,)."""
        column = torch.zeros(len(self.points) + 1, dtype=torch.int64, device=point_ids.device)
        column[point_ids] = torch.arange(1, len(point_ids) + 1, device=point_ids.device)
        seen = column[
            self.keyframes["point_ids"][keyframes]
        ]  # NO_POINT finds the last entry, which stays zero
        found = torch.zeros(len(keyframes), len(point_ids) + 1, dtype=torch.bool, device=point_ids.device)
        return found.scatter_(1, seen, True)[:, 1:]

    def points_seen_by(self, keyframes: Tensor) -> Tensor:
        """Return the points (n,) that at least one of the keyframes (k,) observes, ascending."""
        table = self.keyframes["point_ids"][keyframes].flatten()
        return distinct(table[table >= 0])

    def append(self, other: Map) -> tuple[int, int]:
        """Append keyframes and points of another map in the same coordinate frame; return the offsets of their rows."""
        keyframes, points = len(self.keyframes), len(self.points)
        self.images |= other.images
        rows = other.points.columns()
        rows["first_keyframe"] = rows["first_keyframe"] + keyframes
        rows["replaced_by"] = torch.where(rows["replaced_by"] >= 0, rows["replaced_by"] + points, NO_POINT)
        self.points.append(**rows)
        rows = other.keyframes.columns()
        rows["point_ids"] = torch.where(rows["point_ids"] >= 0, rows["point_ids"] + points, NO_POINT)
        self.keyframes.append(**rows)
        self.reindex()
        return keyframes, points

    def reindex(self) -> None:
        """Note that rows were renumbered: row numbers from before are no longer valid."""
        self._index = None
        self.version += 1

    # --- changing --------------------------------------------------------------------------------------------

    def invalidate(self, point_ids: Tensor) -> None:
        """Mark points (n,) invalid and remove their observations."""
        if len(point_ids) == 0:
            return
        _, slots = self._index_of_points.of(point_ids)
        self._index_of_points.clear(point_ids)
        self._observations.scatter_(0, slots, NO_POINT)
        self.points["is_valid"][point_ids] = False
        self.points["times_observed"][point_ids] = 0

    def drop(self, seen: Observations, wrong: Tensor) -> None:
        """Remove the observations of a mask (O,), and points that fewer than two keyframes still observe."""
        self.forget(seen.keyframe_index[wrong], seen.keypoint_index[wrong])
        touched = torch.unique(seen.point_index[wrong])
        self.invalidate(touched[self.points["times_observed"][touched] < 2])

    def replace(self, old: Tensor, new: Tensor) -> None:
        """Merge points: observations of old (n,) become those of new (n,), and old become invalid.

        Several may be merged into one; none of the new points may be among the old. A keyframe that observes both keeps
        one observation: that of the new point, or that at the first keypoint.
        """
        if len(old) == 0:
            return
        index, count = self._index_of_points, len(self.points)
        replacement = torch.unique(new)
        which, held = index.of(replacement)
        taken = (held // self._keypoints) * count + replacement[
            which
        ]  # keyframes and the heirs that they see already
        which, slots = index.of(old)
        order = torch.argsort(slots)  # of several keypoints the first comes first
        slots, inherited = slots[order], new[which[order]]
        wanted = (slots // self._keypoints) * count + inherited
        kept = first_of_each(wanted) & ~torch.isin(wanted, taken)
        self.invalidate(old)
        self._observations.scatter_(0, slots[kept], inherited[kept])
        index.add(inherited[kept], slots[kept])
        self._count(inherited[kept], 1)
        self.points["replaced_by"][old] = new
        for counter in ("times_visible", "times_found"):
            self.points[counter].index_add_(0, new, self.points[counter][old])

    def follow_merges(self, point_ids: Tensor) -> Tensor:
        """Return the points that points (n,) were merged into; others stay as they are."""
        heir = self.points["replaced_by"][point_ids]
        while bool((heir >= 0).any()):
            point_ids = torch.where(heir >= 0, heir, point_ids)
            heir = self.points["replaced_by"][point_ids]
        return point_ids

    def refresh(self, keyframes: Tensor) -> None:
        """Update direction, scale and descriptor of the points of keyframes (k,) from their newest observation.

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

    def forget_frames(self) -> None:
        """Reset `last_seen_frame` of all points, since a new session numbers its frames from 0."""
        if len(self.points):
            self.points["last_seen_frame"][:] = -1

    def set_covariances(self, keyframes: Tensor, point_ids: Tensor, marginals: Marginals) -> None:
        """Store covariances of keyframes (k,) and points (n,); those that are zero keep the present ones."""
        for column, rows, covariances in (
            (self.keyframes["covariances"], keyframes, marginals.frames),
            (self.points["covariances_w"], point_ids, marginals.points),
        ):
            known = covariances.diagonal(dim1=-2, dim2=-1).sum(-1) > 0
            column[rows[known]] = covariances[known]


def key_of(sessions: Tensor, frames: Tensor) -> Tensor:
    """Return keys (n,) of the frames (n,) of sessions (n,)."""
    return (sessions << SESSION_BITS) + frames


def feature_mismatch(slam_map: Map, view: FrameFeatures, to_map: bool) -> str:
    """Describe why a frame's features cannot be compared with the map's; empty if they can.

    Args:
        slam_map: The map.
        view: The frame.
        to_map: Whether frames become keyframes, which all need the same number of keypoints.
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

    points: dict[str, Tensor]
    keyframes: dict[str, Tensor]
    version: int

    @classmethod
    @torch.inference_mode(False)
    def of(cls, slam_map: Map) -> MapSnapshot:
        """Copy the state of a map with at least one keyframe."""
        points, keyframes = slam_map.points, slam_map.keyframes
        return cls(
            {name: column.clone() for name, column in points.columns().items()},
            {name: keyframes[name].clone() for name in _MUTABLE},
            slam_map.version,
        )

    @property
    def num_keyframes(self) -> int:
        """The number of keyframes at the time of the snapshot."""
        return len(self.keyframes["T_cw"])

    def restore(self, slam_map: Map) -> None:
        """Restore the map."""
        assert slam_map.version == self.version, "rows were renumbered since the snapshot"
        for key in slam_map.keys[self.num_keyframes :].tolist():
            slam_map.images.pop(key, None)
        slam_map.points.truncate(len(self.points["is_valid"]))
        slam_map.keyframes.truncate(self.num_keyframes)
        for table, columns in ((slam_map.points, self.points), (slam_map.keyframes, self.keyframes)):
            for name, column in columns.items():
                table[name][:] = column
        slam_map.reindex()
        slam_map.version = self.version
