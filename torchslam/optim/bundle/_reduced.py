"""The reduced system of a bundle adjustment of many images: blocks of covisible pairs, factorized as such.

Once the points are eliminated, two frames are joined where they see a common point. For the images of a recording these
are neighbors in time, and those of places seen again: few of all pairs. Their blocks are factorized by multifrontal
Cholesky, whose work and memory grow with the number of pairs.

What joins all frames at once, the cameras and the gauge, is a border of few columns. With U the border's columns, S the
frames' blocks and W the border's own block, the system is [[S, U], [U^T, W]], solved by S^-1 U and the small matrix
W - U^T S^-1 U. Where the gauge is open, S is singular: some rows of it are pinned, and two columns of the border for
each direction, one with the sign of a weight taken away, replace the pins by the gauge as it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.optim._core.linear import (
    BlockStructure,
    DefiniteFactor,
    SparseFactor,
    build_block_structure,
    factorize_sparse,
    smallest_pivot,
)

SPARSE_FRAMES = 200
"""Free frames from which on the reduced system is factorized as blocks of covisible pairs. With points in 8 images the
blocks are faster from 150 frames on, with points in 40 images from 250 on; with points in 100 images neither is up to
400. Tried from 60 to 400 frames; local maps, of some ten frames, are far below."""
MOST_CAMERAS = 16
"""Cameras up to which the border that they form is narrow: with a camera per frame it would be as wide as the system.
Tried with 1 to 3 cameras."""

MOST_COVISIBLE = 0.5
"""Share of all pairs of frames up to which blocks are worth it. Of a camera that stays in one room, 87 % of the pairs
of 1,000 frames share a point: blocks then take as long as the dense matrix, and a third more memory. Walks have a few
percent. Tried at this value only."""


FRAME_DIMS = 6
"""Unknowns of a frame: translation and rotation."""


@dataclass(frozen=True)
class DenseReduced:
    """A factorized reduced system of `num_frames` frames, then of the cameras, as one dense matrix."""

    factor: DefiniteFactor
    num_frames: int

    @property
    def definite(self) -> Bool[Tensor, ""]:
        """Whether the matrix is positive definite."""
        return self.factor.definite

    def solve(self, right: Float[Tensor, "R m"]) -> Float[Tensor, "R m"]:
        """matrix^-1 right, zero where the matrix is not definite."""
        return self.factor.solve(right)

    @cached_property
    def _inverse(self) -> Float[Tensor, "R R"]:
        return self.solve(_eye(len(self.factor.factor), self.factor.factor))

    def inverse_among(self, frames: Int[Tensor, " F"], rows: Int[Tensor, " r"]) -> Float[Tensor, "r r"]:
        """The inverse at the rows of frames that share points, then of cameras."""
        return self._inverse[rows[:, None], rows[None, :]]

    @property
    def inverse_frames(self) -> Float[Tensor, "K D D"]:
        """The blocks of the inverse at the frames."""
        split = FRAME_DIMS * self.num_frames
        frames = self._inverse[:split, :split].unflatten(0, (-1, FRAME_DIMS)).unflatten(-1, (-1, FRAME_DIMS))
        return frames.diagonal(dim1=0, dim2=2).movedim(-1, 0)

    @property
    def inverse_cameras(self) -> Float[Tensor, "n n"]:
        """The block of the inverse at the cameras."""
        split = FRAME_DIMS * self.num_frames
        return self._inverse[split:, split:]


@dataclass(frozen=True)
class CovisiblePairs:
    """The pairs of frames that share a point or a factor, and the order in which their blocks are eliminated.

    Blocks are numbered: those of the K frames, of the L pairs, of the transposed pairs, and one of zeros. Keys are K
    times the lower plus the higher frame of each pair, ascending, and one above all.
    """

    keys: Int[Tensor, " L1"]
    structure: BlockStructure

    def number(self, first: Int[Tensor, "*n"], second: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        """The number of the block at the rows of the first and the columns of the second frames."""
        count, pairs = self.structure.num_nodes, len(self.keys) - 1
        key = torch.minimum(first, second) * count + torch.maximum(first, second)
        at = torch.searchsorted(self.keys, key)
        number = count + at + pairs * (first > second)
        number = torch.where(self.keys[at] == key, number, count + 2 * pairs)
        return torch.where(first == second, first, number)


def covisible_pairs(
    num_frames: int,
    seen: Iterable[tuple[Int[Tensor, " F"], Float[Tensor, "p F"]]],
    joined: Int[Tensor, "M 2"],
    most: float,
) -> CovisiblePairs | None:
    """The pairs of frames that see a common point or that factors join; None where they are more than a share `most`.

    seen: for each tile its frames, and how often each of its points is seen by them
    """
    covisible = torch.zeros(num_frames, num_frames, dtype=torch.bool, device=joined.device)  # 4 MB of 2,000
    for frames, counts in seen:
        covisible[frames[:, None], frames] |= counts.mT @ counts > 0
    low, high = joined.amin(-1), joined.amax(-1)
    covisible[low, high] = True
    pairs = covisible.triu(1).nonzero()
    if len(pairs) > most * num_frames * (num_frames - 1) / 2:
        return None
    end = pairs.new_full((1,), num_frames * num_frames)
    keys = torch.cat((pairs[:, 0] * num_frames + pairs[:, 1], end))
    return CovisiblePairs(keys, build_block_structure(num_frames, FRAME_DIMS, pairs))


@dataclass(frozen=True)
class BlockReduced:
    """A reduced system as blocks of covisible pairs with a border.

    Attributes:
        factor: of the frames' blocks, with pins where the gauge is open
        border: columns of the cameras, of the gauge and of the pins, in units in which they are about one
        solved: the factor's solution for them
        rest: the inverse of the border's block, the frames eliminated
        camera_units: of the camera's columns
    """

    pairs: CovisiblePairs
    factor: SparseFactor
    border: Float[Tensor, "R b"]
    solved: Float[Tensor, "R b"]
    rest: Float[Tensor, "b b"]
    camera_units: Float[Tensor, " n"]
    definite: Bool[Tensor, ""]

    def solve(self, right: Tensor) -> Tensor:
        """matrix^-1 right, zero where the matrix is not definite."""
        frames, cameras = right.tensor_split((len(self.border),))
        x = self.factor.solve_columns(frames[None])[0]
        unused = self.border.shape[1] - len(self.camera_units)
        cameras = torch.nn.functional.pad(self.camera_units[:, None] * cameras, (0, 0, 0, unused))
        y = self.rest @ (cameras - self.border.mT @ x)
        x = torch.cat((x - self.solved @ y, self.camera_units[:, None] * y[: len(self.camera_units)]))
        return torch.where(self.definite, x, 0.0)

    @cached_property
    def _inverse(self) -> tuple[Float[Tensor, "M D D"], Float[Tensor, "R b"]]:
        """The inverse of the frames' blocks at covisible pairs, and L: the border adds L rest L^T."""
        diagonal, across = (part[0] for part in self.factor.inverse_blocks())
        blocks = torch.cat((diagonal, across, across.mT, torch.zeros_like(diagonal[:1])))
        unused = self.border.shape[1] - len(self.camera_units)
        of_cameras = torch.nn.functional.pad(torch.diag_embed(-self.camera_units), (0, unused))
        lifted = torch.cat((self.solved, of_cameras))
        return torch.where(self.definite, blocks, 0.0), torch.where(self.definite, lifted, 0.0)

    def inverse_among(self, frames: Tensor, rows: Tensor) -> Tensor:
        """As of `DenseReduced`; zero where frames share no points."""
        blocks, lifted = self._inverse
        numbers = self.pairs.number(*torch.meshgrid(frames, frames, indexing="ij"))
        own = blocks[numbers].transpose(1, 2).flatten(2).flatten(0, 1)
        more, lifted = len(rows) - len(own), lifted[rows]
        return torch.nn.functional.pad(own, (0, more, 0, more)) + lifted @ self.rest @ lifted.mT

    @property
    def inverse_frames(self) -> Tensor:
        """As of `DenseReduced`."""
        blocks, lifted = self._inverse
        count = self.pairs.structure.num_nodes
        lifted = lifted[: len(self.border)].unflatten(0, (count, FRAME_DIMS))
        return blocks[:count] + lifted @ self.rest @ lifted.mT

    @property
    def inverse_cameras(self) -> Tensor:
        """As of `DenseReduced`."""
        lifted = self._inverse[1][len(self.border) :]
        return lifted @ self.rest @ lifted.mT


def factorize_blocks(
    pairs: CovisiblePairs,
    blocks: Float[Tensor, "M D D"],
    camera_columns: Float[Tensor, "R n"],
    cameras: Float[Tensor, "n n"],
    gauge: Float[Tensor, "R g"] | None,
    strict: bool,
) -> BlockReduced:
    """Factorize a reduced system of blocks as `pairs` numbers them, and of cameras with columns against the frames.

    gauge: directions of the frames whose products with themselves are added to the matrix; strict: as of `factorize`
    """
    structure = pairs.structure
    diagonal, across = blocks[: structure.num_nodes], blocks[structure.num_nodes :][: len(pairs.keys) - 1]
    size = cameras.diagonal()
    units = torch.where(size > 0, size, 1.0).rsqrt()
    columns, own = [camera_columns * units], [units[:, None] * cameras * units]
    if gauge is not None:
        d = diagonal.diagonal(dim1=-2, dim2=-1).flatten()
        pinned = _pinned_rows(gauge)
        # A pin is as stiff as the row itself.
        weight = d.new_zeros(len(d)).index_copy(0, pinned, d[pinned])
        diagonal = diagonal + torch.diag_embed(weight.view(diagonal.shape[:2]))
        pins = torch.nn.functional.one_hot(pinned, len(d)).mT * d[pinned].sqrt()
        columns += [gauge * d.mean().sqrt(), pins]
        own += [-_eye(gauge.shape[1], d), _eye(len(pinned), d)]
    border = torch.cat(columns, dim=1)
    factor = factorize_sparse(structure, diagonal[None], across[None], strict=strict)
    determined = factor.definite[0]
    if strict and gauge is not None:  # rows of which no more than rounding is left beside the gauge
        of_gauge = columns[1].square().sum(-1)
        determined = determined & (d > smallest_pivot(d.dtype) ** 2 * of_gauge).all()
    solved = factor.solve_columns(border[None])[0]
    rest = torch.block_diag(*own) - border.mT @ solved
    usable = determined & rest.isfinite().all()
    rest = torch.where(usable, rest, _eye(len(rest), rest))
    with torch.no_grad():
        # Sylvester's law of inertia: of the border, only the columns of the gauge may count as negative.
        least = smallest_pivot(rest.dtype) ** 2 if strict else 0.0
        values, negative = torch.linalg.eigvalsh(rest), 0 if gauge is None else gauge.shape[1]
        signs = ((values < -least).sum() == negative) & ((values > least).sum() == len(rest) - negative)
        definite = usable & signs
    inverse = torch.linalg.inv_ex(torch.where(definite, rest, _eye(len(rest), rest))).inverse
    return BlockReduced(pairs, factor, border, solved, inverse, units, definite)


def _eye(size: int, like: Tensor) -> Tensor:
    return torch.eye(size, dtype=like.dtype, device=like.device)


@torch.no_grad()
def _pinned_rows(gauge: Float[Tensor, "R g"]) -> Int[Tensor, " p"]:
    """Rows that no direction of a gauge leaves alone: where it is largest, what the former ones fix left out."""
    left, pinned = gauge, list[Tensor]()
    largest = gauge.square().sum(-1).amax()
    for _ in range(gauge.shape[1]):
        sizes = left.square().sum(-1)
        row = sizes.argmax()
        if sizes[row] <= torch.finfo(sizes.dtype).eps * largest:  # directions that are zero
            break
        pinned.append(row)
        along = left[row] / sizes[row].sqrt()
        left = left - (left @ along)[:, None] * along
    return torch.stack(pinned) if pinned else torch.zeros(0, dtype=torch.int64, device=gauge.device)


Reduced = DenseReduced | BlockReduced
"""A factorized reduced system."""
