"""Rolling shutters: known ones are found with their size, and none where there is none."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rolling_scene import CAMERA, FRAME_RATE, NOISE_PX, recording

from tests.optim.conftest import solved_graph
from torchslam.geometry import transform
from torchslam.geometry.rolling_shutter import Readout
from torchslam.optim.model_choice import LEAST_GAIN, Gain
from torchslam.optim.observation_graph import ObservationGraph, concatenate_graphs
from torchslam.optim.rolling_shutter import (
    RollingShutter,
    ShakingTest,
    _Block,
    find_rolling_shutter,
    project_out,
    readout_by,
)


def estimated(graph: ObservationGraph) -> RollingShutter:
    found = find_rolling_shutter(graph)
    assert found is not None
    return found


def numbers(found: RollingShutter) -> dict[str, float]:
    """All numbers of a result."""
    own = {name: value for name, value in vars(found).items() if name != "gain"}
    return own | {f"gain.{name}": value for name, value in vars(found.gain).items()}


def adjusted(graph: ObservationGraph) -> ObservationGraph:
    """As a run leaves it: poses and points have absorbed what they can."""
    solution = solved_graph(graph, backward="detached")
    return replace(graph, T_cw=solution.T_cw, points_w=solution.points_w)


@pytest.mark.parametrize("readout", [0.3, 0.9, -0.6])
def test_the_readout_is_found_in_an_adjusted_graph(readout: float) -> None:
    found = estimated(adjusted(recording(readout)))
    assert found.interval == pytest.approx(1 / FRAME_RATE)
    assert found.is_read_out
    error = found.readout * FRAME_RATE - readout
    assert abs(error) < 0.1 * abs(readout)
    assert abs(error) < 4 * found.readout_std * FRAME_RATE + 0.04 * abs(readout)
    assert found.readout_std * FRAME_RATE < 0.05


@pytest.mark.parametrize("start", [0.5, 0.9])
def test_a_known_readout_is_improved(start: float) -> None:
    """The second test starts where the first one ended, with keypoints that are corrected by it."""
    graph = replace(adjusted(recording(0.9)), readout=Readout.known(start / FRAME_RATE, 0.01))
    solution = solved_graph(graph, backward="detached")
    found = estimated(replace(graph, T_cw=solution.T_cw, points_w=solution.points_w))
    assert found.readout * FRAME_RATE == pytest.approx(0.9, abs=0.04)


def test_the_gain_is_over_a_global_shutter_whatever_the_graph_has() -> None:
    """A readout that corrects the keypoints already does not make the evidence for it disappear."""
    graph = adjusted(recording(0.9))
    first = estimated(graph)
    again = estimated(replace(graph, readout=Readout.known(0.9 / FRAME_RATE, 0.01)))
    assert first.is_read_out
    assert again.is_read_out
    assert again.gain.total > 0.5 * first.gain.total > LEAST_GAIN
    unsure = replace(first, gain=Gain(LEAST_GAIN - 1, 1.0, 10))
    assert not unsure.is_read_out
    assert replace(first, gain=Gain(LEAST_GAIN + 1, 1.0, 10)).is_read_out


def test_a_global_shutter_is_not_named() -> None:
    found = estimated(adjusted(recording(0.0)))
    assert not found.is_read_out
    assert not found.is_shaken


def test_a_test_of_fewer_frames_says_the_same_of_the_readout() -> None:
    graph = adjusted(recording(0.9))
    whole, quick = estimated(graph), find_rolling_shutter(graph, 20, shaking=ShakingTest.NEVER)
    assert quick is not None
    assert quick.is_read_out
    assert quick.readout * FRAME_RATE == pytest.approx(0.9, abs=0.09)
    assert math.isnan(quick.by_row)
    assert not quick.is_shaken
    same = find_rolling_shutter(graph, shaking=ShakingTest.NEVER)
    assert same is not None
    assert (same.readout, same.readout_std) == (whole.readout, whole.readout_std)
    assert find_rolling_shutter(graph, shaking=ShakingTest.UNLESS_READ_OUT) == same


def test_shaking_is_tested_where_no_readout_is_found() -> None:
    graph = adjusted(recording(0.0))
    assert find_rolling_shutter(graph, shaking=ShakingTest.UNLESS_READ_OUT) == estimated(graph)


def test_a_readout_is_what_was_given_or_what_residuals_show() -> None:
    """One that is given is improved by any evidence; one that is sought needs a rolling shutter."""
    shown, unsure = estimated(recording(0.9)), estimated(adjusted(recording(0.0)))
    sought, given = Readout.known(0.0, 0.2), Readout.known(0.03, 0.001)
    assert (sought.is_sought, sought.is_given) == (True, False)
    assert (given.is_sought, given.is_given) == (False, True)
    assert not Readout.known(0.0, 0.0).is_sought
    assert readout_by(None, sought) is readout_by(unsure, sought) is None
    assert readout_by(None, given) is given
    for found, known in ((shown, sought), (shown, given), (unsure, given)):
        assert readout_by(found, known) == known.updated(found.readout, found.readout_std)


def test_more_than_a_frame_interval_is_no_readout() -> None:
    found = estimated(recording(0.9))
    assert found.is_read_out
    assert not replace(found, readout=1.3 * found.interval).is_read_out


@settings(max_examples=8, deadline=None)
@given(st.integers(1, 10_000), st.sampled_from([0.0, 0.25, 0.8]))
def test_random_motions_tell_the_readout_within_its_error(seed: int, readout: float) -> None:
    found = estimated(recording(readout, seed))
    error = found.readout * FRAME_RATE - readout
    assert abs(error) < 6 * found.readout_std * FRAME_RATE + 0.05 * readout
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


def test_a_wrong_focal_length_is_no_rolling_shutter() -> None:
    camera = CAMERA.with_params(torch.cat([1.03 * CAMERA.params[:2], CAMERA.params[2:]]))
    found = estimated(adjusted(replace(recording(0.0), camera=camera)))
    assert not found.is_read_out
    assert not found.is_shaken


def test_a_camera_at_rest_tells_nothing() -> None:
    graph = recording(0.0)
    still = graph.T_cw[:1].expand_as(graph.T_cw).contiguous()
    points_c = transform(still[graph.frame_index], graph.points_w[graph.point_index][:, None])
    pixels = CAMERA.project(points_c)[0][:, 0] + NOISE_PX * torch.sin(torch.arange(2.0)[None] + graph.pixels)
    found = estimated(replace(graph, T_cw=still, pixels=pixels))
    assert (found.readout, found.readout_std, found.is_read_out) == (0.0, math.inf, False)


def test_covariances_and_other_submaps_change_nothing() -> None:
    graph = recording(0.5)
    expected = numbers(estimated(graph))
    matrices = graph.weights[:, None, None] * torch.eye(2, dtype=torch.float64)
    assert numbers(estimated(replace(graph, weights=matrices))) == pytest.approx(expected, rel=1e-6)
    other = replace(recording(0.0, 1, frames=20), submap=torch.ones(20, dtype=torch.int64))
    both = concatenate_graphs([other, graph])
    assert numbers(estimated(both)) == pytest.approx(expected, rel=1e-6)


def test_too_few_frames_are_not_tested() -> None:
    assert find_rolling_shutter(recording(0.5, frames=13)) is None
    assert find_rolling_shutter(recording(0.5, frames=14)) is not None
    assert find_rolling_shutter(recording(0.5, frames=2)) is None
    assert find_rolling_shutter(recording(0.5, points=3)) is None


def test_the_projection_is_that_of_least_squares(generator: torch.Generator) -> None:
    derivatives = torch.randn(40, 2, 3, generator=generator, dtype=torch.float64)
    others, shared = torch.randn(2, 40, 2, 2, generator=generator, dtype=torch.float64)
    values = torch.randn(40, 2, 4, generator=generator, dtype=torch.float64)
    index, other = torch.arange(40) % 5, torch.arange(40) % 3
    columns = torch.zeros(40, 2, 23, dtype=torch.float64)
    columns[..., 21:] = shared
    for row in range(40):
        columns[row, :, 3 * int(index[row]) :][:, :3] = derivatives[row]
        columns[row, :, 15 + 2 * int(other[row]) :][:, :2] = others[row]
    matrix, flat = columns.flatten(0, 1), values.flatten(0, 1)
    expected = flat - matrix @ torch.linalg.lstsq(matrix, flat).solution
    all_same = _Block.of(shared, torch.zeros_like(index), 1)
    found = project_out(values, [_Block.of(derivatives, index, 5), _Block.of(others, other, 3), all_same])
    torch.testing.assert_close(found.flatten(0, 1), expected, rtol=1e-3, atol=1e-4)
