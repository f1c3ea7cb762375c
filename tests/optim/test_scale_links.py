"""How well a map ties the scale on both sides of a moment: known cases, and an explicit problem."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.optim.conftest import draw, only
from torchslam.geometry import Camera, se3_exp, se3_inverse, so3_exp, transform
from torchslam.optim import GRAPH_OPTIONS, BundleProblem
from torchslam.optim.observation_graph import RunGraph, keyframe_problem
from torchslam.optim.scale_links import ScaleLinks, scale_links, scale_stds

CAMERA = Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480))
SIGMA_PX = 0.5
PLAIN = GRAPH_OPTIONS.replace(kernel="none")


def walk(frames: int = 12, points: int = 200, step: float = 0.4, seed: int = 0) -> tuple[Tensor, Tensor]:
    """T_cw of a camera that walks to the right past a wall, and points of it."""
    twists = 0.02 * draw(seed, frames, 6)
    twists[:, 0] -= step * torch.arange(frames)
    generator = torch.Generator().manual_seed(seed)
    low = torch.tensor([-2.0, -1.5, 3.0], dtype=torch.float64)
    size = torch.tensor([step * frames + 4.0, 3.0, 3.0], dtype=torch.float64)
    return se3_exp(twists), low + size * torch.rand(points, 3, generator=generator, dtype=torch.float64)


def seen_by(T_cw: Tensor, points_w: Tensor, noise: float = 0.0, seed: int = 0) -> BundleProblem:
    """All points that are in the images."""
    frame, point = torch.ones(len(T_cw), len(points_w)).nonzero().unbind(-1)
    points_c = transform(T_cw[frame], points_w[point][:, None])[:, 0]
    pixels, valid = CAMERA.project(points_c)
    seen = valid & CAMERA.in_image(pixels)
    pixels = pixels[seen] + noise * draw(seed, int(seen.sum()), 2)
    weights = torch.full((len(pixels),), SIGMA_PX**-2, dtype=torch.float64)
    return BundleProblem(T_cw, points_w, frame[seen], point[seen], pixels, CAMERA, weights)


def stds(problem: BundleProblem, plain: bool = True) -> list[float]:
    """Of the frames in their order."""
    order = torch.arange(len(problem.T_cw))
    return scale_stds(problem, order, PLAIN if plain else GRAPH_OPTIONS).tolist()


def explicit_std(problem: BundleProblem, moment: int) -> float:
    """By the whole information of the seven numbers of a similarity and all points, derivatives by differences."""
    after = problem.frame_index > moment

    def pixels(similarity: Tensor, points_w: Tensor) -> Tensor:
        T_cw = problem.T_cw[problem.frame_index]
        own = points_w[problem.point_index]
        moved = (
            torch.exp(similarity[6]) * (so3_exp(similarity[3:6]) @ own[..., None])[..., 0] + similarity[:3]
        )
        own = torch.where(after[:, None], moved, own)
        return CAMERA.project(transform(T_cw, own[:, None])[:, 0])[0]

    start = problem.points_w.new_zeros(7), problem.points_w
    of_similarity, of_points = torch.autograd.functional.jacobian(pixels, start, vectorize=True)
    J = torch.cat((of_similarity.flatten(0, 1), of_points.flatten(0, 1).flatten(1)), dim=-1) / SIGMA_PX
    seen = J.abs().sum(0) > 0
    return float(torch.linalg.inv(J[:, seen].mT @ J[:, seen])[6, 6].sqrt())


def test_the_std_is_that_of_an_explicit_similarity() -> None:
    problem = seen_by(*walk(8, 40))
    found = stds(problem)
    assert len(found) == 7
    for moment in (1, 3, 5):
        assert found[moment] == pytest.approx(explicit_std(problem, moment), rel=1e-4)
    shared = only(problem, torch.rand(len(problem.pixels), generator=torch.Generator().manual_seed(0)) < 0.7)
    assert stds(shared)[3] == pytest.approx(explicit_std(shared, 3), rel=1e-4)


def test_a_chain_of_frames_over_shared_points_ties_the_scale() -> None:
    found = stds(seen_by(*walk()))
    assert found[0] == found[-1] == 0.0  # a single frame has no scale
    assert max(found) < 0.005
    assert min(found[1:-1]) > 1e-4


def test_the_unit_and_the_frame_of_the_map_do_not_matter() -> None:
    T_cw, points_w = walk()
    expected = torch.tensor(stds(seen_by(T_cw, points_w)))
    T = se3_exp(torch.tensor([1.0, -20.0, 5.0, 0.3, -0.4, 2.0], dtype=torch.float64))
    for unit in (1e-3, 1e3):
        moved = T_cw @ se3_inverse(T)
        moved[:, :3, 3] *= unit
        other = seen_by(moved, unit * transform(T, points_w))
        torch.testing.assert_close(torch.tensor(stds(other)), expected, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize(("shared", "is_tied"), [(0, False), (2, False), (60, True)])
def test_halves_that_share_two_points_are_not_tied(shared: int, is_tied: bool) -> None:
    """Two points leave a turn about the line through them, and a similarity needs three."""
    problem = seen_by(*walk(12, 300))
    first, last = (
        torch.zeros(300, dtype=torch.bool).index_fill(0, problem.point_index[own], True)
        for own in (problem.frame_index <= 5, problem.frame_index > 5)
    )
    common = (first & last).nonzero()[:, 0]
    kept = torch.zeros(300, dtype=torch.bool).index_fill(0, common[:shared], True) | ~(first & last)
    found = stds(only(problem, kept[problem.point_index]))
    assert math.isfinite(found[5]) == is_tied
    assert all(map(math.isfinite, found[1:4]))


def test_fewer_points_tie_the_scale_less() -> None:
    problem = seen_by(*walk(12, 400))
    found = [stds(only(problem, problem.point_index % step == 0))[5] for step in (1, 2, 8)]
    assert found == sorted(found)
    assert found[2] == pytest.approx(found[0] * 8**0.5, rel=0.5)


def test_a_camera_that_stands_still_is_tied_tightly() -> None:
    """It sees the same points on both sides, although it has no baseline of its own."""
    T_cw, points_w = walk()
    still = torch.cat((T_cw[:6], T_cw[5:6].expand(10, 4, 4), T_cw[6:]))
    found = stds(seen_by(still, points_w))
    moving = stds(seen_by(T_cw, points_w))
    assert max(found[6:15]) < 1.2 * max(moving)


def bend(problem: BundleProblem, moment: int, factor: float) -> BundleProblem:
    """The second half of a map, frames and the points that only they see, scaled about its first frame."""
    T_wc = se3_inverse(problem.T_cw)
    center = T_wc[moment + 1, :3, 3].clone()
    T_wc[moment + 1 :, :3, 3] = center + factor * (T_wc[moment + 1 :, :3, 3] - center)
    first = torch.zeros(len(problem.points_w), dtype=torch.bool)
    first[problem.point_index[problem.frame_index <= moment]] = True
    moved = center + factor * (problem.points_w - center)
    return replace(
        problem, T_cw=se3_inverse(T_wc), points_w=torch.where(first[:, None], problem.points_w, moved)
    )


def test_a_bent_map_is_tied_less_where_it_is_bent() -> None:
    """The kernel gives less weight to observations that contradict it."""
    problem = seen_by(*walk(), noise=SIGMA_PX)
    right = stds(problem, plain=False)
    bent = stds(bend(problem, 5, 1.3), plain=False)
    assert bent[5] > 2 * right[5]
    assert bent[1] == pytest.approx(right[1], rel=0.1)
    without_kernel = stds(bend(problem, 5, 1.3))
    assert without_kernel[5] < 1.5 * stds(problem)[5]


def test_the_weakest_link_between_two_frames() -> None:
    links = ScaleLinks((0, 10, 20, 30), (0.1, 0.3, 0.2))
    assert links.weakest(10, 20) == 0.3
    assert links.weakest(0, 30) == 0.3
    assert links.weakest(12, 13) == 0.3  # between two keyframes
    assert links.weakest(20, 25) == 0.2
    assert links.weakest(30, 40) == links.weakest(-5, 0) == 0.0
    assert ScaleLinks((4,), ()).weakest(0, 9) == 0.0


def graph(order: Tensor, sessions: Tensor, is_keyframe: Tensor, submap: Tensor) -> RunGraph:
    """A walk whose frames are in any order; frames of a submap see points of their own."""
    problem = seen_by(*walk(len(order)))
    rank = torch.argsort(order)
    frame = rank[problem.frame_index]
    points, point = torch.unique(
        problem.point_index + len(problem.points_w) * submap[frame], return_inverse=True
    )
    assert problem.weights is not None
    return RunGraph(
        timestamps=order / 10.0,
        T_cw=problem.T_cw[order],
        points_w=problem.points_w[points % len(problem.points_w)],
        frame_index=frame,
        point_index=point,
        pixels=problem.pixels,
        weights=problem.weights,
        camera=CAMERA,
        is_keyframe=is_keyframe,
        submap=submap,
        frame_ids=10 * order,
        sessions=sessions,
        point_ids=torch.arange(len(points)),
        keypoint_index=torch.arange(len(frame)),
    )


def test_links_are_those_of_the_keyframes_of_a_run() -> None:
    """In the order of time, whatever that of the rows; frames that are no keyframes do not count."""
    order = torch.randperm(14, generator=torch.Generator().manual_seed(0))
    zero, is_keyframe = torch.zeros(14, dtype=torch.int64), order % 3 != 2
    run = graph(order, zero, is_keyframe, zero)
    found = scale_links(run)
    keyframes = [frame for frame in range(14) if frame % 3 != 2]
    assert found.frames == tuple(10 * frame for frame in keyframes)
    problem = seen_by(*walk(14))
    own = is_keyframe[torch.argsort(order)][problem.frame_index]
    slot = torch.tensor([keyframes.index(frame) if frame in keyframes else -1 for frame in range(14)])
    chosen = only(problem, own)
    expected = replace(chosen, T_cw=problem.T_cw[keyframes], frame_index=slot[chosen.frame_index])
    assert found.std == pytest.approx(stds(expected, plain=False), rel=1e-6)


def test_links_are_those_of_one_session_in_its_main_submap() -> None:
    """Keyframes of an earlier session tie as well, but moments to them are not named."""
    order, every = torch.arange(14), torch.ones(14, dtype=torch.bool)
    sessions = (order >= 5).long()
    found = scale_links(graph(order, sessions, every, 0 * order), session=1)
    assert found.frames == tuple(range(50, 140, 10))
    whole = scale_links(graph(order, 0 * order, every, 0 * order))
    assert found.std == pytest.approx(whole.std[5:], rel=1e-9)
    submap = (order >= 4).long()
    parts = graph(order, 0 * order, every, submap)
    main = scale_links(parts)
    assert main.frames == tuple(range(40, 140, 10))
    assert main.std == pytest.approx(stds(keyframe_problem(parts, 1)[3], plain=False), rel=1e-6)
