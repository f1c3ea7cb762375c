"""Measurements from outside in an observation graph: whitened errors, gradients of the whole, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch import Tensor
from torch.autograd import gradcheck

from tests.metric.drifting import CAMERA, drifting_submap
from torchslam.errors import TorchslamError
from torchslam.geometry import se3_exp, se3_inverse, transform
from torchslam.metric.drift import GAUGE_SHARE
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.measurements import MeasuredLengths, MeasuredPositions, fixed_point_error
from torchslam.optim.run_graph import RunGraph, concatenate_graphs, solve_graph, solve_graphs

CONVERGED = GRAPH_OPTIONS.replace(iterations=200, tolerance=1e-20)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def measured_rows(count: int = 5) -> Tensor:
    """Displacements, the last one a position."""
    measured = draw(count, 4, 3, seed=1)
    measured[:, 3] = 1.0
    measured[-1, 3] = 0.0
    return measured


def wandering(times: Tensor, white: float = 0.2, strength: float = 1.0, duration: float = 5.0) -> Tensor:
    """Inverse covariances of white noise and noise that wanders."""
    apart = (times[:, None] - times).abs()
    slow = (strength * white) ** 2 * torch.exp(-apart / duration)
    return torch.linalg.inv(slow + white**2 * torch.eye(len(times), dtype=torch.float64)).repeat(3, 1, 1)


@pytest.fixture(scope="module")
def graph() -> RunGraph:
    submap, _, _ = drifting_submap(count=8)
    return submap.posed_frames.graph(submap.map, CAMERA)


def positions_on(graph: RunGraph, factor: float = 1.0) -> MeasuredPositions:
    """Positions of an antenna a meter beside every keyframe, a little off, in a unit of one `factor`."""
    rows = torch.nonzero(graph.is_keyframe)[:, 0]
    points_c = torch.tensor((1.0, -0.5, 0.3), dtype=torch.float64) + 0.1 * draw(len(rows), 3)
    at_w = transform(se3_inverse(graph.T_cw[rows]), points_c[:, None])[:, 0]
    positions_w = factor * at_w + 0.1 * draw(len(rows), 3, seed=2)
    return MeasuredPositions(rows, factor * points_c, positions_w, wandering(graph.timestamps[rows]))


def lengths_on(graph: RunGraph, factor: float = 1.0) -> MeasuredLengths:
    frames = torch.tensor([(0, 2), (1, 4), (3, 7)])
    ends_w = se3_inverse(graph.T_cw[frames])[..., :3, 3]
    lengths = factor * (ends_w[:, 1] - ends_w[:, 0]).norm(dim=-1)
    return MeasuredLengths(frames, lengths * (1 + 0.01 * draw(3)), torch.full((3,), 1e4).double())


def test_the_error_has_right_derivatives() -> None:
    T_1w, T_2w, measured = (
        se3_exp(0.3 * draw(5, 6, seed=2)),
        se3_exp(0.3 * draw(5, 6, seed=3)),
        measured_rows(),
    )
    steps = torch.zeros(2, 5, 6, dtype=torch.float64, requires_grad=True)

    def error(steps: Tensor, measured: Tensor) -> Tensor:
        return fixed_point_error(se3_exp(steps[0]) @ T_1w, se3_exp(steps[1]) @ T_2w, measured)

    assert gradcheck(error, (steps, measured.requires_grad_()), atol=1e-6)
    measured = measured.detach()
    at_w = transform(se3_inverse(T_2w), measured[:, 2, None])[:, 0]
    torch.testing.assert_close(error(steps, measured)[-1], at_w[-1] - measured[-1, 0])
    from_w = transform(se3_inverse(T_1w), measured[:, 1, None])[:, 0]
    torch.testing.assert_close(error(steps, measured)[:4], (at_w - from_w - measured[:, 0])[:4])
    together = fixed_point_error(T_1w, T_2w, measured)
    for row in range(5):
        torch.testing.assert_close(fixed_point_error(T_1w[row], T_2w[row], measured[row]), together[row])


@pytest.mark.parametrize("duration", [0.5, 5.0, 1e3])
def test_positions_and_displacements_sum_up_to_the_whitened_errors(graph: RunGraph, duration: float) -> None:
    measured = positions_on(graph)
    measured = replace(measured, information=wandering(graph.timestamps[measured.frames], duration=duration))
    factors = measured.factors()
    T_cw = se3_exp(0.05 * draw(len(graph.T_cw), 6, seed=4)) @ graph.T_cw
    errors = factors.error(T_cw[factors.frames[:, 0]], T_cw[factors.frames[:, 1]], factors.measured)
    found = 0.5 * torch.einsum("fi,fij,fj->", errors, factors.information, errors)
    torch.testing.assert_close(found, measured.cost(T_cw), rtol=1e-2, atol=0.0)
    assert bool((torch.linalg.eigvalsh(factors.information) >= 0).all())
    # With white noise alone there are no displacements.
    white = replace(measured, information=25 * torch.eye(len(measured.frames)).double().repeat(3, 1, 1))
    assert len(white.factors().frames) == len(measured.frames)


@pytest.mark.parametrize("kind", [positions_on, lengths_on])
def test_the_gradient_of_the_whole_reaches_what_was_measured(graph: RunGraph, kind: object) -> None:
    """Against differences of solving again; for a loss that depends on the unit."""
    measured = kind(graph, 1.1)  # type: ignore[operator]
    name = "positions_w" if isinstance(measured, MeasuredPositions) else "lengths"

    def loss(values: Tensor) -> Tensor:
        with_measured = replace(graph, measurements=(replace(measured, **{name: values}),))
        solution = solve_graph(with_measured, options=CONVERGED)
        assert bool(solution.success[graph.is_keyframe].all())
        centers_w = se3_inverse(solution.T_cw)[:, :3, 3]
        return (centers_w - centers_w[0]).square().sum()

    values = getattr(measured, name).clone().requires_grad_()
    at = loss(values)
    (gradient,) = torch.autograd.grad(at, values)
    direction = draw(*values.shape, seed=7)
    step = 1e-4
    with torch.no_grad():
        difference = (loss(values + step * direction) - loss(values - step * direction)) / (2 * step)
    assert float(gradient.abs().max()) > 0
    torch.testing.assert_close((gradient * direction).sum(), difference, rtol=1e-5, atol=1e-8)


def test_a_little_information_determines_the_unit_and_bends_nothing(graph: RunGraph) -> None:
    shape = solve_graph(graph, options=CONVERGED)
    measured = positions_on(graph, 1.1)
    unit = torch.ones((), dtype=torch.float64, requires_grad=True)
    weak = replace(
        measured, points_c=unit * measured.points_c, positions_w=unit * measured.positions_w
    ).weighed(GAUGE_SHARE)
    solution = solve_graph(replace(graph, measurements=(weak,)), options=CONVERGED)

    def distances(T_cw: Tensor) -> Tensor:
        return torch.pdist(se3_inverse(T_cw)[:, :3, 3])

    ratios = distances(solution.T_cw) / distances(shape.T_cw)
    assert abs(float(ratios.detach().mean()) - 1.1) < 0.03
    assert float(ratios.detach().std()) < 1e-4
    # Of measurements in another unit the map has another unit.
    (gradient,) = torch.autograd.grad(ratios.mean().log(), unit)
    assert float(gradient) == pytest.approx(1.0, abs=1e-4)


def test_measurements_are_kept_in_files_and_in_joined_graphs(graph: RunGraph, tmp_path: Path) -> None:
    own = positions_on(graph), lengths_on(graph)
    whole = replace(graph, measurements=own)
    whole.save(tmp_path / "graph")
    loaded = RunGraph.load(tmp_path / "graph")
    assert len(loaded.measurements) == 2
    for before, after in zip(own, loaded.measurements, strict=True):
        assert type(after) is type(before)
        torch.testing.assert_close(after.cost(graph.T_cw), before.cost(graph.T_cw))
    other = replace(graph, submap=graph.submap + 1)
    joined = concatenate_graphs([other, whole])
    for before, after in zip(own, joined.measurements, strict=True):
        assert torch.equal(after.frames, before.frames + len(graph.T_cw))
    together = solve_graphs([whole, graph])
    torch.testing.assert_close(together[0].T_cw, solve_graph(whole).T_cw)
    torch.testing.assert_close(
        solve_graph(joined).T_cw[len(graph.T_cw) :], together[0].T_cw, atol=1e-6, rtol=0
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frames", torch.full((8,), 99)),
        ("positions_w", torch.full((8, 3), torch.nan).double()),
        ("information", torch.ones(3, 8, 7).double()),
    ],
)
def test_damaged_measurements_are_refused(graph: RunGraph, tmp_path: Path, name: str, value: Tensor) -> None:
    replace(graph, measurements=(positions_on(graph),)).save(tmp_path / "graph")
    with safetensors.safe_open(str(tmp_path / "graph"), framework="pt") as file:
        metadata, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    tensors[f"measured.0.positions.{name}"] = value
    safetensors.torch.save_file(tensors, tmp_path / "graph", metadata)
    with pytest.raises(TorchslamError, match="is not an observation graph"):
        RunGraph.load(tmp_path / "graph")
