from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.io.export.conftest import reprojection_error
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, so3_exp
from torchslam.io.export.scene import ExportedScene, scene_of
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.types import PoseEstimate


def test_errors_are_those_of_the_points(scene: ExportedScene) -> None:
    assert float(scene.point_errors().mean()) == pytest.approx(reprojection_error(scene), abs=1e-9)
    assert 0.4 < float(scene.errors().mean()) < 0.9  # 0.63 expected of the noise


def test_rotating_the_map_changes_no_pixel(scene: ExportedScene) -> None:
    R = so3_exp(torch.tensor((0.3, 2.0, -0.7), dtype=torch.float64))
    turned = scene.turned(R)
    torch.testing.assert_close(turned.errors(), scene.errors())
    torch.testing.assert_close(turned.T_wc[:, :3, 3], scene.T_wc[:, :3, 3] @ R.mT)


def facing(slam_map: Map) -> None:
    """Put all points before all cameras: the small run has them anywhere."""
    slam_map.points["positions_w"][:, :2] *= 0.1
    slam_map.keyframes["T_cw"][:] = torch.eye(4, dtype=torch.float64)
    slam_map.keyframes["T_cw"][:, 2, 3] = 20.0


def test_keyframes_and_their_observations(submap: Submap, camera: Camera) -> None:
    facing(submap.map)
    submap.map.points["colors"][:] = torch.arange(len(submap.map.points))[:, None].to(torch.uint8)
    made = scene_of(submap, camera, 0, keyframes_alone=True)
    assert made.frame_ids.tolist() == submap.map.keyframes["frame_index"].tolist()
    assert made.image_names[1] == "000005.png"
    assert made.is_keyframe.all()
    seen = submap.map.observations()
    twice = torch.nonzero(submap.map.points["times_observed"] >= 2)[:, 0]
    assert torch.equal(made.colors[:, 0].long(), twice)
    assert torch.equal(made.points_w, submap.map.positions_w[twice])
    kept = torch.isin(seen.point_index, twice)
    assert torch.equal(made.pixels, seen.pixels[kept])
    assert torch.equal(made.frame_index, seen.keyframe_index[kept])
    assert torch.equal(twice[made.point_index], seen.point_index[kept])


def test_points_behind_a_camera_are_not_seen_by_it(submap: Submap, camera: Camera) -> None:
    facing(submap.map)
    before = scene_of(submap, camera, 0, keyframes_alone=True)
    point = int(torch.nonzero(submap.map.points["times_observed"] >= 2)[0, 0])
    submap.map.points["positions_w"][point, 2] = -30.0
    after = scene_of(submap, camera, 0, keyframes_alone=True)
    assert len(after.points_w) == len(before.points_w) - 1
    assert torch.isfinite(after.errors()).all()


def test_all_frames_come_in_order_of_time(submap: Submap, camera: Camera) -> None:
    facing(submap.map)
    made = scene_of(submap, camera, 0, keyframes_alone=False)
    assert bool((made.timestamps.diff() > 0).all())
    posed = {int(index) for index in submap.posed_frames.frames["frame_index"]}
    keyframes = set(submap.map.keyframes["frame_index"].tolist())
    assert set(made.frame_ids.tolist()) == posed | keyframes
    assert set(made.frame_ids[made.is_keyframe].tolist()) == keyframes
    torch.testing.assert_close(made.T_cw[made.is_keyframe], submap.map.T_cw)


def test_map_rows_may_be_in_any_order(submap: Submap, camera: Camera) -> None:
    """Keyframes that were found on the way back come later in the map."""
    facing(submap.map)
    before = scene_of(submap, camera, 0, keyframes_alone=True)
    submap.map.keyframes.keep(torch.tensor((2, 0, 1, 5, 3, 4)))
    submap.map.mark_renumbered()
    after = scene_of(submap, camera, 0, keyframes_alone=True)
    for name in ("frame_ids", "T_cw", "points_w", "frame_index", "point_index", "pixels"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name


def test_non_keyframes_bring_their_observations(submap: Submap, camera: Camera) -> None:
    facing(submap.map)
    point = torch.nonzero(submap.map.points["times_observed"] >= 2)[:1, 0]
    view = replace(submap.map.frame_features(0), index=29, timestamp=200.0)
    eye = torch.eye(4, dtype=torch.float64)
    estimate = PoseEstimate(eye, point, torch.tensor([7]), 1, torch.eye(6), 1.0)
    submap.posed_frames.add(view, estimate, eye, 0)
    made = scene_of(submap, camera, 0, keyframes_alone=False)
    assert torch.equal(made.pixels[-1], view.keypoints[7])
    assert torch.equal(made.points_w[made.point_index[-1]], submap.map.positions_w[point[0]])
    assert made.frame_index[-1] == len(made.T_cw) - 1


def test_other_sessions_are_excluded(submap: Submap, camera: Camera) -> None:
    facing(submap.map)
    submap.map.keyframes["session"][3:] = 1
    assert len(scene_of(submap, camera, 1, keyframes_alone=True).T_cw) == 3
    with pytest.raises(ResultsError, match="submap 0 holds no frames of this run"):
        scene_of(submap, camera, 2, keyframes_alone=True)
    with pytest.raises(ResultsError, match="submap 4 is empty"):
        scene_of(Submap.empty(4, submap.map.T_cw), camera, 0, keyframes_alone=True)
