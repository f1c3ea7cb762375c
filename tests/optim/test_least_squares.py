"""The general minimizer against closed forms, the special solvers, and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev

from tests.optim.conftest import minimized
from torchslam.geometry import se3_exp, sim3_exp, sim3_scale, transform, umeyama
from torchslam.optim import LEAST_SQUARES_OPTIONS, solve_least_squares

CONVERGED = {"iterations": 60, "tolerance": 0.0}


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def line(coefficients: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return coefficients[:, :1] + coefficients[:, 1:] * x - y


def reprojection(camera):
    def residual(T_cw: Tensor, points_w: Tensor, pixels: Tensor) -> Tensor:
        return camera.project(transform(T_cw, points_w))[0] - pixels

    return residual


def test_a_fitted_line_solves_the_normal_equations():
    x, y, weights = normal(3, 9), normal(3, 9, seed=1), normal(3, 9, seed=2).square()
    mask = normal(3, 9, seed=3) > -1
    solution = solve_least_squares(line, torch.zeros(3, 2).double(), (x, y), weights=weights, mask=mask)
    A, w = torch.stack((torch.ones_like(x), x), -1), weights * mask
    expected = torch.linalg.solve(A.mT @ (w[..., None] * A), A.mT @ (w * y)[..., None]).squeeze(-1)
    torch.testing.assert_close(solution.unknowns[0], expected)
    cost = 0.5 * (w * line(expected, x, y).square()).sum(1)
    torch.testing.assert_close(solution.cost, cost)
    assert solution.success.all()
    assert solution.convergence.converged.all()


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy", "geman_mcclure"])
def test_a_pose_equals_that_of_solve_pose(pose_scene, kernel, model):
    """And so are its gradients, whatever the kernel."""
    scene = pose_scene(batch=3, count=12, noise=1.0, model=model)
    found = []
    for general in (True, False):
        points, pixels = scene.points_w.clone().requires_grad_(), scene.pixels.clone().requires_grad_()
        if general:
            inputs = (points, pixels)
            residual = reprojection(scene.camera)
            solution = minimized(residual, scene.start, inputs, "se3", kernel=kernel, scale=2.0, **CONVERGED)
            T_cw = solution.unknowns[0]
        else:
            solution = scene.solved(points_w=points, pixels=pixels, kernel=kernel, scale=2.0, **CONVERGED)
            T_cw = solution.T_cw
        (T_cw[:, :3] * normal(3, 3, 4, seed=5)).sum().backward()
        found.append((T_cw.detach(), solution.cost, points.grad, pixels.grad))
    for general, special in zip(*found, strict=True):
        torch.testing.assert_close(general, special, rtol=1e-7, atol=1e-9)


def test_a_similarity_equals_that_of_umeyama():
    a = normal(2, 20, 3)
    S_ba = sim3_exp(torch.tensor([[0.3, -1, 2, 0.5, 0.2, -0.4, 0.7], [1, 0, 0, 0, 0, math.pi - 0.01, -0.5]]))
    b = transform(S_ba.double(), a) + 0.05 * normal(2, 20, 3, seed=1)
    start = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    start[1, :2, :2] *= -1  # half a turn
    solution = minimized(lambda S, a, b: transform(S, a) - b, start, (a, b), "sim3", **CONVERGED)
    assert solution.success.all()
    for row in range(2):
        s, R, t = umeyama(a[row], b[row])
        torch.testing.assert_close(sim3_scale(solution.unknowns[0][row]), s, rtol=1e-8, atol=0)
        torch.testing.assert_close(solution.unknowns[0][row, :3, :3], s * R, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(solution.unknowns[0][row, :3, 3], t, rtol=1e-7, atol=1e-9)


def sampled(images: Tensor, xy: Tensor) -> Tensor:
    """Images (B, H, W) at xy (B, N, 2), bilinear: sums of gathered pixels, which have all derivatives."""
    height, width = images.shape[-2:]
    corner = xy.detach().floor()
    corner = torch.stack(
        (corner[..., 0].clamp(0, width - 2), corner[..., 1].clamp(0, height - 2)), dim=-1
    ).long()
    right, down = (xy - corner).unbind(-1)
    place = corner[..., 1] * width + corner[..., 0]
    flat = images.flatten(1)
    a, b, c, d = (flat.gather(1, place + step) for step in (0, 1, width, width + 1))
    return (1 - down) * ((1 - right) * a + right * b) + down * ((1 - right) * c + right * d)


def smooth_images(shifts: Tensor, size: int = 24) -> Tensor:
    """(B, H, W) sums of waves, seen `shifts` (B, 2) further."""
    y, x = torch.meshgrid(*(torch.arange(size, dtype=torch.float64),) * 2, indexing="ij")
    x, y = x - shifts[:, :1, None], y - shifts[:, 1:, None]
    return torch.sin(0.3 * x) + torch.cos(0.25 * y) + torch.sin(0.2 * (x + y)) * torch.cos(0.15 * (x - y))


def test_flow_from_two_images_and_its_gradient_to_every_pixel():
    """Photometric alignment: where the second image shows what the first does, robust against a spot in it."""
    shifts = torch.tensor([[1.3, -0.7], [-2.1, 0.4]], dtype=torch.float64)
    first, second = smooth_images(0 * shifts), smooth_images(shifts)
    second[:, 10:13, 10:13] += 2.0
    y, x = torch.meshgrid(*(torch.arange(5.0, 19.0, dtype=torch.float64),) * 2, indexing="ij")
    places = torch.stack((x.flatten(), y.flatten()), -1)

    def residual(flow: Tensor, first: Tensor, second: Tensor) -> Tensor:
        at = places.expand(len(flow), -1, -1)
        return sampled(second, at + flow[:, None]) - sampled(first, at)

    def flow(first: Tensor, second: Tensor) -> Tensor:
        zero = torch.zeros(2, 2, dtype=torch.float64)
        return minimized(residual, zero, (first, second), kernel="cauchy", scale=0.1, **CONVERGED).unknowns[0]

    torch.testing.assert_close(flow(first, second), shifts, atol=0.04, rtol=0)
    images = [image.clone().requires_grad_() for image in (first, second)]
    gradients = torch.autograd.grad(flow(*images)[:, 0].sum(), images)
    for image, gradient, other in ((0, gradients[0], second), (1, gradients[1], first)):
        step = 1e-6 * normal(*first.shape, seed=image)
        moved = [
            flow(first + sign * step, other) if image == 0 else flow(other, second + sign * step)
            for sign in (1, -1)
        ]
        expected = (moved[0] - moved[1])[:, 0].sum() / 2
        assert float((gradient * step).sum()) == pytest.approx(float(expected), rel=1e-4)


@pytest.fixture
def problem():
    """Of poses, one half a turn from the identity, and scales, that a few numbers move; with rows that do not count."""
    twist = torch.tensor([[0.1, 0.2, 0.3, 0, math.pi - 0.01, 0], [0.1, 0, 0, 0, 0.02, 0]]).double()
    T, x = se3_exp(twist), normal(2, 6, 3)
    y = transform(T, torch.tensor([1.1, 0.9, 1.2]).double() * x) + 0.05 * normal(2, 6, 3, seed=2)

    def residual(T: Tensor, scales: Tensor, x: Tensor, y: Tensor) -> Tensor:
        return transform(T, scales[:, None] * x) - y

    drift, spread = 0.05 * normal(2, 6, 3, seed=3), normal(2, 6, seed=4).square()

    def solve(p: Tensor) -> Tensor:
        solution = minimized(
            residual,
            (T, torch.ones(2, 3, dtype=torch.float64)),
            (x + p[0] * drift, y + 0.1 * p[1] * x.square()),
            ("se3", "euclidean"),
            1 + p[2] * spread,
            torch.tensor([[True] * 6, [True] * 5 + [False]]),
            kernel="cauchy",
            scale=1 + p[3],
            iterations=25,
            tolerance=0.0,
        )
        T_found, scale_found = solution.unknowns
        return torch.cat((T_found[:, :3].flatten(1), scale_found), dim=1)

    return solve, torch.tensor([0.1, -0.1, 0.2, 0.3], dtype=torch.float64)


def test_gradients_and_their_gradients(problem):
    solve, p = problem
    p = p.clone().requires_grad_()
    assert torch.autograd.gradcheck(solve, (p,), eps=1e-5, atol=1e-6, rtol=1e-4)
    assert torch.autograd.gradgradcheck(solve, (p,), eps=1e-4, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_every_transform_agrees(problem):
    solve, p = problem
    expected = torch.autograd.functional.jacobian(solve, p)
    torch.testing.assert_close(jacrev(solve)(p), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(jacfwd(solve)(p), expected, rtol=0, atol=1e-9)


def test_a_batch_equals_a_loop_over_its_elements(pose_scene):
    scene = pose_scene(batch=5, outliers=0.2)
    residual = reprojection(scene.camera)
    options = {"manifolds": "se3", "options": LEAST_SQUARES_OPTIONS.replace(kernel="cauchy")}
    together = solve_least_squares(residual, scene.start, (scene.points_w, scene.pixels), **options)
    for row in range(5):
        rows = slice(row, row + 1)
        alone = solve_least_squares(
            residual, scene.start[rows], (scene.points_w[rows], scene.pixels[rows]), **options
        )
        torch.testing.assert_close(together.unknowns[0][rows], alone.unknowns[0], rtol=0, atol=1e-12)
        assert together.convergence.iterations[row] == alone.convergence.iterations[0]


def test_backward_modes_agree_where_they_should():
    x, y = normal(2, 9), normal(2, 9, seed=1)
    gradients = {}
    for backward in ("implicit", "unroll", "truncated", "detached"):
        leaf = y.clone().requires_grad_()
        solution = minimized(
            line, torch.zeros(2, 2).double(), (x, leaf), kernel="cauchy", backward=backward, **CONVERGED
        )
        (coefficients,) = solution.unknowns
        if backward == "detached":
            assert not coefficients.requires_grad
            continue
        coefficients[:, 1].sum().backward()
        gradients[backward] = leaf.grad
    torch.testing.assert_close(gradients["unroll"], gradients["implicit"], rtol=1e-6, atol=1e-9)
    assert (gradients["truncated"] - gradients["implicit"]).norm() > 0.01 * gradients["implicit"].norm()


def test_a_failure_does_not_affect_the_other_elements(pose_scene):
    """Too few points, a non-finite start or a non-finite input leave a valid problem unaffected."""
    scene = pose_scene(batch=4, count=20)
    start, pixels = scene.start.clone(), scene.pixels.clone()
    mask = torch.ones(4, 20, dtype=torch.bool)
    mask[1, 2:] = False
    start[2, 0, 0] = torch.nan
    pixels[3, 4] = torch.inf
    pixels.requires_grad_()
    solution = solve_least_squares(
        reprojection(scene.camera), start, (scene.points_w, pixels), "se3", mask=mask
    )
    assert solution.success.tolist() == [True, False, False, False]
    (T_cw,) = solution.unknowns
    assert T_cw.isfinite().all()
    assert torch.equal(T_cw[2], torch.eye(4, dtype=torch.float64))
    T_cw.sum().backward()
    assert pixels.grad.isfinite().all()
    assert (pixels.grad[1:] == 0).all()
    assert pixels.grad[0].norm() > 0


def test_a_residual_may_close_over_tensors_with_gradients():
    x, y = normal(2, 9), normal(2, 9)
    start = torch.zeros(2, 2, dtype=torch.float64)

    def both(shift):
        inside = solve_least_squares(lambda c, x, y: line(c, x, y + shift * x.sin()), start, (x, y))
        given = solve_least_squares(
            lambda c, x, y, shift: line(c, x, y + shift * x.sin()), start, (x, y, shift.expand(2, 9))
        )
        return inside.unknowns[0], given.unknowns[0]

    shift = normal(9).requires_grad_()
    found, expected = torch.autograd.functional.jacobian(both, shift)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    assert found.abs().max() > 0


@pytest.mark.usefixtures("without_shape_checks")
def test_inconsistent_inputs_are_rejected_by_name():
    x, y = normal(2, 9), normal(2, 9)
    start = torch.zeros(2, 2, dtype=torch.float64)
    leaf = y.clone().requires_grad_()

    class Hidden(torch.autograd.Function):
        @staticmethod
        def forward(ctx, y):
            return y.clone()

        @staticmethod
        def backward(ctx, gradient):
            return gradient

    with pytest.raises(ValueError, match="with gradient that cannot be found"):
        solve_least_squares(lambda c, x: line(c, x, Hidden.apply(leaf)), start, (x,))
    with pytest.raises(ValueError, match=r"input 1 must lead with the batch of 2, not have shape \(9,\)"):
        solve_least_squares(line, start, (x, y[0]))
    with pytest.raises(ValueError, match=r"weights must be \(B, N\), not \(9,\)"):
        solve_least_squares(line, start, (x, y), weights=torch.ones(9).double())
    with pytest.raises(ValueError, match=r"input 0 is torch.float32, but unknown 0 is torch.float64"):
        solve_least_squares(line, start, (x.float(), y))
    with pytest.raises(ValueError, match="unknown manifold 'so3'"):
        solve_least_squares(line, start, (x, y), "so3")
    with pytest.raises(ValueError, match=r"an unknown on se3 must be \(B, ..., 4, 4\), not \(2, 2\)"):
        solve_least_squares(line, start, (x, y), "se3")
    with pytest.raises(ValueError, match=r"residual must be \(B, N\)"):
        solve_least_squares(lambda c, x, y: line(c, x, y).sum(1), start, (x, y))
