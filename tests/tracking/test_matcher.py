"""Matchers of one's own: the same bytes for torchslam's own one, images, weights, and errors that say what is wrong."""

from __future__ import annotations

import fnmatch
import traceback
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc
from torchslam import SLAM, Matches, Run, load_config
from torchslam.errors import ConfigError
from torchslam.system import map_start
from torchslam.system.front_end import Simulated
from torchslam.tracking.matcher import DescriptorMatcher, nearest_keypoints
from torchslam.types import FrameFeatures, Matcher, MatchPrior, State

CONFIG = load_config(
    None,
    [
        "features.kind=simulated",
        "features.num_keypoints=250",
        "simulated.points_per_view=150",
        "simulated.noise_px=0.4",
        "simulated.outlier_ratio=0.05",
        "camera.std=0",
        "camera.readout_std=0",
    ],
)
WALK = Walk(arc(36)[:16])


def run_with(matcher: Matcher | None) -> tuple[SLAM, Run]:
    slam = SLAM(WALK.camera, CONFIG, matcher=matcher)
    return slam, slam.run(WALK)


class Wrapped:
    """Wrap torchslam's own matcher as a plugin and record the kinds of its calls."""

    def __init__(self, wants_images: bool = False) -> None:
        self.own, self.wants_images = DescriptorMatcher(CONFIG.matching), wants_images
        self.kinds: set[str] = set()

    def __call__(self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        kind = "anywhere" if prior is None else "lines" if prior.radius_px is None else "near"
        self.kinds.add(kind)
        assert (view_2.image is not None) == self.wants_images
        if kind != "near":
            assert (view_1.image is not None) == self.wants_images
        return self.own(view_1, view_2, prior)


def test_the_default_matcher_as_a_plugin_gives_the_same_bytes() -> None:
    matcher = Wrapped()
    one, other = run_with(None)[1], run_with(matcher)[1]
    assert matcher.kinds == {"anywhere", "lines", "near"}
    assert len(one.trajectory) == len(WALK)
    assert torch.equal(one.trajectory.T_wc, other.trajectory.T_wc)
    for table in ("points", "keyframes"):
        columns = getattr(one.map, table).columns()
        assert all(torch.equal(rows, getattr(other.map, table)[name]) for name, rows in columns.items())


CONTRADICTION = "contradicting_initialization"  # of provisional maps
RELOCALIZATION = "tracker.*locate"


class Counting(Wrapped):
    """Count calls by the modules and functions on the call stack; mutation testing adds to the names of functions."""

    def __init__(self) -> None:
        super().__init__()
        self.calls_by: Counter[str] = Counter()

    def __call__(self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        stack = traceback.extract_stack()
        callers = {f"{Path(frame.filename).stem}.{frame.name}" for frame in stack}
        stages = (CONTRADICTION, "loop_detector", "initialization", "new_points", RELOCALIZATION, "tracker")
        self.calls_by[next(stage for stage in stages if fnmatch.filter(callers, f"*{stage}*"))] += 1
        return super().__call__(view_1, view_2, prior)


def test_a_matcher_is_called_in_all_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk, a look backwards that loses it, and the walk again."""
    poses = arc(36)
    behind = poses[18:20].clone()
    behind[:, :3, :3] *= torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)  # half a turn about y
    walk = Walk(torch.cat([poses[:18], behind, poses[12:22]]))
    monkeypatch.setattr(map_start, "PROVISIONAL_FRAMES", 8)
    matcher = Counting()
    run = SLAM(walk.camera, CONFIG, matcher=matcher).run(walk)
    states = [result.state for result in run.results]
    assert states[18:20] == [State.LOST, State.LOST]
    assert states[-1] is State.TRACKING
    assert len(run.submaps) == 1
    calls = matcher.calls_by
    stages = {CONTRADICTION, "initialization", "tracker", "new_points", RELOCALIZATION}
    assert set(calls) - {"loop_detector"} == stages  # whether a loop is looked for depends on the walk
    assert calls["tracker"] >= 20  # near the prediction, in every tracked frame
    assert calls["new_points"] >= run.map.num_keyframes - 2  # of every keyframe after the first map


def test_a_matcher_that_wants_images_gets_those_of_keyframes_too() -> None:
    slam = SLAM(WALK.camera, CONFIG, matcher=Wrapped(wants_images=True))
    frames = Simulated(slam.config, slam.camera, true_T_cw(WALK)).of(WALK)
    states = [slam.step(frames[index]).state for index in range(10)]
    assert states[-1] is State.TRACKING
    image = slam.map.frame_features(0).image
    assert image is not None
    assert image.shape == (1, 1, 240, 320)


class Doubting(Wrapped):
    """Believes in a match by half where it is in the left half of the image."""

    weighs = True

    def __call__(self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        found = super().__call__(view_1, view_2, prior)
        left = view_2.keypoints[found.indices_2[0], 0] < 160
        return replace(found, weights=torch.where(left, 0.5, 1.0)[None].double())


def test_weights_multiply_the_information_of_what_is_seen() -> None:
    _, run = run_with(Doubting())
    assert len(run.trajectory) == len(WALK)
    weights, pixels = run.graph.weights * run.sensor.noise_variance, run.graph.pixels
    right, left = weights[pixels[:, 0] >= 160], weights[pixels[:, 0] < 160]
    assert (
        float(right.isclose(right.new_tensor(4.0)).double().mean()) > 0.8
    )  # half a scale, which is 1, and all of the weight
    assert float(left.isclose(left.new_tensor(2.0)).double().mean()) > 0.8


def rows_of(count: int) -> Tensor:
    return torch.arange(count)[None]


def matches(**changes: object) -> Matches:
    count = 250
    some = rows_of(count) < 5
    found = Matches(rows_of(count) * some, rows_of(count) * some, torch.zeros(1, count), some)
    return replace(found, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (None, "must return torchslam.Matches, not NoneType"),
        ({"mask": torch.ones(1, 250)}, r"mask must be bool \(1, M\), not torch.float32 \(1, 250\)"),
        ({"indices_1": rows_of(250).int()}, "indices_1 must be int64"),
        ({"indices_2": rows_of(249)}, "indices_2 must be int64"),
        ({"indices_2": rows_of(250) + 1000}, r"indices_2 must lie in 0 ... 249"),
        ({"indices_2": 0 * rows_of(250)}, "matched twice"),
        ({"indices_1": 249 - rows_of(250)}, "indices_1 names rows that are no keypoints"),
        ({"weights": torch.zeros(1, 250)}, "weights must be positive floats"),
        ({"weights": torch.ones(1, 2)}, "weights must be positive floats"),
    ],
)
@pytest.mark.usefixtures("without_shape_checks")
def test_an_invalid_matcher_output_is_named(changes: dict[str, Tensor] | None, words: str) -> None:
    def odd(view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        return None if changes is None else matches(**changes)  # type: ignore[return-value]

    with pytest.raises(ConfigError, match=f"matcher odd: .*{words}"):
        run_with(odd)


def test_pixels_belong_to_the_nearest_keypoint_and_each_keypoint_to_one() -> None:
    keypoints = torch.tensor([[10.0, 10.0], [20.0, 10.0], [30.0, 10.0], [40.0, 10.0]]).double()
    mask = torch.tensor([True, True, True, False])
    view = FrameFeatures(0, 0.0, keypoints, torch.ones(4).double(), torch.zeros(4), torch.zeros(4, 0), mask)
    pixels = torch.tensor([[11.0, 10.0], [10.0, 10.2], [30.0, 12.0], [40.0, 10.0], [21.0, 10.0]])
    found = nearest_keypoints(pixels, torch.tensor([4, 5, 6, 7, 8]), view)
    assert found.mask.tolist() == [[False, True, False, False, True]]
    assert found.indices_1[found.mask].tolist() == [5, 8]
    assert found.indices_2[found.mask].tolist() == [0, 1]
