from dataclasses import replace

import pytest
import torch

from tests.optim.conftest import adjusted, only
from torchslam.geometry import se3_exp, se3_inverse, se3_log, umeyama
from torchslam.optim import solve_bundle
from torchslam.optim.bundle import _sparse
from torchslam.optim.bundle._sparse import SparseBundle

CONVERGED = {"iterations": 25, "tolerance": 0.0}


def test_exact_data_gives_the_exact_map(bundle_scene, model):
    scene = bundle_scene(noise=0.0, model=model)
    solution = adjusted(scene.problem, kernel="none")
    assert solution.success
    assert solution.convergence.converged
    torch.testing.assert_close(solution.T_cw, scene.T_cw, atol=1e-8, rtol=0)
    torch.testing.assert_close(solution.points_w, scene.points_w, atol=1e-7, rtol=0)


def test_free_camera_finds_the_intrinsics(bundle_scene, model):
    scene = bundle_scene(frames=8, points=80, noise=0.0, model=model)
    camera = scene.problem.camera
    off = camera.params.clone()
    off[:2] *= 1.05
    off[4:] *= 0.5
    problem = replace(scene.problem, camera=camera.with_params(off))
    solution = adjusted(problem, free_camera=True, kernel="none", iterations=60, tolerance=1e-14)
    torch.testing.assert_close(solution.camera.params, camera.params, atol=1e-4, rtol=1e-4)


def test_camera_that_moves_in_some_directions_alone(bundle_scene):
    """The focal length comes back, its ratio and all else stay; every direction is as good as no directions."""
    scene = bundle_scene(frames=8, points=80, noise=0.0)
    camera = scene.problem.camera
    along = torch.cat((camera.params[:2], torch.zeros(2, dtype=torch.float64)))[:, None]
    off = camera.with_params(camera.params + 0.05 * along[:, 0])
    problem = replace(scene.problem, camera=off)
    solution = adjusted(problem, free_camera=along, kernel="none", iterations=60, tolerance=1e-14)
    torch.testing.assert_close(solution.camera.params, camera.params, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(solution.camera.params[2:], camera.params[2:], atol=0, rtol=0)

    noisy = bundle_scene(frames=8, points=80, noise=0.5).problem
    every = torch.eye(4, dtype=torch.float64) * torch.tensor([2.0, 3.0, 4.0, 5.0], dtype=torch.float64)
    one, other = (adjusted(noisy, free_camera=free, **CONVERGED) for free in (True, every))
    torch.testing.assert_close(one.camera.params, other.camera.params, rtol=1e-8, atol=0)
    covariance = every @ other.covariance().camera @ every.mT
    torch.testing.assert_close(covariance, one.covariance().camera, rtol=1e-5, atol=1e-9)


def test_robust_kernel_survives_outliers(bundle_scene, generator):
    scene = bundle_scene(points=60, noise=0.2)
    pixels = scene.problem.pixels.clone()
    pixels[::10] += 50 * torch.randn(len(pixels[::10]), 2, generator=generator, dtype=torch.float64)
    problem = replace(scene.problem, pixels=pixels)

    def error(kernel):
        T_cw = adjusted(problem, kernel=kernel, scale=1.5, iterations=50).T_cw
        return se3_log(T_cw @ se3_inverse(scene.T_cw)).norm()

    assert error("cauchy") < 0.3 * error("none")
    assert error("huber") < 0.6 * error("none")


def test_order_of_the_observations_does_not_matter(bundle_scene, generator):
    scene = bundle_scene()
    problem = scene.problem
    order = torch.randperm(len(problem.pixels), generator=generator)
    shuffled = only(problem, order)
    torch.testing.assert_close(solve_bundle(problem).T_cw, solve_bundle(shuffled).T_cw)


def test_fixed_parameters_do_not_change(bundle_scene):
    scene = bundle_scene()
    mask = torch.zeros(5, dtype=torch.bool)
    mask[[1, 3]] = True
    problem = replace(scene.problem, fixed_frames=mask, fixed_points=[2, 5])
    solution = solve_bundle(problem)
    assert torch.equal(solution.T_cw[[1, 3]], problem.T_cw[[1, 3]])
    assert torch.equal(solution.points_w[[2, 5]], problem.points_w[[2, 5]])
    assert (solution.T_cw[[0, 2, 4]] != problem.T_cw[[0, 2, 4]]).any()
    assert (solution.covariance().frames[[1, 3]] == 0).all()
    assert (solution.covariance(points=[2, 5]).points == 0).all()


def test_structure_only_and_motion_only(bundle_scene):
    scene = bundle_scene(noise=0.0)
    problem = replace(scene.problem, T_cw=scene.T_cw, fixed_frames=range(5))
    torch.testing.assert_close(solve_bundle(problem).points_w, scene.points_w, atol=1e-7, rtol=0)
    problem = replace(scene.problem, points_w=scene.points_w, fixed_frames=(), fixed_points=range(30))
    torch.testing.assert_close(solve_bundle(problem).T_cw, scene.T_cw, atol=1e-8, rtol=0)


def shape(problem):
    """Distances between the camera centers, relative to the first: what no gauge changes."""
    centers = se3_inverse(adjusted(problem, kernel="cauchy", scale=2.0, **CONVERGED).T_cw)[:, :3, 3]
    distances = (centers[1:] - centers[:1]).norm(dim=-1)
    return distances / distances.sum()


def test_the_shape_and_its_gradient_do_not_depend_on_the_gauge(bundle_scene):
    problem = bundle_scene(noise=0.5, frames=6, points=60).problem
    shapes, gradients = [], []
    for fixed_frames in ((), (0,), (3,)):
        pixels = problem.pixels.clone().requires_grad_()
        shapes.append(shape(replace(problem, pixels=pixels, fixed_frames=fixed_frames)))
        shapes[-1].square().sum().backward()
        gradients.append(pixels.grad)
        assert pixels.grad.norm() > 0
    for row in (1, 2):
        torch.testing.assert_close(shapes[row], shapes[0], atol=1e-8, rtol=0)
        torch.testing.assert_close(gradients[row], gradients[0], atol=1e-9, rtol=1e-5)


def test_an_open_gauge_keeps_the_scale_and_has_covariances(bundle_scene):
    scene = bundle_scene(frames=6, points=60)
    solution = solve_bundle(replace(scene.problem, fixed_frames=(0,)))
    assert solution.success
    s, _, _ = umeyama(solution.points_w, scene.problem.points_w)
    assert s.item() == pytest.approx(1, abs=0.02)
    assert (torch.linalg.eigvalsh(solution.covariance().points) > 0).all()


def test_two_maps_without_a_common_point_are_not_determined(bundle_scene):
    problem = bundle_scene(frames=6, points=60, visible=1.0).problem
    apart = (problem.frame_index < 3) == (problem.point_index < 30)
    pixels = problem.pixels[apart].clone().requires_grad_()
    problem = replace(
        problem, frame_index=problem.frame_index[apart], point_index=problem.point_index[apart], pixels=pixels
    )
    solution = solve_bundle(problem)
    assert not solution.success
    unchecked = solve_bundle(problem, check=False)
    assert unchecked.success
    assert torch.equal(unchecked.T_cw, solution.T_cw)
    assert solution.T_cw.isfinite().all()
    solution.T_cw.sum().backward()
    assert (pixels.grad == 0).all()


def test_invalid_observations_and_unobserved_rows_are_ignored(bundle_scene):
    scene = bundle_scene(frames=6, points=30)
    problem = scene.problem
    T_cw = torch.cat((problem.T_cw, problem.T_cw[:1], torch.full((1, 4, 4), torch.nan).double()))
    points_w = torch.cat((problem.points_w, problem.points_w[:2] + 1, torch.full((1, 3), torch.nan).double()))
    # A frame that sees two points, a frame of NaN, a point seen once, a point of NaN, three broken rows.
    frame_index = torch.cat((problem.frame_index, torch.tensor([6, 6, 7, 0, 0, 0, 0, 0])))
    point_index = torch.cat((problem.point_index, torch.tensor([0, 1, 0, 30, 32, 1, 2, 3])))
    extra = torch.full((8, 2), 100.0).double()
    extra[5:, 0] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    pixels = torch.cat((problem.pixels, extra)).requires_grad_()
    broken = replace(
        problem, T_cw=T_cw, points_w=points_w, frame_index=frame_index, point_index=point_index, pixels=pixels
    )
    solution, expected = solve_bundle(broken), solve_bundle(problem)
    torch.testing.assert_close(solution.T_cw[:6], expected.T_cw)
    torch.testing.assert_close(solution.points_w[:30], expected.points_w)
    assert torch.equal(solution.T_cw[6], T_cw[6])
    assert torch.equal(solution.points_w[30:32], points_w[30:32])
    assert solution.T_cw.isfinite().all()
    assert solution.points_w.isfinite().all()
    solution.T_cw.sum().backward()
    assert pixels.grad.isfinite().all()
    assert (pixels.grad[-8:] == 0).all()


def test_a_point_behind_the_cameras_does_not_spoil_the_rest(bundle_scene):
    scene = bundle_scene()
    points_w = scene.problem.points_w.clone()
    points_w[4, 2] = -5.0
    solution = solve_bundle(replace(scene.problem, points_w=points_w))
    assert solution.T_cw.isfinite().all()
    keep = scene.problem.point_index != 4
    without = only(scene.problem, keep)
    torch.testing.assert_close(solution.T_cw, solve_bundle(without).T_cw, atol=1e-6, rtol=0)


def gradcheck_inputs(scene, generator, model):
    problem = scene.problem
    weights = 0.5 + torch.rand(len(problem.pixels), generator=generator, dtype=torch.float64)
    twist = torch.zeros(2, 6, dtype=torch.float64)
    scale = torch.tensor(2.0, dtype=torch.float64)
    return problem.pixels, weights, problem.camera.params, scale, twist, problem.points_w[:2]


@pytest.mark.parametrize(
    ("model", "free_camera"),
    [
        ("pinhole", False),
        ("pinhole", True),
        ("pinhole", torch.tensor([[1.0], [1.02], [0.0], [0.0]], dtype=torch.float64)),
        pytest.param("radial_tangential", False, marks=pytest.mark.slow),
        pytest.param("fisheye", False, marks=pytest.mark.slow),
    ],
)
def test_implicit_gradient_by_gradcheck(bundle_scene, model, free_camera, generator):
    """To pixels, weights, camera, scale, the poses of two fixed frames and the positions of two fixed points."""
    scene = bundle_scene(frames=6, points=25, noise=1.0, model=model, perturbation=1e-3, fixed_points=(0, 1))
    problem = scene.problem

    def solve(pixels, weights, params, scale, twist, points):
        moved = replace(
            problem,
            T_cw=torch.cat((se3_exp(twist) @ problem.T_cw[:2], problem.T_cw[2:])),
            points_w=torch.cat((points, problem.points_w[2:])),
            pixels=pixels,
            weights=weights,
            camera=problem.camera.with_params(params),
        )
        solution = adjusted(moved, free_camera=free_camera, kernel="cauchy", scale=scale, **CONVERGED)
        return solution.T_cw[:, :3], solution.points_w, solution.camera.params

    inputs = gradcheck_inputs(scene, generator, model)
    leaves = [
        tensor.clone().requires_grad_(not (free_camera is True and index == 2))
        for index, tensor in enumerate(inputs)
    ]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("kernel", [pytest.param("none", marks=pytest.mark.slow), "cauchy"])
def test_covariance_is_calibrated(bundle_scene, kernel):
    """The normalized error squared of poses and points averages to its degrees of freedom."""
    frames, points = [], []
    for seed in range(50):
        scene = bundle_scene(frames=8, points=120, noise=0.7, perturbation=0.002, visible=1.0, seed=seed)
        solution = adjusted(scene.problem, kernel=kernel, scale=2.0, tolerance=1e-10)
        covariance = solution.covariance(frames=range(2, 8))
        error = se3_log(scene.T_cw @ se3_inverse(solution.T_cw))[2:]
        frames.append((error * torch.linalg.solve(covariance.frames, error)).sum(-1))
        error = scene.points_w - solution.points_w
        points.append((error * torch.linalg.solve(covariance.points, error)).sum(-1))
    assert 0.9 < torch.cat(frames).mean() / 6 < 1.1
    assert 0.9 < torch.cat(points).mean() / 3 < 1.1


@pytest.mark.usefixtures("without_shape_checks")
def test_invalid_input_is_rejected_by_name(bundle_scene):
    problem = bundle_scene().problem
    with pytest.raises(ValueError, match=r"frame_index must lie in 0 ... 4"):
        solve_bundle(replace(problem, frame_index=problem.frame_index + 1))
    with pytest.raises(ValueError, match=r"shape \(5,\)"):
        solve_bundle(replace(problem, fixed_frames=torch.ones(4, dtype=torch.bool)))


def test_points_settle_where_their_own_cost_is_lower(monkeypatch, bundle_scene):
    """Each lowers its own cost or stays, poses and camera stay, and together they come close to their minimum."""
    monkeypatch.setattr(_sparse, "_INNER_FRAMES", 2)
    settle, seen = SparseBundle._settled, []

    def settled(self, estimate, model):
        found = settle(self, estimate, model)
        seen.append((self, estimate, found))
        return found

    monkeypatch.setattr(SparseBundle, "_settled", settled)
    adjusted(bundle_scene(frames=6, points=40, perturbation=0.05).problem, iterations=1)
    (bundle, before, after), *_ = seen
    assert torch.equal(before.T_cw, after.T_cw)
    assert torch.equal(before.params, after.params)
    costs, _, _ = bundle._of_points(before)
    lower, gradient, hessian = bundle._of_points(after)
    free = bundle.layout.free_points
    assert bool((lower <= costs).all())
    assert float(lower[free].sum()) < 0.999 * float(costs[free].sum())
    left = torch.linalg.solve(hessian.movedim(-1, 0), gradient.mT[..., None])[..., 0]
    assert float((left * gradient.mT)[free].sum()) < 1e-3 * float(
        lower.sum()
    )  # what one more step could gain


def test_points_that_step_too_far_do_not_stop_the_others(monkeypatch, bundle_scene):
    """Where the joint step raises the cost, such points go back, and are held in the joint steps that follow."""
    problem = bundle_scene(frames=6, points=40, perturbation=0.05).problem
    monkeypatch.setattr(_sparse, "_INNER_FRAMES", 2)
    settle, moved, held = SparseBundle._settled, [], []

    def settled(self, estimate, model):
        points_w = estimate.points_w.clone()
        moved.append((points_w - model.estimate.points_w).norm(dim=-1))
        if len(moved) == 1:
            points_w[::4] *= -1.0  # behind the cameras
        found = settle(self, estimate._replace(points_w=points_w), model)
        held.append(self.own_damping.clone())
        return found

    monkeypatch.setattr(SparseBundle, "_settled", settled)
    start = float(adjusted(problem, iterations=0).cost)
    assert float(adjusted(problem, iterations=1).cost) < 0.5 * start  # else the step is refused
    back = torch.zeros(40, dtype=torch.float64)
    back[::4] = 1
    lengths = []
    for least in (1.0, 10.0):
        monkeypatch.setattr(_sparse, "_HELD", least)
        moved.clear(), held.clear()
        adjusted(problem, iterations=2)
        assert torch.equal(held[0], least * back)
        assert torch.equal(held[1], 0.1 * least * back)
        lengths.append(moved[1])
    assert bool((lengths[1][back > 0] < lengths[0][back > 0]).all())


def test_steps_of_points_lead_to_the_same_minimum(monkeypatch, bundle_scene):
    problem = bundle_scene(frames=6, points=40, perturbation=0.05).problem
    alone = adjusted(problem, tolerance=1e-12)
    monkeypatch.setattr(_sparse, "_INNER_FRAMES", 2)
    settled = adjusted(problem, tolerance=1e-12)
    torch.testing.assert_close(settled.T_cw, alone.T_cw, rtol=0, atol=1e-7)
    torch.testing.assert_close(settled.cost, alone.cost, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("free", "is_settled"), [(31, False), (32, True)])
def test_points_settle_by_themselves_from_32_free_frames_on(monkeypatch, bundle_scene, free, is_settled):
    scene = bundle_scene(frames=33, points=40, perturbation=0.01).problem
    fixed = torch.arange(33) >= free
    evaluated = []
    of_points = SparseBundle._of_points

    def counted(self, estimate):
        evaluated.append(estimate)
        return of_points(self, estimate)

    monkeypatch.setattr(SparseBundle, "_of_points", counted)
    adjusted(replace(scene, fixed_frames=fixed), iterations=1)
    assert bool(evaluated) == is_settled
