"""The NumPy backend of the dense formulation against `solve_bundle`: the sparse one, and its PyTorch backend."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.optim.conftest import adjusted, only
from torchslam.geometry import se3_inverse, se3_log
from torchslam.optim import BundleProblem, BundleSolution
from torchslam.optim.bundle._dense import suits_dense
from torchslam.optim.bundle._problem import sanitized, select_moving
from torchslam.optim.bundle.dense_numpy import NumpyBundleSolution, solve_bundle_numpy

SCALE = 2.0  # of the kernel


def both(
    problem: BundleProblem, iterations: int = 30, tolerance: float = 1e-10
) -> tuple[NumpyBundleSolution, BundleSolution]:
    wanted = adjusted(
        problem,
        check=False,
        kernel="huber",
        scale=SCALE,
        iterations=iterations,
        tolerance=tolerance,
        backward="detached",
    )
    return solve_bundle_numpy(problem, SCALE, iterations, tolerance), wanted


def with_outliers(problem: BundleProblem, every: int = 9) -> BundleProblem:
    """With observations that are far off."""
    off = torch.arange(len(problem.pixels)) % every == 0
    pixels = problem.pixels + 30 * off[:, None] * torch.tensor([1.0, -0.7]).double()
    return replace(problem, pixels=pixels)


def weights_of(problem: BundleProblem, kind: str) -> Tensor | None:
    rows = torch.arange(len(problem.pixels)).double()
    if kind == "none":
        return None
    scalar = 0.5 + rows % 3
    if kind == "numbers":
        return scalar
    root = torch.tensor([[1.0, 0.3], [0.0, 0.8]]).double() * scalar.sqrt()[:, None, None]
    return root.mT @ root


def assert_same(found: NumpyBundleSolution, wanted: BundleSolution, atol: float = 1e-8) -> None:
    torch.testing.assert_close(found.T_cw, wanted.T_cw, rtol=0, atol=atol)
    torch.testing.assert_close(found.points_w, wanted.points_w, rtol=0, atol=10 * atol)
    assert found.cost == pytest.approx(float(wanted.cost), rel=1e-6)


@pytest.mark.parametrize("fixed", [(0, 1), (2, 0), (0,), ()])
@pytest.mark.parametrize(("frames", "points"), [(3, 12), (6, 60), (12, 150)])
@pytest.mark.parametrize("iterations", [2, 30])
def test_both_backends_of_the_dense_formulation_agree(
    bundle_scene, frames, points, fixed, iterations
) -> None:
    """A batch of two for PyTorch, one after the other for NumPy: after two steps, and at the minimum."""
    first = with_outliers(bundle_scene(frames, points, fixed_frames=fixed).problem)
    first = replace(first, weights=weights_of(first, "numbers"))
    noise = torch.randn(first.pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    problems = [first, replace(first, pixels=first.pixels + 0.3 * noise)]
    names = ("T_cw", "points_w", "pixels")
    batch = replace(first, **{name: torch.stack([getattr(p, name) for p in problems]) for name in names})
    given = sanitized(batch, SCALE)
    assert suits_dense(given, select_moving(given))
    together = adjusted(
        batch,
        check=False,
        kernel="huber",
        scale=SCALE,
        iterations=iterations,
        tolerance=1e-12,
        backward="detached",
    )
    for row, problem in enumerate(problems):
        found = solve_bundle_numpy(problem, SCALE, iterations, 1e-12)
        assert_same(found, together.element(row, frames, points), atol=1e-9)


@pytest.mark.parametrize("weights", ["none", "numbers", "matrices"])
@pytest.mark.parametrize("fixed", [(0, 1), (0,), (3, 1), ()])
def test_it_reaches_the_solution_of_solve_bundle(bundle_scene, fixed, weights) -> None:
    """Whatever is fixed: what that leaves open stays where it is, in the same sense."""
    problem = with_outliers(bundle_scene(frames=6, points=60, fixed_frames=fixed).problem)
    problem = replace(problem, weights=weights_of(problem, weights))
    found, wanted = both(problem)
    assert bool(wanted.success)
    assert_same(found, wanted, atol=1e-7)
    assert torch.equal(found.T_cw[list(fixed)], problem.T_cw[list(fixed)])


def test_the_predicted_decrease_equals_that_of_solve_bundle(bundle_scene) -> None:
    """So that both stop together, whatever the tolerance."""
    problem = with_outliers(bundle_scene(frames=6, points=60, perturbation=0.03).problem)
    costs = set()
    for power in range(30):
        found, wanted = both(problem, 30, 0.3 * 0.64**power)
        assert found.cost == pytest.approx(float(wanted.cost), rel=1e-9)
        costs.add(found.cost)
    assert len(costs) > 4


def test_distortion_is_linearized_at_the_keypoint(bundle_scene, model) -> None:
    """Errors of pixels are small enough for the slope at the keypoint."""
    problem = bundle_scene(frames=6, points=80, model=model).problem
    found, wanted = both(problem)
    moved = float(se3_log(wanted.T_cw @ se3_inverse(problem.T_cw)).norm(dim=-1).max())
    off = float(se3_log(found.T_cw @ se3_inverse(wanted.T_cw)).norm(dim=-1).max())
    assert off < (1e-7 if model == "pinhole" else 0.02 * moved)


def test_points_behind_a_camera_have_no_gradient(bundle_scene) -> None:
    scene = bundle_scene(frames=6, points=60, noise=0.1)
    points_w = scene.problem.points_w.clone()
    points_w[:3, 2] = -4.0
    problem = replace(scene.problem, points_w=points_w)
    found, wanted = both(problem)
    assert_same(found, wanted)
    assert torch.equal(found.points_w[:3], points_w[:3])
    assert float(se3_log(found.T_cw @ se3_inverse(scene.T_cw)).norm(dim=-1).max()) < 0.01


def test_unobserved_frames_and_points_do_not_move(bundle_scene) -> None:
    problem = bundle_scene(frames=7, points=50).problem
    unobserved = torch.tensor([11, 49])
    seen = (problem.frame_index != 4) & ~torch.isin(problem.point_index, unobserved)
    problem = only(problem, seen)
    found, wanted = both(problem)
    assert_same(found, wanted)
    assert torch.equal(found.T_cw[4], problem.T_cw[4])
    assert torch.equal(found.points_w[unobserved], problem.points_w[unobserved])


def test_points_alone_can_be_adjusted(bundle_scene) -> None:
    found, wanted = both(bundle_scene(frames=4, points=20, fixed_frames=(0, 1, 2, 3)).problem)
    assert_same(found, wanted)


def test_the_order_of_the_inputs_does_not_matter(bundle_scene) -> None:
    problem = with_outliers(bundle_scene(frames=6, points=60).problem)
    order = torch.randperm(len(problem.pixels), generator=torch.Generator().manual_seed(0))
    shuffled = only(problem, order)
    one, other = (solve_bundle_numpy(each, SCALE, 10, 1e-10) for each in (problem, shuffled))
    torch.testing.assert_close(one.T_cw, other.T_cw, rtol=0, atol=1e-10)
    torch.testing.assert_close(one.points_w, other.points_w, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("name", "size"), [("frame_index", 5), ("point_index", 30)])
@pytest.mark.parametrize("wrong", [-1, 30])
def test_an_index_out_of_range_is_an_error(bundle_scene, name, size, wrong) -> None:
    problem = bundle_scene().problem
    index = getattr(problem, name).clone()
    index[3] = wrong
    with pytest.raises(ValueError, match=rf"{name} must lie in 0 \.\.\. {size - 1}"):
        solve_bundle_numpy(replace(problem, **{name: index}), SCALE, 1, 1e-6)


@pytest.mark.parametrize("name", ["fixed_points", "mask", "camera_index", "batch"])
def test_unsupported_problems_are_an_error(bundle_scene, name) -> None:
    problem = bundle_scene().problem
    rows = torch.zeros(len(problem.T_cw), dtype=torch.int64)
    given = {"mask": problem.frame_index > 0, "camera_index": rows, "fixed_points": rows[:1]}
    if name == "batch":
        problem = replace(problem, T_cw=problem.T_cw[None])
    else:
        problem = replace(problem, **{name: given[name]})
    with pytest.raises(ValueError, match=r"the NumPy backend takes one problem without .*: use solve_bundle"):
        solve_bundle_numpy(problem, SCALE, 1, 1e-6)


def test_the_dtype_of_the_inputs_is_kept(bundle_scene, device) -> None:
    problem = bundle_scene().problem
    single = BundleProblem(
        *(tensor.to(device, torch.float32) for tensor in (problem.T_cw, problem.points_w)),
        problem.frame_index.to(device),
        problem.point_index.to(device),
        problem.pixels.to(device, torch.float32),
        problem.camera.to(torch.float32).to(device),
        fixed_frames=torch.tensor([0, 1], device=device),
    )
    found, exact = solve_bundle_numpy(single, SCALE, 10, 1e-6), solve_bundle_numpy(problem, SCALE, 10, 1e-6)
    assert found.T_cw.dtype == found.points_w.dtype == torch.float32
    assert found.T_cw.device.type == device.type
    torch.testing.assert_close(found.T_cw.cpu().double(), exact.T_cw, rtol=0, atol=1e-4)
