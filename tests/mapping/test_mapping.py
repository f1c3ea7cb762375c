"""A map of a small exact scene, and what the other modes of the paper's system give there."""

from __future__ import annotations

import copy

import pytest
import torch

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc
from torchslam.config import Config, load_config
from torchslam.geometry import SharedCamera, se3_inverse, transform
from torchslam.system.front_end import Simulated
from torchslam.system.slam import SLAM
from torchslam.tracking import tracker as tracker_module
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, Rejection, TwoViewMap

OVERRIDES = [
    "features.kind=simulated",
    "features.num_keypoints=400",
    "simulated.points_per_view=250",
    "simulated.depth_near=0.6",
    "simulated.depth_far=2",
    "scale=groundtruth",
]
CONFIG = load_config(None, OVERRIDES)
WALK = Walk(arc(30))
EYES = Simulated(CONFIG, WALK.camera, true_T_cw(WALK))
SEEN = EYES.of(WALK)


@pytest.fixture(scope="module")
def slam_after_20() -> SLAM:
    slam = SLAM(WALK.camera, CONFIG)
    for i in range(20):
        slam.step(SEEN[i])
    return slam


@pytest.fixture
def slam(slam_after_20: SLAM) -> SLAM:
    """A system that has followed the walk for 20 frames, to be changed at will."""
    return copy.deepcopy(slam_after_20)


def view_of(slam: SLAM, index: int) -> FrameFeatures:
    return FrameFeatures.of(WALK[index], EYES(WALK[index]), WALK.camera.params.double())


def walk_from_start(slam: SLAM, index: int) -> torch.Tensor:
    """The true pose in the frame of the map, which starts at the reference frame of the start."""
    first = int(slam.map.keyframes["frame_index"][0])
    return true_T_cw(WALK)[index] @ se3_inverse(true_T_cw(WALK)[first])


def test_the_map_is_exact(slam: SLAM) -> None:
    for k in range(slam.map.num_keyframes):
        frame = int(slam.map.keyframes["frame_index"][k])
        assert torch.allclose(slam.map.T_cw[k], walk_from_start(slam, frame), atol=1e-6)


def test_every_observation_reprojects(slam: SLAM) -> None:
    seen = slam.map.observations()
    points_c = transform(slam.map.T_cw[seen.keyframe_index], slam.map.positions_w[seen.point_index][:, None])[
        :, 0
    ]
    pixels, valid = slam.camera.project(points_c)
    assert valid.all()
    assert float((pixels - seen.pixels).norm(dim=-1).max()) < 1e-3


def test_tracking_works_by_brute_force(slam: SLAM, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker_module, "RECENT_FRAMES", 10)
    config = load_config(None, ["features.kind=simulated", "paper.brute_force=true"])
    tracker = Tracker(SharedCamera(slam.camera), config)
    tracker.reset_to_keyframe(slam.submap, slam.map.num_keyframes - 1)
    estimate = tracker.track(slam.submap, view_of(slam, 20))
    assert estimate is not None
    assert torch.allclose(estimate.T_cw, walk_from_start(slam, 20), atol=1e-5)


def start_of(indices: tuple[int, int], walk: Walk, config: Config) -> TwoViewMap | Rejection:
    extract = Simulated(config, walk.camera, true_T_cw(walk))
    initializer = Initializer(SharedCamera(walk.camera), config)
    for i in indices:
        result = initializer.step(FrameFeatures.of(walk[i], extract(walk[i]), walk.camera.params.double()))
    return result


def test_the_parallax_criterion_initializes_later() -> None:
    strict = load_config(None, [*OVERRIDES, "paper.parallax=true"])
    rejection = start_of((0, 1), WALK, strict)
    assert isinstance(rejection, Rejection)
    assert "parallax" in str(rejection)
    assert isinstance(start_of((0, 6), WALK, strict), TwoViewMap)
