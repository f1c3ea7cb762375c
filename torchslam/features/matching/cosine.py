"""Nearest neighbors of descriptors of floats by cosine.

Most of the variance of descriptors lies in few directions. Where there are many descriptors, those of each image are
sorted along the first direction. Each is compared, by its coordinates along all of these directions, only with those of
the other image that are near it along the first one. The distances to what is chosen are exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.features.matching.nearest import (
    INDEX_BITS,
    Candidates,
    NearestNeighbors,
    best_keys,
    column_of,
)

_ROWS_AT_ONCE = 512
"""Rows whose similarities are computed at once: they stay in the cache. 256 to 1024 are equally fast, all 2000 of an
image take twice as long."""
_SORTED_AT_ONCE = 256
"""The same for sorted rows: the more there are, the wider is the band of columns. 128 is as fast."""
_DIRECTIONS, _VARIANCE = 0.5, 0.9
"""Share of the dimensions of descriptors by which columns are chosen, and what they must hold of the variance: 64 of
SIFT's 128 hold .96. With 48 dimensions, by the directions of two images, 1.4 % of the matches of garden, courthouse and
machine_hall pass that would not, in place of .6 %, in four fifths of the time."""
_BAND = 3.2
"""Half of the width of the band of columns that are compared, in root mean squares of a coordinate of the largest
difference of two descriptors that match. Of the matches that pass mutual and ratio test on garden, courthouse,
office_loop and machine_hall, .4 to .9 % are lost and .5 to 1.1 % are new, as by _DIRECTIONS without a band, in .75 to
.85 of the time. With 2.5, .7 to 1.6 % are new, in .65 to .85 of the time. Tried 1.6 to 4."""
_SAMPLE = 512
"""Descriptors of each set, the strongest, from which directions are found. Tried at this value only."""
_DIRECTIONS_FROM = 1 << 20
"""Pairs of descriptors from which on directions are found for two sets alone, on the CPU: with fewer than 1000 and 1000
there is little to gain."""


class SortedDescriptors(NamedTuple):
    """The descriptors of an image along `Directions`, by their first coordinate.

    Attributes:
        all: descriptors of the image, also those that are not used.
        row: of those that are used, in the order of the first coordinate.
        first: their first coordinates, ascending.
        left, right: coordinates and more, so that left of one image times right of another is 1 - half of the squared
            distance.
    """

    all: Float[Tensor, "N D"]
    row: Int[Tensor, " M"]
    first: Float[Tensor, " M"]
    left: Float[Tensor, "M K+2"]
    right: Float[Tensor, "M K+2"]


class Directions(NamedTuple):
    """The directions in which descriptors differ most."""

    mean: Float[Tensor, " D"]
    axes: Float[Tensor, "D K"]

    @classmethod
    def of(cls, descriptors: Float[Tensor, "N D"]) -> Directions | None:
        """By principal components; None if few of these hold too little of the variance, or without descriptors."""
        if len(descriptors) == 0:
            return None
        mean = descriptors.mean(0)
        rest = descriptors - mean
        values, vectors = torch.linalg.eigh((rest.mT @ rest).double())
        count = int(_DIRECTIONS * len(mean))
        if float(values[-count:].sum()) < _VARIANCE * float(values.sum()):
            return None
        return cls(mean, vectors[:, -count:].flip(1).to(descriptors))

    @classmethod
    def of_images(
        cls, descriptors: list[Shaped[Tensor, "_ D"]], masks: list[Bool[Tensor, " _"]]
    ) -> Directions | None:
        """The directions by the strongest descriptors of images.

        None also where descriptors are no floats, not on the CPU, or more than a key can number.
        """
        numbered = 1 << INDEX_BITS
        if not all(
            each.is_floating_point() and each.is_cpu and len(each) <= numbered for each in descriptors
        ):
            return None
        strongest = [own[:_SAMPLE][mask[:_SAMPLE]] for own, mask in zip(descriptors, masks, strict=True)]
        return cls.of(torch.cat(strongest).float())

    def sort(self, descriptors: Float[Tensor, "N D"], mask: Bool[Tensor, " N"]) -> SortedDescriptors:
        """Sort the masked descriptors of an image."""
        row = torch.nonzero(mask)[:, 0]
        values = descriptors.index_select(0, row).float() @ self.axes - self.mean @ self.axes
        first, order = values[:, 0].sort(stable=True)
        values = values.index_select(0, order)
        half, one = 0.5 * values.square().sum(1, keepdim=True), torch.ones_like(values[:, :1])
        left, right = torch.cat((values, 1 - half, one), dim=1), torch.cat((values, one, -half), dim=1)
        return SortedDescriptors(descriptors, row[order], first, left, right)


def nearest_by_cosine(
    descriptors_1: Float[Tensor, "B N1 D"],
    descriptors_2: Float[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
    with_second: bool,
    mutual_within: float | None = None,
) -> NearestNeighbors:
    """Find nearest neighbors by cosine similarity of unit descriptors; distances keep their graph.

    Args:
        descriptors_1, descriptors_2: unit vectors, or zero.
        mask_1, mask_2: which are used.
        allowed: pairs that may match; None: all.
        with_second: whether the second nearest one is wanted.
        mutual_within: distance up to which mutual neighbors are wanted, and no others: where there are many, and few
            directions hold most of their variance, `nearest_of_sorted` finds them. None: all are wanted.
    """
    pairs = Candidates(mask_1, mask_2, allowed, _used(mask_1), _used(mask_2))
    used_1, used_2 = descriptors_1[:, : pairs.rows], descriptors_2[:, : pairs.columns]
    with_gradient = torch.is_grad_enabled() and (descriptors_1.requires_grad or descriptors_2.requires_grad)
    is_large = pairs.rows * pairs.columns >= _DIRECTIONS_FROM
    if mutual_within is not None and with_second and not with_gradient and is_large and allowed is None:
        if len(descriptors_1) > 1:
            return _each_alone(descriptors_1, descriptors_2, mask_1, mask_2, mutual_within)
        directions = Directions.of_images([descriptors_1[0], descriptors_2[0]], [mask_1[0], mask_2[0]])
        images = (descriptors_1[0], mask_1[0]), (descriptors_2[0], mask_2[0])
        if directions is not None:
            one, other = (directions.sort(*image) for image in images)
            return nearest_of_sorted(one, other, mutual_within)
    if with_gradient:
        similarity = used_1 @ used_2.mT
    else:  # room for it once: new pages cost as much as products
        similarity = used_2.new_empty(len(mask_2), min(_ROWS_AT_ONCE, pairs.rows), pairs.columns)

    def keys_of(chunk: slice) -> tuple[Tensor, slice]:
        if with_gradient:
            return pairs.only(similarity.detach()[:, chunk].clone(), chunk, -torch.inf)
        room = similarity[:, : chunk.stop - chunk.start]
        return pairs.only(torch.matmul(used_1[:, chunk], used_2.mT, out=room), chunk, -torch.inf)

    best, column, second, of_column = best_keys(
        keys_of, pairs.rows, pairs.columns, -torch.inf, _ROWS_AT_ONCE, 0, with_second
    )
    found = best > -torch.inf
    nearest = 1 - (similarity.gather(2, column[..., None])[..., 0] if with_gradient else best)
    nearest = torch.where(found, nearest, 1.0)
    return pairs.neighbors(column, nearest, found, best >= of_column, 1 - second if with_second else None)


def _each_alone(
    descriptors_1: Float[Tensor, "B N1 D"],
    descriptors_2: Float[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    mutual_within: float,
) -> NearestNeighbors:
    """`nearest_by_cosine` with the second nearest, element by element: directions are those of an element."""
    elements = zip(*(each.split(1) for each in (descriptors_1, descriptors_2, mask_1, mask_2)), strict=True)
    found = [
        nearest_by_cosine(one, other, own, others, None, True, mutual_within)
        for one, other, own, others in elements
    ]
    return NearestNeighbors(*(torch.cat(columns) for columns in zip(*found, strict=True)))


def nearest_of_sorted(
    one: SortedDescriptors,
    other: SortedDescriptors,
    max_distance: float,
    allowed: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> NearestNeighbors:
    """Find mutual nearest neighbors in a band along the first of directions, a batch of one; other rows have none.

    A key is 1 - the squared distance / 2 along the directions, whose lowest bits are replaced with the column.

    Args:
        one, other: of two images, by the same directions.
        max_distance: 1 - cosine beyond which no neighbor is wanted.
        allowed: which of some rows and columns, (R, C), may match; None: all.
    """
    count, rows, columns = len(one.all), len(one.row), len(other.row)
    if rows == 0 or columns == 0:
        nothing = one.row.new_zeros(1, count)
        ones = one.all.new_ones(1, count)
        return NearestNeighbors(nothing, ones, nothing.bool(), nothing.bool(), ones)
    index_bits = columns.bit_length()
    lowest, highest = torch.iinfo(torch.int32).min, (1 << index_bits) - 1
    numbers = highest - torch.arange(columns, dtype=torch.int32, device=one.row.device)
    width = _BAND * math.sqrt(2 * max_distance / one.all.shape[1])
    starts = list(range(0, rows, _SORTED_AT_ONCE))
    begin = torch.searchsorted(other.first, one.first[starts] - width).clamp_(max=columns - 1)
    last = [min(start + _SORTED_AT_ONCE, rows) - 1 for start in starts]
    end = torch.searchsorted(other.first, one.first[last] + width, right=True).maximum(begin + 1)
    bands = dict(zip(starts, map(slice, begin.tolist(), end.tolist()), strict=True))
    room = one.left.new_empty(min(_SORTED_AT_ONCE, rows) * columns)

    def keys_of(chunk: slice) -> tuple[Tensor, slice]:
        at = bands[chunk.start]
        shape = chunk.stop - chunk.start, at.stop - at.start
        values = room[: math.prod(shape)].view(shape)
        torch.matmul(one.left[chunk], other.right[at].mT, out=values)
        keys = values.view(torch.int32).bitwise_and_(~highest).bitwise_or_(numbers[at])
        if allowed is not None:
            keys.masked_fill_(~allowed(one.row[chunk], other.row[at]), lowest)
        return keys[None], at

    found = best_keys(keys_of, rows, columns, lowest, _SORTED_AT_ONCE, index_bits, True)
    best, column, second, of_column = (values[0] for values in found)
    mutual = (best > lowest) & (best >> index_bits >= of_column >> index_bits)
    own = torch.nonzero(mutual)[:, 0]
    row, best, second = one.row[own], best[own], second[own]
    descriptors = one.all.index_select(0, row)

    def distances(keys: Tensor, otherwise: float) -> Tensor:
        chosen = other.row[column_of(keys, lowest, index_bits)]
        apart = 1 - other.all.index_select(0, chosen).mul_(descriptors).sum(-1)
        return torch.where(keys > lowest, apart, otherwise)

    def of_all(values: Tensor, otherwise: float) -> Tensor:
        return values.new_full((1, count), otherwise).index_copy_(1, row, values[None])

    is_found = of_all(torch.ones_like(row, dtype=torch.bool), False)
    nearest = of_all(other.row[column[own]], 0), of_all(distances(best, 1.0), 1.0)
    return NearestNeighbors(*nearest, is_found, is_found, of_all(distances(second, torch.inf), 1.0))


def _used(mask: Bool[Tensor, "B N"]) -> int:
    """Number of rows up to the last one that some element uses, at least one: feature extractors pad at the end."""
    used = torch.nonzero(mask.any(0))
    return int(used[-1]) + 1 if len(used) else 1
