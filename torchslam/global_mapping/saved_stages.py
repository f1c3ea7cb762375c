"""The costly stages of global mapping in a folder: features by groups of images, verified pairs by distance.

A run that was killed finds what it had, and goes on with the same bytes. The name of a file is a hash of all that its
content depends on, so what belongs to another run, or to other images, is never read. One image takes about 1.6 MB.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

import torchslam
from torchslam.config import Config
from torchslam.data.sequence import Sequence as Recording
from torchslam.errors import ResultsError
from torchslam.global_mapping.view_graph import PairMatcher, Relation, ViewPair
from torchslam.map.file import FORMAT, read_tensors, write_tensors
from torchslam.system.checkpoint import input_hash
from torchslam.types import FrameFeatures
from torchslam.utils.files import PART, fingerprint

VIEWS, PAIRS = "views", "pairs"
"""What files begin with."""
COLUMNS = "keypoints", "scales", "angles", "descriptors", "mask", "information"
"""Attributes of `FrameFeatures` with a row per keypoint."""
RELATIONS = tuple(Relation)
"""The order of relations in a file."""

_Found = TypeVar("_Found")
_Columns = dict[str, Tensor]


class SavedStages:
    """Computes stages, or reads what an earlier run saved of them.

    Args:
        folder: created with the first stage that is saved; None: nothing is saved or read.
        sequence: of the run.
        config: of the run.
        device: of what is read.
    """

    def __init__(
        self, folder: Path | None, sequence: Recording, config: Config, device: torch.device | str = "cpu"
    ) -> None:
        self.folder, self.device = folder, device
        self._run = [torchslam.__version__, input_hash(sequence), input_hash(config)] if folder else []

    def views(
        self, images: Sequence[int], find: Callable[[], list[FrameFeatures | None]]
    ) -> list[FrameFeatures | None]:
        """The features of images. They are not saved if an image cannot be read, or if matching needs images."""

        def pack(found: list[FrameFeatures | None]) -> _Columns | None:
            known = [view for view in found if view is not None and view.image is None]
            return _packed_views(known) if len(known) == len(found) else None

        return self._stage(VIEWS, list(images), find, pack, lambda columns: _unpacked_views(columns, images))

    def matcher(self, matcher: PairMatcher) -> PairMatcher:
        """A matcher that saves each of its results."""
        return _SavingMatcher(matcher, self)

    def pairs(
        self,
        views: Sequence[FrameFeatures],
        ends: Sequence[tuple[int, int]],
        find: Callable[[], list[ViewPair]],
    ) -> list[ViewPair]:
        """The pairs of views that hold, of those with the given rows."""
        return self._stage(
            PAIRS,
            [[view.index for view in views], list(ends)],
            find,
            _packed_pairs,
            lambda columns: _unpacked_pairs(columns, views, ends),
        )

    def _stage(
        self,
        name: str,
        of: list[object],
        find: Callable[[], list[_Found]],
        pack: Callable[[list[_Found]], _Columns | None],
        unpack: Callable[[_Columns], list[_Found]],
    ) -> list[_Found]:
        if self.folder is None:
            return find()
        path = self.folder / f"{name}_{fingerprint([self._run, name, of], digits=32)}.safetensors"
        if path.exists():
            try:
                saved, _ = read_tensors(path)
                return unpack({column: rows.to(self.device) for column, rows in saved.items()})
            except (ResultsError, ValueError, KeyError, TypeError) as error:
                warnings.warn(f"{path}: damaged, so it is computed again: {error}", stacklevel=2)
        found = find()
        columns = pack(found)
        if columns is not None:
            self.folder.mkdir(exist_ok=True)
            write_tensors(path, columns, {"format": FORMAT})
        return found


class _SavingMatcher(PairMatcher):
    def __init__(self, matcher: PairMatcher, saved: SavedStages) -> None:
        super().__init__(matcher.views, matcher.camera, matcher.matcher, matcher.config)
        self._saved = saved

    def match(self, pairs: Iterable[tuple[int, int]]) -> list[ViewPair]:
        ends = list(pairs)
        return self._saved.pairs(self.views, ends, lambda: super(_SavingMatcher, self).match(ends))


def delete_stages(folder: Path) -> None:
    """Delete saved stages, and their folder if nothing else is in it."""
    if not folder.is_dir():
        return
    for name in (VIEWS, PAIRS):
        for path in (*folder.glob(f"{name}_*.safetensors"), *folder.glob(f"{name}_*.safetensors{PART}")):
            path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def _packed_views(views: list[FrameFeatures]) -> _Columns:
    """Features as columns. True poses are left out: only what makes simulated features reads them."""
    about = {
        "index": torch.tensor([view.index for view in views], dtype=torch.int64, device="cpu"),
        "timestamp": torch.tensor([view.timestamp for view in views], dtype=torch.float64, device="cpu"),
    }
    return about | {name: torch.stack([getattr(view, name) for view in views]) for name in COLUMNS}


def _unpacked_views(columns: _Columns, images: Sequence[int]) -> list[FrameFeatures | None]:
    """Invert `_packed_views`; raise ValueError, KeyError or TypeError for anything but features of these images."""
    if columns["index"].tolist() != list(images):
        raise ValueError("features of other images")
    table = [columns[name] for name in COLUMNS]
    if len({rows.shape[:2] for rows in table}) > 1 or len(table[0]) != len(images):
        raise ValueError("columns of different lengths")
    if columns["mask"].dtype != torch.bool:
        raise ValueError("the mask is not boolean")
    if not all(bool(rows.isfinite().all()) for rows in table):
        raise ValueError("numbers that are not finite")
    times = columns["timestamp"].tolist()
    views: list[FrameFeatures | None] = []
    for row, (index, time) in enumerate(zip(images, times, strict=True)):
        # In memory of their own: a sum over rows that lie elsewhere in a cache line may have other last bits.
        own: dict[str, Any] = {name: columns[name][row].clone() for name in COLUMNS}
        views.append(FrameFeatures(index, time, **own))
    return views


def _packed_pairs(pairs: list[ViewPair]) -> _Columns:
    none = torch.zeros(0, dtype=torch.int64, device="cpu")
    about = [(pair.first, pair.second, len(pair), RELATIONS.index(pair.relation)) for pair in pairs]
    poses = [pair.T_21.cpu() for pair in pairs]
    return {
        "about": torch.tensor(about, dtype=torch.int64, device="cpu").view(-1, 4),
        "keypoints_1": torch.cat([none, *(pair.keypoints_1.cpu() for pair in pairs)]),
        "keypoints_2": torch.cat([none, *(pair.keypoints_2.cpu() for pair in pairs)]),
        "T_21": torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64, device="cpu"),
    }


def _unpacked_pairs(
    columns: _Columns, views: Sequence[FrameFeatures], ends: Sequence[tuple[int, int]]
) -> list[ViewPair]:
    """Invert `_packed_pairs`; raise ValueError, KeyError or TypeError for anything but pairs of these views."""
    about, T_21 = columns["about"].tolist(), columns["T_21"]
    sizes = [size for _, _, size, _ in about]
    if not {(one, other) for one, other, _, _ in about} <= set(ends):
        raise ValueError("pairs of other images")
    if T_21.shape != (len(about), 4, 4) or not bool(T_21.isfinite().all()):
        raise ValueError("poses that are no finite matrices")
    if min(sizes, default=0) < 0 or not all(0 <= code < len(RELATIONS) for _, _, _, code in about):
        raise ValueError("numbers out of range")
    matches = []
    for name, side in (("keypoints_1", 0), ("keypoints_2", 1)):
        rows = columns[name]
        if rows.dtype != torch.int64 or rows.shape != (sum(sizes),):
            raise ValueError(f"{name}: not a row for each match")
        matches.append(rows.split(sizes))
        for pair, own in zip(about, matches[-1], strict=True):
            if len(own) and not 0 <= int(own.min()) <= int(own.max()) < len(views[pair[side]].mask):
                raise ValueError(f"{name}: rows that are no keypoints")
    return [
        ViewPair(one, other, at_1.clone(), at_2.clone(), pose.clone(), RELATIONS[code])
        for (one, other, _, code), at_1, at_2, pose in zip(about, *matches, T_21, strict=True)
    ]
