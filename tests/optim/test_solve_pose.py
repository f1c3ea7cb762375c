from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, se3_inverse, se3_log, transform
from torchslam.optim import POSE_OPTIONS, PosePrior, solve_pose
from torchslam.optim._core.residuals import ReprojectionData
from torchslam.optim._core.tangent import retract
from torchslam.optim.pose import PoseProblem

CONVERGED = {"iterations": 25, "tolerance": 0.0}


def errors(T_cw, truth):
    return se3_log(T_cw @ se3_inverse(truth)).norm(dim=-1)


def test_exact_data_gives_the_exact_pose(pose_scene, model):
    scene = pose_scene(noise=0.0, model=model)
    refined = scene.solved(kernel="none")
    assert refined.success.all()
    assert errors(refined.T_cw, scene.T_cw).max() < 1e-9


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman_mcclure", "truncated"])
def test_robust_kernels_survive_outliers(pose_scene, kernel):
    scene = pose_scene(count=200, outliers=0.3, noise=0.3, perturbation=0.01)
    scale = 8.0 if kernel == "truncated" else 2.0
    refined = scene.solved(kernel=kernel, scale=scale)
    plain = scene.solved(kernel="none")
    assert (errors(refined.T_cw, scene.T_cw) < 0.3 * errors(plain.T_cw, scene.T_cw)).all()


def test_the_gradient_of_the_cost_vanishes_at_the_solution(pose_scene, model):
    scene = pose_scene(outliers=0.2, model=model)
    refined = scene.solved(scale=2.0, **CONVERGED)
    xi = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    points_c = scene.points_w @ (se3_exp(xi) @ refined.T_cw)[:, :3, :3].mT
    points_c = points_c + (se3_exp(xi) @ refined.T_cw)[:, None, :3, 3]
    squared = (scene.camera.project(points_c)[0] - scene.pixels).square().sum(-1)
    cost = 2.0 * torch.log1p(squared / 4).sum(-1)
    torch.testing.assert_close(refined.cost, cost.detach())
    (gradient,) = torch.autograd.grad(cost.sum(), xi)
    assert gradient.abs().max() < 1e-5


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy"])
def test_the_hessian_of_a_pinhole_camera_is_that_of_any(pose_scene, kernel):
    scene = pose_scene(outliers=0.2, model="pinhole")
    weights = 0.5 + torch.rand(scene.pixels.shape[:2], dtype=torch.float64)
    scale = torch.full((1, 1), 2.0, dtype=torch.float64)
    problem = PoseProblem(
        scene.points_w, ReprojectionData(scene.pixels, weights, scene.camera, kernel, scale), None
    )
    found = problem.hessian(scene.start)
    torch.testing.assert_close(found, problem._general_hessian(scene.start), rtol=1e-10, atol=1e-6)


def test_batch_is_the_same_as_a_loop(pose_scene):
    scene = pose_scene(batch=3, outliers=0.2)
    scale = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    together = scene.solved(scale=scale)
    for row in range(3):
        one = slice(row, row + 1)
        alone = scene.solved(
            points_w=scene.points_w[one], pixels=scene.pixels[one], start=scene.start[one], scale=scale[one]
        )
        torch.testing.assert_close(alone.T_cw[0], together.T_cw[row], atol=1e-12, rtol=0)
        torch.testing.assert_close(alone.covariance[0], together.covariance[row])
        assert alone.convergence.iterations[0] == together.convergence.iterations[row]


def test_masked_and_non_finite_rows_are_ignored(pose_scene):
    scene = pose_scene(count=40)
    mask = torch.arange(40).expand(2, 40) >= 5
    pixels, points, weights = scene.pixels.clone(), scene.points_w.clone(), torch.ones(2, 40).double()
    pixels[:, 0], points[:, 1], weights[:, 2], pixels[:, 3], weights[:, 4] = (
        torch.nan,
        torch.inf,
        torch.nan,
        1e9,
        -1,
    )
    tensors = [tensor.requires_grad_() for tensor in (points, pixels, weights)]
    refined = scene.solved(points_w=points, pixels=pixels, weights=weights, mask=mask)
    expected = scene.solved(points_w=scene.points_w[:, 5:], pixels=scene.pixels[:, 5:])
    torch.testing.assert_close(refined.T_cw, expected.T_cw)
    refined.T_cw.sum().backward()
    for tensor in tensors:
        assert tensor.grad.isfinite().all()
        assert (tensor.grad[:, :5] == 0).all()
        assert (tensor.grad[:, 5:] != 0).any()


def test_points_behind_the_camera_are_ignored(pose_scene):
    scene = pose_scene(count=40)
    points = scene.points_w.clone()
    center = se3_inverse(scene.T_cw)[:, None, :3, 3]
    points[:, :5] = 2 * center - points[:, :5]
    refined = scene.solved(points_w=points, kernel="none")
    expected = scene.solved(points_w=scene.points_w[:, 5:], pixels=scene.pixels[:, 5:], kernel="none")
    torch.testing.assert_close(refined.T_cw, expected.T_cw, atol=1e-8, rtol=0)


@pytest.mark.parametrize("backward", ["implicit", "unroll", "truncated", "detached"])
def test_failures_are_flagged_and_have_no_gradient(pose_scene, backward):
    scene = pose_scene(batch=5, count=20)
    points, start = scene.points_w.clone(), scene.start.clone()
    points[2] = points[2, :1]  # one point, twenty times
    start[3] = torch.nan
    mask = torch.ones(5, 20, dtype=torch.bool)
    mask[1, 2:] = False
    line = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    points[4] = (1 - line) * points[4, :1] + line * points[4, 1:2]  # the pose may turn about the line
    points.requires_grad_()
    pixels = scene.pixels.clone().requires_grad_()
    refined = scene.solved(
        points_w=points, pixels=pixels, start=start, mask=mask, kernel="none", backward=backward
    )
    assert refined.success.tolist()[:3] == [True, False, False]
    assert not refined.success[4]
    assert refined.T_cw.isfinite().all()
    assert refined.covariance.isfinite().all()
    assert torch.equal(refined.T_cw[1], start[1])
    if backward == "detached":
        assert not refined.T_cw.requires_grad
        return
    refined.T_cw.sum().backward()
    for tensor in (points, pixels):
        assert tensor.grad.isfinite().all()
        assert (tensor.grad[[1, 2, 4]] == 0).all()
        assert (tensor.grad[0] != 0).any()


@pytest.mark.parametrize("with_prior", [False, True])
def test_implicit_gradient_by_gradcheck(pose_scene, model, with_prior, generator):
    scene = pose_scene(batch=2, count=8, noise=2.0, outliers=0.2, model=model, perturbation=0.005)
    mask = torch.ones(2, 8, dtype=torch.bool)
    mask[1, 7] = False
    A = 20 * torch.randn(2, 6, 6, generator=generator, dtype=torch.float64)

    def solve(points_w, pixels, weights, params, scale, twist, root):
        prior = PosePrior(se3_exp(twist) @ scene.start, root @ root.mT) if with_prior else None
        return scene.solved(
            points_w=points_w,
            pixels=pixels,
            camera=replace(scene.camera, params=params),
            weights=weights,
            mask=mask,
            prior=prior,
            kernel="cauchy",
            scale=scale,
            **CONVERGED,
        ).T_cw[:, :3]

    weights = 0.5 + torch.rand(2, 8, generator=generator, dtype=torch.float64)
    twist = 0.01 * torch.randn(2, 6, generator=generator, dtype=torch.float64)
    scale = torch.tensor([2.0, 3.0], dtype=torch.float64)
    inputs = (scene.points_w, scene.pixels, weights, scene.camera.params, scale, twist, A)
    leaves = [tensor.clone().requires_grad_(with_prior or index < 5) for index, tensor in enumerate(inputs)]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=True)


def test_unroll_reaches_the_start(pose_scene):
    scene = pose_scene()
    start = scene.start.clone().requires_grad_()
    options = POSE_OPTIONS.replace(kernel="none", backward="unroll", iterations=1, tolerance=0.0)
    solve_pose(
        scene.points_w, scene.pixels, T_cw=start, camera=scene.camera, options=options
    ).T_cw.sum().backward()
    assert start.grad.isfinite().all()
    assert (start.grad != 0).any()


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
def test_covariance_is_calibrated(pose_scene, kernel):
    """The normalized error squared, over many noisy views, averages to its six degrees of freedom."""
    scene = pose_scene(batch=400, count=100, noise=1.3)
    refined = scene.solved(kernel=kernel, scale=2.0)
    error = se3_log(scene.T_cw @ se3_inverse(refined.T_cw))
    squared = (error * torch.linalg.solve(refined.covariance, error)).sum(-1)
    assert 0.9 < squared.mean() / 6 < 1.1


def test_prior_alone_and_prior_against_data(pose_scene):
    scene = pose_scene()
    eye = torch.eye(6, dtype=torch.float64).expand(2, 6, 6)
    nothing = torch.zeros(2, 40, dtype=torch.bool)
    alone = scene.solved(mask=nothing, prior=PosePrior(scene.T_cw, 4 * eye))
    assert alone.success.all()
    torch.testing.assert_close(alone.T_cw, scene.T_cw, atol=1e-5, rtol=0)
    torch.testing.assert_close(alone.covariance, eye / 4)
    stiff = scene.solved(prior=PosePrior(scene.start, 1e12 * eye))
    torch.testing.assert_close(stiff.T_cw, scene.start, atol=1e-6, rtol=0)


PINHOLE = Camera.pinhole(500.0, 480.0, 320.0, 240.0, size=(640, 480))
BENT = Camera.radial_tangential(500.0, 480.0, 320.0, 240.0, -0.2, 0.05, 1e-3, -5e-4, size=(640, 480))
STRAIGHT = Camera.radial_tangential(500.0, 480.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, size=(640, 480))
ALL, NONE = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool)


def scene(camera: Camera, generator: torch.Generator) -> tuple[Tensor, PoseProblem]:
    """Two poses of 30 points, the first ones far off their pixels and the last one behind the camera."""
    points_w = torch.rand(2, 30, 3, generator=generator, dtype=torch.float64) * 4 - 2
    points_w[..., 2] += 6
    points_w[:, -1, 2] = -5
    T_cw = se3_exp(0.1 * torch.randn(2, 6, generator=generator, dtype=torch.float64))
    pixels, _ = camera.project(transform(T_cw, points_w))
    pixels = pixels + torch.randn(2, 30, 2, generator=generator, dtype=torch.float64)
    pixels[:, :6] += 20
    weights = 0.5 + torch.rand(2, 30, generator=generator, dtype=torch.float64)
    scale = torch.tensor([2.0], dtype=torch.float64)
    observations = ReprojectionData(pixels, weights, camera, "cauchy", scale)
    return T_cw, PoseProblem(points_w, observations, None)


@pytest.mark.parametrize("camera", [PINHOLE, BENT], ids=["pinhole", "bent"])
def test_the_curvature_is_exact_for_linear_residuals(camera: Camera, generator: torch.Generator) -> None:
    """Hessian and curvature term make the Hessian of the cost, with the residual in its place linear in xi."""
    T_cw, observations = scene(camera, generator)
    inputs = observations.observations
    points_w = observations.points_w

    def residuals(xi: Tensor) -> Tensor:
        return inputs.camera.project(transform(retract(T_cw, xi), points_w))[0] - inputs.pixels

    zero = torch.zeros(2, 6, dtype=torch.float64)
    r = residuals(zero)[:, :-1]
    J = torch.autograd.functional.jacobian(lambda xi: residuals(xi)[:, :-1].sum(0), zero).movedim(2, 0)

    def cost(xi: Tensor) -> Tensor:
        s = inputs.weights[:, :-1] * (r + (J @ xi[:, None, :, None])[..., 0]).square().sum(-1)
        return 0.5 * (4 * torch.log1p(s / 4)).sum()

    exact = torch.autograd.functional.hessian(cost, zero)
    found = observations.expand(T_cw, ALL)
    for row in range(2):
        torch.testing.assert_close((found.hessian + found.curvature_term)[row], exact[row, :, row])
    assert (torch.linalg.eigvalsh(found.hessian) > 0).all()
    assert (torch.linalg.eigvalsh(found.curvature_term) < 1e-6).all()


def test_the_pinhole_shortcut_equals_the_general_expansion(generator: torch.Generator) -> None:
    T_cw, short = scene(PINHOLE, generator)
    inputs = short.observations
    straight = ReprojectionData(inputs.pixels, inputs.weights, STRAIGHT, inputs.kernel, inputs.scale)
    general = PoseProblem(short.points_w, straight, None)
    moved = se3_exp(torch.tensor([0.05, 0, -0.1, 0.01, 0.02, 0.0], dtype=torch.float64)) @ T_cw
    for T in (T_cw, moved):
        torch.testing.assert_close(short.expand(T, ALL), general.expand(T, ALL))
    batch = Camera("pinhole", PINHOLE.params * torch.tensor([[1.0], [1.1]], dtype=torch.float64), (640, 480))
    two = ReprojectionData(inputs.pixels, inputs.weights, batch, inputs.kernel, inputs.scale)
    pair = PoseProblem(short.points_w, two, None)
    torch.testing.assert_close(pair.expand(T_cw, ALL).hessian[0], short.expand(T_cw, ALL).hessian[0])
    assert not torch.allclose(pair.expand(T_cw, ALL).hessian[1], short.expand(T_cw, ALL).hessian[1])


@pytest.mark.parametrize("bad", [float("nan"), 0.0, -500.0])
def test_a_degenerate_camera_fails_alone(pose_scene, bad):
    scene = pose_scene(batch=2)
    params = scene.camera.params.repeat(2, 1)
    params[1, 0] = bad
    params.requires_grad_()
    pixels = scene.pixels.clone().requires_grad_()
    refined = scene.solved(camera=scene.camera.with_params(params), pixels=pixels)
    refined.T_cw.sum().backward()
    assert refined.success.tolist() == [True, False]
    assert torch.equal(refined.T_cw[0], scene.solved().T_cw[0])
    for gradient in (params.grad, pixels.grad):
        assert gradient[0].any()
        assert not gradient[1].any()
