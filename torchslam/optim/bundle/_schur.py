"""The sparse normal equations of a bundle adjustment, solved by the Schur complement on its points.

Poses form 6x6 blocks, points 3x3 blocks, free cameras n x n blocks, and an observation joins one pose, one camera and
one point. Eliminating the points leaves a system over the free poses and cameras: a dense matrix for few frames, blocks
of covisible pairs for many (`_reduced`). What makes the elimination sparse are *tiles*: runs of points, ordered by the
first and last frame that see them, with the few frames that see any of them, and their cameras. Within a tile the
coupling is one dense matrix, so that the Schur complement is a few large matrix products instead of very many small
ones, and a sum in a fixed order: the same bytes on every run.
Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.optim._core.linear import Groups, diagonal_floor, factorize, inverse_roots, smallest_pivot
from torchslam.optim.bundle._factors import FrameBlocks, PointBlocks
from torchslam.optim.bundle._reduced import (
    FRAME_DIMS,
    MOST_CAMERAS,
    MOST_COVISIBLE,
    SPARSE_FRAMES,
    BlockReduced,
    CovisiblePairs,
    DenseReduced,
    Reduced,
    covisible_pairs,
    factorize_blocks,
)

# Small enough for a tile's coupling to stay in the cache, large enough for its product to be worth the call. Where many
# frames see a place again and again, a tile has a column for each of them: fewer points share them better.
_TILE_POINTS, _TILE_POINTS_OF_MANY = 512, 64
MANY_FRAMES = 64
"""Frames from which on the tiles are smaller."""
_STRIP = 120
"""Columns of a tile's coupling whose products with themselves and all later ones are computed at once, a multiple of 6.
Half of the matrix is enough: of 150 frames it takes 7 ms in place of 20. Tried 96 to 960; 96 to 240 are equal."""

AT_ONCE = 1 << 17
"""Observations whose blocks are computed at once, 80 MB, or those of a single frame. With 8,000 or 65,000 an adjustment
takes the same time but for a second linearization, a tenth of it, where observations are more."""


class Columns(NamedTuple):
    """The frames or the cameras of a tile, ascending, and the slice of the coupling's rows with its blocks."""

    members: Int[Tensor, " n"]
    storage: slice


class Tile(NamedTuple):
    """A run of points, the free frames that see any of them, and the cameras that do."""

    points: slice
    frames: Columns
    cameras: Columns


class Strip(NamedTuple):
    """Covisible pairs of the members of a tile from number `start` on: first, of the strip, and second, counted from
    there, and the numbers of their blocks."""

    start: int
    row: Int[Tensor, " p"]
    column: Int[Tensor, " p"]
    number: Int[Tensor, " p"]


class Coupling(NamedTuple):
    """How the blocks that join points with frames, or with cameras, are stored: tile by tile, row by row, with a block
    of every member of the tile. `rows`: the storage row of each of their three rows; `size`: number of storage rows."""

    rows: Int[Tensor, " R"]
    size: int

    def stored(self, blocks: Float[Tensor, "M 3 n"]) -> Float[Tensor, "S n"]:
        """The blocks as they are stored, summed where a point and a member have several."""
        return self.add(blocks.new_zeros(self.size, blocks.shape[2]), blocks, 0)

    def add(
        self, stored: Float[Tensor, "S n"], blocks: Float[Tensor, "m 3 n"], first: int
    ) -> Float[Tensor, "S n"]:
        """Add blocks, from number `first` on, to those that are stored."""
        rows = self.rows[3 * first : 3 * (first + len(blocks))]
        return stored.index_add_(0, rows, blocks.reshape(len(rows), stored.shape[1]))


@dataclass(frozen=True)
class Structure:
    """Which observation joins which frame, camera and point; made once per problem.

    Free frames have slots 0 ... K-1 in the reduced system. Observations are ordered by frame, those of free frames
    first; points by the first and the last free frame that see them, or nearly so.

    Attributes:
        frame_ends: for every free frame, the end of its observations
        cameras: camera of each free frame
        camera_ends: for every camera, the end of its observations when they are ordered by camera
        by_camera: that order; None for a single camera
        by_pair: the observations of each pair that there is of a point and a camera
        coupling: of the observations by free frames; camera_coupling: of those pairs
        pairs: the covisible pairs of frames; None where the reduced system is dense
    """

    num_points: int
    frame_ends: list[int]
    by_point: Groups
    cameras: Int[Tensor, " K"]
    camera_ends: list[int]
    by_camera: Int[Tensor, " O"] | None
    by_pair: Groups
    coupling: Coupling
    camera_coupling: Coupling
    tiles: list[Tile]
    pairs: CovisiblePairs | None = None

    @property
    def num_frames(self) -> int:
        """How many frames are free."""
        return len(self.frame_ends)

    @cached_property
    def tile_blocks(self) -> list[list[Strip]]:
        """The covisible pairs of the members of each tile."""
        assert self.pairs is not None
        most, found = self.num_frames + len(self.pairs.keys) - 1, []
        for tile in self.tiles:
            members = tile.frames.members
            row, column = torch.triu_indices(len(members), len(members), device=members.device)
            number = self.pairs.number(members[row], members[column])
            there = number < most
            row, column, number = row[there], column[there], number[there]
            starts = range(0, len(members), _STRIP // FRAME_DIMS)
            counts = torch.bincount(row // starts.step, minlength=len(starts)).tolist()
            parts = zip(starts, *(each.split(counts) for each in (row, column, number)), strict=True)
            found.append([Strip(start, own - start, other - start, at) for start, own, other, at in parts])
        return found

    @property
    def num_linked(self) -> int:
        """How many observations are made by free frames."""
        return self.frame_ends[-1] if self.frame_ends else 0

    def sum_by_point(self, values: Float[Tensor, "O ..."]) -> Float[Tensor, "N ..."]:
        """Sums over each point's observations."""
        return self.by_point.sum(values[None])[0]

    def sum_by_pair(self, values: Float[Tensor, "O ..."]) -> Float[Tensor, "M ..."]:
        """Sums over each pair's observations."""
        return self.by_pair.sum(values[None])[0]

    def runs(self) -> Iterator[tuple[slice, list[int]]]:
        """The observations by free frames in runs of whole frames, each with the ends of its frames in it."""
        begin, ends = 0, list[int]()
        for end in self.frame_ends:
            if ends and end - begin > AT_ONCE:
                yield slice(begin, begin + ends[-1]), ends
                begin, ends = begin + ends[-1], []
            ends.append(end - begin)
        yield slice(begin, self.num_linked), ends

    def sum_by_camera(self, values: Float[Tensor, "... O"]) -> Float[Tensor, "C ..."]:
        """Sums over each camera's observations."""
        ordered = values if self.by_camera is None else values.index_select(-1, self.by_camera)
        return sum_runs(ordered, self.camera_ends)


def sum_runs(values: Float[Tensor, "... O"], ends: Sequence[int]) -> Float[Tensor, "R ..."]:
    """Sums over consecutive runs."""
    sums = [values[..., begin:end].sum(-1) for begin, end in pairwise((0, *ends))]
    return torch.stack(sums) if sums else values.new_zeros(0, *values.shape[:-1])


def build_structure(
    frame_slots: Int[Tensor, " O"],
    point_index: Int[Tensor, " O"],
    num_points: int,
    cameras: Int[Tensor, " K"],
    camera_of: Int[Tensor, " O"],
    num_cameras: int,
    joined: Int[Tensor, "M 2"] | None = None,
    free_cameras: bool = True,
) -> Structure:
    """The structure of observations in the order of `Structure`, by the slots of their frames, K for all fixed ones.

    cameras: of the free frames; camera_of: of the observations; joined: free frames that factors join; free_cameras:
    without, no pairs of points and cameras are needed
    """
    num_frames = len(cameras)
    frame_ends = torch.bincount(frame_slots, minlength=num_frames + 1)[:num_frames].cumsum(0).tolist()
    linked = frame_ends[-1] if frame_ends else 0
    height = _TILE_POINTS if num_frames <= MANY_FRAMES else _TILE_POINTS_OF_MANY
    coupling, frames_of = _stored(frame_slots[:linked], point_index[:linked], num_frames, num_points, height)
    by_point, pair = Groups.of(point_index, num_points), point_index * num_cameras + camera_of
    order = torch.argsort(pair, stable=True) if num_cameras > 1 else by_point.order
    order = order if free_cameras else order[:0]
    numbers, counts = torch.unique_consecutive(pair[order], return_counts=True)
    of_pairs = numbers % num_cameras, numbers // num_cameras
    camera_coupling, cameras_of = _stored(*of_pairs, num_cameras, num_points, height)
    runs = [slice(start, min(start + height, num_points)) for start in range(0, num_points, height)]
    pairs = None
    if num_frames >= SPARSE_FRAMES and num_cameras <= MOST_CAMERAS:
        ones = torch.ones(linked, 3, 1, dtype=torch.float32, device=frame_slots.device)
        views = coupling.stored(ones).squeeze(-1)
        seen = (
            (columns.members, views[columns.storage].view(run.stop - run.start, 3, -1)[:, 0])
            for run, columns in zip(runs, frames_of, strict=True)
            if len(columns.members)
        )
        joined = frame_slots.new_zeros(0, 2) if joined is None else joined
        pairs = covisible_pairs(num_frames, seen, joined, MOST_COVISIBLE)
    return Structure(
        num_points,
        frame_ends,
        by_point,
        cameras,
        torch.bincount(camera_of, minlength=num_cameras).cumsum(0).tolist(),
        torch.argsort(camera_of, stable=True) if num_cameras > 1 else None,
        Groups(order, counts),
        coupling,
        camera_coupling,
        [Tile(*parts) for parts in zip(runs, frames_of, cameras_of, strict=True)],
        pairs,
    )


def _stored(
    members: Int[Tensor, " M"],
    points: Int[Tensor, " M"],
    num_members: int,
    num_points: int,
    height: int,
) -> tuple[Coupling, list[Columns]]:
    """How the blocks of points against members are stored in tiles of `height` points, and the columns of each tile."""
    tile_of = points // height
    num_tiles = -(-num_points // height)
    keys = tile_of * num_members + members
    present = torch.zeros(num_tiles * num_members, dtype=torch.bool, device=keys.device)
    present[keys] = True
    sizes = present.view(num_tiles, num_members).sum(1)
    first = sizes.cumsum(0) - sizes
    starts = torch.arange(num_tiles, device=keys.device) * height
    storage = 3 * sizes * (num_points - starts).clamp_max(height)
    offsets = storage.cumsum(0) - storage

    row_in_tile = (points % height)[:, None] * 3 + torch.arange(3, device=keys.device)
    position = (present.cumsum(0) - 1)[keys] - first[tile_of]
    rows = offsets[tile_of][:, None] + row_in_tile * sizes[tile_of][:, None] + position[:, None]
    of_tiles = present.nonzero().squeeze(-1) % max(num_members, 1)
    columns = [
        Columns(of_tiles[begin : begin + size], slice(offset, offset + count))
        for begin, size, offset, count in zip(
            *(x.tolist() for x in (first, sizes, offsets, storage)), strict=True
        )
    ]
    return Coupling(rows.flatten(), int(storage.sum())), columns


class BundleTangent(NamedTuple):
    """A vector over all unknowns: frames (K, D), points (N, 3), cameras (C, n); n = 0 where they are fixed."""

    frames: Float[Tensor, "K D"]
    points: Float[Tensor, "N 3"]
    cameras: Float[Tensor, "C n"]

    def dot(self, other: BundleTangent) -> Tensor:
        products = (mine * others for mine, others in zip(self, other, strict=True))
        return torch.stack([product.sum() for product in products]).sum()


@dataclass(frozen=True)
class NormalEquations:
    """Gradient and block Hessian of a bundle adjustment's cost.

    Attributes:
        frames_cameras: blocks of frames against their cameras
        coupling: the blocks of points against frames, as `Structure.coupling` stores them
        camera_coupling: those against cameras
        between: blocks between two free frames, by slots, where there are factors
        joined: of factors that join points with points or free frames; its diagonal is part of `points` already
    """

    structure: Structure
    gradient: BundleTangent
    frames: Float[Tensor, "K D D"]
    points: Float[Tensor, "N 3 3"]
    cameras: Float[Tensor, "C n n"]
    frames_cameras: Float[Tensor, "K D n"]
    coupling: Float[Tensor, "R D"]
    camera_coupling: Float[Tensor, "S n"]
    free_points: Bool[Tensor, " N"]
    between: FrameBlocks | None = None
    joined: PointBlocks | None = None

    def factorized(
        self,
        damping: Float[Tensor, "*#scale"] | None = None,
        gauge: Float[Tensor, "K D g"] | None = None,
        of_points: Float[Tensor, " N"] | None = None,
    ) -> FactorizedEquations:
        """Eliminate the points and factorize what is left, after the diagonals grew by the share `damping`, or, those
        of points, by `of_points` where that is larger.

        Points that their observations do not determine are left out, as if fixed. Along the gauge, directions of the
        frames, the solution is zero: if they span the null space of the observations, solutions for right sides
        orthogonal to it do not change.
        """
        blocks, grown = self.points.permute(1, 2, 0), None if damping is None else damping.reshape(1)
        if grown is not None and of_points is not None:
            grown = torch.maximum(grown, of_points)
        root = inverse_roots(blocks, self.free_points, grown).permute(2, 0, 1).contiguous()
        directions = None if gauge is None else gauge.flatten(0, 1)
        find = self._dense if self.structure.pairs is None else self._blocks
        is_small = self.structure.num_linked <= AT_ONCE
        kept = list(self.whitened(root)) if is_small else None
        tiles = self.whitened(root) if kept is None else kept
        return FactorizedEquations(self, root, find(tiles, damping, directions), kept)

    def _dense(
        self, tiles: Iterable[TileCoupling], damping: Tensor | None, gauge: Tensor | None
    ) -> DenseReduced:
        """The reduced system as one matrix."""
        frame_rows, camera_rows = self.rows
        size = frame_rows.numel() + camera_rows.numel()
        reduced = self.frames.new_zeros(size, size)
        reduced[_at(frame_rows, frame_rows)] = self._own_frames(damping)
        if self.between is not None:
            first, second, blocks = self.between
            first, second = frame_rows[first], frame_rows[second]
            reduced.index_put_(_at(first, second), blocks, accumulate=True)
            reduced.index_put_(_at(second, first), blocks.mT, accumulate=True)
        if camera_rows.numel():
            own = camera_rows[self.structure.cameras]
            reduced[_at(camera_rows, camera_rows)] = _damped(self.cameras, damping)
            reduced[_at(frame_rows, own)] = self.frames_cameras
            reduced[_at(own, frame_rows)] = self.frames_cameras.mT
        flat = reduced.view(-1)
        for _, rows, A in tiles:
            # The factorization reads what is on and below the diagonal.
            for begin in range(0, len(rows), _STRIP):
                below, strip = rows[begin:], rows[begin : begin + _STRIP]
                product = A[:, begin:].mT @ A[:, begin : begin + _STRIP]
                flat.index_add_(0, (below[:, None] * size + strip).view(-1), product.view(-1), alpha=-1)
        if gauge is not None:
            c = gauge * reduced.diagonal().mean().sqrt()
            reduced[: len(c), : len(c)] += c @ c.mT
        factor = factorize(reduced, strict=damping is None)
        return DenseReduced(factor, self.structure.num_frames)

    def _blocks(
        self, tiles: Iterable[TileCoupling], damping: Tensor | None, gauge: Tensor | None
    ) -> BlockReduced:
        """The reduced system as blocks of covisible pairs, with the cameras as a border."""
        pairs, dims = self.structure.pairs, FRAME_DIMS
        assert pairs is not None
        frame_rows, camera_rows = self.rows
        split, size = frame_rows.numel(), camera_rows.numel()
        count = len(frame_rows)
        most = count + len(pairs.keys) - 1
        blocks = self.frames.new_zeros(most, dims, dims)
        blocks[:count] = self._own_frames(damping)
        if self.between is not None:
            first, second, between = self.between
            low, high = torch.minimum(first, second), torch.maximum(first, second)
            between = torch.where((first < second)[:, None, None], between, between.mT)
            blocks.index_add_(0, pairs.number(low, high), between)
        columns, own = self.frames.new_zeros(split, size), self.frames.new_zeros(size, size)
        if size:
            of_cameras = camera_rows - split
            own[_at(of_cameras, of_cameras)] = _damped(self.cameras, damping)
            columns[_at(frame_rows, of_cameras[self.structure.cameras])] = self.frames_cameras
        structure = self.structure
        for tile, strips, (_, rows, A) in zip(structure.tiles, structure.tile_blocks, tiles, strict=True):
            width = dims * len(tile.frames.members)
            border, of_cameras = A[:, width:], rows[width:] - split
            for start, row, column, number in strips:
                begin, end = dims * start, min(dims * start + _STRIP, width)
                products = A[:, begin:end].mT @ A[:, begin:]
                of_frames = products[:, : width - begin].unflatten(0, (-1, dims)).unflatten(2, (-1, dims))
                blocks.index_add_(0, number, of_frames[row, :, column], alpha=-1)
                if size:
                    more = -products[:, width - begin :]
                    columns.index_put_((rows[begin:end, None], of_cameras), more, accumulate=True)
            if size:
                own.index_put_((of_cameras[:, None], of_cameras), -(border.mT @ border), accumulate=True)
        return factorize_blocks(pairs, blocks, columns, own, gauge, strict=damping is None)

    def _own_frames(self, damping: Tensor | None) -> Tensor:
        """The blocks (K, D, D) of the frames before elimination."""
        frames = _damped(self.frames, damping)
        if damping is not None:  # a frame that lost all its observations stays solvable: its step is zero
            eye = torch.eye(FRAME_DIMS, dtype=frames.dtype, device=frames.device)
            frames = frames + diagonal_floor(frames.dtype) * eye
        return frames

    @cached_property
    def rows(self) -> tuple[Int[Tensor, "K D"], Int[Tensor, "C n"]]:
        """Rows of the reduced system that belong to each frame, and to each camera."""
        split, (num_cameras, num_free) = FRAME_DIMS * self.structure.num_frames, self.cameras.shape[:2]
        rows = torch.arange(split + num_cameras * num_free, device=self.frames.device)
        return rows[:split].view(-1, FRAME_DIMS), rows[split:].view(num_cameras, num_free)

    def whitened(self, root: Float[Tensor, "N 3 3"]) -> Iterator[TileCoupling]:
        """The coupling of each tile with frames and cameras, times the inverse roots of the points' blocks.

        Tile by tile, since all of them take as much memory as the coupling itself.
        """
        frame_rows, camera_rows = self.rows
        for tile in self.structure.tiles:
            count = tile.points.stop - tile.points.start
            rows = frame_rows[tile.frames.members].flatten()
            coupling = self.coupling[tile.frames.storage].view(count, 3, len(rows))
            if camera_rows.numel():
                more = camera_rows[tile.cameras.members].flatten()
                of_cameras = self.camera_coupling[tile.cameras.storage].view(count, 3, len(more))
                rows, coupling = torch.cat((rows, more)), torch.cat((coupling, of_cameras), dim=-1)
            yield TileCoupling(tile.points, rows, (root[tile.points] @ coupling).flatten(0, 1))


def _at(rows: Int[Tensor, "M r"], columns: Int[Tensor, "M c"]) -> tuple[Tensor, Tensor]:
    """Where blocks (M, r, c) lie in a matrix."""
    return rows[:, :, None], columns[:, None, :]


class TileCoupling(NamedTuple):
    """The points of a tile, the rows of the reduced system of its frames and cameras, and the whitened coupling of
    both."""

    points: slice
    rows: Int[Tensor, " R"]
    coupling: Float[Tensor, "p3 R"]


@dataclass(frozen=True)
class FactorizedEquations:
    """Normal equations, ready to be solved for any right side: `points_root` is Q with Q^T Q the inverse of a point's
    block, zero for points that do not move."""

    equations: NormalEquations
    points_root: Float[Tensor, "N 3 3"]
    reduced: Reduced
    kept: list[TileCoupling] | None

    @property
    def tiles(self) -> Iterable[TileCoupling]:
        """As of `NormalEquations.whitened`, kept in small problems."""
        return self.equations.whitened(self.points_root) if self.kept is None else self.kept

    @property
    def definite(self) -> Bool[Tensor, ""]:
        """Whether the whole matrix is positive definite."""
        if self._correction is None:
            return self.reduced.definite
        return self.reduced.definite & self._correction.definite

    def solve(self, right: BundleTangent) -> BundleTangent:
        """H^-1 right; all zero where the system is not definite."""
        solution, correction = self._solve_apart(right), self._correction
        if correction is None:
            return solution
        pulled = correction.middle @ _flat(solution)[correction.numbers]
        return BundleTangent(
            *(
                torch.where(correction.definite, x - column @ pulled, 0.0)
                for x, column in zip(solution, correction.columns, strict=True)
            )
        )

    @cached_property
    def _correction(self) -> _Correction | None:
        """What factors that join points change; Sylvester's identity needs one solution for each of their numbers."""
        joined = self.equations.joined
        if joined is None or not len(joined.joined):
            return None
        like = self.equations.gradient
        shapes, sizes = [x.shape for x in like], [x.numel() for x in like]
        units = (
            torch.nn.functional.one_hot(joined.joined, sum(sizes)).to(self.points_root).split(sizes, dim=1)
        )
        columns = torch.vmap(self._solve_apart, out_dims=-1)(
            BundleTangent(*(x.unflatten(1, shape) for x, shape in zip(units, shapes, strict=True)))
        )
        inverse = torch.cat([x.flatten(0, 1) for x in columns])[joined.joined]
        lower, failed = torch.linalg.cholesky_ex(0.5 * (inverse + inverse.mT))
        eye = torch.eye(len(lower), dtype=lower.dtype, device=lower.device)
        lower = torch.where(failed > 0, eye, lower)
        values = torch.linalg.eigvalsh(lower.mT @ joined.matrix @ lower)
        definite = (failed == 0) & (values > smallest_pivot(lower.dtype) - 1).all()
        system = torch.where(definite, eye + joined.matrix @ inverse, eye)
        middle = torch.linalg.solve(system, joined.matrix)
        return _Correction(joined.joined, columns, middle, definite)

    def _solve_apart(self, right: BundleTangent) -> BundleTangent:
        """As `solve`, without the factors that join points."""
        reduced_right = torch.cat((right.frames.flatten(), right.cameras.flatten()))
        halves = (self.points_root @ right.points[..., None]).squeeze(-1)
        for points, rows, A in self.tiles:
            reduced_right = reduced_right.index_add(0, rows, -(A.mT @ halves[points].flatten()))
        solution = self.reduced.solve(reduced_right[:, None]).squeeze(-1)
        remainders = [halves[points] - (A @ solution[rows]).view(-1, 3) for points, rows, A in self.tiles]
        halves = torch.cat(remainders) if remainders else halves  # without points there are no tiles
        moved = (self.points_root.mT @ halves[..., None]).squeeze(-1)
        frame_rows, camera_rows = self.equations.rows
        moved = torch.where(self.reduced.definite, moved, 0.0)
        return BundleTangent(solution[frame_rows], moved, solution[camera_rows])

    def marginals(self) -> Marginals:
        """The diagonal blocks of H^-1."""
        eye = torch.eye(3, dtype=self.points_root.dtype, device=self.points_root.device)
        blocks = []
        for tile, (points, rows, A) in zip(self.equations.structure.tiles, self.tiles, strict=True):
            moved = (A @ self.reduced.inverse_among(tile.frames.members, rows)).unflatten(0, (-1, 3))
            root = self.points_root[points]
            blocks.append(root.mT @ (eye + moved @ A.unflatten(0, (-1, 3)).mT) @ root)
        points_w = torch.cat(blocks) if blocks else self.points_root
        inverse = self.reduced.inverse_frames, points_w, self.reduced.inverse_cameras
        correction = self._correction
        if correction is not None:
            columns = *correction.columns[:2], correction.columns.cameras.flatten(0, 1)
            inverse = tuple(  # type: ignore[assignment]
                torch.where(correction.definite, x - Y @ correction.middle @ Y.mT, 0.0)
                for x, Y in zip(inverse, columns, strict=True)
            )
        return Marginals(*inverse)


class _Correction(NamedTuple):
    """H^-1 = A^-1 - columns middle columns^T of H = A + U S U^T: U picks `numbers` (r,), columns are A^-1 U."""

    numbers: Int[Tensor, " r"]
    columns: BundleTangent
    middle: Float[Tensor, "r r"]
    definite: Bool[Tensor, ""]


def _flat(vector: BundleTangent) -> Tensor:
    return torch.cat([part.flatten() for part in vector])


class Marginals(NamedTuple):
    """Marginal covariances, of frames those of the left perturbations (translation, rotation)."""

    frames: Float[Tensor, "*batch K 6 6"]
    points: Float[Tensor, "*batch N 3 3"]
    camera: Float[Tensor, "*batch P P"]


def _damped(blocks: Tensor, damping: Tensor | None) -> Tensor:
    """Blocks with their diagonals grown by the share `damping`."""
    if damping is None:
        return blocks
    return blocks + torch.diag_embed(damping * blocks.diagonal(dim1=-2, dim2=-1))
