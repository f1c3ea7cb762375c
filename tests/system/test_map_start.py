"""The start of a submap: how many frames confirm it, when it is checked, and what is left of one that is discarded."""

from __future__ import annotations

import pytest
import torch

from tests.scene import CAMERA, Scene, pose, sideways, submap_of_scene
from torchslam import SLAM, load_config
from torchslam.geometry import SharedCamera
from torchslam.map.atlas import Submap
from torchslam.system import map_start as map_starts
from torchslam.system.frame_log import FrameStatus
from torchslam.system.map_start import CHECK_INTERVAL, FRAMES_PER_KEYFRAME, MapStart
from torchslam.system.savepoint import Savepoint
from torchslam.tracking.initialization import Initializer
from torchslam.types import FrameFeatures, Reason, Rejection, TwoViewMap

SCENE = Scene.of(400)
SIDE = pose(-0.5, 0.0, 0.1, 0.01, -0.05, 0.02)


class Started:
    """A provisional map of three keyframes, frames 0 to 2, which so many certain frames confirm.

    Attributes:
        checked: First and last frame of each check.
        tracked_back: Submaps whose earlier frames were to be tracked backward.
        contradiction: What the checks find.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, num_confirming: int = 12) -> None:
        monkeypatch.setattr(map_starts, "PROVISIONAL_FRAMES", num_confirming)
        self.slam = SLAM(CAMERA)
        self.context, self.submap = self.slam._context, submap_of_scene(SCENE, sideways(3))
        self.active, self.log = self.context.active_map, self.context.log
        self.slam.atlas._submaps, self.slam.atlas.num_created = [self.submap], 1
        for keyframe in range(3):
            self.slam.loop_closer.add(self.submap.map, keyframe)
        self.savepoint = Savepoint(self.submap, num_confirming)
        self.active.submap, self.active.provisional = self.submap, self.savepoint
        self.map_start.add_frames(SCENE.view(index, T) for index, T in enumerate(sideways(3)))
        self.checked: list[tuple[int, int]] = []
        self.tracked_back: list[Submap] = []
        self.contradiction: TwoViewMap | None = None

        def check(submap: Submap, first: FrameFeatures, last: FrameFeatures, *_: object) -> TwoViewMap | None:
            self.checked.append((first.index, last.index))
            return self.contradiction

        monkeypatch.setattr(map_starts, "contradicting_initialization", check)
        monkeypatch.setattr(self.map_start.backward, "from_first_keyframe", self.tracked_back.append)

    @property
    def map_start(self) -> MapStart:
        return self.slam._state_machine.map_start

    def count(self, *indices: int) -> list[bool]:
        return [self.map_start.count_frame(SCENE.view(index, pose())) for index in indices]

    @property
    def statuses(self) -> list[FrameStatus | None]:
        return [self.log.status(index) for index in range(3)]


def test_every_few_frames_the_map_is_checked_with_its_first_and_last_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started = Started(monkeypatch, num_confirming=12)
    assert started.count(*range(3, 14)) == [False] * 11
    assert started.checked == [(0, 2 + CHECK_INTERVAL), (0, 2 + 2 * CHECK_INTERVAL)]


def test_enough_certain_frames_confirm_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch, num_confirming=3)
    for index in (3, 4):
        assert started.active.provisional is started.savepoint
        assert started.tracked_back == []
        assert started.map_start.is_almost_confirmed is False
        started.count(index)
        assert started.log.status(index) is FrameStatus.POSED
    assert started.map_start.is_almost_confirmed
    started.count(5)
    assert started.active.provisional is None
    assert started.tracked_back == [started.submap]
    assert not any(started.log.status(index) for index in range(6))  # their poses are final
    assert not started.map_start.is_almost_confirmed
    assert started.count(6) == [False]
    assert started.log.status(6) is None


def test_frames_that_were_held_are_logged_but_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch)
    started.map_start.add_frames(SCENE.view(index, pose()) for index in (3, 4))
    assert (started.savepoint.num_certain, started.savepoint.needed) == (0, 12)
    assert started.savepoint.frames == [0, 1, 2, 3, 4]
    assert started.log.status(4) is FrameStatus.POSED


@pytest.mark.parametrize(
    ("num_confirming", "num_certain", "is_discarded"),
    [
        (3 * FRAMES_PER_KEYFRAME, 0, False),  # of three keyframes
        (3 * FRAMES_PER_KEYFRAME + 1, 0, True),
        (3 * FRAMES_PER_KEYFRAME + 4, 9, True),
    ],
)
def test_a_map_that_has_not_grown_is_discarded_when_the_camera_is_lost(
    num_confirming: int, num_certain: int, is_discarded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = Started(monkeypatch, num_confirming)
    started.count(*range(3, 3 + num_certain))
    assert started.map_start.end() is is_discarded
    assert started.active.provisional is None
    assert len(started.slam.atlas) == (0 if is_discarded else 1)
    assert len(started.slam.loop_closer.keyframe_database) == (0 if is_discarded else 3)
    assert started.tracked_back == ([] if is_discarded else [started.submap])
    assert started.statuses == [FrameStatus.UNPOSED if is_discarded else None] * 3


def test_a_confirmed_map_is_not_discarded(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch)
    started.map_start.confirm()
    assert started.map_start.end() is False
    assert len(started.slam.atlas) == 1
    assert started.tracked_back == [started.submap]  # once


def test_a_discarded_map_leaves_no_pending_adjustment(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch)
    started.slam.mapper.adjustment.request(started.submap.map, 2, None)
    started.map_start.end()
    assert not started.slam.mapper.adjustment.is_pending


def two_views() -> TwoViewMap:
    initializer = Initializer(SharedCamera(CAMERA), load_config(None, []))
    initializer.step(SCENE.view(0, pose()))
    start = initializer.step(SCENE.view(7, SIDE))
    assert isinstance(start, TwoViewMap), start
    return start


def test_a_contradicted_map_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that the new map does not explain have no pose."""
    started = Started(monkeypatch)
    started.contradiction = two_views()
    assert started.count(3, 4, 5, 6) == [False] * 4
    assert started.map_start.count_frame(SCENE.view(7, SIDE)) is True
    assert started.checked == [(0, 7)]
    submap, savepoint = started.active.current, started.active.provisional
    assert submap is not started.submap
    assert list(started.slam.atlas) == [submap]
    assert submap.number == 1
    assert savepoint is not None
    assert savepoint.submap is submap
    assert (savepoint.num_certain, savepoint.needed) == (0, 12)
    posed = submap.posed_frames.frames["frame_index"].tolist()
    assert savepoint.frames == sorted(posed)
    assert {0, 7} <= set(posed)
    keys = started.slam.loop_closer.keyframe_database.query(
        started.submap.map.frame_features(0).descriptors, started.submap.map.frame_features(0).mask
    )[0]
    assert sorted(keys.tolist()) == sorted(submap.map.keys.tolist())
    assert all(
        started.log.status(index) is (FrameStatus.POSED if index in posed else FrameStatus.UNPOSED)
        for index in range(8)
    )


def test_a_contradiction_that_gives_no_map_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch)
    started.contradiction = two_views()
    rejection = Rejection.of(Reason.FRAMES_UNEXPLAINED, count=1, frames=8)
    monkeypatch.setattr(started.map_start.map_initializer, "build", lambda *_: rejection)
    before = started.submap.map.T_cw.clone()
    assert started.count(*range(3, 8)) == [False] * 5
    assert started.checked == [(0, 7)]
    assert list(started.slam.atlas) == [started.submap]
    assert started.active.provisional is started.savepoint
    assert started.savepoint.num_certain == 5
    assert torch.equal(started.submap.map.T_cw, before)
