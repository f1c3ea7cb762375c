"""Several submaps, and a second camera in one of them."""

from __future__ import annotations

import torch

from tests.map.simulated import simulated_submap
from tests.scene import CAMERA, Scene, pose, sideways, submap_of_scene
from torchslam.geometry import se3_inverse
from torchslam.map.atlas import Atlas, TrackingState
from torchslam.map.compaction import RowRemap, replacement_keyframe
from torchslam.map.map import Map


def test_submaps_are_numbered_in_order_and_numbers_are_not_reused() -> None:
    submaps = Atlas(CAMERA.params)
    assert submaps.main() is None
    created = [submaps.create() for _ in range(3)]
    assert [submap.number for submap in created] == [0, 1, 2]
    submaps.remove(created[2])
    submaps.remove(created[0])
    assert list(submaps) == [created[1]]
    assert len(submaps) == 1
    assert submaps.create().number == 3
    assert created[1].map.num_keyframes == 0
    assert created[1].tracking.T_cr.dtype == CAMERA.params.dtype


def test_the_main_submap_has_the_most_frames() -> None:
    held = [simulated_submap(frames=frames, number=number) for number, frames in enumerate((9, 12, 12))]
    submaps = Atlas(CAMERA.params)
    submaps._submaps = held
    assert submaps.main() is held[1]
    submaps.remove(held[1])
    assert submaps.main() is held[2]


def test_a_keyframe_is_found_by_its_key_in_any_submap() -> None:
    scene = Scene.of(30)
    held = [submap_of_scene(scene, sideways(3), first=first) for first in (0, 40)]
    submaps = Atlas(CAMERA.params)
    empty = submaps.create()
    submaps._submaps += held
    for submap in held:
        for row in range(3):
            assert submaps.find(submap.map.key(row)) == (submap, row)
    assert submaps.find(7) is None
    assert empty.map.row(0) == -1
    assert Map().row(0) == -1
    single = submap_of_scene(scene, sideways(1), first=5)
    assert single.map.row(5) == 0
    assert single.map.row(6) == -1


def test_a_second_camera_has_its_own_tracking_state() -> None:
    submap = simulated_submap()
    before = submap.T_cw.clone()
    aside = submap.fork()
    aside.tracking.reference = 0
    aside.tracking.T_cr = pose(1.0)
    assert aside.map is submap.map
    assert aside.posed_frames is submap.posed_frames
    torch.testing.assert_close(submap.T_cw, before)
    aside.tracking = TrackingState.empty(before)
    torch.testing.assert_close(submap.T_cw, before)


def test_poses_are_compared_within_a_world_only() -> None:
    """It ends where keyframes are corrected as a whole, and where another map joins."""
    one, other = (submap_of_scene(Scene.of(30), sideways(3)) for _ in range(2))
    other.number = 1
    assert one.world != other.world
    worlds = [one.world]
    one.apply_sim3_correction(one.map.T_cw.clone())
    worlds.append(one.world)
    one.transform(pose())
    worlds.append(one.world)
    one.merge(other, pose())
    worlds.append(one.world)
    assert len(set(worlds)) == 4


def test_the_nearest_of_the_most_covisible_keyframes_is_the_replacement() -> None:
    """Cameras in a row that look at one scene: those on either side are as near as the step says."""
    T_cw = sideways(6)
    T_cw[3, 0, 3], T_cw[3, 1, 3] = T_cw[2, 0, 3] - 0.05, 0.02  # nearer to 2 than 1 is
    slam_map = submap_of_scene(Scene.of(200), T_cw).map
    centers = se3_inverse(slam_map.T_cw)[:, :3, 3]
    for removed in ([2], [2, 3], [2, 3, 1], [0, 2]):
        gone = torch.zeros(6, dtype=torch.bool)
        gone[removed] = True
        distance = (centers - centers[2]).norm(dim=-1).masked_fill(gone, torch.inf)
        assert replacement_keyframe(slam_map, 2, gone) == int(distance.argmin())


def test_row_remaps_compose() -> None:
    one = RowRemap(torch.tensor([0, -1, 1]), torch.tensor([1, -1, 0, 2]), torch.tensor([0, 1, 1]))
    two = RowRemap(torch.tensor([-1, 0]), torch.tensor([2, -1, 0]), torch.tensor([0, 0]))
    both = one.then(two)
    assert both.keyframes.tolist() == [-1, -1, 0]
    assert both.points.tolist() == [-1, -1, 2, 0]
    assert both.replacement.tolist() == [0, 0, 0]
