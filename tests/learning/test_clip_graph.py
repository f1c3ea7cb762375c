"""Looking once and posing often: the same bytes as in one call, right gradients, cameras of their own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.learning.test_clip_slam import FRAMES, BentExtractor, clip_of, derivative
from tests.walks import Walk, arc, still
from torchslam import Camera, ClipGraph, ClipPoses, ClipSLAM, Features, clip_loss
from torchslam.errors import ClipError
from torchslam.evaluation import ate
from torchslam.learning import clip_halves


@pytest.fixture
def walk() -> Walk:
    return Walk(arc(FRAMES, length=1.0))


def camera_with(focal: Tensor | float) -> Camera:
    return Camera.pinhole(focal, focal, 159.5, 119.5, size=(320, 240))


def test_a_call_equals_extraction_and_solution(walk: Walk) -> None:
    images, truth = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.01)
    clip_slam = ClipSLAM(extractor)

    def graph() -> ClipGraph:
        found = clip_slam.build_graph(images, walk.camera)
        assert (found.frames, found.batched) == (FRAMES, False)
        return found

    def of_call() -> ClipPoses:
        return clip_slam(images, walk.camera)

    def in_two() -> ClipPoses:
        return clip_slam.pose(graph(), clip_slam.extract(images), walk.camera)

    def with_graph() -> ClipPoses:
        return clip_slam(images, walk.camera, graph())

    results = []
    for way in (of_call, in_two, with_graph):
        extractor.bend.grad = None
        poses = way()
        ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed).backward()
        results.append((poses.T_cw.detach(), poses.posed, extractor.bend.grad))
    assert results[0][1].all()
    for other in results[1:]:
        assert all(torch.equal(*pair) for pair in zip(results[0], other, strict=True))


def test_a_clip_graph_is_detached(walk: Walk) -> None:
    images, _ = clip_of(walk)
    focal = torch.tensor(400.0, dtype=torch.float64, requires_grad=True)
    camera = camera_with(focal)
    graph = ClipSLAM(BentExtractor(walk, bend=0.01)).build_graph(images, camera)
    (run,) = graph.runs
    assert run is not None
    columns = [getattr(run, name) for name in run.columns()]
    assert not any(column.requires_grad for column in [*columns, run.camera.params])
    with torch.no_grad():
        camera.params.mul_(2)
    assert graph.cameras[0].fx == 400


def test_the_gradient_through_a_stored_graph_agrees_with_finite_differences(walk: Walk) -> None:
    images, truth = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.01)
    clip_slam = ClipSLAM(extractor)
    graph = clip_slam.build_graph(images, walk.camera)

    def loss(bend: float, focal: Tensor | float) -> Tensor:
        with torch.no_grad():
            extractor.bend.fill_(bend)
        poses = clip_slam.pose(graph, clip_slam.extract(images), camera_with(focal))
        return ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)

    focal = torch.tensor(405.0, dtype=torch.float64, requires_grad=True)
    loss(0.03, focal).backward()  # far from where it was looked
    assert extractor.bend.grad is not None
    assert focal.grad is not None
    assert float(extractor.bend.grad) == pytest.approx(
        derivative(lambda x: loss(x, 405.0), 0.03, 1e-5), rel=1e-3
    )
    assert float(focal.grad) == pytest.approx(derivative(lambda x: loss(0.03, x), 405.0, 1e-2), rel=1e-3)


def test_clips_of_a_batch_have_their_own_cameras(walk: Walk) -> None:
    images, truth = clip_of(walk)
    clip_slam = ClipSLAM(BentExtractor(walk, bend=0.0))
    params = torch.stack([camera_with(focal).params for focal in (400.0, 410.0)]).requires_grad_()
    poses = clip_slam(torch.stack([images, images]), walk.camera.with_params(params))
    alone = [clip_slam(images, camera_with(focal)) for focal in (400.0, 410.0)]
    torch.testing.assert_close(poses.T_cw, torch.stack([each.T_cw for each in alone]), atol=1e-9, rtol=0)
    assert not torch.equal(poses.T_cw[0], poses.T_cw[1])
    ate(T_cw=poses.T_cw, T_cw_groundtruth=truth.expand(2, -1, -1, -1), mask=poses.posed)[1].backward()
    assert params.grad is not None
    assert (params.grad[0] == 0).all()
    assert (params.grad[1] != 0).all()
    with pytest.raises(ValueError, match=r"\(K,\) or \(1, K\)"):
        clip_slam(images[None], walk.camera.with_params(params))


def test_graphs_of_clips_stack_to_a_batch(walk: Walk) -> None:
    images, _ = clip_of(walk)
    clip_slam = ClipSLAM(BentExtractor(walk, bend=0.0))
    graphs = [clip_slam.build_graph(images, camera_with(focal)) for focal in (400.0, 410.0)]
    features = clip_slam.extract(torch.stack([images, images]))
    poses = clip_slam.pose(ClipGraph.stack(graphs), features)
    one = clip_slam.pose(graphs[1], clip_slam.extract(images))
    torch.testing.assert_close(poses.T_cw[1], one.T_cw, atol=1e-9, rtol=0)
    assert clip_slam.pose(ClipGraph.stack(graphs[:1]), features[:1]).T_cw.shape == (1, FRAMES, 4, 4)
    with pytest.raises(ValueError, match="one clip each"):
        ClipGraph.stack([ClipGraph.stack(graphs), graphs[0]])
    with pytest.raises(ValueError, match="same number of frames"):
        ClipGraph.stack([graphs[0], replace(graphs[1], frames=4)])
    with pytest.raises(ValueError, match=f"2 clips of {FRAMES} frames"):
        clip_slam.pose(ClipGraph.stack(graphs), features[:1])


def test_missing_keypoints_are_ignored(walk: Walk) -> None:
    images, _ = clip_of(walk)
    clip_slam = ClipSLAM(BentExtractor(walk, bend=0.0, noise_px=0.0))
    graph, features = clip_slam.build_graph(images, walk.camera), clip_slam.extract(images)
    assert isinstance(features, Features)
    gone = torch.zeros_like(features.mask)
    gone[:, ::4] = True
    spoilt = torch.where(gone[..., None], features.keypoints + 50.0, features.keypoints)
    poses = clip_slam.pose(graph, features)
    partial = clip_slam.pose(graph, replace(features, keypoints=spoilt, mask=features.mask & ~gone))
    torch.testing.assert_close(partial.T_cw, poses.T_cw, atol=1e-5, rtol=0)
    (seen,), (left,) = poses.graphs, partial.graphs
    assert seen is not None
    assert left is not None
    assert 0 < len(left.pixels) < len(seen.pixels)


def test_failing_clips_among_good_ones_keep_their_reasons(walk: Walk) -> None:
    """Together they are what each is alone: cameras of two models, one clip without a map, one that is blind now."""
    images, truth = clip_of(walk)
    extractor, idle = BentExtractor(walk, bend=0.0), BentExtractor(Walk(still(FRAMES)), bend=0.0)
    bent = Camera.radial_tangential(401.0, 402.0, 159.5, 119.5, 1e-3, 0.0, 0.0, 0.0, size=(320, 240))
    looked = [
        ClipSLAM(each).build_graph(images, camera)
        for each, camera in (
            (extractor, walk.camera),
            (idle, walk.camera),
            (extractor, bent),
            (extractor, walk.camera),
        )
    ]
    clip_slam = ClipSLAM(extractor, keypoint_weight=lambda features: features.scores)
    seen = extractor(images)
    keypoints, scores = seen.keypoints.clone().requires_grad_(), torch.ones_like(seen.scores).requires_grad_()
    good = replace(seen, keypoints=keypoints, scores=scores)
    blind = replace(good, mask=torch.zeros_like(good.mask))
    features = [good, good, good, blind]
    together = clip_slam.pose(ClipGraph.stack(looked), features)
    alone = [clip_slam.pose(*one) for one in zip(looked, features, strict=True)]
    assert together.success.tolist() == [True, False, True, False]
    assert together.reasons == tuple(each.reasons[0] for each in alone)
    assert together.reasons[1].startswith("no map was initialized")
    assert "not determined" in together.reasons[3]
    assert [graph is None for graph in together.graphs] == [False, True, False, False]
    assert [solution is None for solution in together.solutions] == [False, True, False, False]
    assert torch.equal(together.posed, torch.stack([each.posed for each in alone]))
    T_cw = torch.stack([each.T_cw for each in alone])
    torch.testing.assert_close(together.T_cw, T_cw, atol=1e-9, rtol=0)
    losses = [clip_loss(together, T_cw_groundtruth=truth.expand(4, -1, -1, -1), on_failure=2.0).loss]
    losses.append(sum(clip_loss(each, T_cw_groundtruth=truth, on_failure=2.0).loss for each in alone) / 4)
    found, expected = (torch.autograd.grad(loss, (keypoints, scores), retain_graph=True) for loss in losses)
    for gradient, other in zip(found, expected, strict=True):
        torch.testing.assert_close(gradient, other, rtol=1e-7, atol=1e-9 * float(other.abs().max()))


class SortedExtractor(BentExtractor):
    """A feature extractor whose rows are in the order of scores that it learns, as those of a network are."""

    def __init__(self, walk: Walk) -> None:
        super().__init__(walk, bend=0.01)
        self.order = torch.arange(self.exact.mask.shape[1])

    def forward(self, images: Tensor) -> Features:
        return super().forward(images).rows(self.order)


class FixedExtractor(SortedExtractor):
    """The same, but it can describe given keypoints again."""

    def read(self, images: Tensor, keypoints: Tensor, mask: Tensor) -> Features:
        assert (keypoints - self.exact.keypoints)[mask].norm(
            dim=-1
        ).max() < 8  # those of the graph, in its rows
        return BentExtractor.forward(self, images)


def test_keypoints_that_jump_to_other_rows_are_refused_and_fixed_ones_read_again(walk: Walk) -> None:
    images, truth = clip_of(walk)
    losses = []
    for extractor in (SortedExtractor(walk), FixedExtractor(walk)):
        clip_slam = ClipSLAM(extractor)
        graph = clip_slam.build_graph(images, walk.camera)
        before = clip_slam(images, walk.camera, graph)
        extractor.order = torch.cat((extractor.order[:100].flip(0), extractor.order[100:]))
        if isinstance(extractor, FixedExtractor):
            after = clip_slam(images, walk.camera, graph)
            losses = [
                ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed) for poses in (before, after)
            ]
            continue
        with pytest.raises(ValueError, match=r"keypoints are up to \d+ px from where the graph has them"):
            clip_slam(images, walk.camera, graph)
    assert before.success
    torch.testing.assert_close(*losses)
    losses[1].backward()
    assert extractor.bend.grad is not None
    assert extractor.bend.grad.abs() > 0


def test_halves_share_no_observation_and_their_difference_has_right_gradients(walk: Walk) -> None:
    images, _ = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.01)
    clip_slam = ClipSLAM(extractor)
    graph = clip_slam.build_graph(torch.stack([images, images]), walk.camera)
    (whole, _), (even, _), (odd, _) = graph.runs, *(half.runs for half in graph.halves())
    assert not set(even.point_index.tolist()) & set(odd.point_index.tolist())
    assert len(even.pixels) + len(odd.pixels) == len(whole.pixels)

    def loss(bend: float | Tensor) -> Tensor:
        with torch.no_grad():
            extractor.bend.copy_(torch.as_tensor(bend))
        features = clip_slam.extract(torch.stack([images, images]), graph)
        poses = [clip_slam.pose(half, features, walk.camera) for half in graph.halves()]
        assert all(each.success.all() for each in poses)
        return clip_halves(*poses).loss

    found = loss(0.01)
    found.backward()
    assert float(found.detach()) > 0
    assert extractor.bend.grad is not None
    assert float(extractor.bend.grad) == pytest.approx(derivative(loss, 0.01, 1e-5), rel=1e-3)


def test_a_clip_with_a_failed_half_counts_as_failed(walk: Walk) -> None:
    images, _ = clip_of(walk)
    clip_slam = ClipSLAM(BentExtractor(walk, bend=0.01))
    graph = clip_slam.build_graph(images, walk.camera)
    even, _ = graph.halves()
    nothing = replace(even, runs=(None,), reasons=("too few points",))
    good, bad = (clip_slam.pose(half, clip_slam.extract(images)) for half in (even, nothing))
    for pair in ((good, bad), (bad, good)):
        loss, failure_rate = clip_halves(*pair, on_failure=7.0)
        assert (float(loss.detach()), float(failure_rate)) == (7.0, 1.0)
        with pytest.raises(ClipError, match="too few points"):
            clip_halves(*pair)
