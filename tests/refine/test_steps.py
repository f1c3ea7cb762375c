"""The steps of refining, each where its answer is known: rotations, tracks, points, keyframes, the frame."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, sideways
from torchslam.config import Config
from torchslam.geometry import Camera, rigid, se3_exp, se3_inverse, so3_exp, so3_log, transform
from torchslam.refine.map_building import align_rotations, average_rotations, build_map
from torchslam.refine.pose_refinement import align_to_input, largest_connected_part
from torchslam.refine.tracks import (
    Pair,
    Tracks,
    candidates,
    choose_keyframes,
    find_pairs,
    join_matches,
    make_map,
    triangulate_tracks,
)

CONFIG = Config()


def randn(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def pair(first: int, second: int, *matches: tuple[int, int], R_21: Tensor | None = None) -> Pair:
    at_1, at_2 = (torch.tensor([match[side] for match in matches]) for side in (0, 1))
    return Pair(first, second, at_1, at_2, R_21)


def degrees(R: Tensor, other: Tensor) -> Tensor:
    return torch.rad2deg(so3_log(R @ other.mT).norm(dim=-1))


# --- rotations -----------------------------------------------------------------------------------------------


def edges(R_cw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Exact relative rotations of each view and the three after it."""
    first, second = torch.tensor(
        [(i, j) for i in range(len(R_cw)) for j in range(i + 1, min(i + 4, len(R_cw)))]
    ).T
    return first, second, R_cw[second] @ R_cw[first].mT


def test_exact_relative_rotations_are_recovered(generator: torch.Generator) -> None:
    """Up to the turn that is common to all, which is the mean of what the given ones say."""
    true = so3_exp(0.5 * randn(generator, 12, 3))
    given = so3_exp(0.05 * randn(generator, 12, 3)) @ true
    first, second, R_21 = edges(true)
    found = average_rotations(given, first, second, R_21)
    assert float(degrees(found[second] @ found[first].mT, R_21).max()) < 0.02
    assert float(degrees(found, true).max()) < float(degrees(given, true).mean())


def test_wrong_relative_rotations_are_outvoted(generator: torch.Generator) -> None:
    true = so3_exp(0.5 * randn(generator, 12, 3))
    first, second, R_21 = edges(true)
    wrong = R_21.clone()
    wrong[::6] = so3_exp(0.2 * randn(generator, len(R_21[::6]), 3)) @ R_21[::6]
    found = average_rotations(so3_exp(0.03 * randn(generator, 12, 3)) @ true, first, second, wrong)
    right = torch.ones(len(R_21), dtype=torch.bool)
    right[::6] = False
    assert float(degrees(found[second] @ found[first].mT, R_21)[right].max()) < 0.2


def test_consistent_rotations_are_unchanged(generator: torch.Generator) -> None:
    true = so3_exp(0.5 * randn(generator, 6, 3))
    torch.testing.assert_close(average_rotations(true, *edges(true)), true, atol=1e-10, rtol=0)
    nothing = torch.zeros(0, dtype=torch.int64)
    assert average_rotations(true, nothing, nothing, true[:0]) is true


def test_rotation_averaging_keeps_the_centers(generator: torch.Generator) -> None:
    T_cw = rigid(so3_exp(0.3 * randn(generator, 3, 3)), randn(generator, 3, 3))
    off = T_cw.clone()
    off[1] = se3_exp(torch.tensor([0, 0, 0, 0.05, 0, 0], dtype=torch.float64)) @ T_cw[1]
    pairs = [
        pair(i, j, (0, 0), R_21=(T_cw[j] @ se3_inverse(T_cw[i]))[:3, :3]) for i, j in ((0, 1), (1, 2), (0, 2))
    ]
    found = align_rotations(off, pairs)
    torch.testing.assert_close(se3_inverse(found)[:, :3, 3], se3_inverse(off)[:, :3, 3])
    assert align_rotations(off, [pair(0, 1, (0, 0))]) is off


# --- tracks --------------------------------------------------------------------------------------------------


def test_connected_matches_are_one_track() -> None:
    pairs = [pair(0, 1, (4, 2), (5, 6)), pair(1, 2, (2, 0)), pair(0, 3, (7, 7))]
    tracks = join_matches(pairs, keyframes=4, keypoints=8)
    rows = list(zip(tracks.track.tolist(), tracks.keyframe.tolist(), tracks.keypoint.tolist(), strict=True))
    assert rows == [(0, 0, 4), (0, 1, 2), (0, 2, 0), (1, 0, 5), (1, 1, 6), (2, 0, 7), (2, 3, 7)]
    assert tracks.count == 3


def test_two_keypoints_of_one_keyframe_invalidate_a_track() -> None:
    """Nobody knows which is right: both are left out, the rest stays if it is of two keyframes."""
    around = [pair(0, 1, (0, 0)), pair(1, 2, (0, 0)), pair(0, 2, (0, 1))]
    tracks = join_matches(around, keyframes=3, keypoints=4)
    assert (tracks.keyframe.tolist(), tracks.keypoint.tolist()) == ([0, 1], [0, 0])
    assert join_matches([pair(0, 1, (0, 0), (1, 0))], keyframes=2, keypoints=4).count == 0


def test_the_largest_connected_component() -> None:
    assert largest_connected_part([pair(0, 1, (0, 0)), pair(2, 4, (0, 0)), pair(3, 4, (0, 0))], 5) == [
        2,
        3,
        4,
    ]
    assert largest_connected_part([pair(0, 1, (0, 0)), pair(2, 3, (0, 0))], 4) == [0, 1]
    assert largest_connected_part([], 0) == []


def test_long_tracks_are_triangulated(generator: torch.Generator) -> None:
    """A point behind a camera, and one without parallax, are none."""
    T_cw = sideways(20)
    points_w = torch.tensor(
        [[0.5, 0.2, 4.0], [0.1, -0.2, 5.0], [0.0, 0.0, 9000.0], [0.0, 0.3, -4.0]], dtype=torch.float64
    )
    track = torch.arange(4).repeat_interleave(20)
    keyframe = torch.arange(20).repeat(4)
    seen = transform(T_cw[keyframe], points_w[track][:, None])[:, 0]
    pixels = CAMERA.params[2:4] + CAMERA.params[:2] * seen[:, :2] / seen[:, 2:]
    tracks = Tracks(track, keyframe, track)
    found, good = triangulate_tracks(tracks, pixels, T_cw, CAMERA, min_parallax_deg=1.0)
    assert good.tolist() == [True, True, False, False]
    torch.testing.assert_close(found[:2], points_w[:2], atol=1e-9, rtol=0)
    short, _ = triangulate_tracks(
        tracks.select(keyframe % 19 == 0), pixels[keyframe % 19 == 0], T_cw, CAMERA, 1.0
    )
    torch.testing.assert_close(short[:2], points_w[:2], atol=1e-9, rtol=0)


def test_a_map_has_the_observations_of_the_tracks() -> None:
    scene, T_cw = Scene.of(40), sideways(3)
    views = [scene.view(index, T) for index, T in enumerate(T_cw)]
    tracks = Tracks(
        torch.tensor([0, 0, 1, 1, 1]), torch.tensor([1, 2, 0, 1, 2]), torch.tensor([5, 6, 7, 8, 9])
    )
    points_w = torch.tensor([[0.0, 0, 4], [1, 0, 4]], dtype=torch.float64)
    made = make_map(views, T_cw, tracks, points_w)
    seen = made.observations()
    placed = made.positions_w[seen.point_index]
    assert placed[:, 0].tolist() == [1, 0, 1, 0, 1]  # keyframes 0, 1, 1, 2, 2
    assert seen.keypoint_index.tolist() == [7, 5, 8, 6, 9]
    assert made.points["first_keyframe"].tolist() == [0, 1]
    assert made.points["times_observed"].tolist() == [3, 2]


# --- keyframes and pairs -------------------------------------------------------------------------------------


def test_keyframes_are_chosen_by_image_motion() -> None:
    """0.08 of 320 px are 26: at 4 m a point moves by 50 px per meter."""
    scene = Scene.of()
    T_cw = sideways(16, step=0.1)
    views = [scene.view(index, T) for index, T in enumerate(T_cw)]
    chosen = choose_keyframes(views, CAMERA.width, CONFIG)
    assert chosen[:2] == [0, 6]
    assert 2 <= len(chosen) <= 4
    still = [scene.view(index, T_cw[0]) for index in range(5)]
    assert choose_keyframes(still, CAMERA.width, CONFIG) == [0]


def test_pairs_have_similar_view_directions() -> None:
    """Neighbors in time always; others only where the given poses do not look elsewhere."""
    scene, T_cw = Scene.of(), sideways(8, step=0.1)
    views = [scene.view(index, T) for index, T in enumerate(T_cw)]
    assert (0, 7) in candidates(views, T_cw)
    about = T_cw.clone()
    about[7] = se3_exp(torch.tensor([0, 0, 0, 0, math.radians(70), 0], dtype=torch.float64)) @ T_cw[7]
    pairs = candidates(views, about)
    assert (0, 7) not in pairs
    assert (6, 7) in pairs
    assert all(first < second for first, second in pairs)


def test_matches_are_verified_geometrically(generator: torch.Generator) -> None:
    """Wrong ones go; a pair whose rotation is not that of the given poses by far goes as a whole."""
    scene, T_cw = Scene.of(), sideways(3, step=0.3)
    views = [scene.view(index, T) for index, T in enumerate(T_cw)]
    moved = views[1].keypoints.clone()
    moved[::5] += 60 * randn(generator, len(moved[::5]), 2)
    views[1] = replace(views[1], keypoints=moved)
    pairs = find_pairs(views, T_cw, CAMERA, CONFIG)
    assert [(p.first, p.second) for p in pairs] == [(0, 1), (0, 2), (1, 2)]
    for found in pairs:
        shown_1 = scene.shows(found.first)[found.keypoints_1]
        assert torch.equal(shown_1, scene.shows(found.second)[found.keypoints_2])
        assert found.R_21 is not None
        off = float(degrees(found.R_21, torch.eye(3, dtype=torch.float64)))
        assert off < (
            1e-3 if (found.first, found.second) == (0, 2) else 5.0
        )  # the moved ones are in the others
    wrong = T_cw.clone()
    wrong[2] = se3_exp(torch.tensor([0, 0, 0, 0, 0, math.radians(16)], dtype=torch.float64)) @ T_cw[2]
    assert [(p.first, p.second) for p in find_pairs(views, wrong, CAMERA, CONFIG)] == [(0, 1)]


def test_reduced_images_have_the_same_pairs() -> None:
    """What is noise at 640x480 is noise in four times as large an image, which is looked at reduced to that."""
    scene, T_cw = Scene.of(), sideways(3, step=0.4)
    small = [scene.view(index, T, noise=0.5) for index, T in enumerate(T_cw)]
    found = []
    for factor in (2, 8):
        size = factor * CAMERA.width, factor * CAMERA.height
        focal, center = factor * CAMERA.params[:2], factor * (CAMERA.params[2:] + 0.5) - 0.5
        camera = Camera.pinhole(*focal.tolist(), *center.tolist(), size=size)
        views = [replace(view, keypoints=factor * (view.keypoints + 0.5) - 0.5) for view in small]
        found.append(find_pairs(views, T_cw, camera, CONFIG))
    assert len(found[0]) == len(found[1]) > 0
    for one, other in zip(*found, strict=True):
        assert torch.equal(one.keypoints_1, other.keypoints_1)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_a_map_from_perturbed_poses(generator: torch.Generator, noise: float) -> None:
    """Poses 2 degrees and 5 cm off at 4 m become those that the pixels say."""
    scene, T_cw = Scene.of(), sideways(8, step=0.2)
    views = [scene.view(index, T, noise=noise) for index, T in enumerate(T_cw)]
    tangent = torch.tensor([0.03] * 3 + [math.radians(1.2)] * 3, dtype=torch.float64)
    given = se3_exp(tangent * randn(generator, 8, 6)) @ T_cw
    pairs = find_pairs(views, given, CAMERA, CONFIG)
    tracks = join_matches(pairs, 8, len(views[0].mask))
    made, _ = build_map(views, align_rotations(given, pairs), tracks, CAMERA, CONFIG)
    S = align_to_input(made.T_cw, T_cw)
    centers = se3_inverse(made.T_cw)[:, :3, 3] @ S[:3, :3].mT + S[:3, 3]
    off = (centers - se3_inverse(T_cw)[:, :3, 3]).norm(dim=-1)
    assert float(off.max()) < (1e-5 if noise == 0 else 0.04)


# --- the frame of the given poses ----------------------------------------------------------------------------


def test_the_result_is_in_the_given_frame(generator: torch.Generator) -> None:
    """The similarity that was lost is found, also of centers on a line, and one wild pose does not change it."""
    S = se3_exp(torch.tensor([1.0, -2, 0.5, 0.3, -0.4, 0.2], dtype=torch.float64))
    S[:3, :3] *= 1.6
    for given in (
        rigid(so3_exp(randn(generator, 9, 3)), randn(generator, 9, 3)),
        sideways(9),
    ):
        moved = given @ S  # world to camera, of points before S
        own = rigid(moved[:, :3, :3] / 1.6, moved[:, :3, 3] / 1.6)
        torch.testing.assert_close(align_to_input(own, given), S, atol=1e-9, rtol=0)
        wild = given.clone()
        wild[4, :3, 3] += 3.0
        torch.testing.assert_close(align_to_input(own, wild), S, atol=1e-9, rtol=0)


def test_without_translation_the_alignment_keeps_the_scale(generator: torch.Generator) -> None:
    given = rigid(so3_exp(randn(generator, 5, 3)), torch.zeros(5, 3, dtype=torch.float64))
    turn = se3_exp(torch.tensor([0, 0, 0, 0.3, -0.4, 0.2], dtype=torch.float64))
    torch.testing.assert_close(align_to_input(given @ turn, given), turn, atol=1e-9, rtol=0)
