"""Several cameras in one bundle adjustment, and priors on poses and cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tests.optim.conftest import adjusted
from torchslam.geometry import Camera, se3_exp, se3_inverse, se3_log, transform
from torchslam.optim import BundleProblem, CameraPrior, PosePrior, solve_bundle

CONVERGED = {"iterations": 60, "tolerance": 0.0}


def zoomed(bundle_scene, noise=0.0, **options) -> tuple[BundleProblem, torch.Tensor]:
    """A problem in which every second frame was taken with another focal length, and the cameras (2, 4)."""
    scene = bundle_scene(frames=8, points=80, **options)
    problem = scene.problem
    params = torch.stack((problem.camera.params, problem.camera.params * torch.tensor([1.3, 1.3, 1, 1])))
    cameras, index = problem.camera.with_params(params), torch.arange(8) % 2
    points_c = transform(scene.T_cw[problem.frame_index], scene.points_w[problem.point_index][:, None])
    pixels = cameras[index[problem.frame_index]].project(points_c)[0][:, 0]
    generator = torch.Generator().manual_seed(7)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=pixels.dtype)
    return replace(problem, pixels=pixels, camera=cameras, camera_index=index), params


def test_every_frame_has_its_camera(bundle_scene):
    problem, _ = zoomed(bundle_scene)
    solution = adjusted(problem, kernel="none")
    assert solution.cost < 1e-12
    assert solution.camera.params.shape == (2, 4)
    swapped = adjusted(replace(problem, camera_index=1 - problem.camera_index), kernel="none")
    assert swapped.cost > 1


@pytest.mark.parametrize("directions", [True, torch.tensor([[1.0], [1.02], [0.0], [0.0]]).double()])
def test_every_camera_is_found(bundle_scene, directions):
    problem, params = zoomed(bundle_scene)
    step = torch.tensor([1.0, 1.02, 0.0, 0.0], dtype=torch.float64)
    off = params + torch.tensor([[20.0], [-15.0]], dtype=torch.float64) * step
    problem = replace(problem, camera=problem.camera.with_params(off))
    solution = adjusted(problem, free_camera=directions, kernel="none", iterations=60, tolerance=1e-16)
    torch.testing.assert_close(solution.camera.params, params, atol=1e-4, rtol=1e-6)
    size = 8 if directions is True else 2
    assert solution.covariance().camera.shape == (size, size)


def one_each(problem: BundleProblem) -> BundleProblem:
    """The problem with a camera for each frame."""
    index = problem.camera_index
    return replace(problem, camera=problem.camera[index], camera_index=torch.arange(len(index)))


def test_cameras_tied_by_a_prior_are_as_one(bundle_scene):
    """A camera per frame, held by a strong prior at shared ones; the prior is then its covariance."""
    shared, _ = zoomed(bundle_scene, noise=1.0)
    one = adjusted(shared, free_camera=True, kernel="cauchy", scale=2.0, **CONVERGED)
    eye = 1e6 * torch.eye(4, dtype=torch.float64).expand(8, 4, 4)
    mean = one.camera.params[shared.camera_index]
    tied = replace(one_each(shared), camera_prior=CameraPrior(mean, eye))
    found = adjusted(tied, free_camera=True, kernel="cauchy", scale=2.0, **CONVERGED)
    torch.testing.assert_close(found.T_cw, one.T_cw, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.camera.params, mean, atol=1e-3, rtol=0)
    spread = found.covariance().camera.unflatten(0, (8, 4)).unflatten(2, (8, 4)).diagonal(dim1=0, dim2=2)
    torch.testing.assert_close(spread.movedim(-1, 0), torch.linalg.inv(eye), rtol=0.1, atol=1e-8)


def test_the_gradient_of_a_camera_per_frame_by_gradcheck(bundle_scene):
    """With respect to pixels, weights, the scale of the kernel, and what does not move of the cameras."""
    problem, _ = zoomed(bundle_scene, noise=1.0, perturbation=1e-3)
    problem = one_each(problem)
    focal = torch.tensor([[1.0], [1.02], [0.0], [0.0]], dtype=torch.float64)

    def solve(pixels, weights, scale, centers):
        params = torch.cat((problem.camera.params[:, :2], centers), dim=1)
        moved = replace(problem, pixels=pixels, weights=weights, camera=problem.camera.with_params(params))
        solution = adjusted(
            moved, free_camera=focal, kernel="cauchy", scale=scale, iterations=30, tolerance=0.0
        )
        return solution.T_cw[:, :3], solution.points_w, solution.camera.params

    weights, scale = torch.ones_like(problem.pixels[:, 0]), torch.tensor(3.0).double()
    inputs = [problem.pixels, weights, scale, problem.camera.params[:, 2:]]
    leaves = [x.clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_two_equal_cameras_give_the_result_of_one(bundle_scene, model):
    problem = bundle_scene(model=model).problem
    index = torch.tensor([0, 1, 0, 1, 1])
    cameras = problem.camera.with_params(problem.camera.params.expand(2, -1))
    gradients, solutions = [], []
    for camera, camera_index in ((problem.camera, None), (cameras, index)):
        params = camera.params.clone().requires_grad_()
        solution = adjusted(
            replace(problem, camera=camera.with_params(params), camera_index=camera_index),
            kernel="cauchy",
            scale=2.0,
        )
        solution.T_cw.sum().backward()
        gradients.append(params.grad)
        solutions.append(solution)
    one, two = solutions
    torch.testing.assert_close(two.T_cw, one.T_cw)
    torch.testing.assert_close(two.covariance().points, one.covariance().points)
    torch.testing.assert_close(gradients[1].sum(0), gradients[0], rtol=1e-6, atol=1e-12)


def pose_prior(problem: BundleProblem, T_cw: torch.Tensor, weights: list[float]) -> PosePrior:
    eye = torch.eye(6, dtype=torch.float64)
    return PosePrior(T_cw, torch.tensor(weights, dtype=torch.float64)[:, None, None] * eye)


def test_a_strong_prior_acts_like_a_fixed_frame(bundle_scene):
    """And one without information is none."""
    problem = bundle_scene(frames=5, points=40).problem
    fixed = adjusted(replace(problem, fixed_frames=(0, 1, 3)), **CONVERGED)
    held = pose_prior(problem, problem.T_cw, [0, 0, 0, 1e12, 0])
    solution = adjusted(replace(problem, pose_prior=held), **CONVERGED)
    torch.testing.assert_close(solution.T_cw, fixed.T_cw, atol=1e-6, rtol=0)
    nothing = pose_prior(problem, problem.T_cw, [0] * 5)
    torch.testing.assert_close(
        solve_bundle(replace(problem, pose_prior=nothing)).T_cw, solve_bundle(problem).T_cw
    )


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize(("weights", "is_open"), [([1, 0, 0, 0, 1], 0), ([4, 0, 0, 0, 0], 1)])
def test_priors_instead_of_fixed_frames(bundle_scene, batched, weights, is_open):
    """Two of them fix the scale as well, one leaves it open: the poses that they hold are those that they expect."""
    scene = bundle_scene(frames=5, points=60, noise=0.0, perturbation=0.02, fixed_frames=())
    problem = replace(scene.problem, pose_prior=pose_prior(scene.problem, scene.T_cw, weights))
    if batched:
        problem = replace(problem, T_cw=problem.T_cw.expand(3, 5, 4, 4))
    solution = adjusted(problem, kernel="none", **CONVERGED)
    assert solution.success.all()
    T_cw = solution.T_cw.view(-1, 5, 4, 4)[-1]
    torch.testing.assert_close(T_cw[0], scene.T_cw[0], atol=1e-8, rtol=0)
    if not is_open:
        torch.testing.assert_close(T_cw, scene.T_cw, atol=1e-6, rtol=0)
        return
    centers = [se3_inverse(T)[:, :3, 3] - se3_inverse(T)[0, :3, 3] for T in (T_cw, scene.T_cw)]
    shapes = [center / center.norm() for center in centers]
    torch.testing.assert_close(shapes[0], shapes[1], atol=1e-6, rtol=0)


def test_a_prior_weighs_against_pixels(bundle_scene):
    """The pull of the prior is balanced by that of the pixels: the gradient of both is zero, at any rotation."""
    problem = bundle_scene(frames=5, points=30, noise=1.0).problem
    off = se3_exp(torch.tensor([0.01, 0, 0, 0, 0.02, 0], dtype=torch.float64)) @ problem.T_cw
    weights = [0, 0, 0, 1e4, 1e4]
    prior = pose_prior(problem, off, weights)
    solution = adjusted(replace(problem, pose_prior=prior), kernel="none", **CONVERGED)
    twist = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
    T_cw = se3_exp(twist) @ solution.T_cw
    points_c = transform(T_cw[problem.frame_index], solution.points_w[problem.point_index][:, None])[:, 0]
    error = problem.camera.project(points_c)[0] - problem.pixels
    E = T_cw @ se3_inverse(off)
    R, t = E[:, :3, :3], E[:, :3, 3]
    rotated = se3_log(torch.cat((torch.cat((R, 0 * t[..., None]), -1), E[:, 3:]), -2))[:, 3:]
    squared = t.square().sum(-1) + rotated.square().sum(-1)
    costs = 0.5 * error.square().sum(), 0.5 * (torch.tensor(weights) * squared).sum()
    pulls = [torch.autograd.grad(cost, twist, retain_graph=True)[0][3:] for cost in costs]
    assert pulls[1].norm() > 1
    torch.testing.assert_close(pulls[0], -pulls[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(solution.cost, sum(costs).detach())


def test_a_frame_with_too_few_observations_stays_at_its_prior(bundle_scene):
    problem = bundle_scene(frames=5, points=30, noise=0.0).problem
    T_cw = torch.cat((problem.T_cw, problem.T_cw[-1:]))
    expected = se3_exp(torch.tensor([0.1, 0, 0, 0, 0.1, 0], dtype=torch.float64)) @ T_cw
    prior = pose_prior(problem, expected, [0, 0, 0, 0, 0, 100])
    solution = solve_bundle(replace(problem, T_cw=T_cw, pose_prior=prior))
    assert solution.success
    assert solution.moved_frames.tolist() == [False, False, True, True, True, True]
    torch.testing.assert_close(solution.T_cw[5], expected[5], atol=1e-8, rtol=0)
    torch.testing.assert_close(
        solution.covariance().frames[5], 0.01 * torch.eye(6).double(), atol=1e-6, rtol=0
    )


def test_the_camera_lies_between_its_prior_and_the_data(bundle_scene):
    problem = bundle_scene(frames=8, points=80, noise=0.3).problem
    mean = problem.camera.params + torch.tensor([10.0, 10.0, 0.0, 0.0], dtype=torch.float64)
    found = []
    for weight in (0.0, 1.0, 1e9):
        information = weight * torch.eye(4, dtype=torch.float64)
        prior = CameraPrior(mean, information)
        solution = adjusted(replace(problem, camera_prior=prior), free_camera=True, **CONVERGED)
        found.append(solution.camera.params)
    free = adjusted(problem, free_camera=True, **CONVERGED).camera.params
    torch.testing.assert_close(found[0], free, rtol=1e-8, atol=0)
    torch.testing.assert_close(found[2], mean, atol=1e-4, rtol=0)
    assert free[0] < found[1][0] < mean[0]
    covariance = solve_bundle(problem, free_camera=True).covariance().camera
    tight = solve_bundle(
        replace(problem, camera_prior=CameraPrior(mean, 1e4 * torch.eye(4).double())), free_camera=True
    ).covariance()
    assert (torch.linalg.eigvalsh(covariance - tight.camera) > 0).all()
    assert (tight.camera.diagonal() < 1e-4).all()


@pytest.mark.parametrize("angle", [0.0, math.pi - 0.02])
def test_gradients_to_priors_and_cameras_by_gradcheck(bundle_scene, angle):
    """Of a problem alone, its prior far from and near to half a turn off what the frames are."""
    problem, params = zoomed(bundle_scene, noise=1.0, perturbation=1e-3)
    twist = torch.zeros(8, 6, dtype=torch.float64)
    twist[:, 4] = angle
    weak = 1e-3 if angle else 50.0
    information = weak * torch.eye(6, dtype=torch.float64).expand(8, 6, 6)
    tight = 0.1 * torch.eye(4, dtype=torch.float64).expand(2, 4, 4)

    def solve(params, twist, information, mean, tight):
        prior = PosePrior(se3_exp(twist) @ problem.T_cw, 0.5 * (information + information.mT))
        moved = replace(
            problem,
            camera=Camera("pinhole", params, (640, 480)),
            pose_prior=prior,
            camera_prior=CameraPrior(mean, 0.5 * (tight + tight.mT)),
        )
        solution = adjusted(
            moved, free_camera=not angle, kernel="cauchy", scale=3.0, iterations=30, tolerance=0.0
        )
        return solution.T_cw[:, :3], solution.points_w, solution.camera.params

    inputs = (params, twist, information, params + 1.0, tight)
    leaves = [x.clone().requires_grad_(bool(angle) or index > 0) for index, x in enumerate(inputs)]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)
