"""Which mapping of a recording is kept: decisions by what was lost and by what the check says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.global_mapping.synthetic import CAMERA
from torchslam import SLAM, open_sequence
from torchslam.config import Config, load_config
from torchslam.geometry import SensorModel
from torchslam.global_mapping import recording
from torchslam.global_mapping.check import Break, BreakKind, MapCheck
from torchslam.global_mapping.recording import MappedRun, Mapping, check_run, map_recording, with_doubts
from torchslam.system.run import Run
from torchslam.types import Explanation, Reason, State, StepResult, Trajectory


@dataclass(frozen=True)
class FakeRun(Run):
    """A run with a number of posed frames."""

    posed: int = 0

    @property
    def trajectory(self) -> Trajectory:
        """So many poses."""
        return Trajectory(
            torch.arange(self.posed, dtype=torch.float64), torch.eye(4).double().repeat(self.posed, 1, 1)
        )


def a_run(posed: int = 100, frames: int = 100, lost: int = 0, failure: str = "") -> FakeRun:
    states = [State.LOST] * lost + [State.TRACKING] * (frames - lost)
    results = [StepResult(row, 0.1 * row, state, None) for row, state in enumerate(states)]
    return FakeRun((), SensorModel(CAMERA), Config(), results, [], False, failure, posed=posed)


PAIRS = 40
"""Pairs that were held back."""


def a_check(
    score: float = 1.0, is_broken: bool = False, uncertain: tuple[int, ...] = (), predicted: int = PAIRS
) -> MapCheck:
    """A check with a score, of a map that predicts the first so many of the pairs that were held back."""
    breaks = (Break(3, 4, BreakKind.SCALE, 1.5),) * is_broken
    return MapCheck(
        images=100,
        pairs=10,
        agreeing=10,
        triplets=0,
        consistent=0,
        used_agreeing=score,
        distance_px=0.5,
        evidence=10.0 * (torch.arange(PAIRS) < predicted).double(),
        breaks=breaks,
        certain=tuple(range(100)),
        uncertain=uncertain,
    )


class World:
    """What the mapper and the checks answer, and whether they were asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.whole = a_run()
        self.checks: dict[bool, MapCheck] = {
            True: a_check(),
            False: a_check(),
        }  # by whether it is the whole map
        self.online_check: MapCheck | None = a_check()
        self.doubtful: frozenset[int] = frozenset()
        self.mapped: list[Any] = []
        self.given: Any = "not asked"
        self.checked_online = 0
        self.certain: frozenset[int] | None = None
        self.stages: list[str] = []
        world = self

        class FakeMapper:
            def __init__(
                self, sequence: Any, camera: Any, config: Config, given: Any, *more: Any, **rest: Any
            ):
                world.given = given
                self.config = config

            def run(self, results: Any, before: Run, certain: frozenset[int]) -> SimpleNamespace:
                assert before.results is results  # keypoints are corrected by the run they come from
                world.certain = certain
                world.mapped.append(results)
                return SimpleNamespace(
                    run=world.whole,
                    views=[],
                    pairs=["pair"],
                    held_back=frozenset({0}),
                    held_back_times=torch.arange(PAIRS, dtype=torch.float64),
                    doubtful=world.doubtful,
                )

        def check_online(run: Run) -> MapCheck | None:
            world.checked_online += 1
            return world.online_check

        monkeypatch.setattr(recording, "GlobalMapper", FakeMapper)
        monkeypatch.setattr(recording, "check_run", check_online)
        monkeypatch.setattr(recording, "poses_of", lambda run, views: (run, "known"))
        monkeypatch.setattr(recording, "check_map", lambda run, *more: world.checks[run is world.whole])
        monkeypatch.setattr(recording, "scale_links", lambda graph, session: None)
        monkeypatch.setattr(FakeRun, "graph", None)
        monkeypatch.setattr(FakeRun, "at_middle_row", lambda run, views: views)

    def map(
        self,
        online: Run,
        mapping: Mapping = Mapping.AUTO,
        *overrides: str,
        go_on: Callable[[], Run] | None = None,
    ) -> MappedRun:
        """Map a recording with this online run."""
        return map_recording(
            None,  # type: ignore[arg-type]
            online,
            load_config(None, list(overrides)),
            CAMERA,
            mapping,
            progress=lambda stage, done, most: self.stages.append(stage),
            go_on=go_on,
        )


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def test_a_complete_run_that_the_check_calls_right_is_kept(world: World) -> None:
    online = a_run()
    kept = world.map(online)
    assert kept.results is online.results
    assert (kept.check, kept.kept, kept.why) == (world.online_check, Mapping.ONLINE, "")
    assert world.mapped == []
    assert world.stages == ["check"]
    world.online_check = None  # nothing to check by
    assert world.map(online).kept is Mapping.ONLINE
    assert world.mapped == []


@pytest.mark.parametrize(
    ("online", "why"),
    [
        (a_run(posed=98), ""),
        (a_run(posed=97), "97 of 100 frames are posed in one map"),
        (a_run(lost=1), "tracking was lost in 1 frames"),
        (a_run(posed=0, failure="no map was initialized"), "no map was initialized"),
    ],
)
def test_a_recording_with_lost_frames_is_mapped_as_a_whole(world: World, online: FakeRun, why: str) -> None:
    """Two of a hundred may have no pose; with the frames that were lost in mind."""
    kept = world.map(online)
    assert kept.why == why
    assert world.mapped == ([online.results] if why else [])
    assert (kept.kept is Mapping.GLOBAL) == bool(why)
    assert (kept.results is world.whole.results) == bool(why)
    assert world.checked_online == (not why)


def test_a_camera_that_stands_still_is_not_mapped(world: World) -> None:
    """But for one that asks for it, or where one frame shows something else."""
    first, still = Explanation(Reason.NEW_REFERENCE), Explanation.of(Reason.STATIONARY, pixels=0.5)
    reasons = [first, *[still] * 9]
    online = a_run(posed=0, failure="the camera stands still")
    online.results[:] = [
        StepResult(index, index / 30, State.INITIALIZING, None, reasons=(why,))
        for index, why in enumerate(reasons)
    ]
    kept = world.map(online)
    assert (kept.kept, kept.why, kept.check, world.mapped) == (Mapping.ONLINE, "", None, [])
    assert kept.results is online.results
    world.map(online, Mapping.GLOBAL)
    assert len(world.mapped) == 1
    for moving in (Explanation(Reason.PURE_ROTATION), first):
        online.results[4] = replace(online.results[4], reasons=(moving,))
        world.map(online)
    assert len(world.mapped) == 3


def test_a_run_that_the_check_contradicts_is_mapped_as_a_whole(world: World) -> None:
    world.online_check = a_check(is_broken=True)
    world.checks[False] = a_check(0.9, predicted=0)
    kept = world.map(a_run())
    assert kept.kept is Mapping.GLOBAL
    assert kept.check == world.checks[True]
    assert kept.why == f"the check of the online map failed: {world.online_check.sentence()}"


def test_a_user_may_choose(world: World) -> None:
    """Online whatever was lost, but checked; or as a whole as well, although nothing was."""
    kept = world.map(a_run(posed=10), Mapping.ONLINE)
    assert (kept.kept, kept.why, world.mapped) == (Mapping.ONLINE, "", [])
    assert kept.check is world.online_check
    kept = world.map(a_run(), Mapping.GLOBAL)
    assert (kept.kept, kept.why, len(world.mapped)) == (Mapping.GLOBAL, "it was asked for", 1)


@pytest.mark.parametrize(
    ("whole", "before", "posed", "kept"),
    [
        (PAIRS, 0, 200, Mapping.GLOBAL),  # every pair is predicted better, in all stretches
        (0, PAIRS, 10, Mapping.ONLINE),
        (
            PAIRS // 10,
            0,
            91,
            Mapping.ONLINE,
        ),  # those of a tenth of the recording are: the one with more poses
        (PAIRS // 10, 0, 90, Mapping.GLOBAL),
        (0, PAIRS // 10, 89, Mapping.GLOBAL),
        (0, PAIRS // 10, 91, Mapping.ONLINE),
        (PAIRS, PAIRS, 90, Mapping.GLOBAL),
        (PAIRS, PAIRS, 89, Mapping.GLOBAL),
        (PAIRS, PAIRS, 91, Mapping.ONLINE),
    ],
)
def test_the_map_that_predicts_the_held_out_pairs_better_is_kept(
    world: World, whole: int, before: int, posed: int, kept: Mapping
) -> None:
    """Of the pairs that the whole map did not use; where stretches of them disagree, the map with more poses."""
    world.whole = a_run(posed=90)
    world.checks = {True: a_check(predicted=whole), False: a_check(predicted=before)}
    online = a_run(posed=posed, frames=300)
    made = world.map(online, Mapping.GLOBAL)
    assert made.kept is kept
    assert made.results is (world.whole if kept is Mapping.GLOBAL else online).results
    assert made.by_frame is (online if kept is Mapping.GLOBAL else None)
    assert made.check == world.checks[kept is Mapping.GLOBAL]


@pytest.mark.parametrize(("posed", "kept"), [(98, Mapping.GLOBAL), (97, Mapping.ONLINE)])
def test_a_right_map_with_a_few_frames_less_is_kept(world: World, posed: int, kept: Mapping) -> None:
    """Where neither predicts surely better, and the check contradicts the online map."""
    world.whole = a_run(posed=posed)
    world.checks = {True: a_check(predicted=100), False: a_check(0.7, predicted=100)}
    assert world.map(a_run(), Mapping.GLOBAL).kept is kept


def test_without_any_map_the_whole_one_must_be_right(world: World) -> None:
    failed = a_run(posed=0, failure="the camera only turns")
    world.checks = {True: a_check(0.7), False: a_check(0.0)}
    made = world.map(failed)
    assert made.results is failed.results
    assert (made.check, made.kept) == (None, Mapping.ONLINE)
    assert made.why == "the camera only turns"
    world.checks[True] = a_check(0.9)
    assert world.map(failed).kept is Mapping.GLOBAL


def test_a_recording_without_a_whole_map_keeps_the_online_run(world: World) -> None:
    """Checked once, before or after."""
    world.whole = a_run(posed=0, failure="no map: 2 images are too few")
    online = a_run(posed=50)
    kept = world.map(online)
    assert kept.results is online.results
    assert (kept.kept, kept.check) == (Mapping.ONLINE, world.online_check)
    assert kept.why == "50 of 100 frames are posed in one map"
    assert world.checked_online == 1
    world.map(a_run(), Mapping.GLOBAL)
    assert world.checked_online == 2


def test_a_run_that_was_lost_goes_on_only_where_the_whole_map_is_not_right(world: World) -> None:
    """Not right: the check contradicts it, frames have no pose, or there is no map; then both are compared."""
    begun = a_run(posed=9, frames=10)
    begun.results[-1] = replace(begun.results[-1], state=State.LOST)
    ended = a_run(posed=60)
    asked: list[Run] = []

    def go_on() -> Run:
        asked.append(ended)
        return ended

    kept = world.map(begun, go_on=go_on)
    assert kept.results is world.whole.results
    assert (kept.check, kept.kept) == (world.checks[True], Mapping.GLOBAL)
    assert kept.why == "tracking was lost at frame 9"
    assert (asked, world.mapped, world.checked_online) == ([], [begun.results], 0)
    world.whole = a_run(posed=99)
    kept = world.map(begun, go_on=go_on)
    assert kept.results is world.whole.results
    assert kept.why == "60 of 100 frames are posed in one map"
    assert asked == [ended]
    world.whole = a_run()
    world.checks = {True: a_check(0.7, predicted=0), False: a_check(0.9)}
    kept = world.map(begun, go_on=go_on)
    assert kept.results is ended.results
    assert (kept.check, kept.kept) == (world.checks[False], Mapping.ONLINE)
    world.whole = a_run(posed=0, failure="no map: 2 images are too few")
    kept = world.map(begun, go_on=go_on)
    assert kept.results is ended.results
    assert kept.check == world.online_check
    assert len(asked) == 3


def test_frames_that_the_mapper_doubts_are_uncertain(world: World) -> None:
    world.doubtful, world.checks[False] = frozenset({7, 8}), a_check(0.5, predicted=0)
    made = world.map(a_run(lost=3))
    assert made.kept is Mapping.GLOBAL
    states = [result.state for result in made.results]
    assert [row for row, state in enumerate(states) if state is State.UNCERTAIN] == [7, 8]
    assert made.check is not None
    assert made.check.uncertain == (7, 8)


def test_doubted_frames_are_uncertain() -> None:
    """Up to the next checked one that is certain; lost ones stay lost, and nothing else changes."""
    online = a_run(frames=12, lost=1)
    check = replace(a_check(uncertain=(4, 6)), certain=(0, 2, 8, 10))
    doubted = with_doubts(online.results, check)
    assert [row for row, each in enumerate(doubted) if each.state is State.UNCERTAIN] == [4, 5, 6, 7]
    assert {each.reason for each in doubted if each.state is State.UNCERTAIN} == {Reason.WEAK_LINK.value}
    assert [each.reason for each in doubted if each.state is not State.UNCERTAIN] == [""] * 8
    first = with_doubts(online.results, replace(check, uncertain=(0,), certain=(3,)))
    assert [each.state for each in first[:4]] == [
        State.LOST,
        State.UNCERTAIN,
        State.UNCERTAIN,
        State.TRACKING,
    ]
    assert with_doubts(online.results, None) is online.results
    assert with_doubts(online.results, a_check()) is online.results


@pytest.mark.usefixtures("without_shape_checks")
def test_an_online_run_is_checked_by_pairs_of_its_keyframes() -> None:
    """Its features are matched anew, one, two and four keyframes apart; without images there are none."""
    sequence = open_sequence("synthetic:room").part(0, 30, 2)
    run = SLAM(sequence.camera).run(sequence)
    found = check_run(run)
    assert found is not None
    keyframes = run.map.num_keyframes
    assert found.images == keyframes >= 4
    assert found.pairs == sum(keyframes - distance for distance in (1, 2, 4) if distance < keyframes)
    assert found.agreeing == found.pairs
    assert found.used_agreeing == 1
    simulated = replace(run, config=load_config(None, ["features.kind=simulated"]))
    assert check_run(simulated) is None
    assert check_run(replace(run, submaps=())) is None


def test_windows_keep_poses_that_neither_the_run_nor_its_check_doubts(world: World) -> None:
    """Of a recording longer than a window, the check is asked though frames were lost."""
    lost, long = a_run(90, lost=10), "global_mapping.window_images=50"
    world.online_check = replace(a_check(is_broken=True, uncertain=(80,)), certain=tuple(range(80)))
    world.map(lost, Mapping.AUTO, long)
    assert world.checked_online == 1
    assert world.certain == frozenset(range(10, 80))
    world.online_check = None
    world.map(lost, Mapping.AUTO, long)
    assert world.certain == frozenset()


def test_a_short_recording_that_was_lost_is_not_checked_before_it_is_mapped(world: World) -> None:
    world.map(a_run(90, lost=10))
    assert (world.checked_online, world.certain) == (0, frozenset())
