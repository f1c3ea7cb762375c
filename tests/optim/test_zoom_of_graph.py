"""A zoom by a graph: one focal length is kept, sudden, gradual and slight changes are found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from rolling_scene import CAMERA, recording
from torch import Tensor

from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.zoom import Zoom
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import RunGraph
from torchslam.optim.run_graph import solve_graph
from torchslam.optim.zoom import ZoomEstimate, _Evidence, find_zoom, with_jumps

OPTIONS = GRAPH_OPTIONS.replace(backward="detached", tolerance=1e-6)
GIVEN = CameraMeasurement.of(CAMERA, 0.02)
FRAMES, EVERY = 40, 2
"""Frames, and from one keyframe to the next."""


def zoomed(ratio: Callable[[Tensor], Tensor], seed: int = 0, every: int = EVERY) -> RunGraph:
    """A recording with a zoom as a run leaves it that knows of none."""
    plain = recording(0.0, seed, frames=FRAMES)
    frames = torch.arange(FRAMES)
    center = CAMERA.params[2:4]
    ratios = ratio(frames.double())[plain.frame_index, None]
    is_keyframe = (frames % every == 0) | (frames == FRAMES - 1)
    plain = replace(plain, pixels=center + ratios * (plain.pixels - center), is_keyframe=is_keyframe)
    return adjusted(plain)


def adjusted(graph: RunGraph) -> RunGraph:
    solution = solve_graph(replace(graph, calibration=GIVEN), options=OPTIONS)
    columns = {name: getattr(graph, name) for name in graph.columns()}
    columns |= {"T_cw": solution.T_cw.detach(), "points_w": solution.points_w.detach()}
    return RunGraph(
        **columns
        | {
            "frame_ids": torch.arange(FRAMES),
            "sessions": torch.zeros(FRAMES, dtype=torch.int64),
            "point_ids": torch.arange(len(graph.points_w)),
            "keypoint_index": torch.arange(len(graph.pixels)),
        },
        camera=solution.camera.with_params(solution.camera.params.detach()),
    )


def found(graph: RunGraph) -> ZoomEstimate:
    estimate = find_zoom(graph, GIVEN, OPTIONS)
    assert estimate is not None
    return estimate


def test_one_focal_length_is_kept() -> None:
    for seed in range(4):
        assert not found(zoomed(torch.ones_like, seed)).is_found


def test_what_exact_observations_leave_open_stays_as_it_is() -> None:
    """A factor on all focal lengths: their differences alone are known, and the start is the mean."""
    step = torch.tensor([[-1.0, 1, 0], [0, -1, 1]], dtype=torch.float64)
    information = (1e4 * step.mT @ step).expand(2, 1, 3, 3)
    scores = (information @ torch.tensor([0.0, 0.1, 0.3], dtype=torch.float64)[:, None])[..., 0]
    evidence = _Evidence(scores, information, variance=0.0)
    moved = evidence.moved(torch.zeros(3, dtype=torch.float64), math.inf)
    torch.testing.assert_close(
        moved.diff(), torch.tensor([0.1, 0.2], dtype=torch.float64), atol=1e-6, rtol=0.0
    )
    assert abs(float(moved.mean())) < 1e-6


@pytest.mark.parametrize(
    "ratio",
    [
        lambda frame: torch.where(frame >= 20, 1.4, 1.0).double(),
        lambda frame: torch.where(frame >= 20, 1 / 1.4, 1.0).double(),
        lambda frame: 1.0 + 0.4 * ((frame - 10) / 20).clamp(0, 1),
        lambda frame: 1.0 + 0.02 * ((frame - 10) / 20).clamp(0, 1),
    ],
    ids=["in", "out", "gradual", "breathing"],
)
def test_a_zoom_is_found(ratio: Callable[[Tensor], Tensor]) -> None:
    """Beside the camera of the first frame."""
    estimate = found(zoomed(ratio))
    assert estimate.is_found
    expected = ratio(estimate.zoom.frames.double())
    assert float((estimate.zoom.ratios / expected).log().abs().max()) < 0.01
    assert float(estimate.zoom.ratios[0]) == 1.0
    assert (
        abs(float(estimate.camera.focal) / float(CAMERA.focal) - 1) < 0.03
    )  # for the final adjustment to settle


def test_a_jump_between_keyframes_is_placed() -> None:
    """Each frame has the focal length of its own side; those of a gradual zoom follow the line."""

    def ratio(frame: Tensor) -> Tensor:
        return torch.where(frame >= 18, 1.2, 1.0).double()

    graph = zoomed(ratio, every=8)
    zoom = found(graph).zoom
    undone = replace(graph, pixels=zoom.undone(graph.pixels, graph.frame_index, CAMERA), camera=CAMERA)
    both = with_jumps(adjusted(undone), zoom, OPTIONS)
    assert set(range(17, 24)) <= set(both.frames.tolist())
    assert (
        float((both.at(torch.arange(FRAMES)) / ratio(torch.arange(FRAMES).double())).log().abs().max()) < 0.02
    )
    gradual = Zoom(torch.tensor([0, FRAMES - 1]), torch.tensor([1.0, 1.1], dtype=torch.float64))
    assert len(with_jumps(zoomed(torch.ones_like), gradual, OPTIONS).frames) == 2


def test_observations_in_runs_give_the_same_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = zoomed(lambda frame: torch.where(frame >= 20, 1.1, 1.0).double())
    whole = found(graph)
    monkeypatch.setattr("torchslam.optim.bundle._scores.EXACT_AT_ONCE", 37)
    runs = found(graph)
    torch.testing.assert_close(runs.zoom.ratios, whole.zoom.ratios, rtol=1e-9, atol=0)
    assert runs.gain.total == pytest.approx(whole.gain.total, rel=1e-9)


def test_few_keyframes_say_nothing() -> None:
    graph = zoomed(torch.ones_like)
    assert find_zoom(replace(graph, is_keyframe=graph.frame_ids < 3), GIVEN, OPTIONS) is None
