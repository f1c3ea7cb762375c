"""The sparse normal equations of a bundle adjustment, solved by the Schur complement on its points.

Poses form 6x6 blocks, points 3x3 blocks, and an observation joins one pose with one point. Eliminating the points
leaves a dense system over the free poses (and the camera), which is fine up to several hundred keyframes. What makes
the elimination sparse are *tiles*: runs of points, ordered by the first frame that sees them, with the few frames that
see any of them. Within a tile the coupling is one dense matrix, so that the Schur complement is a few large matrix
products instead of very many small ones, and a sum in a fixed order: the same bytes on every run.
Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.optim._core.linear import DefiniteFactor, diagonal_floor, factorize
from torchslam.optim.bundle._factors import FrameBlocks

# Small enough for a tile's coupling to stay in the cache, large enough for its product to be worth the call. Where many
# frames see a place again and again, a tile has a column for each of them: fewer points share them better.
_TILE_POINTS, _TILE_POINTS_OF_MANY = 512, 128
_MANY_FRAMES = 64


@dataclass(frozen=True)
class Tile:
    """A run of points and the free frames that see any of them.

    Attributes:
        points: slice of the points
        storage: slice of the coupling's rows
        rows: rows of the reduced system that belong to the n frames
    """

    points: slice
    storage: slice
    rows: Int[Tensor, " R"]


@dataclass(frozen=True)
class Structure:
    """Which observation joins which frame and which point; made once per problem.

    Free frames have slots 0 ... K-1 in the reduced system. Observations are ordered by frame, those of free frames
    first; points by the first free frame that sees them.

    Attributes:
        frame_ends: for every free frame, the end of its observations
        by_point: the observations ordered by point
        point_counts: number of observations of each point
        coupling: storage row of each row of the observations' 3x6 blocks
    """

    num_frames: int
    num_points: int
    frame_ends: list[int]
    by_point: Int[Tensor, " O"]
    point_counts: Int[Tensor, " N"]
    coupling: Int[Tensor, " R"]
    storage_rows: int
    tiles: list[Tile]

    @property
    def num_linked(self) -> int:
        """How many observations are made by free frames."""
        return self.frame_ends[-1] if self.frame_ends else 0

    def sum_by_point(self, values: Float[Tensor, "O ..."]) -> Float[Tensor, "N ..."]:
        """Sums over each point's observations. (O, ...) -> (N, ...)."""
        flat = values.flatten(1)[self.by_point]
        total = torch.segment_reduce(flat, "sum", lengths=self.point_counts, unsafe=True)
        return total.view(self.num_points, *values.shape[1:])

    def sum_by_frame(self, values: Float[Tensor, "... O"]) -> Float[Tensor, "K ..."]:
        """Sums over each free frame's observations. (..., O) -> (K, ...)."""
        sums = [values[..., begin:end].sum(-1) for begin, end in pairwise((0, *self.frame_ends))]
        return torch.stack(sums) if sums else values.new_zeros(0, *values.shape[:-1])


def build_structure(
    frame_slots: Int[Tensor, " O"], point_index: Int[Tensor, " O"], num_frames: int, num_points: int
) -> Structure:
    """The structure of observations (O,) in the order of `Structure`.

    Args:
        frame_slots: slot of the observing frame, `num_frames` for all fixed ones.
    """
    counts = torch.bincount(frame_slots, minlength=num_frames + 1)[:num_frames]
    frame_ends = counts.cumsum(0).tolist()
    linked = frame_ends[-1] if frame_ends else 0
    slots, points = frame_slots[:linked], point_index[:linked]

    height = _TILE_POINTS if num_frames <= _MANY_FRAMES else _TILE_POINTS_OF_MANY
    tile_of = points // height
    keys, positions = torch.unique(tile_of * max(num_frames, 1) + slots, return_inverse=True)
    num_tiles = -(-num_points // height)
    sizes = torch.bincount(keys // max(num_frames, 1), minlength=num_tiles)  # frames per tile
    first = sizes.cumsum(0) - sizes
    starts = torch.arange(num_tiles, device=points.device) * height
    lengths = (num_points - starts).clamp_max(height)
    storage = 3 * sizes * lengths
    offsets = storage.cumsum(0) - storage

    axis = torch.arange(3, device=points.device)
    row_in_tile = (points % height)[:, None] * 3 + axis
    coupling = offsets[tile_of][:, None] + row_in_tile * sizes[tile_of][:, None]
    coupling = coupling + (positions - first[tile_of])[:, None]

    rows = (6 * (keys % max(num_frames, 1)))[:, None] + torch.arange(6, device=keys.device)
    tiles = [
        Tile(
            slice(start, start + length), slice(offset, offset + rows_), rows[begin : begin + size].flatten()
        )
        for start, length, offset, rows_, begin, size in zip(
            *(x.tolist() for x in (starts, lengths, offsets, storage, first, sizes)), strict=True
        )
    ]
    return Structure(
        num_frames,
        num_points,
        frame_ends,
        torch.argsort(point_index, stable=True),
        torch.bincount(point_index, minlength=num_points),
        coupling.flatten(),
        int(storage.sum()),
        tiles,
    )


class BundleTangent(NamedTuple):
    """A vector over all unknowns: frames (K, 6), points (N, 3), camera (P,); P = 0 where the camera is fixed."""

    frames: Float[Tensor, "K 6"]
    points: Float[Tensor, "N 3"]
    camera: Float[Tensor, " P"]

    def dot(self, other: BundleTangent) -> Tensor:
        products = (mine * others for mine, others in zip(self, other, strict=True))
        return torch.stack([product.sum() for product in products]).sum()


@dataclass(frozen=True)
class NormalEquations:
    """Gradient and block Hessian of a bundle adjustment's cost.

    Attributes:
        coupling: the point-frame blocks as the tiles store them
        free_points: the points that move
        between: blocks between two free frames, by slots, where there are factors
    """

    structure: Structure
    gradient: BundleTangent
    frames: Float[Tensor, "K 6 6"]
    points: Float[Tensor, "N 3 3"]
    camera: Float[Tensor, "P P"]
    frames_camera: Float[Tensor, "K 6 P"]
    points_camera: Float[Tensor, "N 3 P"]
    coupling: Float[Tensor, "R 6"]
    free_points: Bool[Tensor, " N"]
    between: FrameBlocks | None = None

    def factorized(
        self, damping: Float[Tensor, "*#scale"] | None = None, gauge: Float[Tensor, "K 6 g"] | None = None
    ) -> FactorizedEquations:
        """Eliminate the points and factorize what is left, after the diagonals grew by the share `damping`.

        Points that their observations do not determine are left out, as if fixed.

        Args:
            gauge: directions of the frames along which the solution is set to zero. If they span
                the null space of the observations, solutions for right sides orthogonal to it do not change.
        """
        root = factorize(_damped(self.points, damping), strict=damping is None).inverse_root()
        root = torch.where(self.free_points[:, None, None], root, 0.0)
        reduced = self._frames_and_camera(damping)
        whitened = [self._whitened(tile, root) for tile in self.structure.tiles]
        for tile, A in zip(self.structure.tiles, whitened, strict=True):
            rows = self._rows(tile)
            reduced.index_put_((rows[:, None], rows[None, :]), -(A.mT @ A), accumulate=True)
        if gauge is not None:
            c = gauge.flatten(0, 1) * reduced.diagonal().mean().sqrt()
            reduced[: len(c), : len(c)] += c @ c.mT
        return FactorizedEquations(self, root, whitened, factorize(reduced, strict=damping is None))

    def _frames_and_camera(self, damping: Tensor | None) -> Tensor:
        """The reduced system before elimination, (6 K + P, 6 K + P)."""
        num_frames, num_camera = self.structure.num_frames, self.camera.shape[-1]
        size = 6 * num_frames + num_camera
        reduced = self.frames.new_zeros(size, size)
        rows = torch.arange(6 * num_frames, device=reduced.device).view(num_frames, 6)
        frames = _damped(self.frames, damping)
        if damping is not None:  # a frame that lost all its observations stays solvable: its step is zero
            eye = torch.eye(6, dtype=frames.dtype, device=frames.device)
            frames = frames + diagonal_floor(frames.dtype) * eye
        reduced[rows[:, :, None], rows[:, None, :]] = frames
        if self.between is not None:
            first, second, blocks = self.between
            reduced.index_put_((rows[first][:, :, None], rows[second][:, None, :]), blocks, accumulate=True)
            reduced.index_put_(
                (rows[second][:, :, None], rows[first][:, None, :]), blocks.mT, accumulate=True
            )
        if num_camera:
            split = 6 * num_frames
            across = self.frames_camera.reshape(split, num_camera)
            reduced[split:, split:] = _damped(self.camera, damping)
            reduced[:split, split:], reduced[split:, :split] = across, across.mT
        return reduced

    def _whitened(self, tile: Tile, root: Tensor) -> Tensor:
        """A tile's coupling times the inverse root of its points' blocks, (3 p, 6 f + P)."""
        count = tile.points.stop - tile.points.start
        coupling = self.coupling[tile.storage].view(count, 3, len(tile.rows))
        if self.camera.shape[-1]:
            coupling = torch.cat((coupling, self.points_camera[tile.points]), dim=-1)
        return (root[tile.points] @ coupling).flatten(0, 1)

    def _rows(self, tile: Tile) -> Tensor:
        """Rows of the reduced system that a tile touches, the camera's last."""
        first = 6 * self.structure.num_frames
        camera = torch.arange(first, first + self.camera.shape[-1], device=tile.rows.device)
        return torch.cat((tile.rows, camera))


@dataclass(frozen=True)
class FactorizedEquations:
    """Normal equations, ready to be solved for any right side.

    Attributes:
        points_root: Q with Q^T Q the inverse of a point's block, zero for points that do not move
        whitened: per tile (3 p, 6 f + P)
        reduced: factor of the system over frames and camera
    """

    equations: NormalEquations
    points_root: Float[Tensor, "N 3 3"]
    whitened: list[Tensor]
    reduced: DefiniteFactor

    def solve(self, right: BundleTangent) -> BundleTangent:
        """H^-1 right; all zero where the reduced system is not definite."""
        equations, tiles = self.equations, self.equations.structure.tiles
        reduced_right = torch.cat((right.frames.flatten(), right.camera))
        halves = (self.points_root @ right.points[..., None]).squeeze(-1)
        for tile, A in zip(tiles, self.whitened, strict=True):
            update = A.mT @ halves[tile.points].flatten()
            reduced_right = reduced_right.index_add(0, equations._rows(tile), -update)
        solution = self.reduced.solve(reduced_right[:, None]).squeeze(-1)
        remainders = [
            halves[tile.points] - (A @ solution[equations._rows(tile)]).view(-1, 3)
            for tile, A in zip(tiles, self.whitened, strict=True)
        ]
        halves = torch.cat(remainders) if remainders else halves  # without points there are no tiles
        points = (self.points_root.mT @ halves[..., None]).squeeze(-1)
        split = 6 * equations.structure.num_frames
        points = torch.where(self.reduced.definite, points, 0.0)
        return BundleTangent(solution[:split].view(-1, 6), points, solution[split:])

    def marginals(self) -> Marginals:
        """The diagonal blocks of H^-1."""
        equations = self.equations
        size = self.reduced.factor.shape[-1]
        inverse = self.reduced.solve(
            torch.eye(size, dtype=self.points_root.dtype, device=self.points_root.device)
        )
        eye = torch.eye(3, dtype=inverse.dtype, device=inverse.device)
        points = []
        for tile, A in zip(equations.structure.tiles, self.whitened, strict=True):
            rows = equations._rows(tile)
            moved = (A @ inverse[rows[:, None], rows[None, :]]).unflatten(0, (-1, 3))
            root = self.points_root[tile.points]
            points.append(root.mT @ (eye + moved @ A.unflatten(0, (-1, 3)).mT) @ root)
        split = 6 * equations.structure.num_frames
        frames = inverse[:split, :split].unflatten(0, (-1, 6)).unflatten(-1, (-1, 6))
        frames = frames.diagonal(dim1=0, dim2=2).movedim(-1, 0)
        blocks = torch.cat(points) if points else self.points_root
        return Marginals(frames, blocks, inverse[split:, split:])


class Marginals(NamedTuple):
    """Marginal covariances.

    Attributes:
        frames: of the left perturbations (translation, rotation).
    """

    frames: Float[Tensor, "*batch K 6 6"]
    points: Float[Tensor, "*batch N 3 3"]
    camera: Float[Tensor, "*batch P P"]


def _damped(blocks: Tensor, damping: Tensor | None) -> Tensor:
    """Blocks with their diagonals grown by the share `damping`."""
    if damping is None:
        return blocks
    return blocks + torch.diag_embed(damping * blocks.diagonal(dim1=-2, dim2=-1))
