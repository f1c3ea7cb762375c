"""The costly stages of global mapping in a folder: features by groups of images, verified pairs by distance, windows.

A run that was killed finds what it had, and goes on with the same bytes. The name of a file is a hash of all that its
content depends on, so what belongs to another run, or to other images, is never read; a checksum of its content tells
damage. One image takes .6 KB for each of its keypoints.
"""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

import torchslam
from torchslam.config import Config
from torchslam.data.sequence import Sequence as Recording
from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.global_mapping.coarse import CoarseMap
from torchslam.global_mapping.rounds import ObservedTracks, Reconstruction
from torchslam.global_mapping.tracks import Tracks
from torchslam.global_mapping.view_graph import PairMatcher, Relation, ViewPair
from torchslam.map.file import FORMAT, read_tensors, write_tensors
from torchslam.system.checkpoint import input_hash
from torchslam.types import FrameFeatures
from torchslam.utils.files import PART, fingerprint

VIEWS, PAIRS, WINDOW = "views", "pairs", "window"
"""What files begin with."""
COLUMNS = "keypoints", "scales", "angles", "descriptors", "mask", "information"
"""Attributes of `FrameFeatures` with a row per keypoint. True poses are not saved: only what makes simulated features
reads them."""
RELATIONS = tuple(Relation)
"""The order of relations in a file."""

_Found = TypeVar("_Found")
_Columns = dict[str, Tensor]


class SavedStages:
    """Computes stages of a run, or reads what an earlier run saved of them, onto a device.

    folder: created with the first stage that is saved; None: nothing is saved or read
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
            if len(known) < len(found):
                return None
            times = torch.tensor([view.timestamp for view in known], dtype=torch.float64, device="cpu")
            counts = torch.tensor([len(view.mask) for view in known], dtype=torch.int64, device="cpu")
            return {"timestamp": times, "count": counts} | {
                name: torch.cat([getattr(view, name) for view in known]) for name in COLUMNS
            }

        def unpack(columns: _Columns) -> list[FrameFeatures | None]:
            views: list[FrameFeatures | None] = []
            counts = columns["count"].tolist()
            rows = zip(*(columns[name].split(counts) for name in COLUMNS), strict=True)
            for index, time, of_view in zip(images, columns["timestamp"].tolist(), rows, strict=True):
                # In memory of their own: a sum over rows that lie elsewhere in a cache line may have other last bits.
                own: dict[str, Any] = {
                    name: column.clone() for name, column in zip(COLUMNS, of_view, strict=True)
                }
                views.append(FrameFeatures(index, time, **own))
            return views

        return self._stage(VIEWS, list(images), find, pack, unpack)

    def pairs(self, matcher: PairMatcher, pairs: Iterable[tuple[int, int]]) -> list[ViewPair]:
        """The pairs that hold, as `PairMatcher.match`."""
        ends = list(pairs)
        of = [[view.index for view in matcher.views], ends]
        return self._stage(PAIRS, of, lambda: matcher.match(ends), _packed_pairs, _unpacked_pairs)

    def window(
        self,
        views: list[FrameFeatures],
        pairs: list[ViewPair],
        learned: list[ViewPair],
        camera: Camera,
        find: Callable[[list[FrameFeatures], list[ViewPair], list[ViewPair]], CoarseMap | str],
    ) -> CoarseMap | str:
        """The coarse map that is found of views from their pairs; a reason why there is none is not saved."""

        def pack(found: list[CoarseMap | str]) -> _Columns | None:
            (made,) = found
            if isinstance(made, str):
                return None
            tracks, solved = made.observed.tracks, made.found
            return {
                "pairs": _rows_among(pairs, made.pairs),
                "learned": _rows_among(learned, made.learned),
                "track": tracks.track,
                "view": tracks.view,
                "keypoint": tracks.keypoint,
                "T_cw": solved.T_cw,
                "params": solved.camera.params,
                "points_w": solved.points_w,
                "agrees": solved.agrees,
            }

        def unpack(columns: _Columns) -> list[CoarseMap | str]:
            tracks = Tracks(columns["track"], columns["view"], columns["keypoint"])
            own, more = (
                [every[row] for row in columns[name].tolist()]
                for name, every in (("pairs", pairs), ("learned", learned))
            )
            found = Reconstruction(
                columns["T_cw"], camera.with_params(columns["params"]), columns["points_w"], columns["agrees"]
            )
            return [CoarseMap(own, more, ObservedTracks.of(tracks, views), found, [])]

        ends = [[(pair.first, pair.second, len(pair)) for pair in every] for every in (pairs, learned)]
        of = [[view.index for view in views], ends]
        return self._stage(WINDOW, of, lambda: [find(views, pairs, learned)], pack, unpack)[0]

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
                saved, about = read_tensors(path)
                if about.get("checksum") != _checksum(saved):
                    raise ResultsError("its content has another checksum")
                return unpack({column: rows.to(self.device) for column, rows in saved.items()})
            except (ResultsError, TypeError) as error:
                warnings.warn(f"{path}: damaged, so it is computed again: {error}", stacklevel=2)
        found = find()
        columns = pack(found)
        if columns is not None:
            self.folder.mkdir(exist_ok=True)
            write_tensors(path, columns, {"format": FORMAT, "checksum": _checksum(columns)})
        return found


def delete_stages(folder: Path) -> None:
    """Delete saved stages, and their folder if nothing else is in it."""
    if not folder.is_dir():
        return
    for name in (VIEWS, PAIRS, WINDOW):
        for path in (*folder.glob(f"{name}_*.safetensors"), *folder.glob(f"{name}_*.safetensors{PART}")):
            path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def _rows_among(pairs: list[ViewPair], chosen: list[ViewPair]) -> Tensor:
    """The rows of chosen pairs."""
    row_of = {(pair.first, pair.second): row for row, pair in enumerate(pairs)}
    rows = [row_of[pair.first, pair.second] for pair in chosen]
    return torch.tensor(rows, dtype=torch.int64, device="cpu")


def _checksum(columns: _Columns) -> int:
    """CRC-32 of names and bytes."""
    found = 0
    for name in sorted(columns):
        found = zlib.crc32(columns[name].cpu().contiguous().numpy().data, zlib.crc32(name.encode(), found))
    return found


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


def _unpacked_pairs(columns: _Columns) -> list[ViewPair]:
    about = columns["about"].tolist()
    sizes = [size for _, _, size, _ in about]
    matches = (columns[name].split(sizes) for name in ("keypoints_1", "keypoints_2"))
    return [
        ViewPair(one, other, at_1.clone(), at_2.clone(), pose.clone(), RELATIONS[code])
        for (one, other, _, code), at_1, at_2, pose in zip(about, *matches, columns["T_21"], strict=True)
    ]
