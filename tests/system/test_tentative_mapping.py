"""Frames that are held back are mapped on trial: kept when they are confirmed, taken back when the camera is lost."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.system.judging import DOUBT, SIMULATED, judge
from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc
from torchslam import SLAM, Frame, State, evaluate, load_config
from torchslam.system import map_start, state_machine
from torchslam.system import savepoint as savepoints
from torchslam.system.front_end import Simulated
from torchslam.system.local_mapping import LocalMapping
from torchslam.system.modes import Mode
from torchslam.tracking.non_static import NO_MOVEMENT
from torchslam.types import Reason, Rejection

DOUBTFUL = range(14, 26)
LATE = 7  # the first frame that may begin a submap, where one starts late
SEEN = 38  # frames, until as many were certain as were doubtful


@pytest.fixture(autouse=True)
def soon_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new map is kept before frames are doubted."""
    monkeypatch.setattr(map_start, "PROVISIONAL_FRAMES", 12)


class Leaving(Walk):
    """From a frame on the camera is where nothing was ever seen."""

    def __init__(self, T_wc: Tensor, leaves: int) -> None:
        super().__init__(T_wc)
        self.leaves = leaves

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        away = torch.eye(4, dtype=torch.float64)
        away[2, 3] = -1e6
        return frame if index < self.leaves else replace(frame, T_cw_groundtruth=away)


def doubting(monkeypatch: pytest.MonkeyPatch, frames: Container[int], doubt: Rejection = DOUBT) -> SLAM:
    """A system that doubts the poses of some frames, and of no others, forward in time."""
    judge(monkeypatch, state_machine, lambda index: doubt if index in frames else None)
    return SLAM(Walk(arc(2)).camera, load_config(None, SIMULATED))


def states_of(slam: SLAM, walk: Walk, each: Callable[[int], None] = lambda _: None) -> list[State]:
    """The states of the system at the frames of a walk."""
    frames, states = Simulated(slam.config, slam.camera, true_T_cw(walk)).of(walk), []
    for index in range(len(walk)):
        states.append(slam.step(frames[index]).state)
        each(index)
    return states


def tables(slam: SLAM) -> dict[str, Tensor]:
    """The columns of a map, but for when points were looked for."""
    points, keyframes = slam.map.points.columns(), slam.map.keyframes.columns()
    return {name: column for name, column in (points | keyframes).items() if name != "last_seen_frame"}


def test_tentative_keyframes_are_committed_when_confirmed(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, walk = doubting(monkeypatch, DOUBTFUL), Walk(arc(60)[: SEEN + 4])
    keyframes: list[int] = []
    states = states_of(slam, walk, lambda _: keyframes.append(slam.map.num_keyframes))
    first, last = DOUBTFUL[0], DOUBTFUL[-1]
    assert keyframes[last] > keyframes[first - 1] + 1
    assert states[first : SEEN - 1] == [State.UNCERTAIN] * (SEEN - 1 - first)
    assert states[SEEN - 1 :] == [State.TRACKING] * 5  # as many certain frames as doubtful ones
    assert len(slam.loop_closer.keyframe_database) == slam.map.num_keyframes
    assert len(slam.trajectory()) == len(walk)
    assert walk.groundtruth is not None
    assert evaluate(slam.trajectory(), walk.groundtruth).ate_m < 1e-3


def test_tentative_keyframes_are_rolled_back_when_the_camera_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two systems that see the same, but that one of them does not map what is doubtful."""
    walk = Leaving(arc(60)[:22], 19)
    slam = doubting(monkeypatch, DOUBTFUL)
    grown: list[int] = []
    states = states_of(slam, walk, lambda _: grown.append(slam.map.num_keyframes))
    assert states[-1] is State.LOST
    assert max(grown) > grown[DOUBTFUL[0] - 1]
    assert len(slam.loop_closer.keyframe_database) == slam.map.num_keyframes == grown[DOUBTFUL[0] - 1]

    cautious = doubting(monkeypatch, DOUBTFUL)
    monkeypatch.setattr(LocalMapping, "add_tentative_keyframe", lambda *_: None)
    assert states_of(cautious, walk) == states
    assert tables(slam).keys() == tables(cautious).keys()
    for name, column in tables(slam).items():
        assert torch.equal(column, tables(cautious)[name]), name
    assert torch.equal(slam.trajectory().T_wc, cautious.trajectory().T_wc)


@pytest.mark.parametrize(
    ("rejection", "is_mapped"),
    [(Reason.LOW_INLIER_RATIO, False), (Reason.UNCERTAIN_POSITION, False), (Reason.JUMP, True)],
)
def test_a_pose_that_disagrees_with_its_matches_is_not_mapped(
    rejection: Reason, is_mapped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that disagrees with the motion model alone is: where views are far apart, the model is wrong."""
    values = {"ratio": 0.1, "matches": 9, "std": 0.1, "translation": 0.1, "degrees": 30.0}
    slam = doubting(monkeypatch, DOUBTFUL, Rejection(rejection, values))
    grown: list[int] = []
    states = states_of(slam, Walk(arc(60)[: DOUBTFUL.stop]), lambda _: grown.append(slam.map.num_keyframes))
    assert State.UNCERTAIN in states
    assert (len(set(grown[DOUBTFUL[0] - 1 : DOUBTFUL[-1] + 1])) > 1) is is_mapped


@pytest.mark.parametrize(
    ("rejection", "is_mapped"), [(Reason.MOVING_REMAINDER, True), (Reason.MOVING_MAJORITY, False)]
)
def test_a_frame_with_independent_motion_is_mapped_tentatively(
    rejection: Reason, is_mapped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without new points a moving camera would be lost before it is clear what moves; most of the image may not."""
    slam = doubting(monkeypatch, ())
    moving = replace(NO_MOVEMENT, rejection=Rejection(rejection, {"count": 30}))
    monkeypatch.setattr(
        slam.scene_filter,
        "detect_independent_motion",
        lambda *_: moving if slam.last_frame and slam.last_frame[0] in DOUBTFUL else NO_MOVEMENT,
    )
    grown: list[int] = []
    states = states_of(slam, Walk(arc(60)[: DOUBTFUL.stop]), lambda _: grown.append(slam.map.num_keyframes))
    assert State.UNCERTAIN in states
    assert (len(set(grown[DOUBTFUL[0] - 1 : DOUBTFUL[-1] + 1])) > 1) is is_mapped


def test_tentative_frames_at_the_end_keep_their_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk(arc(60)[:28])
    slam = doubting(monkeypatch, range(14, 60))
    states = states_of(slam, walk)
    before = slam.map.num_keyframes
    slam.finalize()
    assert states[-1] is State.UNCERTAIN
    assert len(slam.trajectory()) == len(walk)
    assert slam.map.num_keyframes == before
    assert walk.groundtruth is not None
    assert evaluate(slam.trajectory(), walk.groundtruth).ate_m < 1e-3


def starting_late(monkeypatch: pytest.MonkeyPatch, slam: SLAM) -> None:
    """No submap may begin before frame `LATE`: what comes before waits for the way back."""
    map_start = slam._state_machine.map_start
    step = map_start.step
    monkeypatch.setattr(map_start, "step", lambda view: DOUBT if view.index < LATE else step(view))


@pytest.mark.parametrize("end", [SLAM.finalize, SLAM.confirm_map])
def test_a_provisional_map_that_ends_uncertain_is_tracked_backward(
    end: Callable[[SLAM], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was mapped on trial is kept before the way back adds to the map."""
    walk = Walk(arc(60)[:28])
    slam = doubting(monkeypatch, range(14, 60))
    starting_late(monkeypatch, slam)
    states_of(slam, walk)
    assert slam.mode is Mode.PROVISIONAL_DOUBTED
    assert slam.map.num_keyframes > len(slam.loop_closer.keyframe_database)
    end(slam)
    assert len(slam.trajectory()) == len(walk)
    assert len(slam.loop_closer.keyframe_database) == slam.map.num_keyframes
    assert int(slam.map.keyframes["frame_index"].min()) < LATE


def test_the_number_of_tentative_frames_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest keep their poses for good, even if the camera is lost then; later ones wait again."""
    monkeypatch.setattr(savepoints, "MAX_HELD_FRAMES", 5)
    walk = Leaving(arc(60)[:32], 26)
    slam = doubting(monkeypatch, range(14, 60))
    states = states_of(slam, walk)
    assert states[14:26] == [State.UNCERTAIN] * 12
    assert states[26:] == [State.LOST] * 6
    assert slam.posed_frames.frames["frame_index"].tolist() == list(range(24))
    assert int(slam.map.keyframes["frame_index"].max()) < 24
    assert len(slam.loop_closer.keyframe_database) == slam.map.num_keyframes


def test_a_loop_precheck_applies_to_its_own_keyframe_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """A keyframe whose adjustment is taken over without a look back, as before the first keyframe on trial."""
    slam, walk = SLAM(Walk(arc(2)).camera, load_config(None, SIMULATED)), Walk(arc(60)[:32])
    frames = Simulated(slam.config, slam.camera, true_T_cw(walk)).of(walk)
    for index in range(len(walk)):
        slam.step(frames[index])
        newest = slam.map.num_keyframes - 1
        if slam.mapper.adjustment.is_pending and slam.loop_closer.loop_precheck == (
            slam.map.key(newest),
            False,
        ):
            break
    else:
        pytest.fail("no keyframe was checked for loops")
    queried: list[int] = []
    loop_detector, submap = slam.loop_closer.loop_detector, slam.submap
    assert submap is not None
    monkeypatch.setattr(loop_detector, "detect", lambda _, keyframe: queried.append(keyframe))
    slam._state_machine.maintenance.close_loops()
    assert not queried  # the answer is known already
    slam.loop_closer.loop_precheck = -1, False
    slam._state_machine.maintenance.close_loops()
    assert queried == [newest]
