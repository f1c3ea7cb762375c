"""Initialization, tracking, mapping and adjustment on a small exact scene."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from tests.scene import adjust_local
from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc, turn
from torchslam.config import Config, load_config
from torchslam.errors import ConfigError
from torchslam.geometry import KeypointNoise, SharedCamera, se3_exp, se3_inverse, transform
from torchslam.map.map import NO_POINT, Map
from torchslam.mapping.local_bundle import GLOBAL_ITERATIONS, adjust_all
from torchslam.mapping.mapper import Mapper, initial_scale, keyframe_reason
from torchslam.mapping.new_points import fuse, has_consistent_scale
from torchslam.system.front_end import Simulated
from torchslam.system.slam import SLAM
from torchslam.tracking import tracker as tracker_module
from torchslam.tracking.data_association import match_points
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.localizer import match_projected_points, project_points
from torchslam.tracking.matcher import DescriptorMatcher, FreeKeypoints, match_along_epipolar_lines
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


def test_points_project_where_they_are_seen(slam: SLAM) -> None:
    view = view_of(slam, 20)
    near = project_points(
        slam.map, slam.map.valid_points(), walk_from_start(slam, 20), slam.camera, (1.0, 1.0)
    )
    pairs = match_projected_points(slam.map, near, view, 1.0, DescriptorMatcher(CONFIG.matching))
    ids, keypoints = pairs.first, pairs.second
    assert len(ids) > 150
    assert len(torch.unique(keypoints)) == len(keypoints)
    pairs = match_points(slam.map, near.ids, view, CONFIG.matching)
    anywhere_ids, anywhere_keypoints = pairs.first, pairs.second
    both = dict(zip(anywhere_ids.tolist(), anywhere_keypoints.tolist(), strict=True))
    assert all(both.get(i, k) == k for i, k in zip(ids.tolist(), keypoints.tolist(), strict=True))


def test_tracking_finds_the_true_pose(slam: SLAM) -> None:
    estimate = slam.tracker.track(slam.submap, view_of(slam, 20))
    assert estimate is not None
    assert torch.allclose(estimate.T_cw, walk_from_start(slam, 20), atol=1e-5)


def test_tracking_works_by_brute_force(slam: SLAM, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker_module, "RECENT_FRAMES", 10)
    config = load_config(None, ["features.kind=simulated", "paper.brute_force=true"])
    tracker = Tracker(SharedCamera(slam.camera), config)
    tracker.reset_to_keyframe(slam.submap, slam.map.num_keyframes - 1)
    estimate = tracker.track(slam.submap, view_of(slam, 20))
    assert estimate is not None
    assert torch.allclose(estimate.T_cw, walk_from_start(slam, 20), atol=1e-5)


def test_a_frame_is_relocalized_anywhere_in_the_map(slam: SLAM) -> None:
    view = view_of(slam, 2)
    anywhere = match_points(slam.map, slam.map.valid_points(), view, CONFIG.matching)
    estimate = slam.tracker.localizer.locate(slam.map, view, iter([anywhere]), anywhere.first[:0])
    assert estimate is not None
    assert torch.allclose(estimate.T_cw, walk_from_start(slam, 2), atol=1e-5)
    slam.tracker.start_at_estimate(slam.submap, view, estimate)
    assert slam.submap.tracking.reference <= 2
    assert torch.allclose(slam.submap.T_cw, estimate.T_cw)


def test_bundle_adjustment_repairs_a_perturbed_map(slam: SLAM, generator: torch.Generator) -> None:
    count = slam.map.num_keyframes
    shake = 0.01 * torch.randn(count - 1, 6, generator=generator, dtype=torch.float64)
    slam.map.keyframes["T_cw"][1:] = se3_exp(shake) @ slam.map.T_cw[1:]
    adjust_all(slam.map, slam.camera)
    scale = (
        slam.map.T_cw[-1, :3, 3].norm()
        / walk_from_start(slam, int(slam.map.keyframes["frame_index"][-1]))[:3, 3].norm()
    )
    for k in range(1, count):
        truth = walk_from_start(slam, int(slam.map.keyframes["frame_index"][k]))
        assert torch.allclose(slam.map.T_cw[k, :3, :3], truth[:3, :3], atol=1e-4)
        assert torch.allclose(slam.map.T_cw[k, :3, 3], scale * truth[:3, 3], atol=1e-3)


def test_an_interrupted_adjustment_leaves_the_map_unchanged(slam: SLAM, generator: torch.Generator) -> None:
    shake = 0.01 * torch.randn(slam.map.num_keyframes - 1, 6, generator=generator, dtype=torch.float64)
    slam.map.keyframes["T_cw"][1:] = se3_exp(shake) @ slam.map.T_cw[1:]
    before = copy.deepcopy(slam.map)

    def interrupt(iteration: int, iterations: int) -> None:
        assert iterations == GLOBAL_ITERATIONS
        if iteration == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adjust_all(slam.map, slam.camera, interrupt)
    for table, old in ((slam.map.points, before.points), (slam.map.keyframes, before.keyframes)):
        for name, column in table.columns().items():
            assert torch.equal(column, old[name]), name


def test_bundle_adjustment_removes_an_outlier(slam: SLAM) -> None:
    keyframe = slam.map.num_keyframes - 1
    keypoint = int(torch.nonzero(slam.map.keyframes["point_ids"][keyframe] >= 0)[0])
    slam.map.keyframes["keypoints"][keyframe, keypoint] += 40.0
    adjust_local(slam.map, keyframe, slam.camera)
    assert slam.map.keyframes["point_ids"][keyframe, keypoint] == NO_POINT


def test_the_first_keyframe_is_fixed(slam: SLAM) -> None:
    before = slam.map.T_cw[0].clone()
    adjust_local(slam.map, 1, slam.camera)
    adjust_all(slam.map, slam.camera)
    assert torch.equal(slam.map.T_cw[0], before)


def test_a_duplicated_point_is_fused(slam: SLAM) -> None:
    keyframe = slam.map.num_keyframes - 1
    seen = torch.nonzero(slam.map.keyframes["point_ids"][keyframe] >= 0)[:5, 0]
    originals = slam.map.keyframes["point_ids"][keyframe, seen]
    doubles = slam.map.add_points(
        slam.map.positions_w[originals], slam.map.points["descriptors"][originals], keyframe
    )
    slam.map.add_observations(keyframe, seen, doubles)
    slam.map.update_appearance(torch.tensor([keyframe]))
    near = slam.map.covisible_keyframes(keyframe, 5, min_shared=5)
    fuse(slam.map, near, torch.tensor([keyframe]), slam.camera, CONFIG)
    assert torch.equal(slam.map.follow_merges(doubles), slam.map.follow_merges(originals))


def test_points_that_are_never_found_are_culled(slam: SLAM) -> None:
    newest = slam.map.num_keyframes - 1
    recent = torch.nonzero((slam.map.points["first_keyframe"] >= newest - 2) & slam.map.points["is_valid"])[
        :3, 0
    ]
    assert len(recent) > 0
    slam.map.points["times_visible"][recent] += 1000
    slam.mapper.cull_recent_points(slam.map, newest)
    assert not slam.map.points["is_valid"][recent].any()


def test_epipolar_matches_are_correct(slam: SLAM) -> None:
    one, two = (
        FreeKeypoints(
            view.features,
            torch.arange(len(view.mask))[None],
            slam.camera.normalize(view.keypoints)[None],
            KeypointNoise(view.scales[None], view.information[None]),
        )
        for view in (view_of(slam, i) for i in (4, 9))
    )
    T_21 = walk_from_start(slam, 9) @ se3_inverse(walk_from_start(slam, 4))
    _, first, second = match_along_epipolar_lines(one, two, T_21[None], slam.camera, 1.0, 64.0)
    assert len(first) > 50
    assert torch.equal(one.features.descriptors[0, first], two.features.descriptors[0, second])


def test_scale_consistency() -> None:
    points_w = torch.tensor([[0.0, 0.0, 4.0]] * 3, dtype=torch.float64)
    T_1w = torch.eye(4, dtype=torch.float64)
    T_2w = T_1w.clone()
    T_2w[2, 3] = -2.0  # two meters ahead: the point appears twice as large
    scales = torch.tensor([2.0, 1.0, 4.0], dtype=torch.float64)
    consistent = has_consistent_scale(
        points_w, T_1w, T_2w, torch.ones(3, dtype=torch.float64), scales, (scales[1:2], 2 * scales[2:])
    )
    assert consistent.tolist() == [True, False, False]


def start_of(indices: tuple[int, int], walk: Walk, config: Config) -> TwoViewMap | Rejection:
    extract = Simulated(config, walk.camera, true_T_cw(walk))
    initializer = Initializer(SharedCamera(walk.camera), config)
    for i in indices:
        result = initializer.step(FrameFeatures.of(walk[i], extract(walk[i]), walk.camera.params.double()))
    return result


def test_two_views_initialize_with_the_true_motion() -> None:
    start = start_of((0, 5), WALK, CONFIG)
    assert isinstance(start, TwoViewMap), start
    truth = true_T_cw(WALK)[5] @ se3_inverse(true_T_cw(WALK)[0])
    truth[:3, 3] /= truth[:3, 3].norm()
    assert torch.allclose(start.T_cw, truth, atol=1e-6)
    assert initial_scale(start, "groundtruth") == pytest.approx(
        float((true_T_cw(WALK)[5] @ se3_inverse(true_T_cw(WALK)[0]))[:3, 3].norm())
    )


def test_the_parallax_criterion_initializes_later() -> None:
    strict = load_config(None, [*OVERRIDES, "paper.parallax=true"])
    rejection = start_of((0, 1), WALK, strict)
    assert isinstance(rejection, Rejection)
    assert "parallax" in str(rejection)
    assert isinstance(start_of((0, 6), WALK, strict), TwoViewMap)


def test_pure_rotation_does_not_initialize() -> None:
    walk = Walk(turn(10))
    config = load_config(None, [*OVERRIDES, "simulated.noise_px=0.3"])
    assert isinstance(start_of((0, 5), walk, config), Rejection)


def test_scale_from_ground_truth_needs_ground_truth() -> None:
    start = start_of((0, 5), WALK, CONFIG)
    assert isinstance(start, TwoViewMap)
    view = FrameFeatures(**{**start.view.__dict__, "T_cw_groundtruth": None})
    with pytest.raises(ConfigError, match="ground truth"):
        initial_scale(
            TwoViewMap(
                start.reference, view, start.T_cw, start.points_w, start.keypoints_1, start.keypoints_2
            ),
            "groundtruth",
        )


def test_keyframes_are_chosen_by_translation_rotation_and_overlap(slam: SLAM) -> None:
    estimate = slam.tracker.track(slam.submap, view_of(slam, 20))
    assert estimate is not None
    reference = slam.map.T_cw[slam.submap.tracking.reference]
    view = FrameFeatures(**{**view_of(slam, 20).__dict__, "index": 100})

    def why(T_cr: list[float], overlap: float = 1.0) -> str:
        pose = se3_exp(torch.tensor(T_cr, dtype=torch.float64)) @ reference
        slam.submap.tracking.reference_size = int(estimate.inliers / overlap)
        moved = replace(estimate, T_cw=pose)
        return str(keyframe_reason(view, moved, slam.submap, Config().keyframes) or "")

    assert why([0.0] * 6) == ""
    assert why([2.0, 0, 0, 0, 0, 0]).startswith("moved")
    assert why([0, 0, 0, 0, 0.4, 0]).startswith("turned")
    assert why([0.0] * 6, overlap=0.3).startswith("sees 30%")


def test_a_mapper_starts_with_two_covisible_keyframes() -> None:
    start = start_of((0, 5), WALK, CONFIG)
    assert isinstance(start, TwoViewMap)
    slam = SLAM(WALK.camera, CONFIG)
    slam_map = Map()
    first, second = Mapper(SharedCamera(slam.camera), CONFIG, slam.clock).start(slam_map, start)
    seen = [slam_map.observed_points(torch.tensor([k])) for k in (first, second)]
    assert torch.equal(*seen)
    assert len(seen[0]) == len(start.points_w)
