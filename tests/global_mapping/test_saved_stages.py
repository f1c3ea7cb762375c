"""What global mapping saves while it is going on, and what a resumed run makes of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.global_mapping.synthetic import Recording, arc, ball
from tests.global_mapping.test_mapper import WALK, config
from torchslam.global_mapping import view_graph
from torchslam.global_mapping.mapper import GlobalMapper
from torchslam.global_mapping.saved_stages import SavedStages, delete_stages
from torchslam.global_mapping.view_graph import PairMatcher, Relation, ViewPair
from torchslam.map.file import read_tensors, write_tensors
from torchslam.types import FrameFeatures

RECORDING = Recording.of(arc(4), ball(60), first=0)
VIEWS = RECORDING.views
PAIRS = [RECORDING.pair(0, 1), RECORDING.pair(1, 3, Relation.PLANE)]
ENDS = [(0, 1), (0, 2), (1, 3)]


class Counted:
    """A stage that counts how often it is computed."""

    def __init__(self, found: list) -> None:
        self.found, self.times = found, 0

    def __call__(self) -> list:
        self.times += 1
        return self.found


def equal(one: object, other: object) -> bool:
    """Whether all attributes are equal to the bit."""

    def same(a: object, b: object) -> bool:
        return torch.equal(a, b) and a.dtype == b.dtype if isinstance(a, torch.Tensor) else a == b

    return all(same(getattr(one, each.name), getattr(other, each.name)) for each in fields(one))


@pytest.fixture
def saved(tmp_path: Path) -> Callable[..., SavedStages]:
    return lambda *overrides: SavedStages(tmp_path / "stages", WALK, config(*overrides))


def matcher(find: Callable[[], list], views: list[FrameFeatures] = VIEWS) -> Any:
    """Finds given pairs."""
    return SimpleNamespace(views=views, match=lambda ends: find())


def without_truth(view: FrameFeatures) -> FrameFeatures:
    return replace(view, T_cw_groundtruth=None)


def test_stages_are_read_as_they_were_saved(saved: Callable[..., SavedStages]) -> None:
    views, pairs, images = Counted(VIEWS), Counted(PAIRS), [view.index for view in VIEWS]
    for _ in range(2):
        found = saved().views(images, views)
        assert all(map(equal, found, map(without_truth, VIEWS)))
        assert all(map(equal, saved().pairs(matcher(pairs), ENDS), PAIRS))
    assert views.times == pairs.times == 1
    nothing = Counted([])
    assert [saved().pairs(matcher(nothing), [(2, 3)]) for _ in range(2)] == [[], []]
    assert nothing.times == 1


def test_stages_of_anything_else_are_not_read(saved: Callable[..., SavedStages]) -> None:
    """Another configuration, other images, other pairs."""
    views, pairs, images = Counted(VIEWS[:2]), Counted(PAIRS), [view.index for view in VIEWS]
    saved().views(images[:2], views)
    saved("seed=3").views(images[:2], views)
    saved().views(images[1:3], views)
    assert views.times == 3
    saved().pairs(matcher(pairs), ENDS)
    saved().pairs(matcher(pairs), ENDS[:2])
    saved().pairs(matcher(pairs, VIEWS[::-1]), ENDS)
    assert pairs.times == 3


def test_without_a_folder_nothing_is_saved() -> None:
    views = Counted(VIEWS)
    saved = SavedStages(None, WALK, config())
    assert saved.views([0], views) is saved.views([0], views) is VIEWS
    assert views.times == 2


def test_images_that_cannot_be_read_are_tried_again(saved: Callable[..., SavedStages]) -> None:
    """So is the warning of them; and what a matcher needs of images is not saved."""
    for found in ([VIEWS[0], None], [VIEWS[0], replace(VIEWS[1], image=torch.zeros(1, 1, 4, 4))]):
        views = Counted(found)
        assert all(saved().views([0, 1], views) is found for _ in range(2))
        assert views.times == 2


@pytest.mark.parametrize("name", ["views", "pairs"])
def test_a_damaged_file_is_reported_and_computed_again(saved: Callable[..., SavedStages], name: str) -> None:
    stage = Counted(VIEWS if name == "views" else PAIRS)
    column = "scales" if name == "views" else "keypoints_1"

    def read() -> list:
        return saved().views([0, 1, 2, 3], stage) if name == "views" else saved().pairs(matcher(stage), ENDS)

    read()
    (path,) = saved().folder.glob(f"{name}_*")
    columns, about = read_tensors(path)
    others = {key: rows for key, rows in columns.items() if key != column}
    for times, damaged in enumerate((others, others | {column: columns[column].flip(0) + 1}), 2):
        write_tensors(path, damaged, about)
        with pytest.warns(UserWarning, match="damaged, so it is computed again"):
            read()
        assert stage.times == times
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read()  # it was written anew
        assert stage.times == times
    path.write_bytes(b"half a fi")
    with pytest.warns(UserWarning, match="damaged, so it is computed again"):
        read()
    assert stage.times == 4


def test_only_stages_are_deleted(saved: Callable[..., SavedStages], tmp_path: Path) -> None:
    folder = tmp_path / "stages"
    delete_stages(folder)
    saved().views([0, 1, 2, 3], lambda: VIEWS)
    saved().pairs(matcher(lambda: PAIRS), ENDS)
    (folder / "views_1.safetensors.part").write_bytes(b"of a killed run")
    (folder / "notes.txt").write_text("mine")
    delete_stages(folder)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    (folder / "notes.txt").unlink()
    delete_stages(folder)
    assert not folder.exists()


class PowerCut(BaseException):
    """Ends a run wherever it is."""


def test_global_mapping_goes_on_with_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut after the features of five images, or after two distances of pairs: these are not computed again."""
    import torchslam.global_mapping.mapper as module

    monkeypatch.setattr(module, "SAVED_TOGETHER", 5)
    monkeypatch.setattr(view_graph, "_IMAGES_AT_ONCE", 5)
    read, matched = list[int](), list[int]()
    view, match = GlobalMapper.view, PairMatcher.match

    def counted_view(self: GlobalMapper, index: int) -> object:
        read.append(index)
        return view(self, index)

    def counted_match(self: PairMatcher, pairs: list[tuple[int, int]]) -> list[ViewPair]:
        matched.append(len(pairs))
        return match(self, pairs)

    monkeypatch.setattr(GlobalMapper, "view", counted_view)
    monkeypatch.setattr(PairMatcher, "match", counted_match)

    def mapped(folder: Path | None, stop: tuple[str, int] | None = None) -> bytes:
        read.clear()
        matched.clear()

        def progress(stage: str, done: int, most: int) -> None:
            if (stage, done) == stop:
                raise PowerCut

        saved = SavedStages(folder, WALK, config())
        run = GlobalMapper(WALK, WALK.camera, config(), None, progress=progress, saved=saved).run().run
        assert len(run.trajectory) == len(WALK)
        return run.trajectory.T_wc.numpy().tobytes() + run.map.positions_w.numpy().tobytes()

    whole = mapped(None)
    images, all_matched = read[:15], list(matched)
    with pytest.raises(PowerCut):
        mapped(tmp_path / "stages", ("features", 7))
    with pytest.raises(PowerCut):
        mapped(tmp_path / "stages", ("matches", 2))
    assert read == images[5:]
    assert mapped(tmp_path / "stages") == whole
    assert not set(read) & set(images)
    choice = 2  # neighbors, for the choice of images; no pairs are one stage, wherever they are asked for
    assert matched == [count for count in all_matched[choice + 2 :] if count]
    assert mapped(tmp_path / "stages") == whole
    assert matched == []
