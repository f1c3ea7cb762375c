"""The modes of a session: every transition happens, in frames of a simulated walk, and no other one does."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from itertools import pairwise, product
from types import ModuleType

import pytest

from tests.system.judging import DOUBT, NO_POSE, WRONG, Drive, Judgment
from tests.walks import Walk, arc
from torchslam import State
from torchslam.system import map_start, state_machine
from torchslam.system.modes import TRANSITIONS, Mode
from torchslam.system.session import SystemContext
from torchslam.system.state_machine import FrameOutcome, StateMachine
from torchslam.types import Reason

INITIALIZING, LOST = Mode.INITIALIZING, Mode.LOST
PROVISIONAL, PROVISIONAL_DOUBTED = Mode.PROVISIONAL, Mode.PROVISIONAL_DOUBTED
TRACKING, DOUBTED, RELOCALIZED = Mode.TRACKING, Mode.DOUBTED, Mode.RELOCALIZED
Constants = tuple[tuple[ModuleType, str, int], ...]
SOON_KEPT: Constants = ((map_start, "PROVISIONAL_FRAMES", 8),)
SOON_ANEW: Constants = ((state_machine, "FRAMES_BEFORE_NEW_SUBMAP", 2),)


def until_lost(drive: Drive) -> None:
    """A confirmed map, and then no pose."""
    drive.until(TRACKING)
    for _ in range(5):
        drive.step()
    drive.step(NO_POSE)
    assert drive.slam.mode is LOST


def until_second_map(drive: Drive) -> None:
    """A confirmed map, a loss, and a provisional map of the same place, which is not recognized."""
    until_lost(drive)
    drive.recognizes = False
    drive.until(PROVISIONAL)
    assert len(drive.slam.atlas) == 2


def start(drive: Drive) -> None:
    drive.until(PROVISIONAL)
    assert drive.results[-1].reason == Reason.STARTED


def start_another_map(drive: Drive) -> None:
    until_second_map(drive)
    assert drive.results[-1].reason == Reason.STARTED


def relocalize(drive: Drive) -> None:
    until_lost(drive)
    drive.step()
    assert drive.results[-1].reason == Reason.RELOCALIZED


def confirm_by_frames(drive: Drive) -> None:
    drive.until(TRACKING)
    certain = [result for result in drive.results if result.state is State.TRACKING]
    assert len(certain) == map_start.PROVISIONAL_FRAMES + 1  # and the frame of its start
    assert not drive.slam.loop_closer.loop_closures


def confirm_by_known_map(drive: Drive) -> None:
    until_second_map(drive)
    drive.recognizes = True
    drive.until(TRACKING)
    assert len(drive.slam.atlas) == 1
    assert drive.results[-1].submap == 0


def doubt_in_provisional_map(drive: Drive) -> None:
    drive.until(PROVISIONAL)
    drive.step(DOUBT)


def doubt_where_a_known_map_agrees(drive: Drive) -> None:
    """The map is merged before the frame is tracked."""
    until_second_map(drive)
    drive.recognizes = drive.doubts_when_merged = True
    drive.until(DOUBTED)
    assert len(drive.slam.atlas) == 1


def discard_first_map(drive: Drive) -> None:
    drive.until(PROVISIONAL)
    drive.step(NO_POSE)
    assert len(drive.slam.atlas) == 0
    assert drive.results[-1].reason == Reason.LOST_AT_START


def discard_second_map(drive: Drive) -> None:
    until_second_map(drive)
    drive.step(NO_POSE)
    assert [submap.number for submap in drive.slam.atlas] == [0]
    assert drive.results[-1].reason == Reason.LOST_AT_START


def grow(drive: Drive) -> None:
    """A provisional map with so many keyframes that it is kept; frames would still have to follow."""
    drive.until(PROVISIONAL)
    provisional = drive.slam._context.active_map.provisional
    assert provisional is not None
    while 2 * drive.slam.map.num_keyframes < provisional.num_confirming:
        drive.step()
    assert drive.slam.mode is PROVISIONAL


def lose_grown_map(drive: Drive) -> None:
    grow(drive)
    drive.step(NO_POSE)
    assert len(drive.slam.atlas) == 1
    assert drive.results[-1].reason == Reason.LOST


def confirm_in_provisional_map(drive: Drive) -> None:
    doubt_in_provisional_map(drive)
    drive.step()
    assert drive.slam.mode is PROVISIONAL_DOUBTED
    drive.step()


def confirm_where_a_known_map_agrees(drive: Drive) -> None:
    """The places of tentative keyframes are compared when they are confirmed."""
    until_second_map(drive)
    doubted = drive.slam._context.active_map
    while doubted.doubted is None or not doubted.doubted.has_keyframes:
        drive.step(DOUBT)
    drive.recognizes = True
    while drive.slam.mode is PROVISIONAL_DOUBTED:
        drive.step()
    assert len(drive.slam.atlas) == 1


def confirm_while_frames_are_held(drive: Drive) -> None:
    """No more frames can be held back: their poses are kept, and one of their places is known."""
    until_second_map(drive)
    drive.limit_held_frames(12)
    doubted = drive.slam._context.active_map
    drive.step(DOUBT)
    while doubted.doubted is None or not doubted.doubted.has_keyframes:
        drive.step(DOUBT)
    drive.recognizes = True
    while drive.slam.mode is PROVISIONAL_DOUBTED:
        drive.step(DOUBT)
    assert len(drive.slam.atlas) == 1


def discard_doubted_map(drive: Drive) -> None:
    doubt_in_provisional_map(drive)
    drive.step(NO_POSE)
    assert len(drive.slam.atlas) == 0


def discard_doubted_second_map(drive: Drive) -> None:
    until_second_map(drive)
    drive.step(DOUBT)
    drive.step(NO_POSE)
    assert [submap.number for submap in drive.slam.atlas] == [0]


def lose_grown_doubted_map(drive: Drive) -> None:
    grow(drive)
    drive.step(DOUBT)
    drive.step(NO_POSE)
    assert len(drive.slam.atlas) == 1


def doubt(drive: Drive) -> None:
    drive.until(TRACKING)
    drive.step(DOUBT)


def lose(drive: Drive) -> None:
    until_lost(drive)


def confirm(drive: Drive) -> None:
    doubt(drive)
    drive.step()
    assert drive.slam.mode is DOUBTED
    drive.step()


def lose_doubted(drive: Drive) -> None:
    doubt(drive)
    drive.step(NO_POSE)


def confirm_relocalized(drive: Drive) -> None:
    relocalize(drive)
    for _ in range(state_machine.NUM_RELOCALIZED_FRAMES):
        assert drive.slam.mode is RELOCALIZED
        drive.step()


def lose_relocalized(drive: Drive) -> None:
    relocalize(drive)
    drive.step(NO_POSE)


SCENARIOS: list[tuple[Mode, Mode, Callable[[Drive], None], Constants]] = [
    (INITIALIZING, PROVISIONAL, start, ()),
    (LOST, PROVISIONAL, start_another_map, SOON_ANEW),
    (LOST, RELOCALIZED, relocalize, ()),
    (PROVISIONAL, TRACKING, confirm_by_frames, ()),
    (PROVISIONAL, TRACKING, confirm_by_known_map, SOON_ANEW),
    (PROVISIONAL, PROVISIONAL_DOUBTED, doubt_in_provisional_map, ()),
    (PROVISIONAL, DOUBTED, doubt_where_a_known_map_agrees, SOON_ANEW),
    (PROVISIONAL, INITIALIZING, discard_first_map, ()),
    (PROVISIONAL, LOST, discard_second_map, SOON_ANEW),
    (PROVISIONAL, LOST, lose_grown_map, SOON_KEPT),
    (PROVISIONAL_DOUBTED, PROVISIONAL, confirm_in_provisional_map, ()),
    (PROVISIONAL_DOUBTED, TRACKING, confirm_where_a_known_map_agrees, SOON_ANEW),
    (PROVISIONAL_DOUBTED, DOUBTED, confirm_while_frames_are_held, SOON_ANEW),
    (PROVISIONAL_DOUBTED, INITIALIZING, discard_doubted_map, ()),
    (PROVISIONAL_DOUBTED, LOST, discard_doubted_second_map, SOON_ANEW),
    (PROVISIONAL_DOUBTED, LOST, lose_grown_doubted_map, SOON_KEPT),
    (TRACKING, DOUBTED, doubt, ()),
    (TRACKING, LOST, lose, ()),
    (DOUBTED, TRACKING, confirm, ()),
    (DOUBTED, LOST, lose_doubted, ()),
    (RELOCALIZED, TRACKING, confirm_relocalized, ()),
    (RELOCALIZED, LOST, lose_relocalized, ()),
]


@pytest.mark.parametrize("transition", TRANSITIONS, ids=lambda pair: f"{pair[0].name}-{pair[1].name}")
def test_every_transition_happens(transition: tuple[Mode, Mode], monkeypatch: pytest.MonkeyPatch) -> None:
    scenarios = [(drives, constants) for *pair, drives, constants in SCENARIOS if tuple(pair) == transition]
    assert scenarios
    for drives, constants in scenarios:
        with monkeypatch.context() as patched:
            for constant in (*SOON_KEPT, *constants):
                patched.setattr(*constant)
            drive = Drive(patched, Walk(arc(120)))
            drives(drive)
            assert tuple(drive.modes[-2:]) == transition
            drive.check()
            assert drive.results[-1].state is transition[1].state


def test_every_mode_has_the_state_that_users_see() -> None:
    assert {mode: mode.state for mode in Mode} == {
        INITIALIZING: State.INITIALIZING,
        LOST: State.LOST,
        PROVISIONAL: State.TRACKING,
        PROVISIONAL_DOUBTED: State.UNCERTAIN,
        TRACKING: State.TRACKING,
        DOUBTED: State.UNCERTAIN,
        RELOCALIZED: State.UNCERTAIN,
    }


@pytest.mark.parametrize(("before", "after"), list(product(Mode, Mode)))
def test_another_transition_is_an_error(before: Mode, after: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Drive(monkeypatch, Walk(arc(2)))
    filtered = drive.slam.scene_filter.mask_out(drive.slam._extract(drive.frames[0]))
    modes: Iterator[Mode] = iter([before, after])
    monkeypatch.setattr(SystemContext, "mode", property(lambda _: next(modes)))
    monkeypatch.setattr(StateMachine, "_find", lambda *_: FrameOutcome([Reason.LOST]))
    machine = drive.slam._state_machine
    if before is after or (before, after) in TRANSITIONS:
        assert machine.step(filtered).reasons == [Reason.LOST]
    else:
        with pytest.raises(AssertionError, match=f"{before.name} -> {after.name}"):
            machine.step(filtered)


@pytest.mark.parametrize(
    ("seed", "frames"), [(0, 100), *(pytest.param(seed, 160, marks=pytest.mark.slow) for seed in range(1, 4))]
)
def test_no_other_transition_happens_and_no_frame_is_forgotten_whatever_the_judgments(
    seed: int, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are judged by chance, in runs; places are recognized by chance. The assertion is in the state machine."""
    for constant in (*SOON_KEPT, *SOON_ANEW):
        monkeypatch.setattr(*constant)
    drive, draw = Drive(monkeypatch, Walk(arc(240))), random.Random(seed)
    drive.limit_held_frames(6)
    judgments: list[Judgment] = [None, None, None, None, DOUBT, DOUBT, WRONG, NO_POSE]
    while len(drive.results) < frames:
        judgment, drive.recognizes = draw.choice(judgments), draw.random() < 0.5
        for _ in range(1 if judgment is NO_POSE else draw.randint(1, 12)):
            drive.step(judgment)
            drive.check()
    happened = {(before, after) for before, after in pairwise(drive.modes) if before is not after}
    assert len(happened) >= 6
    drive.slam.finalize()
    drive.check()
    assert len(drive.slam.loop_closer.keyframe_database) == sum(
        submap.map.num_keyframes for submap in drive.slam.atlas
    )


def test_a_map_that_is_confirmed_while_frames_are_held_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next frames are held until enough certain ones were seen; a loss takes back these only."""
    for last in (None, NO_POSE):
        with monkeypatch.context() as patched:
            drive = Drive(patched, Walk(arc(120)))
            doubt_in_provisional_map(drive)
            held = len(drive.results) - 1
            assert held not in drive.slam.posed_frames.frames["frame_index"].tolist()
            drive.slam.confirm_map()
            assert drive.slam.mode is DOUBTED
            assert held in drive.slam.posed_frames.frames["frame_index"].tolist()
            drive.check()
            drive.step()
            assert drive.slam.mode is DOUBTED
            assert drive.step(last) is (TRACKING if last is None else LOST)
            drive.check()
            posed = drive.slam.posed_frames.frames["frame_index"].tolist()
            assert held in posed
            assert (held + 1 in posed) is (last is None)
