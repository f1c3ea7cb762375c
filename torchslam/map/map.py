"""The map: points, keyframes and who observes whom, as tensors that grow.

Points are never removed, only marked dead, so an id stays valid for the whole run. The table of keyframes holds
for each keypoint the id of the point it observes, or -1: every list of observations is a view of that table.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import KeypointNoise, se3_inverse
from torchslam.map.observation_index import ObservationIndex, first_of_each, most
from torchslam.map.schema import KEYFRAMES, POINTS
from torchslam.map.table import Table
from torchslam.optim import Marginals
from torchslam.types import Features, FrameFeatures, Observations
from torchslam.utils.indexing import distinct, ranks_among

NO_POINT = -1
MIN_SHARED = 15  # points that two keyframes see, to count as neighbours
SESSION_BITS = 40  # of a key, below the number of the session: more frames than a session has


class Map:
    """Points and keyframes of one world frame."""

    def __init__(self) -> None:
        self.points = Table(POINTS)
        self.keyframes = Table(KEYFRAMES)
        self.images: dict[int, Tensor] = {}  # of keyframes, by key, where a matcher wants them; saved nowhere
        self._index: ObservationIndex | None = None  # of what the tables hold; None: not made yet

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
        """(L, 3) positions of all points ever made, dead ones included."""
        return self.points["positions_w"]

    def ids(self, *keyframes: int) -> Tensor:
        """Indices of keyframes as a tensor (k,) beside the map's."""
        return torch.tensor(keyframes, device=self.T_cw.device)

    @property
    def keys(self) -> Tensor:
        """(K,) names of the keyframes that stay the same however rows are renumbered: session and frame in one."""
        return key_of(self.keyframes["session"], self.keyframes["frame_index"])

    def key(self, keyframe: int) -> int:
        """The name of one keyframe."""
        session, frame = self.keyframes["session"][keyframe], self.keyframes["frame_index"][keyframe]
        return (int(session) << SESSION_BITS) + int(frame)

    def row(self, key: int) -> int:
        """The row of the keyframe of that name; -1 where there is none."""
        if self.num_keyframes == 0:
            return -1
        rows = torch.nonzero(self.keys == key)
        return int(rows[0]) if len(rows) else -1

    def valid_points(self) -> Tensor:
        """(L',) ids of the valid points."""
        return torch.nonzero(self.points["is_valid"])[:, 0]

    def point_features(self, point_ids: Tensor) -> Features:
        """The points (n,) as a batch of one of features without a place in an image, for matching by descriptor."""
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
        """What keyframes (k,) saw, as a batch, for matching: all keypoints, or some rows (k, n) of them."""
        at = (keyframes,) if rows is None else (keyframes[:, None], rows)
        names = ("keypoints", "scales", "angles", "descriptors", "mask")
        keypoints, scales, angles, descriptors, mask = (self.keyframes[name][at] for name in names)
        return Features(keypoints, torch.ones_like(scales), scales, angles, descriptors, mask)

    def noise(self, keyframes: Tensor, keypoints: Tensor) -> KeypointNoise:
        """Of keypoints (n,) of a keyframe each, (n,)."""
        table = self.keyframes
        return KeypointNoise(
            table["scales"][keyframes, keypoints], table["information"][keyframes, keypoints]
        )

    def scale_ranges(self, keyframes: Tensor) -> tuple[Tensor, Tensor]:
        """(k, 1), (k, 1) the finest and the coarsest scale among the keypoints of keyframes (k,)."""
        scales, mask = self.keyframes["scales"][keyframes], self.keyframes["mask"][keyframes]
        finest = scales.masked_fill(~mask, torch.inf).amin(1, keepdim=True)
        return finest, scales.masked_fill(~mask, 0.0).amax(1, keepdim=True)

    def centre_covariances_w(self) -> Tensor:
        """(K, 3, 3) covariances of the positions of the keyframes, zero where unknown."""
        R_cw = self.T_cw[:, :3, :3]
        return R_cw.mT @ self.keyframes["covariances"][:, :3, :3] @ R_cw

    def add_keyframe(self, view: FrameFeatures, T_cw: Tensor) -> int:
        """Add a keyframe that observes nothing yet and whose covariance is unknown; returns its index."""
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
        """Add points (n, 3) with descriptors (n, D), first seen in a keyframe; returns their ids (n,).

        covariances_w: (n, 3, 3) of the positions, zero where unknown; all unknown if None
        from_initialization: whether they come from the two views that start the map

        Their view directions and scales are set by `refresh`, once they are observed.
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
        """Note that keypoints (n,) of a keyframe, or of one each (n,), which see nothing yet, see points (n,)."""
        self._index_of_points.add(point_ids, keyframe * self._keypoints + keypoint_index)
        self.keyframes["point_ids"][keyframe, keypoint_index] = point_ids
        self._count(point_ids, 1)

    def weigh(self, keyframe: int | Tensor, keypoint_index: Tensor, weights: Tensor) -> None:
        """Multiply the stated information of keypoints (n,) of a keyframe, or of one each (n,), with weights (n,)."""
        self.keyframes["information"][keyframe, keypoint_index] *= weights[:, None]

    def forget(self, keyframe_index: Tensor, keypoint_index: Tensor) -> None:
        """Drop observations, given by keyframe (n,) and keypoint (n,)."""
        table = self.keyframes["point_ids"]
        point_ids = table[keyframe_index, keypoint_index]
        self._index_of_points.remove(point_ids, keyframe_index * self._keypoints + keypoint_index)
        self._count(point_ids, -1)
        table[keyframe_index, keypoint_index] = NO_POINT

    @property
    def _keypoints(self) -> int:
        """How many keypoints a keyframe has room for."""
        return self.keyframes["point_ids"].shape[1]

    @property
    def _index_of_points(self) -> ObservationIndex:
        if self._index is None:
            self._index = ObservationIndex(self.keyframes["point_ids"])
        return self._index

    @property
    def _observations(self) -> Tensor:
        """(K N,) the points that keypoints observe, as a flat view: index it with the places of the index."""
        return self.keyframes["point_ids"].view(-1)

    def _count(self, point_ids: Tensor, step: int) -> None:
        self.points["times_observed"].index_add_(0, point_ids, torch.full_like(point_ids, step))

    def observations(self, keyframes: Tensor | None = None) -> Observations:
        """All observations by the keyframes (k,) of this list; by all keyframes without it."""
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
        """(K,) how many of the distinct points (n,) each keyframe observes; or each keyframe of a list (k,)."""
        _, places = self._index_of_points.of(point_ids)
        counts = torch.bincount(places // self._keypoints, minlength=self.num_keyframes)
        return counts if keyframes is None else counts[keyframes]

    def scales_of(self, point_ids: Tensor) -> tuple[Tensor, Tensor]:
        """(n, w) which keyframes observe points (n,), NO_POINT beyond the last one, and (n, w) at which scales."""
        places = self._index_of_points.padded(point_ids).long()
        keyframes = torch.where(places >= 0, places // self._keypoints, NO_POINT)
        return keyframes, self.keyframes["scales"][keyframes, places % self._keypoints]

    def view(self, keyframe: int) -> FrameFeatures:
        """What a keyframe saw."""
        row = {name: column[keyframe] for name, column in self.keyframes.columns().items()}
        names = ("keypoints", "scales", "angles", "descriptors", "mask", "information")
        return FrameFeatures(
            index=int(row["frame_index"]),
            timestamp=float(row["timestamp"]),
            session=int(row["session"]),
            image=self.images.get(self.key(keyframe)) if self.images else None,
            waiting=0,
            **{name: row[name] for name in names},
        )

    def shared(self, keyframes: Tensor) -> Tensor:
        """(k, K) how many points each of keyframes (k,) shares with every other one; none with itself."""
        table, count = self.keyframes["point_ids"][keyframes], self.num_keyframes
        ids = torch.nonzero(torch.bincount(table[table >= 0]))[:, 0]
        which, places = self._index_of_points.of(ids)
        observers = places // self._keypoints
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
        """(<= count,) keyframes that share most points with this one, best first, itself excluded."""
        row = self.keyframes["point_ids"][keyframe]
        shared = self.observers(row[row >= 0])
        shared[keyframe] = 0
        return most(shared, count, min_shared)

    def around(self, keyframes: Tensor, count: int) -> Tensor:
        """(n,) keyframes (k,) and those that share most points with each of them, `count` at most, ascending."""
        shared = self.shared(keyframes)
        columns = torch.nonzero((shared >= MIN_SHARED).any(0))[:, 0]
        ranked = torch.sort(shared[:, columns], dim=1, descending=True, stable=True)
        is_near = ranked.values[:, :count] >= MIN_SHARED
        return torch.unique(torch.cat([keyframes, columns[ranked.indices[:, :count][is_near]]]))

    def sees(self, keyframes: Tensor, point_ids: Tensor) -> Tensor:
        """(k, n) whether keyframes (k,) observe distinct points (n,)."""
        column = torch.zeros(len(self.points) + 1, dtype=torch.int64, device=point_ids.device)
        column[point_ids] = torch.arange(1, len(point_ids) + 1, device=point_ids.device)
        seen = column[
            self.keyframes["point_ids"][keyframes]
        ]  # NO_POINT finds the last entry, which stays zero
        found = torch.zeros(len(keyframes), len(point_ids) + 1, dtype=torch.bool, device=point_ids.device)
        return found.scatter_(1, seen, True)[:, 1:]

    def points_seen_by(self, keyframes: Tensor) -> Tensor:
        """(n,) ids of the points that at least one of the keyframes (k,) observes, ascending."""
        table = self.keyframes["point_ids"][keyframes].flatten()
        return distinct(table[table >= 0])

    def append(self, other: Map) -> tuple[int, int]:
        """Add all keyframes and points of another map, in the same world frame; returns how far their rows moved."""
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
        """To be called when rows were renumbered."""
        self._index = None

    # --- changing --------------------------------------------------------------------------------------------

    def invalidate(self, point_ids: Tensor) -> None:
        """Mark points (n,) dead and drop their observations."""
        if len(point_ids) == 0:
            return
        _, places = self._index_of_points.of(point_ids)
        self._index_of_points.clear(point_ids)
        self._observations.scatter_(0, places, NO_POINT)
        self.points["is_valid"][point_ids] = False
        self.points["times_observed"][point_ids] = 0

    def drop(self, seen: Observations, wrong: Tensor) -> None:
        """Forget the observations that are `wrong` (O,), and kill points that fewer than two keyframes still see."""
        self.forget(seen.keyframe_index[wrong], seen.keypoint_index[wrong])
        touched = torch.unique(seen.point_index[wrong])
        self.invalidate(touched[self.points["times_observed"][touched] < 2])

    def replace(self, old: Tensor, new: Tensor) -> None:
        """Merge points: every observation of old (n,) becomes one of new (n,); old are dead from now on.

        Several may be merged into one; none of the new points may be among the old. A keyframe that saw both keeps
        one observation: that of the new point, or that at the first keypoint.
        """
        if len(old) == 0:
            return
        index, count = self._index_of_points, len(self.points)
        heirs = torch.unique(new)
        which, held = index.of(heirs)
        taken = (held // self._keypoints) * count + heirs[
            which
        ]  # keyframes and the heirs that they see already
        which, places = index.of(old)
        order = torch.argsort(places)  # of several keypoints the first comes first
        places, inherited = places[order], new[which[order]]
        wanted = (places // self._keypoints) * count + inherited
        kept = first_of_each(wanted) & ~torch.isin(wanted, taken)
        self.invalidate(old)
        self._observations.scatter_(0, places[kept], inherited[kept])
        index.add(inherited[kept], places[kept])
        self._count(inherited[kept], 1)
        self.points["replaced_by"][old] = new
        for counter in ("times_visible", "times_found"):
            self.points[counter].index_add_(0, new, self.points[counter][old])

    def resolve(self, point_ids: Tensor) -> Tensor:
        """The living heirs of merged points (n,); points that were not merged stay themselves."""
        heir = self.points["replaced_by"][point_ids]
        while bool((heir >= 0).any()):
            point_ids = torch.where(heir >= 0, heir, point_ids)
            heir = self.points["replaced_by"][point_ids]
        return point_ids

    def refresh(self, keyframes: Tensor) -> None:
        """Take direction, scale and descriptor of the points that keyframes (k,) see from their newest observation.

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
        centres_w = se3_inverse(self.T_cw[keyframe])[:, :3, 3]
        rays_w = self.positions_w[ids] - centres_w
        distance = torch.linalg.vector_norm(rays_w, dim=-1)
        self.points["view_directions_w"][ids] = rays_w / distance[:, None].clamp(min=1e-12)
        self.points["scale_distance"][ids] = distance * seen.scales[row]
        self.points["angles"][ids] = self.keyframes["angles"][keyframe, keypoint]
        self.points["descriptors"][ids] = self.keyframes["descriptors"][keyframe, keypoint]

    def forget_frames(self) -> None:
        """Frames are numbered anew: no point was seen by one of them yet."""
        if len(self.points):
            self.points["last_seen_frame"][:] = -1

    def take_covariances(self, keyframes: Tensor, point_ids: Tensor, marginals: Marginals) -> None:
        """Note how certain keyframes (k,) and points (n,) are; those the marginals hold no answer for keep theirs."""
        for column, rows, covariances in (
            (self.keyframes["covariances"], keyframes, marginals.frames),
            (self.points["covariances_w"], point_ids, marginals.points),
        ):
            known = covariances.diagonal(dim1=-2, dim2=-1).sum(-1) > 0
            column[rows[known]] = covariances[known]


def key_of(sessions: Tensor, frames: Tensor) -> Tensor:
    """Names (n,) of the frames (n,) of sessions (n,)."""
    return (sessions << SESSION_BITS) + frames
