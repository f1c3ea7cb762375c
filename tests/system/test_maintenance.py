"""Maintenance of the active map: adjustment, then loops, then culling, before a frame is tracked and after it."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from tests.loop_closing.ring import END, ring_submap
from tests.scene import CAMERA, Scene, pose, sideways, submap_of_scene
from tests.system.judging import DOUBT, Drive
from tests.walks import Walk, arc
from torchslam import SLAM, Config
from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.map.atlas import Submap
from torchslam.map.compaction import RowRemap
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import ApplyAt
from torchslam.system import local_mapping, state_machine
from torchslam.system.maintenance import LOOP_STRIDE, Maintenance
from torchslam.system.modes import Mode
from torchslam.system.savepoint import Savepoint
from torchslam.system.state_machine import StateMachine

SCENE = Scene.of(200)
DUE = 7  # the frame after which the pending adjustment is applied
STEPS = ["apply", "loops", "cull"]


class Recorded:
    """A system with a map, whose maintenance does nothing but record its calls."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, due: int | None = None, is_pending: bool = True
    ) -> None:
        self.slam, self.calls = SLAM(CAMERA, Config()), list[str]()
        self.submap = self.slam._context.active_map.submap = submap_of_scene(SCENE, sideways(4))
        mapper, loop_closer, adjustment = self.slam.mapper, self.slam.loop_closer, self.slam.mapper.adjustment
        if is_pending:
            adjustment.request(self.submap.map, 3, due)

        def apply(_: Map) -> None:
            adjustment.drop()
            self.calls.append("apply")

        def cull(_: Submap) -> RowRemap | None:
            self.calls.append("cull")
            return None

        def detect(_: Submap, keyframe: int) -> LoopCandidate | None:
            self.calls.append("loops")
            return None

        monkeypatch.setattr(adjustment, "start", lambda: self.calls.append("start"))
        monkeypatch.setattr(mapper, "apply_adjustment", apply)
        monkeypatch.setattr(mapper, "cull_and_compact", cull)
        monkeypatch.setattr(loop_closer, "detect", detect)
        monkeypatch.setattr(loop_closer, "precheck", lambda *_: self.calls.append("precheck"))

    @property
    def maintenance(self) -> Maintenance:
        return self.slam._state_machine.maintenance


@pytest.mark.parametrize(
    ("due", "is_pending", "calls"),
    [(None, True, ["start", *STEPS]), (DUE, True, ["start"]), (None, False, [])],
    ids=["due before the frame", "due later", "nothing pending"],
)
def test_before_a_frame_an_adjustment_is_started_and_applied_if_it_is_due(
    due: int | None, is_pending: bool, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = Recorded(monkeypatch, due, is_pending)
    recorded.submap.tracking.reference = 0
    recorded.maintenance.before_frame()
    assert recorded.calls == calls
    is_applied = "apply" in calls
    assert recorded.submap.tracking.reference == (3 if is_applied else 0)  # the newest keyframe moved


@pytest.mark.parametrize(
    ("frame", "is_keyframe", "is_pending", "calls"),
    [
        (DUE, False, True, STEPS),
        (DUE + 1, False, True, STEPS),
        (DUE - 1, False, True, ["precheck"]),
        (DUE, True, True, []),  # it requested the adjustment itself
        (None, False, True, STEPS),
        (None, True, True, STEPS),
        (DUE, True, False, ["loops", "cull"]),  # its adjustment is applied already
        (DUE, False, False, []),
        (None, False, False, []),
        (None, True, False, ["loops", "cull"]),
    ],
)
def test_after_a_frame_adjustment_comes_before_loops_and_these_before_culling(
    frame: int | None, is_keyframe: bool, is_pending: bool, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = Recorded(monkeypatch, DUE, is_pending)
    recorded.maintenance.after_frame(frame, is_keyframe)
    assert recorded.calls == calls
    assert recorded.slam.mapper.adjustment.is_pending is (is_pending and "apply" not in calls)


def test_a_keyframe_is_checked_for_a_loop_once_while_its_adjustment_is_pending(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recorded = Recorded(monkeypatch, DUE)
    key = recorded.submap.map.key(3)
    for known, checks in ((None, 1), ((key, False), 1), ((key, True), 1), ((key + 1, False), 2)):
        recorded.slam.loop_closer.loop_precheck = known
        recorded.maintenance.after_frame(DUE - 1)
        assert recorded.calls == ["precheck"] * checks


@pytest.mark.parametrize("count", [0, 1, LOOP_STRIDE, LOOP_STRIDE + 1, 10])
def test_of_the_newest_keyframes_some_are_checked_for_loops(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded, checked = Recorded(monkeypatch, is_pending=False), list[int]()
    recorded.submap = recorded.slam._context.active_map.submap = submap_of_scene(
        SCENE, sideways(12, step=0.05)
    )
    monkeypatch.setattr(recorded.slam.loop_closer, "detect", lambda _, keyframe: checked.append(keyframe))
    recorded.maintenance.close_loops(count)
    assert checked == list(range(11, 11 - count, -1))[::LOOP_STRIDE]


def test_the_search_ends_with_the_first_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded, checked, closed = Recorded(monkeypatch, is_pending=False), list[int](), list[LoopCandidate]()
    submap = recorded.slam._context.active_map.submap = submap_of_scene(SCENE, sideways(12, step=0.05))
    found = LoopCandidate(submap, 7, submap, 0, pose())

    def detect(_: Submap, keyframe: int) -> LoopCandidate | None:
        checked.append(keyframe)
        return found if keyframe == found.keyframe else None

    monkeypatch.setattr(recorded.slam.loop_closer, "detect", detect)
    monkeypatch.setattr(recorded.maintenance, "_close", closed.append)
    recorded.maintenance.close_loops(12)
    assert checked == [11, 7]
    assert closed == [found]


def test_culled_keyframes_leave_the_keyframe_database(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded, removed = Recorded(monkeypatch, is_pending=False), list[int]()
    keys = recorded.submap.map.keys.clone()
    remap = RowRemap(
        torch.tensor([0, -1, 1, 2]), torch.arange(len(recorded.submap.map.points)), torch.tensor([0, 0, 1, 2])
    )
    monkeypatch.setattr(recorded.slam.mapper, "cull_and_compact", lambda _: remap)
    monkeypatch.setattr(recorded.slam.loop_closer, "remove", lambda gone: removed.extend(gone.tolist()))
    recorded.maintenance.after_frame(DUE, is_keyframe=True)
    assert removed == [int(keys[1])]


def test_after_a_loop_tracking_continues_at_the_newest_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = Recorded(monkeypatch, is_pending=False)
    submap = recorded.slam._context.active_map.submap = ring_submap(scale=1.01, twist=0.002)
    recorded.slam.tracker.reset_to_keyframe(submap, 3)
    T_before = submap.map.T_cw[END].clone()
    recorded.maintenance._close(LoopCandidate(submap, END - 2, submap, 0, pose()))
    assert submap.tracking.reference == END
    torch.testing.assert_close(submap.T_cw, submap.map.T_cw[END])
    assert not torch.allclose(submap.T_cw, T_before)


def test_a_merge_confirms_a_provisional_map_and_takes_frames_that_are_held_along(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recorded = Recorded(monkeypatch, is_pending=False)
    atlas, active = recorded.slam.atlas, recorded.slam._context.active_map
    earlier, later = (
        submap_of_scene(SCENE, sideways(4), first=first, number=number) for first, number in ((0, 0), (10, 1))
    )
    atlas._submaps = [earlier, later]
    active.submap, active.provisional, active.doubted = later, Savepoint(later, 20), Savepoint(later, 2)
    recorded.maintenance._close(LoopCandidate(later, 3, earlier, 3, pose()))
    assert active.provisional is None
    assert active.submap is earlier
    assert active.doubted is not None
    assert active.doubted.submap is earlier
    assert list(atlas) == [earlier]
    assert earlier.tracking.reference == 7


@pytest.mark.parametrize("is_delayed", [False, True])
def test_in_a_run_the_map_is_maintained_in_the_same_order(
    is_delayed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows may only be renumbered once nothing is pending."""
    if not is_delayed:
        monkeypatch.setattr(StateMachine, "_apply_at", lambda *_: ApplyAt.NOW)
    drive = Drive(monkeypatch, Walk(arc(80, 6.0)[:40]), "loop_closing.enabled=true")
    calls: list[str] = []

    def record(owner: object, name: str, call: str) -> None:
        called = getattr(owner, name)

        def recording(*given: object) -> object:
            calls.append(call)
            return called(*given)

        monkeypatch.setattr(owner, name, recording)

    slam = drive.slam
    record(slam.mapper, "apply_adjustment", "apply")
    record(slam._state_machine.maintenance, "close_loops", "loops")
    record(slam.mapper, "cull_and_compact", "cull")
    for _ in range(40):
        drive.step()
    following = dict(pairwise([*STEPS, STEPS[0]]))
    assert all(following[one] == other for one, other in pairwise(calls)), calls
    assert calls.count("cull") >= 6


WHOLE_FRAMES = 12  # after which the adjustment of the whole map is due


def with_whole_adjustment(monkeypatch: pytest.MonkeyPatch, few: int) -> tuple[Drive, list[int]]:
    """A walk with an adjustment of the whole map pending, and the frame in which it is applied, once it is.

    few: points in view below which no keyframe waits for it
    """
    for module in (local_mapping, state_machine):
        monkeypatch.setattr(module, "MIN_POINTS", few)
    monkeypatch.setattr(local_mapping, "LIVE_MIN_OVERLAP", 0.0)
    drive, applied = Drive(monkeypatch, Walk(arc(80, 6.0)[:60])), list[int]()
    slam, adjustment = drive.slam, drive.slam.mapper.adjustment
    while drive.step() is not Mode.TRACKING or adjustment.is_pending:
        pass
    assert slam.submap is not None
    due = len(drive.results) + WHOLE_FRAMES - 1
    adjustment.request_whole(
        slam.submap.map, slam.camera, due, lambda: applied.append(len(drive.results) + 1)
    )
    return drive, applied


def test_keyframes_wait_for_an_adjustment_of_the_whole_map(monkeypatch: pytest.MonkeyPatch) -> None:
    drive, applied = with_whole_adjustment(monkeypatch, few=0)
    begun = len(drive.results)
    while not applied:
        drive.step()
    assert applied == [begun + WHOLE_FRAMES]
    assert not any(result.is_keyframe for result in drive.results[begun:])


def test_with_few_points_in_view_a_keyframe_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adjustment is applied, and that of the keyframe is due before the next frame."""
    drive, applied = with_whole_adjustment(monkeypatch, few=1000)
    begun = len(drive.results)
    while not applied:
        drive.step()
    assert applied[0] < begun + WHOLE_FRAMES
    assert [result.is_keyframe for result in drive.results[begun:]] == [False] * (applied[0] - begun - 1) + [
        True
    ]
    assert drive.slam.mapper.adjustment.is_due_before_next_frame
    drive.check()


def test_a_frame_that_is_not_found_in_the_adjusted_map_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    drive, applied = with_whole_adjustment(monkeypatch, few=1000)
    tracker = drive.slam._context.tracker
    track = tracker.track
    monkeypatch.setattr(tracker, "track", lambda *given: None if applied else track(*given))
    drive.until(Mode.LOST)
    assert applied == [len(drive.results)]
    drive.check()


def test_a_doubtful_pose_in_the_adjusted_map_is_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    drive, applied = with_whole_adjustment(monkeypatch, few=1000)
    monkeypatch.setattr(state_machine, "check_pose_quality", lambda *_: DOUBT)
    drive.until(Mode.DOUBTED)
    assert applied == [len(drive.results)]
    assert [each.reason for each in drive.results[-1].reasons] == [DOUBT.reason]
    drive.check()
