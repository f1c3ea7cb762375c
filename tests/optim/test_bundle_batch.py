"""Bundle adjustments in batches: what the problems alone would give, without work for what is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import vmap

from tests.optim.conftest import adjusted
from torchslam.geometry import se3_exp
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, CameraPrior, PosePrior, solve_bundle
from torchslam.optim.bundle import _dense
from torchslam.optim.bundle import _solve as minimization
from torchslam.optim.bundle._dense import DenseBundle
from torchslam.optim.bundle._problem import sanitized, select_moving

CONVERGED = {"iterations": 15, "tolerance": 0.0}
EQUAL = {"rtol": 1e-8, "atol": 1e-10}


def padded(tensor: Tensor, size: int, value: float) -> Tensor:
    return torch.cat((tensor, tensor.new_full((size - len(tensor), *tensor.shape[1:]), value)))


def batch_of(problems: Sequence[BundleProblem]) -> BundleProblem:
    """One problem of all, filled up with NaN."""
    sizes = {
        name: max(len(getattr(problem, name)) for problem in problems)
        for name in ("T_cw", "points_w", "pixels", "frame_index", "point_index")
    }
    stacked = {
        name: torch.stack(
            [padded(getattr(p, name), size, 0 if "index" in name else torch.nan) for p in problems]
        )
        for name, size in sizes.items()
    }
    mask = torch.stack([torch.arange(sizes["pixels"]) < len(problem.pixels) for problem in problems])
    weights = None
    if problems[0].weights is not None:
        weights = torch.stack([padded(p.weights, sizes["pixels"], -1.0) for p in problems])
    fixed_frames, fixed_points = (
        torch.stack([as_mask(getattr(p, name), size) for p in problems])
        for name, size in (("fixed_frames", sizes["T_cw"]), ("fixed_points", sizes["points_w"]))
    )
    return replace(
        problems[0],
        **stacked,
        weights=weights,
        mask=mask,
        fixed_frames=fixed_frames,
        fixed_points=fixed_points,
    )


def as_mask(rows: Sequence[int] | None, size: int) -> Tensor:
    mask = torch.zeros(size, dtype=torch.bool)
    mask[list(rows or ())] = True
    return mask


def assert_as_alone(
    batch: BundleProblem, problems: Sequence[BundleProblem], free_camera=False, **options
) -> None:
    settings = {"free_camera": free_camera, "options": BUNDLE_OPTIONS.replace(**options)}
    together = solve_bundle(batch, **settings)
    covariance = together.covariance()
    for row, problem in enumerate(problems):
        alone = solve_bundle(problem, **settings)
        frames, points = len(problem.T_cw), len(problem.points_w)
        torch.testing.assert_close(together.T_cw[row, :frames], alone.T_cw, **EQUAL)
        torch.testing.assert_close(together.points_w[row, :points], alone.points_w, **EQUAL)
        torch.testing.assert_close(together.cost[row], alone.cost, **EQUAL)
        if options.get("free_camera") is not None:
            torch.testing.assert_close(together.camera.params[row], alone.camera.params, rtol=1e-7, atol=1e-7)
        assert together.success[row] == alone.success
        assert torch.equal(together.moved_frames[row, :frames], alone.moved_frames)
        assert torch.equal(together.moved_points[row, :points], alone.moved_points)
        assert together.convergence.iterations[row] == alone.convergence.iterations[0]
        if not alone.success:
            continue
        expected = alone.covariance()
        torch.testing.assert_close(covariance.frames[row, :frames], expected.frames, rtol=1e-6, atol=1e-14)
        torch.testing.assert_close(covariance.points[row, :points], expected.points, rtol=1e-6, atol=1e-12)
        torch.testing.assert_close(covariance.camera[row], expected.camera, rtol=1e-5, atol=1e-10)


def mixed(bundle_scene, **options) -> list[BundleProblem]:
    """Problems of different sizes, with two, one or no fixed frame, or a fixed point."""
    return [
        bundle_scene(frames=5, points=30, seed=0, **options).problem,
        bundle_scene(frames=6, points=25, seed=1, fixed_frames=(0, 2), **options).problem,
        bundle_scene(frames=4, points=28, seed=2, fixed_frames=(), fixed_points=(1, 2, 7), **options).problem,
    ]


@pytest.mark.parametrize("grids", [True, False])
def test_a_batch_equals_a_loop_over_its_elements(bundle_scene, model, grids, monkeypatch):
    if not grids:
        monkeypatch.setattr(minimization, "suits_dense", lambda *_: False)
    problems = mixed(bundle_scene, model=model)
    assert_as_alone(batch_of(problems), problems, kernel="cauchy", scale=2.0)


def test_a_single_problem_that_suits_a_grid_is_solved_on_one(bundle_scene, monkeypatch):
    """With the same minimum, gradient and covariances; not if half of its cells are empty."""
    scene = bundle_scene(frames=5, points=30, fixed_frames=())
    found = []
    for most in (0, 1.5):
        monkeypatch.setattr(_dense, "_CELLS_PER_OBSERVATION_ALONE", most)
        pixels = scene.problem.pixels.clone().requires_grad_()
        problem = replace(scene.problem, pixels=pixels)
        given = sanitized(problem, 1.0)
        is_dense = minimization.suits_dense(given, select_moving(given))
        assert is_dense == (most > 0)
        solution = adjusted(problem, **CONVERGED)
        loss = solution.points_w.square().sum() + solution.T_cw[1, 0, 3]
        (gradient,) = torch.autograd.grad(loss, pixels)
        covariance = solution.covariance()
        found.append((solution.T_cw, solution.points_w, gradient, covariance.frames, covariance.points))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, **EQUAL)
    given = sanitized(bundle_scene(frames=9, points=30, visible=0.2).problem, 1.0)
    assert not minimization.suits_dense(given, select_moving(given))


def test_exact_data_are_solved_to_rounding(bundle_scene, model):
    """Alone and in a batch; steps after that would only shuffle it."""
    problems = [bundle_scene(noise=0.0, frames=f, seed=f, model=model).problem for f in (4, 5)]
    together = adjusted(batch_of(problems), iterations=100, tolerance=0.0)
    for row, problem in enumerate(problems):
        alone = adjusted(problem, iterations=100, tolerance=0.0)
        assert alone.convergence.converged
        assert together.convergence.converged[row]
        assert max(int(alone.convergence.iterations), int(together.convergence.iterations[row])) < 20
        assert float(alone.cost) < 1e-18
        torch.testing.assert_close(together.T_cw[row, : len(problem.T_cw)], alone.T_cw, rtol=0, atol=1e-9)


@pytest.mark.parametrize("fixed_frames", [(0,), ()])
def test_an_open_gauge_in_a_batch_equals_one_alone(bundle_scene, fixed_frames):
    problems = [
        bundle_scene(frames=5, points=30, seed=seed, fixed_frames=fixed_frames).problem for seed in (0, 1)
    ]
    problems.append(bundle_scene(frames=5, points=30, seed=2, fixed_frames=(0, 1)).problem)
    problems.append(bundle_scene(frames=7, points=30, seed=3, fixed_frames=fixed_frames).problem)
    assert_as_alone(batch_of(problems), problems)


@pytest.mark.parametrize("directions", [True, torch.tensor([[1.0], [1.1], [0.0], [0.0]]).double()])
def test_every_problem_estimates_its_own_camera(bundle_scene, directions):
    problems = [bundle_scene(frames=7, points=60, seed=seed).problem for seed in (0, 1)]
    batch = batch_of(problems)
    factors = torch.tensor([[0.97], [1.03]], dtype=torch.float64)
    camera = batch.camera.with_params(factors * batch.camera.params)
    alone = [replace(p, camera=camera[row]) for row, p in enumerate(problems)]
    assert_as_alone(replace(batch, camera=camera), alone, free_camera=directions, iterations=40)


@pytest.mark.parametrize("cameras", [2, 6])
@pytest.mark.parametrize("grids", [True, False])
def test_every_problem_estimates_its_several_cameras(bundle_scene, cameras, grids, monkeypatch):
    """Other cameras in each, one of which no frame may have."""
    if not grids:
        monkeypatch.setattr(minimization, "suits_dense", lambda *_: False)
    alone = [bundle_scene(frames=frames, points=60, seed=frames).problem for frames in (5, 6)]
    batch, eye = batch_of(alone), torch.eye(4, dtype=torch.float64)
    factors = 1 + 0.02 * torch.linspace(-1, 1, 2 * cameras, dtype=torch.float64).view(2, cameras, 1)
    params = factors * batch.camera.params
    prior = CameraPrior(params, 1e-2 * eye.expand(2, cameras, 4, 4))
    index = torch.stack((torch.arange(6), torch.arange(6).flip(0))) % cameras
    batch = replace(batch, camera=batch.camera.with_params(params), camera_index=index, camera_prior=prior)
    alone = [
        replace(
            problem,
            camera=batch.camera[row],
            camera_index=index[row, : len(problem.T_cw)],
            camera_prior=CameraPrior(prior.params[row], prior.information[row]),
        )
        for row, problem in enumerate(alone)
    ]
    assert_as_alone(batch, alone, kernel="cauchy", scale=2.0, free_camera=True, iterations=40)


def test_splitting_a_large_batch_does_not_change_the_result(bundle_scene, monkeypatch):
    problems = mixed(bundle_scene)
    monkeypatch.setattr(minimization, "_MAX_CELLS_CPU", 400)
    reported = []
    batch = batch_of(problems)
    options = BUNDLE_OPTIONS.replace(iterations=20)
    solve_bundle(batch, progress=lambda now, most: reported.append((now, most)), options=options)
    given = sanitized(batch, 1.0)
    assert len(minimization._parts(given, select_moving(given))) == 2
    assert reported == sorted(reported)
    assert {most for _, most in reported} == {60}
    assert_as_alone(batch, problems)


def test_converged_problems_are_not_iterated_further(bundle_scene, monkeypatch):
    """An element that starts at its minimum leaves after the first step; what is left is evaluated alone, but for the
    last step."""
    problems = [bundle_scene(seed=seed, noise=0.5).problem for seed in range(3)]
    done = adjusted(problems[1], iterations=50, tolerance=1e-14)
    problems[1] = replace(problems[1], T_cw=done.T_cw, points_w=done.points_w)
    sizes = []
    evaluate = DenseBundle.evaluate
    monkeypatch.setattr(
        DenseBundle, "evaluate", lambda self, at, near: sizes.append(len(near)) or evaluate(self, at, near)
    )
    solution = adjusted(batch_of(problems), tolerance=1e-8)
    iterations = solution.convergence.iterations
    assert iterations[1] == 1
    assert solution.convergence.converged.all()
    assert sizes[:3] == [3, 3, 2]
    assert sum(sizes) == 3 + int(iterations.sum()) - 1


def test_a_failed_problem_does_not_affect_the_others(bundle_scene):
    """A non-finite frame and two maps without a common point leave a valid problem unaffected."""
    problems = [bundle_scene(frames=6, points=60, visible=1.0, seed=seed).problem for seed in range(3)]
    T_cw = problems[1].T_cw.clone()
    T_cw[3, 0, 3] = torch.nan
    problems[1] = replace(problems[1], T_cw=T_cw)
    apart = (problems[2].frame_index < 3) == (problems[2].point_index < 30)
    names = ("frame_index", "point_index", "pixels")
    problems[2] = replace(problems[2], **{name: getattr(problems[2], name)[apart] for name in names})
    batch = batch_of(problems)
    pixels = batch.pixels.clone().requires_grad_()
    solution = solve_bundle(replace(batch, pixels=pixels))
    assert solution.success.tolist() == [True, False, False]
    assert solve_bundle(batch, check=False).success.tolist() == [True, False, True]
    assert solution.T_cw.isfinite().all()
    assert solution.points_w.isfinite().all()
    (solution.T_cw.sum() + solution.points_w.sum()).backward()
    assert pixels.grad.isfinite().all()
    assert (pixels.grad[1:] == 0).all()
    expected = problems[0].pixels.clone().requires_grad_()
    alone = solve_bundle(replace(problems[0], pixels=expected))
    (alone.T_cw.sum() + alone.points_w.sum()).backward()
    torch.testing.assert_close(pixels.grad[0, : len(expected)], expected.grad, **EQUAL)


def test_a_point_seen_twice_in_a_frame_counts_twice(bundle_scene):
    problems = [bundle_scene(seed=seed).problem for seed in (0, 1)]
    twice = [
        replace(
            problem,
            frame_index=torch.cat((problem.frame_index, problem.frame_index[:4])),
            point_index=torch.cat((problem.point_index, problem.point_index[:4])),
            pixels=torch.cat((problem.pixels, problem.pixels[:4] + 2.0)),
        )
        for problem in problems
    ]
    assert_as_alone(batch_of(twice), twice)


@pytest.mark.parametrize("backward", ["implicit", "unroll", "truncated"])
def test_gradients_of_a_batch_equal_those_of_a_loop(bundle_scene, backward):
    problems = mixed(bundle_scene, noise=1.0)
    batch = batch_of(problems)

    def gradient(problem: BundleProblem) -> Tensor:
        pixels = problem.pixels.clone().requires_grad_()
        solution = adjusted(replace(problem, pixels=pixels), kernel="cauchy", scale=2.0, backward=backward)
        loss = (solution.points_w * torch.tensor([0.3, -0.5, 0.7], dtype=torch.float64)).nansum()
        (loss + solution.T_cw[..., :3, :].nansum()).backward()
        return pixels.grad

    found = gradient(batch)
    for row, problem in enumerate(problems):
        expected = gradient(problem)
        torch.testing.assert_close(found[row, : len(expected)], expected, rtol=1e-6, atol=1e-9)
        assert (found[row, len(expected) :] == 0).all()


@pytest.mark.parametrize("free_camera", [pytest.param(False, marks=pytest.mark.slow), True])
def test_gradients_of_a_batch_by_gradcheck(bundle_scene, generator, free_camera):
    """To all that may have a gradient, two cameras, priors, and rows that do not count among it."""
    scenes = [bundle_scene(frames=5, points=14, noise=1.0, perturbation=1e-3, seed=seed) for seed in (0, 3)]
    batch = batch_of([scene.problem for scene in scenes])
    batch = replace(
        batch,
        camera=batch.camera.with_params(batch.camera.params.expand(2, 4)),
        camera_index=torch.tensor([0, 0, 1, 0, 1]),
        mask=batch.mask & (torch.rand(batch.mask.shape, generator=generator) < 0.95),
    )
    weights = 0.5 + torch.rand(batch.mask.shape, generator=generator, dtype=torch.float64)
    scale, twist = torch.tensor([2.0, 3.0]).double(), torch.zeros(2, 5, 6, dtype=torch.float64)
    information = (
        100
        * torch.eye(6, dtype=torch.float64).expand(2, 5, 6, 6)
        * torch.tensor([1.0, 1, 1, 0, 0], dtype=torch.float64).view(5, 1, 1)
    )
    tight = 0.1 * torch.eye(4, dtype=torch.float64).expand(2, 2, 4, 4)
    params = batch.camera.params.expand(2, 2, 4)

    def solve(pixels, weights, params, scale, twist, information, mean, tight):
        T_cw = se3_exp(twist) @ batch.T_cw
        moved = replace(
            batch,
            T_cw=torch.cat((T_cw[:, :2], batch.T_cw[:, 2:]), dim=1),
            pixels=pixels,
            weights=weights,
            camera=batch.camera.with_params(params),
            pose_prior=PosePrior(T_cw, 0.5 * (information + information.mT)),
            camera_prior=CameraPrior(mean, 0.5 * (tight + tight.mT)),
        )
        solution = adjusted(moved, free_camera=free_camera, kernel="cauchy", scale=scale, **CONVERGED)
        return solution.T_cw[..., :3, :], solution.points_w, solution.camera.params

    pixels = torch.where(batch.pixels.isnan(), 7.0, batch.pixels)
    inputs = (pixels, weights, params, scale, twist, information, params - 2.0, tight)
    leaves = [x.clone().requires_grad_(not (free_camera and index == 2)) for index, x in enumerate(inputs)]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)
    if not free_camera:
        solution = solve_bundle(replace(batch, pixels=leaves[0]))
        solution.points_w.sum().backward()
        assert (leaves[0].grad[~batch.mask] == 0).all()


def test_dtype_and_device_of_a_batch(bundle_scene, dtype, device):
    scenes = [bundle_scene(frames=6, points=60, seed=seed) for seed in (0, 1)]
    batch = batch_of([scene.problem for scene in scenes])
    moved = {name: getattr(batch, name).to(device, dtype) for name in ("T_cw", "points_w", "pixels")}
    kept = ("frame_index", "point_index", "mask", "fixed_frames", "fixed_points")
    moved |= {name: getattr(batch, name).to(device) for name in kept}
    solution = solve_bundle(replace(batch, **moved, camera=batch.camera.to(device).to(dtype)))
    assert solution.success.all()
    for tensor in (solution.T_cw, solution.points_w, solution.cost, solution.covariance().points):
        assert tensor.dtype == dtype
        assert tensor.device.type == device.type
    for row, scene in enumerate(scenes):
        torch.testing.assert_close(solution.T_cw[row].cpu().double(), scene.T_cw, atol=0.03, rtol=0)


@pytest.mark.usefixtures("without_shape_checks")
def test_an_invalid_batch_is_rejected_by_name(bundle_scene):
    problems = [bundle_scene(seed=seed).problem for seed in (0, 1)]
    batch = batch_of(problems)
    with pytest.raises(ValueError, match=r"camera.params must be \(P,\) = \(4,\), not \(3, 4\)"):
        solve_bundle(replace(batch, camera=batch.camera.with_params(torch.ones(3, 4).double())))
    with pytest.raises(ValueError, match=r"points_w must be .*: ... is \(0,\) in problem.T_cw"):
        solve_bundle(replace(batch, T_cw=batch.T_cw[:0]))


def test_vmap_over_batches(bundle_scene):
    batch = batch_of([bundle_scene(seed=seed).problem for seed in (0, 1)])
    pixels = torch.stack([batch.pixels, batch.pixels + 0.3])

    def points(pixels: Tensor) -> Tensor:
        return solve_bundle(replace(batch, pixels=pixels)).points_w

    expected = torch.stack([points(pixels[0]), points(pixels[1])])
    torch.testing.assert_close(vmap(points)(pixels), expected, **EQUAL)
