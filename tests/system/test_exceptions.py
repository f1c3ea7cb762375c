"""An exception in a matcher of one's own leaves the state of before the frame, which can be tried again."""

from __future__ import annotations

import pytest
import torch

from tests.walks import Walk, arc
from torchslam import SLAM, Frame, Matches, load_config
from torchslam.features import SimulatedFeatures
from torchslam.tracking.matcher import DescriptorMatcher
from torchslam.types import FrameFeatures, MatchPrior

CONFIG = load_config(None, ["features.num_keypoints=250"])
WALK = Walk(arc(36)[:14])
SCENE = SimulatedFeatures(
    torch.stack([WALK.pose(row) for row in range(len(WALK))]),
    WALK.camera,
    num_keypoints=250,
    points_per_view=150,
    noise_px=0.4,
)


class Failing:
    """Torchslam's own matcher, which fails at one of its calls."""

    def __init__(self, failing_call: int) -> None:
        self.own, self.failing_call, self.calls = DescriptorMatcher(CONFIG.matching), failing_call, 0

    def __call__(self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        self.calls += 1
        if self.calls == self.failing_call:
            raise RuntimeError("out of memory")
        return self.own(view_1, view_2, prior)


def frames() -> list[Frame]:
    image = torch.zeros(1, 1, 0, 0)
    times = WALK.timestamps.tolist()
    return [Frame(row, times[row], image, features=SCENE(WALK.pose(row), row)) for row in range(len(WALK))]


def run(failing_call: int, count: int = len(WALK)) -> tuple[SLAM, int, Failing]:
    """The system after some frames, the frame in which the matcher failed, -1 if none, and the matcher."""
    matcher, failed = Failing(failing_call), -1
    slam = SLAM(WALK.camera, CONFIG, matcher=matcher)
    for frame in frames()[:count]:
        before = slam.state, len(slam.atlas), slam.atlas.num_created
        try:
            slam.step(frame)
        except RuntimeError:
            failed = frame.index
            assert (slam.state, len(slam.atlas), slam.atlas.num_created) == before
            slam.step(frame)
    return slam, failed, matcher


def test_the_frame_that_starts_the_map_can_be_tried_again() -> None:
    start = int(run(0)[0].map.keyframes["frame_index"][1])
    expected, _, matcher = run(0, start + 2)
    failures = {}
    for call in range(1, matcher.calls + 1):
        slam, failed, _ = run(call, start + 2)
        failures[call] = failed
        if failed > start:
            break
        assert torch.equal(slam.trajectory().T_wc, expected.trajectory().T_wc)
        assert torch.equal(slam.map.points["positions_w"], expected.map.points["positions_w"])
    assert start in failures.values()  # also after the submap was made
    assert list(failures.values()).count(start) > 1


def test_a_tracked_frame_can_be_tried_again_unless_it_has_a_pose() -> None:
    expected, _, matcher = run(0)
    for call in range(9, matcher.calls + 1, matcher.calls // 3):
        matcher = Failing(call)
        slam = SLAM(WALK.camera, CONFIG, matcher=matcher)
        for frame in frames():
            try:
                slam.step(frame)
            except RuntimeError:
                if slam.last_frame is None or slam.last_frame[0] < frame.index:
                    slam.step(frame)
        assert len(slam.atlas) == 1
        assert len(slam.trajectory()) == len(expected.trajectory())
        torch.testing.assert_close(slam.trajectory().T_wc, expected.trajectory().T_wc, rtol=0, atol=0.02)


def test_a_frame_of_another_size_leaves_the_state() -> None:
    slam = SLAM(WALK.camera, CONFIG)
    first, *_ = frames()
    slam.step(first)
    last = slam.last_frame
    with pytest.raises(Exception, match="has 5 x 5 pixels"):
        slam.step(Frame(1, 1e9, torch.zeros(1, 1, 5, 5), features=first.features))
    assert slam.last_frame == last
