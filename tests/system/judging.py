"""Simulated walks in which a test decides what the system thinks of a pose, and which places it recognizes."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from types import ModuleType

import pytest

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk
from torchslam import SLAM, load_config
from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.map.atlas import Submap
from torchslam.system import savepoint as savepoints
from torchslam.system import state_machine
from torchslam.system.frame_log import FrameStatus
from torchslam.system.front_end import Simulated
from torchslam.system.local_mapping import locate
from torchslam.system.maintenance import Maintenance
from torchslam.system.modes import Mode
from torchslam.tracking.pose_validation import Verdict
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate, Reason, Rejection, StepResult

SIMULATED = ["features.kind=simulated", "features.num_keypoints=250", "simulated.points_per_view=150"]
DOUBT = Rejection.of(Reason.LOW_COVERAGE_RATIO, ratio=0.1)
WRONG = Rejection.of(Reason.LOW_INLIER_RATIO, ratio=0.1, matches=9)


class NoPose(Enum):
    """The judgment of a frame that has no pose."""

    NO_POSE = "no pose"


NO_POSE = NoPose.NO_POSE
Judgment = Rejection | NoPose | None
"""Of a frame: it has no pose, a doubtful or wrong one, or None: a certain one."""


def judge(
    monkeypatch: pytest.MonkeyPatch, module: ModuleType, judgment_of: Callable[[int], Judgment]
) -> None:
    """Judge tracked frames by their index: forward in time in `state_machine`, backward in `local_mapping`."""

    def judged(
        tracker: Tracker, submap: Submap, view: FrameFeatures, is_sure: bool
    ) -> tuple[PoseEstimate, Verdict] | None:
        located, judgment = locate(tracker, submap, view, is_sure), judgment_of(view.index)
        return None if located is None or judgment is NO_POSE else (located[0], Verdict(judgment))

    monkeypatch.setattr(module, "locate", judged)


class Drive:
    """Steps of a system through the frames of a walk.

    Attributes:
        judgment: Of the next frame.
        recognizes: Whether a place may be recognized: by a relocalization, at a loop, or in another submap.
        doubts_when_merged: Whether the frame is doubted in which a known map agrees with a provisional one.
        modes: The mode before the first frame and after each.
        results: Of each frame.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, walk: Walk, *overrides: str) -> None:
        config = load_config(None, [*SIMULATED, *overrides])
        self.slam = SLAM(walk.camera, config)
        self.frames = Simulated(self.slam.config, self.slam.camera, true_T_cw(walk)).of(walk)
        self.monkeypatch = monkeypatch
        self.judgment: Judgment = None
        self.recognizes, self.doubts_when_merged = True, False
        self.modes, self.results = [self.slam.mode], list[StepResult]()
        judge(monkeypatch, state_machine, lambda _: self.judgment)
        machine, detect = self.slam._state_machine, self.slam.loop_closer.detect
        relocalize, close = machine.relocalizer.locate, Maintenance._close

        def close_and_doubt(maintenance: Maintenance, found: LoopCandidate) -> None:
            close(maintenance, found)
            if self.doubts_when_merged and not found.is_loop:
                self.judgment = DOUBT

        monkeypatch.setattr(Maintenance, "_close", close_and_doubt)
        monkeypatch.setattr(
            machine.relocalizer, "locate", lambda *given: relocalize(*given) if self.recognizes else None
        )
        monkeypatch.setattr(
            self.slam.loop_closer, "detect", lambda *given: detect(*given) if self.recognizes else None
        )

    def limit_held_frames(self, most: int) -> None:
        """Hold at most so many frames back, and keep the poses of half as many when the camera is lost."""
        self.monkeypatch.setattr(savepoints, "MAX_HELD_FRAMES", most)
        self.monkeypatch.setattr(savepoints, "MANY_HELD_FRAMES", most // 2)

    def step(self, judgment: Judgment = None) -> Mode:
        """Process the next frame; return the mode after it."""
        self.judgment = judgment
        self.results.append(self.slam.step(self.frames[len(self.results)]))
        self.modes.append(self.slam.mode)
        return self.modes[-1]

    def until(self, mode: Mode, judgment: Judgment = None) -> None:
        """Process frames until the mode is this one, as many as there are."""
        while self.step(judgment) is not mode:
            pass

    def check(self) -> None:
        """Every frame has a pose in one submap, or is in the log; the savepoints know theirs."""
        active, log = self.slam._context.active_map, self.slam._context.log
        count = len(self.results)
        posed = [
            index
            for submap in self.slam.atlas
            if len(submap.posed_frames)
            for index in submap.posed_frames.frames["frame_index"].tolist()
        ]
        assert len(set(posed)) == len(posed)
        waiting = {
            index for index in range(count) if log.status(index) in (FrameStatus.UNPOSED, FrameStatus.HELD)
        }
        assert not waiting & set(posed)
        assert waiting | set(posed) == set(range(count))
        for savepoint, status in (
            (active.doubted, FrameStatus.HELD),
            (active.provisional, FrameStatus.POSED),
        ):
            logged = [] if savepoint is None else sorted(savepoint.frames)
            assert logged == [index for index in range(count) if log.status(index) is status]
            assert savepoint is None or savepoint.submap is active.submap
