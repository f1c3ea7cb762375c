from __future__ import annotations

from tests.scene import CAMERA, Scene, pose
from torchslam.map.atlas import Atlas
from torchslam.tracking.backward_tracking import UnposedFrames
from torchslam.tracking.provisional_map import ProvisionalMap
from torchslam.types import FrameFeatures

SCENE = Scene.of(5)


def views(*indices: int) -> list[FrameFeatures]:
    return [SCENE.view(index, pose()) for index in indices]


def waiting_for(limit: int, *indices: int) -> UnposedFrames:
    waiting = UnposedFrames(limit)
    waiting.add(*views(*indices))
    return waiting


def indices(waiting: UnposedFrames) -> list[int]:
    return [view.index for view in waiting]


def test_the_latest_frames_wait_in_order() -> None:
    waiting = waiting_for(3, 0, 1, 2, 3)
    waiting.add(*views(5))
    assert indices(waiting) == [2, 3, 5]
    assert len(waiting) == 3


def test_frames_from_in_between_find_their_place() -> None:
    waiting = waiting_for(10, 1, 2, 7, 8)
    waiting.add(*views(4, 5))
    assert indices(waiting) == [1, 2, 4, 5, 7, 8]


def test_frames_that_were_posed_wait_no_longer() -> None:
    waiting = waiting_for(10, 1, 2, 3, 4)
    waiting.remove(views(2, 4, 9))
    assert indices(waiting) == [1, 3]
    waiting.add()
    assert indices(waiting) == [1, 3]


def test_nobody_waits_where_nobody_may() -> None:
    assert len(waiting_for(0, 1, 2)) == 0


def test_a_young_world_counts_its_frames_from_the_start_on() -> None:
    submap = Atlas(CAMERA.params).create()
    youth = ProvisionalMap(submap, views(0, 1))
    assert youth.age == 0
    for view in views(2, 3, 4):
        youth.add_frame(view)
    assert youth.age == 3
    assert [view.index for view in youth.views] == [0, 1, 2, 3, 4]
    assert youth.submap is submap
