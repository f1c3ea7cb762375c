"""Rolling shutters: known ones are found with their size, and none where there is none."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from experiments.trials.edited import Edit, Edited, shots
from experiments.trials.edits import rolling
from torchslam.calibration.rolling_shutter import (
    RollingShutter,
    _Block,
    find_rolling_shutter,
    image_interval_velocities,
    project_out,
    rolling_shutter_remark,
)
from torchslam.data import open_sequence
from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import ObservationGraph, concatenate_graphs, solve_graph
from torchslam.system.run import Run
from torchslam.system.slam import SLAM

CAMERA = Camera.radial_tangential(400.0, 400.0, 319.5, 239.5, -0.1, 0.02, 0.0, 0.0, size=(640, 480))
NOISE_PX = 0.5


def path(times: Tensor, seed: int) -> Tensor:
    """T_cw (..., 4, 4) of a hand-held camera: it turns by up to one degree a frame and goes to and fro."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([0.2, 0.2, 0.2, 0.08, 0.08, 0.05], dtype=torch.float64)
    rates, phases, weights = torch.rand(3, 3, 6, generator=generator, dtype=torch.float64)
    waves = torch.sin(times[..., None, None] * (0.05 + 0.25 * rates) + 2 * math.pi * phases)
    return se3_exp((size * (0.5 + weights) * waves).sum(-2))


def recording(
    readout: float, seed: int = 0, noise: float = NOISE_PX, frames: int = 40, points: int = 120
) -> ObservationGraph:
    """Keypoints of a rolling shutter, in a graph with the poses at the middles of the exposures."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    points_w = torch.stack((2.0 * normal(points), 1.5 * normal(points), 4 + normal(points).clamp(-2, 2)), -1)
    frame, point = torch.ones(frames, points).nonzero().unbind(-1)
    times = frame.double()
    for _ in range(6):  # the row decides about the time, and the time about the row
        pixels, valid = CAMERA.project(transform(path(times, seed), points_w[point][:, None]))
        times = frame + readout * ((pixels[:, 0, 1] + 0.5) / CAMERA.height - 0.5)
    seen = (valid & CAMERA.in_image(pixels))[:, 0]
    moments = torch.arange(frames, dtype=torch.float64)
    return ObservationGraph(
        moments / 30,
        path(moments, seed),
        points_w,
        frame[seen],
        point[seen],
        pixels[seen, 0] + noise * normal(int(seen.sum()), 2),
        torch.full((int(seen.sum()),), NOISE_PX**-2, dtype=torch.float64),
        CAMERA,
        moments % 4 == 0,
    )


def estimated(graph: ObservationGraph) -> RollingShutter:
    found = find_rolling_shutter(graph)
    assert found is not None
    return found


def adjusted(graph: ObservationGraph) -> ObservationGraph:
    """As a run leaves it: poses and points have absorbed what they can."""
    solution = solve_graph(graph, options=GRAPH_OPTIONS.replace(backward="detached"))
    return replace(graph, T_cw=solution.T_cw, points_w=solution.points_w)


@pytest.mark.parametrize("readout", [0.3, 0.9, -0.6])
def test_the_readout_is_found_in_an_adjusted_graph(readout: float) -> None:
    found = estimated(adjusted(recording(readout)))
    assert found.is_read_out
    assert found.readout == pytest.approx(readout, abs=0.1 * abs(readout))
    assert abs(found.readout - readout) < 4 * found.readout_std + 0.04 * abs(readout)
    assert found.readout_std < 0.05
    said = f"(rolling shutter: {100 * abs(found.readout):.0f} ± {100 * found.readout_std:.0f} % of the frame interval)"
    assert said in found.description()


def test_a_global_shutter_is_not_named() -> None:
    found = estimated(adjusted(recording(0.0)))
    assert not found.is_read_out
    assert not found.is_shaken
    assert found.description() == ""


@settings(max_examples=8, deadline=None)
@given(st.integers(1, 10_000), st.sampled_from([0.0, 0.25, 0.8]))
def test_random_motions_tell_the_readout_within_its_error(seed: int, readout: float) -> None:
    found = estimated(recording(readout, seed))
    assert abs(found.readout - readout) < 6 * found.readout_std + 0.05 * readout
    assert found.is_read_out == (readout > 0)
    assert not found.is_shaken


@pytest.mark.parametrize(("axis", "named"), [(1, True), (0, False)])
def test_a_shaking_camera_shifts_rows_and_not_columns(axis: int, named: bool) -> None:
    """The same wave along the rows and along the columns: only the first is a rolling shutter."""
    graph = recording(0.0)
    place = graph.pixels[:, axis] / CAMERA.size[axis] + graph.frame_index / 9
    shifts = torch.zeros_like(graph.pixels)
    shifts[:, 1 - axis] = 3 * torch.sin(2 * math.pi * place)
    found = estimated(replace(graph, pixels=graph.pixels + shifts))
    assert found.is_shaken == named
    assert not found.is_read_out
    assert ("the camera shakes" in found.description()) == named


def test_a_wrong_focal_length_is_no_rolling_shutter() -> None:
    camera = CAMERA.with_params(torch.cat([1.03 * CAMERA.params[:2], CAMERA.params[2:]]))
    assert estimated(adjusted(replace(recording(0.0), camera=camera))).description() == ""


def run_on(data_dir: Path, name: str, edit: Edit | None = None) -> Run:
    whole = open_sequence(data_dir / name)
    sequence = Edited(name, whole.camera, shots(whole, range(len(whole)), edit))
    return SLAM(whole.camera).run(sequence)


@pytest.mark.data
@pytest.mark.parametrize("wave_px", [0.0, 6.0])
def test_waves_in_real_images_are_named(data_dir: Path, wave_px: float) -> None:
    """The images of shelf_bin have none; here a sine along the rows shifts them."""
    said = rolling_shutter_remark(run_on(data_dir, "shelf_bin", rolling(wave_px)))
    assert ("the camera shakes" in said) if wave_px else said == ""


@pytest.mark.data
def test_the_rolling_shutter_of_a_kinect_is_named(data_dir: Path) -> None:
    """Its color camera reads an image in about 30 ms, of the 100 ms between two frames of this sequence."""
    finished = run_on(data_dir, "fr2_desk_20")
    found = find_rolling_shutter(finished.graph)
    assert found is not None
    assert found.is_read_out
    assert 0.2 < found.readout < 0.4
    assert not found.is_shaken
    assert rolling_shutter_remark(finished) == found.description()
    assert rolling_shutter_remark(replace(finished, interrupted=True)) == ""


def test_a_camera_at_rest_tells_nothing() -> None:
    graph = recording(0.0)
    still = graph.T_cw[:1].expand_as(graph.T_cw).contiguous()
    points_c = transform(still[graph.frame_index], graph.points_w[graph.point_index][:, None])
    pixels = CAMERA.project(points_c)[0][:, 0] + NOISE_PX * torch.sin(torch.arange(2.0)[None] + graph.pixels)
    found = estimated(replace(graph, T_cw=still, pixels=pixels))
    assert (found.readout, found.readout_std, found.is_read_out) == (0.0, math.inf, False)


def test_covariances_and_other_submaps_change_nothing() -> None:
    graph = recording(0.5)
    expected = estimated(graph)
    matrices = graph.weights[:, None, None] * torch.eye(2, dtype=torch.float64)
    assert vars(estimated(replace(graph, weights=matrices))) == pytest.approx(vars(expected), rel=1e-6)
    other = replace(recording(0.0, 1, frames=20), submap=torch.ones(20, dtype=torch.int64))
    both = concatenate_graphs([other, graph])
    assert vars(estimated(both)) == pytest.approx(vars(expected), rel=1e-6)


def test_too_few_frames_are_not_tested() -> None:
    assert find_rolling_shutter(recording(0.5, frames=13)) is None
    assert find_rolling_shutter(recording(0.5, frames=14)) is not None
    assert find_rolling_shutter(recording(0.5, frames=2)) is None
    assert find_rolling_shutter(recording(0.5, points=3)) is None


def test_velocities_are_those_of_a_constant_motion_without_gaps() -> None:
    twist = torch.tensor([0.01, -0.02, 0.03, 0.004, 0.005, -0.006], dtype=torch.float64)
    graph = recording(0.0, frames=20)
    T_cw = se3_exp(torch.arange(20)[:, None] * twist)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(1))
    times = torch.arange(20, dtype=torch.float64) / 25
    times[12:] += 0.1  # frames are missing
    graph = replace(graph, T_cw=T_cw[order], timestamps=times[order])
    velocities, known = image_interval_velocities(graph)
    expected = torch.ones(20, dtype=torch.bool)
    expected[[0, 11, 12, 19]] = False
    assert torch.equal(known, expected[order])
    torch.testing.assert_close(velocities[known], twist.expand(16, 6))
    assert not velocities[~known].any()


def test_the_projection_is_that_of_least_squares(generator: torch.Generator) -> None:
    derivatives = torch.randn(40, 2, 3, generator=generator, dtype=torch.float64)
    others = torch.randn(40, 2, 2, generator=generator, dtype=torch.float64)
    values = torch.randn(40, 2, 4, generator=generator, dtype=torch.float64)
    index, other = torch.arange(40) % 5, torch.arange(40) % 3
    columns = torch.zeros(40, 2, 21, dtype=torch.float64)
    for row in range(40):
        columns[row, :, 3 * int(index[row]) :][:, :3] = derivatives[row]
        columns[row, :, 15 + 2 * int(other[row]) :][:, :2] = others[row]
    matrix, flat = columns.flatten(0, 1), values.flatten(0, 1)
    expected = flat - matrix @ torch.linalg.lstsq(matrix, flat).solution
    found = project_out(values, [_Block.of(derivatives, index, 5), _Block.of(others, other, 3)])
    torch.testing.assert_close(found.flatten(0, 1), expected, rtol=1e-3, atol=1e-4)
