"""Measurements of parts of a path correct the drift of a map, where that explains what was held back."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.metric.drifting import CAMERA, drifting_submap
from tests.metric.drives import ORIGIN
from torchslam import evaluate
from torchslam.config import Config
from torchslam.data.formats.fixes import Fixes
from torchslam.geometry import geodetic_from_enu, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.metric.camera_path import CameraPath, Clock
from torchslam.metric.meters import bring_into_meters
from torchslam.metric.path_measurements import Keyframes, PathPositions, PathScales, whole_path
from torchslam.metric.positions import PositionSource
from torchslam.metric.receiver_noise import receiver_noise
from torchslam.metric.scale import ScaleMeasurement, ScaleSource
from torchslam.metric.source import SubmapView
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.measurements import MeasuredLengths, MeasuredPositions
from torchslam.optim.run_graph import solve_graph
from torchslam.system.metric_run import run_in_meters
from torchslam.system.run import Run
from torchslam.types import Trajectory

DRIFTS = {"count": 120, "noise": 1.0, "per_keyframe": 8}


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def gps(times: Tensor, T_ec: Tensor, noise: float, wrong: slice = slice(0)) -> PositionSource:
    """Positions with every keyframe, some of them 40 m off."""
    positions_e = T_ec[::2, :3, 3] + noise * normal(len(T_ec[::2]), 3)
    positions_e[wrong, 0] += 40.0
    std = torch.full((len(positions_e), 2), math.nan, dtype=torch.float64)
    geodetic = geodetic_from_enu(positions_e, torch.tensor(ORIGIN, dtype=torch.float64))
    return PositionSource(Fixes(Path("gps.csv"), geodetic, std, times[::2]), Clock(seconds=0.0))


def run_of(submap: Submap) -> Run:
    return Run((submap,), CAMERA, Config(), [], [], False, "")


@pytest.mark.parametrize(
    "wrong",
    [
        slice(50, 56),
        *(pytest.param(each, marks=pytest.mark.slow) for each in (slice(0), slice(60, None, 13))),
    ],
)
def test_positions_correct_a_map_that_drifts(wrong: slice) -> None:
    submap, times, T_ec = drifting_submap(seed=2, **DRIFTS)
    truth = Trajectory(times, T_ec)
    before = evaluate(submap.map.keyframe_trajectory(), truth)
    run = run_in_meters(run_of(submap), None, [gps(times, T_ec, 0.3, wrong)])
    after = evaluate(run.keyframes, truth)
    assert before.ate_m > 2.0
    assert after.ate_m < 0.3
    assert after.ate_se3_m < 1.1 * after.ate_m
    assert run.metric is not None
    assert any("corrected" in line for line in run.metric.remarks)
    # The run is the minimum of its graph, in which the measurements are.
    (measured,) = run.graph.measurements
    assert isinstance(measured, MeasuredPositions)
    again = solve_graph(run.graph, options=GRAPH_OPTIONS.replace(backward="detached"))
    moved = (se3_inverse(again.T_cw) - se3_inverse(run.graph.T_cw))[run.graph.is_keyframe, :3, 3]
    assert float(moved.norm(dim=-1).max()) < 0.02


def test_a_short_path_is_known_better_by_the_images() -> None:
    """The poses are those of one similarity; the measurements are in the graph, and bend nothing."""
    submap, times, T_ec = drifting_submap(count=30)
    same, _, _ = drifting_submap(count=30)
    run = run_in_meters(run_of(submap), None, [gps(times, T_ec, 1.0)])
    assert run.metric is not None
    same.transform(torch.tensor(run.metric.S_mw, dtype=torch.float64))
    assert torch.equal(same.map.T_cw, submap.map.T_cw)
    assert torch.equal(same.trajectory().T_wc, submap.trajectory().T_wc)
    assert not any("corrected" in line for line in run.metric.remarks)
    graph = run.graph
    centers_w = se3_inverse(graph.T_cw)[:, :3, 3]
    again = se3_inverse(solve_graph(graph, options=GRAPH_OPTIONS.replace(backward="detached")).T_cw)[:, :3, 3]
    ratios = torch.pdist(again) / torch.pdist(centers_w)
    assert abs(float(ratios.log().median())) < 2 * run.metric.relative_std
    assert float(ratios.log().std()) < 0.01


def scales_of(T_ec: Tensor, times: Tensor, submap: Submap, noise: float) -> ScaleMeasurement:
    """The unit over every keyframe's stretch, by true lengths."""
    path = CameraPath.of(SubmapView(submap, CAMERA))
    starts, ends = times[:-8:4], times[8::4]
    true = (T_ec[8::4, :3, 3] - T_ec[:-8:4, :3, 3]).norm(dim=-1)
    found = (path.at(ends)[0] - path.at(starts)[0]).norm(dim=-1)
    logs = (true / found).log() + noise * normal(len(true))
    std = noise / math.sqrt(len(logs))
    parts = PathScales.of_mean(starts, ends, logs.exp(), torch.ones_like(logs), std)
    return ScaleMeasurement(
        ScaleSource.SPEED, math.exp(float(logs.mean())), std, len(logs), "stretches", parts=parts
    )


class Fixed:
    """A source that was asked before."""

    def __init__(self, answer: ScaleMeasurement) -> None:
        self.answer = answer

    def measure(self, view: SubmapView) -> ScaleMeasurement:
        return self.answer


def test_lengths_correct_the_drift_of_the_scale() -> None:
    submap, times, T_ec = drifting_submap(seed=2, **DRIFTS)
    truth = Trajectory(times, T_ec)
    before = evaluate(submap.map.keyframe_trajectory(), truth).ate_m
    measured = scales_of(T_ec, times, submap, 0.005)
    _, _, correction = bring_into_meters(SubmapView(submap, CAMERA), [Fixed(measured)])
    assert correction.is_taken
    assert evaluate(submap.map.keyframe_trajectory(), truth).ate_m < 0.8 * before


def test_a_scale_without_a_place_is_in_the_graph_and_changes_no_pose() -> None:
    submap, _, _ = drifting_submap(count=12)
    same, _, _ = drifting_submap(count=12)
    marker = ScaleMeasurement(ScaleSource.MARKER, 2.0, 0.01, 1, "marker")
    run = run_in_meters(run_of(submap), None, [Fixed(marker)])
    assert torch.allclose(same.map.T_cw[:, :3, :3], submap.map.T_cw[:, :3, :3], atol=1e-12)
    (length,) = run.graph.measurements
    assert isinstance(length, MeasuredLengths)
    assert float(length.errors(run.graph.T_cw).abs().max()) < 1e-9


def keyframes_of(submap: Submap, meters_per_unit: float = 1.0) -> Keyframes:
    view = SubmapView(submap, CAMERA)
    return Keyframes.of(CameraPath.of(view), submap.map, 0, meters_per_unit)


def test_parts_find_their_keyframes() -> None:
    submap, _, _ = drifting_submap(count=12)
    keyframes = keyframes_of(submap, 2.0)
    starts, ends = torch.tensor((0.1, 3.0)).double(), torch.tensor((3.9, 3.1)).double()
    stds = torch.tensor((0.1, 0.2)).double()
    found = PathScales(starts, ends, torch.tensor((2.0, 2.2)).double(), stds).on(keyframes)
    assert found is not None
    assert found.frames.tolist() == [
        [0, 4],
        [2, 4],
    ]  # the second part has one keyframe: those beside it count
    chords = (se3_inverse(submap.map.T_cw)[[4, 4], :3, 3] - se3_inverse(submap.map.T_cw)[[0, 2], :3, 3]).norm(
        dim=-1
    )
    torch.testing.assert_close(found.lengths, chords * torch.tensor((1.0, 1.1)).double())
    torch.testing.assert_close(found.information, stds**-2)
    # Positions half a second after a keyframe are on the path there, and two of one keyframe are averaged.
    at = torch.tensor((2.2, 2.4, 4.0, 99.0)).double()
    path_w, _, known = keyframes.path.at(at)
    positions = PathPositions(at, path_w, torch.ones(4, 3).double()).on(keyframes)
    assert known.tolist() == [True, True, True, False]
    assert positions is not None
    assert positions.frames.tolist() == [2, 4]
    assert float(positions.errors(submap.map.T_cw).abs().max()) < 1e-9
    deviations = torch.linalg.inv(positions.information).diagonal(dim1=1, dim2=2)
    torch.testing.assert_close(deviations, torch.tensor((1.5, 2.0)).double().expand(3, 2))


def test_the_error_of_a_mean_is_in_its_parts() -> None:
    none = torch.zeros(5).double()
    parts = PathScales.of_mean(none, none, none + 1, torch.tensor((1.0, 2, 1, 3, 1)).double(), 0.02)
    assert float(parts.stds.square().reciprocal().sum()) == pytest.approx(0.02**-2)


@pytest.mark.parametrize(
    "make",
    [
        lambda keyframes: whole_path(keyframes, 1.0, 0.1),
        lambda keyframes: PathScales(*(torch.ones(4, 2).double())).on(keyframes),
        lambda keyframes: PathPositions(*(torch.ones(2).double(), *torch.ones(2, 2, 3).double())).on(
            keyframes
        ),
    ],
)
def test_one_keyframe_has_no_length(make: Callable[[Keyframes], object]) -> None:
    submap, _, _ = drifting_submap(count=12)
    whole = keyframes_of(submap)
    one = Keyframes(whole.path, whole.rows[:1], whole.timestamps[:1], whole.T_cw[:1], 1.0)
    assert make(one) is None


def test_the_noise_of_a_receiver_is_found_beside_a_drift() -> None:
    """A drift of 20 m over 200 positions; gross errors are found, and heights that were not measured do not matter."""
    count = 200
    drift = 20 * torch.linspace(0, 1, count, dtype=torch.float64)[:, None].square()
    size = torch.tensor((0.5, 0.5, 1.5), dtype=torch.float64)
    residuals = drift + size * normal(count, 3)
    wrong = torch.arange(7, count - 5, 20)
    residuals[wrong, 1] += 12.0
    unknown = torch.full((count, 2), math.nan, dtype=torch.float64)
    white, agrees = receiver_noise(residuals, unknown, torch.ones(count, dtype=torch.bool))
    assert not bool(agrees[wrong].any())
    assert int((~agrees).sum()) <= len(wrong) + 4
    torch.testing.assert_close(white[0], size, rtol=0.15, atol=0.0)
    stated = torch.stack((torch.full((count,), 0.25), torch.full((count,), 3.0)), dim=-1).double()
    no_height = torch.zeros(count, dtype=torch.bool)
    residuals[:, 2] = 0.0
    white, agrees = receiver_noise(residuals, stated, no_height)
    torch.testing.assert_close(white[0, :2], size[:2], rtol=0.15, atol=0.0)
    assert not bool(agrees[wrong].any())
