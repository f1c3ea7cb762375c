"""What a start and a keyframe leave in the map, and which new points are culled."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, camera_center, pose, rows_of, sideways, submap_of_scene
from torchslam.config import Config, load_config
from torchslam.errors import ConfigError
from torchslam.geometry import SharedCamera, transform, triangulation_covariance
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.mapping.mapper import RECENT_KEYFRAMES, Mapper, initial_scale
from torchslam.tracking.tracker import Tracker
from torchslam.types import TwoViewMap
from torchslam.utils.timing import Stopwatch

SCENE = Scene.of(300)
ROWS = rows_of(SCENE)
BASE = sideways(2, step=0.5)


def mapper(*overrides: str) -> Mapper:
    return Mapper(SharedCamera(CAMERA), load_config(None, overrides), Stopwatch())


def start(true: bool = True) -> tuple[TwoViewMap, Tensor]:
    """Two views half a unit apart, in units of their baseline, and (n,) which points they share."""
    one, two = SCENE.view(3, BASE[0]), SCENE.view(8, BASE[1])
    if true:
        one = replace(one, T_cw_groundtruth=pose(5.0, 0, 0, 0, 1.0))
        two = replace(two, T_cw_groundtruth=pose(-3.0) @ pose(5.0, 0, 0, 0, 1.0))
    both = torch.nonzero(one.mask[SCENE.at(3)] & two.mask[SCENE.at(8)])[:, 0]
    points_w, T_cw = 2 * SCENE.points_w[both], BASE[1].clone()
    T_cw[:3, 3] *= 2
    return TwoViewMap(one, two, T_cw, points_w, SCENE.at(3)[both], SCENE.at(8)[both]), both


def test_the_scale_of_a_new_map() -> None:
    begin, _ = start()
    assert initial_scale(begin, "unit") == pytest.approx(1 / float(begin.points_w[:, 2].median()))
    assert initial_scale(begin, "groundtruth") == pytest.approx(3.0)
    longer = replace(begin, T_cw=pose(-2.0) @ pose(0, 0, 0, 0, 0.3))
    assert initial_scale(longer, "groundtruth") == pytest.approx(1.5)
    for name in ("reference", "view"):
        unknown = replace(begin, **{name: replace(getattr(begin, name), T_cw_groundtruth=None)})
        with pytest.raises(ConfigError, match="ground truth"):
            initial_scale(unknown, "groundtruth")


@pytest.mark.parametrize("scale", ["unit", "groundtruth"])
def test_an_initialization_becomes_two_keyframes_with_points(scale: str) -> None:
    begin, both = start()
    slam_map, factor = Map(), initial_scale(begin, scale)
    assert mapper(f"scale={scale}").start(slam_map, begin) == (0, 1)
    assert slam_map.keyframes["frame_index"].tolist() == [3, 8]
    torch.testing.assert_close(slam_map.T_cw[0], pose())
    torch.testing.assert_close(slam_map.T_cw[1, :3, :3], BASE[1, :3, :3])
    torch.testing.assert_close(camera_center(slam_map.T_cw[1]), factor * torch.tensor([1.0, 0, 0]).double())
    points = slam_map.points
    torch.testing.assert_close(points["positions_w"], factor * begin.points_w)
    torch.testing.assert_close(
        points["covariances_w"],
        triangulation_covariance(
            slam_map.T_cw[0],
            slam_map.T_cw[1],
            points["positions_w"],
            begin.reference.scales[begin.keypoints_1],
            begin.view.scales[begin.keypoints_2],
            CAMERA,
            CAMERA,
        ),
    )
    assert points["from_initialization"].all()
    assert (points["first_keyframe"] == 1).all()
    assert (points["times_observed"] == 2).all()
    assert torch.equal(points["descriptors"], SCENE.descriptors[both])
    everyone = torch.arange(len(both))
    assert torch.equal(slam_map.keyframes["point_ids"][0, begin.keypoints_1], everyone)
    assert torch.equal(slam_map.keyframes["point_ids"][1, begin.keypoints_2], everyone)
    distance = (points["positions_w"] - camera_center(slam_map.T_cw[1])).norm(dim=-1)
    torch.testing.assert_close(points["scale_distance"], distance * begin.view.scales[begin.keypoints_2])
    assert torch.equal(begin.T_cw[:3, 3], 2 * BASE[1, :3, 3])  # the start itself is left alone


def submap_of_half_the_points(count: int = 2) -> Submap:
    return submap_of_scene(SCENE, sideways(count, step=0.4), seen=torch.arange(300) % 2 == 0)


def inserted(by: Mapper, submap: Submap, T_cw: Tensor) -> int:
    view = SCENE.view(50, T_cw)
    estimate = Tracker(SharedCamera(CAMERA), Config()).track(submap, view)
    assert estimate is not None
    return by.insert(submap.map, view, estimate)


def test_a_keyframe_adds_observations_and_new_points() -> None:
    submap = submap_of_half_the_points()
    before = len(submap.map.points)
    keyframe = inserted(mapper("paper.unrefined=true"), submap, sideways(1, start=0.8)[0])
    assert keyframe == 2
    assert submap.map.num_keyframes == 3
    new = torch.arange(before, len(submap.map.points))
    living = new[submap.map.points["is_valid"][new]]
    assert len(living) > 50
    table, order = submap.map.keyframes["point_ids"][2], SCENE.shows(50)
    at = torch.nonzero(table >= 0)[:, 0]
    torch.testing.assert_close(
        submap.map.positions_w[table[at]], SCENE.points_w[order[at]], atol=1e-6, rtol=0
    )
    old = at[table[at] < before]
    assert len(old) > 50
    assert torch.equal(table[old], ROWS[order[old]])
    assert (submap.map.points["scale_distance"][living] > 0).all()
    seen = transform(submap.map.T_cw[2], submap.map.positions_w[living])
    assert (seen[:, 2] > 0).all()


def test_new_points_come_from_the_configured_neighbors() -> None:
    made = []
    for override in ("paper.last_keyframe=true", "paper.last_keyframe=false"):
        submap = submap_of_half_the_points(3)
        before = len(submap.map.points)
        inserted(mapper("paper.unrefined=true", override), submap, sideways(1, start=1.2)[0])
        made.append(len(submap.map.points) - before)
    assert 0 < made[0] < made[1]


def test_fusion_culling_and_adjustment_can_be_disabled() -> None:
    doubles: dict[str, int] = {}
    for without in ("true", "false"):
        submap = submap_of_scene(SCENE, sideways(2, step=0.4))
        table = submap.map.keyframes["point_ids"]
        at = torch.nonzero(table[0] >= 0)[:10, 0]
        originals = table[0, at].clone()
        submap.map.remove_observations(torch.zeros_like(at), at)
        twins = submap.map.add_points(
            submap.map.positions_w[originals],
            submap.map.points["descriptors"][originals],
            0,
            from_initialization=True,
        )
        submap.map.add_observations(0, at, twins)
        submap.map.update_appearance(torch.arange(2))
        Tracker(SharedCamera(CAMERA), Config()).reset_to_keyframe(submap, 1)
        inserted(
            mapper("paper.unrefined=true", f"paper.last_keyframe={without}"),
            submap,
            sideways(1, start=0.2)[0],
        )
        doubles[without] = int(submap.map.points["is_valid"][twins].sum())
    assert doubles["true"] == 10
    assert doubles["false"] < 5


def test_a_local_bundle_adjustment_follows_a_keyframe() -> None:
    for unrefined in ("true", "false"):
        submap = submap_of_scene(SCENE, sideways(3, step=0.4), noise=0.5)
        before = submap.map.T_cw.clone()
        by = mapper(f"paper.unrefined={unrefined}")
        inserted(by, submap, sideways(1, start=1.0)[0])
        has_moved = bool((submap.map.T_cw[:3] != before).any())
        assert has_moved is (unrefined == "false")
        assert ("bundle" in by.clock.take()) is (unrefined == "false")


def is_kept(
    age: int, *, found: int = 10, visible: int = 10, observed: int = 3, from_initialization: bool = False
) -> bool:
    """Whether a point of that age, in keyframes, is kept when keyframe 8 is inserted."""
    submap = submap_of_scene(SCENE, sideways(9, step=0.01))
    slam_map = submap.map
    point = int(torch.nonzero(slam_map.points["times_observed"] == 9)[0])
    points = slam_map.points
    points["first_keyframe"][:] = 0
    points["times_found"][:] = points["times_visible"][:] = 10
    points["first_keyframe"][point] = 8 - age
    points["times_found"][point], points["times_visible"][point] = found, visible
    points["times_observed"][point] = observed
    points["from_initialization"][point] = from_initialization
    count = slam_map.num_points
    mapper().cull_recent_points(slam_map, 8)
    assert slam_map.num_points >= count - 1
    return bool(points["is_valid"][point])


def test_new_points_must_be_found_where_they_are_visible() -> None:
    assert is_kept(1, found=5, visible=20)
    assert not is_kept(1, found=4, visible=20)
    assert not is_kept(RECENT_KEYFRAMES, found=4, visible=20)
    assert is_kept(RECENT_KEYFRAMES + 1, found=4, visible=20)
    assert RECENT_KEYFRAMES == 3


def test_new_points_must_be_observed_by_a_third_keyframe_in_time() -> None:
    assert is_kept(1, observed=2)
    assert not is_kept(2, observed=2)
    assert is_kept(2, observed=3)
    assert not is_kept(3, observed=2)
    assert is_kept(4, observed=2)
    assert is_kept(2, observed=2, from_initialization=True)
