"""A transform applies to positions, poses, covariances, directions, frames and tracking state."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor

from tests.map.simulated import reprojection_errors, simulated_submap
from torchslam.geometry import sim3_exp, sim3_inverse, sim3_scale, transform
from torchslam.map.atlas import Submap

SCALE = 1.7
SIMILARITY = torch.tensor([0.4, -0.3, 0.2, 0.5, -0.2, 0.3, math.log(SCALE)], dtype=torch.float64)


@pytest.fixture
def submap() -> Submap:
    return simulated_submap()


def similarity() -> Tensor:
    return sim3_exp(SIMILARITY)


def rotation() -> Tensor:
    return similarity()[:3, :3] / SCALE


def moved_poses(T_cw: Tensor, S_ba: Tensor) -> Tensor:
    """T_cw (F, 4, 4) of cameras that were in frame a, in frame b."""
    moved = T_cw @ sim3_inverse(S_ba)
    moved[:, :3] *= sim3_scale(S_ba)
    return moved


def test_a_transform_moves_points_and_cameras_by_the_similarity(submap: Submap) -> None:
    before = copy.deepcopy(submap)
    submap.transform(similarity())
    torch.testing.assert_close(submap.map.positions_w, transform(similarity(), before.map.positions_w))
    torch.testing.assert_close(submap.map.T_cw, moved_poses(before.map.T_cw, similarity()))
    torch.testing.assert_close(
        submap.posed_frames.T_cw(submap.map), moved_poses(before.posed_frames.T_cw(before.map), similarity())
    )
    torch.testing.assert_close(submap.T_cw, moved_poses(before.T_cw[None], similarity())[0])


def test_a_transform_scales_covariances(submap: Submap) -> None:
    """Covariances of points turn and grow; those of poses live in the cameras: their unit alone grows."""
    before = copy.deepcopy(submap)
    submap.transform(similarity())
    linear = similarity()[:3, :3]
    torch.testing.assert_close(
        submap.map.points["covariances_w"], linear @ before.map.points["covariances_w"] @ linear.T
    )
    units = torch.diag(torch.tensor([SCALE] * 3 + [1.0] * 3, dtype=torch.float64))
    torch.testing.assert_close(
        submap.map.keyframes["covariances"], units @ before.map.keyframes["covariances"] @ units
    )
    centers = before.map.center_covariances_w()
    torch.testing.assert_close(submap.map.center_covariances_w(), linear @ centers @ linear.T)


def test_transformed_directions_and_scale_distances_equal_refreshed_ones(submap: Submap) -> None:
    before = copy.deepcopy(submap)
    submap.transform(similarity())
    torch.testing.assert_close(
        submap.map.points["view_directions_w"], before.map.points["view_directions_w"] @ rotation().T
    )
    torch.testing.assert_close(
        submap.map.points["scale_distance"], SCALE * before.map.points["scale_distance"]
    )
    refreshed = copy.deepcopy(submap)
    refreshed.map.update_appearance(torch.arange(submap.map.num_keyframes))
    for name in ("view_directions_w", "scale_distance"):
        torch.testing.assert_close(submap.map.points[name], refreshed.map.points[name])


def test_a_transform_changes_no_reprojection(submap: Submap) -> None:
    before = reprojection_errors(submap)
    assert float(before.norm(dim=-1).max()) > 0.5
    submap.transform(similarity())
    torch.testing.assert_close(reprojection_errors(submap), before)


def test_tracking_continues_after_a_transform(submap: Submap) -> None:
    before = copy.deepcopy(submap)
    submap.transform(similarity())
    predicted = submap.tracking.motions @ submap.T_cw
    torch.testing.assert_close(predicted, moved_poses(before.tracking.motions @ before.T_cw, similarity()))


def corrections(submap: Submap) -> Tensor:
    """S_cw (K, 4, 4): every keyframe drifted by another similarity, in its own frame."""
    generator = torch.Generator().manual_seed(7)
    xi = 0.2 * torch.randn(submap.map.num_keyframes, 7, generator=generator, dtype=torch.float64)
    return sim3_exp(xi) @ submap.map.T_cw


def test_corrected_points_project_as_before_in_their_first_keyframe(submap: Submap) -> None:
    before, seen = reprojection_errors(submap), submap.map.observations()
    submap.apply_sim3_correction(corrections(submap))
    own = submap.map.points["first_keyframe"][seen.point_index] == seen.keyframe_index
    assert int(own.sum()) > 20
    torch.testing.assert_close(reprojection_errors(submap)[own], before[own])
    assert float((reprojection_errors(submap) - before)[~own].abs().max()) > 1.0


def test_corrected_frames_see_points_of_their_keyframe_as_before(submap: Submap) -> None:
    """A frame stays where it was among the points of its reference keyframe, in that keyframe's unit."""
    before = copy.deepcopy(submap)
    S_cw = corrections(submap)
    scale = sim3_scale(S_cw)
    submap.apply_sim3_correction(S_cw)
    reference = submap.posed_frames.frames["reference_keyframe"]
    T_cw, old = submap.posed_frames.T_cw(submap.map), before.posed_frames.T_cw(before.map)
    for frame in range(len(submap.posed_frames)):
        made = submap.map.points["first_keyframe"] == reference[frame]
        points_c = transform(T_cw[frame], submap.map.positions_w[made])
        expected = transform(old[frame], before.map.positions_w[made]) / scale[reference[frame]]
        torch.testing.assert_close(points_c, expected)
    around = scale[submap.tracking.reference]
    torch.testing.assert_close(submap.tracking.T_cr[:3, 3], before.tracking.T_cr[:3, 3] / around)
    moved, old = submap.tracking.motions[..., :3, 3], before.tracking.motions[..., :3, 3]
    torch.testing.assert_close(moved, old / around)


def test_corrected_covariances_keep_their_size_in_pixels(submap: Submap) -> None:
    """Seen from the keyframe that made it, a point is as uncertain in shares of its depth as it was."""
    before = copy.deepcopy(submap)
    S_cw = corrections(submap)
    submap.apply_sim3_correction(S_cw)
    first_keyframe = submap.map.points["first_keyframe"]
    scale = sim3_scale(S_cw)[first_keyframe][:, None, None]

    def in_camera(of: Submap) -> Tensor:
        R_cw = of.map.T_cw[first_keyframe][:, :3, :3]
        return R_cw @ of.map.points["covariances_w"] @ R_cw.mT

    torch.testing.assert_close(in_camera(submap) * scale**2, in_camera(before))
    normals = [
        (of.map.T_cw[first_keyframe][:, :3, :3] @ of.map.points["view_directions_w"][..., None])[..., 0]
        for of in (submap, before)
    ]
    torch.testing.assert_close(*normals)
    torch.testing.assert_close(
        submap.map.points["scale_distance"] * sim3_scale(S_cw)[first_keyframe],
        before.map.points["scale_distance"],
    )


def test_a_merged_submap_is_appended(submap: Submap) -> None:
    other = simulated_submap(seed=3, number=1, session=1)
    mine, theirs = copy.deepcopy(submap), copy.deepcopy(other)
    submap.merge(other, similarity())
    theirs.transform(similarity())
    keyframes, points = mine.map.num_keyframes, len(mine.map.points)
    torch.testing.assert_close(
        submap.map.positions_w, torch.cat([mine.map.positions_w, theirs.map.positions_w])
    )
    torch.testing.assert_close(submap.map.T_cw, torch.cat([mine.map.T_cw, theirs.map.T_cw]))
    torch.testing.assert_close(
        reprojection_errors(submap), torch.cat([reprojection_errors(mine), reprojection_errors(theirs)])
    )
    torch.testing.assert_close(
        submap.posed_frames.T_cw(submap.map),
        torch.cat([mine.posed_frames.T_cw(mine.map), theirs.posed_frames.T_cw(theirs.map)]),
    )
    assert torch.equal(
        submap.map.points["first_keyframe"][points:], theirs.map.points["first_keyframe"] + keyframes
    )
    torch.testing.assert_close(submap.T_cw, theirs.T_cw)
    assert submap.tracking.reference == theirs.tracking.reference + keyframes
    for name, moved_by in (
        ("last_inlier_points", points),
        ("local_points", points),
        ("local_keyframes", keyframes),
    ):
        assert torch.equal(getattr(submap.tracking, name), getattr(theirs.tracking, name) + moved_by)
    assert len(submap.trajectory(session=1)) == len(theirs.posed_frames)
    assert (other.map.num_keyframes, len(other.map.points), len(other.posed_frames)) == (0, 0, 0)


def test_merged_points_keep_their_replacements_in_a_merged_submap(submap: Submap) -> None:
    other = simulated_submap(seed=3)
    other.map.merge_points(torch.tensor([5]), torch.tensor([2]))
    count = len(submap.map.points)
    submap.merge(other, torch.eye(4, dtype=torch.float64))
    assert submap.map.follow_merges(torch.tensor([count + 5, 5])).tolist() == [count + 2, 5]
    graph_rows = submap.posed_frames.observations["frame_row"]
    assert int(graph_rows.max()) == len(submap.posed_frames) - 1
