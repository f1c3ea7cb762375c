"""Depths, distances, relative poses and errors of one's own beside the reprojection errors."""

from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from tests.optim.conftest import adjusted, minimized
from torchslam.geometry import se3_exp, se3_inverse, se3_log, transform
from torchslam.optim import (
    BUNDLE_OPTIONS,
    DepthPrior,
    Factors,
    displacement_error,
    relative_pose_error,
    solve_bundle,
)
from torchslam.optim.bundle import _factors
from torchslam.optim.bundle.dense_numpy import solve_bundle_numpy

CONVERGED = {"iterations": 100, "tolerance": 1e-18, "strict": True}


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def spd(count, size, weight=1e3):
    A = draw(count, size, size, seed=5)
    return weight * (A @ A.mT + torch.eye(size))


def depths_of(scene):
    """z of every observation in truth."""
    problem = scene.problem
    return transform(scene.T_cw[problem.frame_index], scene.points_w[problem.point_index][:, None])[:, 0, 2]


def motions_of(T_cw, frames):
    return T_cw[frames[:, 1]] @ se3_inverse(T_cw[frames[:, 0]])


def centers(T_cw):
    return se3_inverse(T_cw)[..., :3, 3]


@pytest.mark.parametrize("fixed", [(0,), ()])
@pytest.mark.parametrize("kind", ["depths", "distances", "motions", "displacements"])
def test_each_determines_the_scale(bundle_scene, kind, fixed):
    """With the truth 1.3 times as large, the map grows by as much; without, it keeps the scale of the start."""
    scene = bundle_scene(noise=0.0, frames=6, points=50, fixed_frames=fixed)
    frames = torch.tensor([(1, 4), (5, 2)])
    pairs = centers(scene.T_cw)[frames]
    long = (pairs[:, 1] - pairs[:, 0]).norm(dim=-1)
    T_21 = motions_of(scene.T_cw, frames)
    T_21[:, :3, 3] *= 1.3
    lever = torch.tensor((0.1, -0.2, 0.05), dtype=torch.float64)
    arms = (se3_inverse(scene.T_cw)[frames][..., :3, :3] @ lever[:, None]).squeeze(-1)
    antennas = 1.3 * pairs + arms
    more = {
        "depths": {
            "depth_prior": DepthPrior(1.3 * depths_of(scene), torch.ones(len(scene.problem.pixels)).double())
        },
        "distances": {"factors": (Factors.distances(frames, 1.3 * long, torch.full((2,), 1e4).double()),)},
        "motions": {
            "factors": (Factors.relative_poses(frames, T_21, 1e4 * torch.eye(6).double().expand(2, 6, 6)),)
        },
        "displacements": {
            "factors": (
                Factors.displacements(
                    frames,
                    antennas[:, 1] - antennas[:, 0],
                    1e4 * torch.eye(3).double().expand(2, 3, 3),
                    lever,
                ),
            )
        },
    }[kind]
    solution = adjusted(replace(scene.problem, **more), kernel="none", **CONVERGED)
    found = (centers(solution.T_cw)[1:] - centers(solution.T_cw)[0]).norm(dim=-1)
    true = (centers(scene.T_cw)[1:] - centers(scene.T_cw)[0]).norm(dim=-1)
    torch.testing.assert_close(found, 1.3 * true, rtol=1e-5, atol=0)
    assert solution.cost < 1e-9


def started_at(solution):
    """What of a problem makes a solution its start, from which one with other measurements is a few steps away."""
    camera = solution.camera.with_params(solution.camera.params.detach())
    return {"T_cw": solution.T_cw.detach(), "points_w": solution.points_w.detach(), "camera": camera}


def mixed(scene, frames):
    """A problem with all kinds, with noise, and the tensors that it has gradients to."""
    problem = scene.problem
    pairs = centers(scene.T_cw)[frames]
    tensors = {
        "T_21": se3_exp(0.02 * draw(len(frames), 6, seed=1)) @ motions_of(scene.T_cw, frames),
        "T_information": spd(len(frames), 6),
        "distances": (pairs[:, 1] - pairs[:, 0]).norm(dim=-1) * (0.05 * draw(len(frames), seed=2)).exp(),
        "distance_information": torch.full((len(frames),), 400.0).double(),
        "depths": depths_of(scene) * (0.1 * draw(len(problem.pixels), seed=3)).exp(),
        "depth_information": 50 + 50 * draw(len(problem.pixels), seed=8).sigmoid(),
        "heights": 0.01 * draw(len(frames), seed=4),
    }

    def with_all(tensors, **options):
        factors = (
            Factors.relative_poses(frames, tensors["T_21"], tensors["T_information"]),
            Factors.distances(frames, tensors["distances"], tensors["distance_information"]),
            Factors(
                frames,
                tensors["heights"],
                torch.full((len(frames), 1, 1), 1e3).double(),
                difference_of_heights,
            ),
        )
        depths = DepthPrior(tensors["depths"], tensors["depth_information"])
        return replace(problem, factors=factors, depth_prior=depths, **options)

    return with_all, tensors


def test_the_displacement_of_an_antenna():
    """A camera that turns on the spot moves its antenna; gradients reach poses, displacement and lever arm."""
    T_1w, T_2w = se3_exp(draw(2, 6)), se3_exp(draw(2, 6, seed=1))
    turned = se3_exp(torch.tensor((0.0, 0, 0, 0, 0, torch.pi / 2), dtype=torch.float64))
    measured = torch.tensor([[[0.0, 0, 0], [1, 0, 0]]], dtype=torch.float64)
    expected = torch.tensor([[-1.0, -1, 0]], dtype=torch.float64)
    start = torch.eye(4, dtype=torch.float64)[None]
    torch.testing.assert_close(displacement_error(start, turned[None], measured), expected)
    inputs = (T_1w.requires_grad_(), T_2w.requires_grad_(), draw(2, 2, 3, seed=2).requires_grad_())
    assert gradcheck(displacement_error, inputs, atol=1e-6)


def difference_of_heights(T_1w, T_2w, measured):
    """An error of one's own: the second camera is so much lower than the first."""
    return (centers(T_2w)[..., 1] - centers(T_1w)[..., 1] - measured)[..., None]


def test_the_minimum_is_that_of_the_written_out_cost(bundle_scene):
    """Against `minimize`, with one dense Hessian: poses, and the gradient to everything that is measured."""
    scene = bundle_scene(noise=1.0, frames=4, points=12, visible=1.0, fixed_frames=(0,))
    frames = torch.tensor([(0, 2), (1, 2), (3, 1), (1, 2)])
    with_all, tensors = mixed(scene, frames)
    problem = scene.problem
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in tensors.items()}
    pixels = problem.pixels.clone().requires_grad_()
    solution = adjusted(with_all(leaves, pixels=pixels), kernel="none", **CONVERGED)

    def residual(T_free, points_w, T_21, T_info, distances, d_info, depths, z_info, heights, pixels):
        T_cw = torch.cat((problem.T_cw[:1].expand(len(T_free), 1, 4, 4), T_free), dim=1)
        points_c = (T_cw[:, problem.frame_index, :3, :3] @ points_w[:, problem.point_index, :, None]).squeeze(
            -1
        ) + T_cw[:, problem.frame_index, :3, 3]
        seen = problem.camera.project(points_c)[0] - pixels
        T_1w, T_2w = T_cw[:, frames[:, 0]], T_cw[:, frames[:, 1]]
        between = (centers(T_2w) - centers(T_1w)).norm(dim=-1)
        L = torch.linalg.cholesky(T_info)
        parts = (
            seen,
            (L.mT @ relative_pose_error(T_1w, T_2w, T_21)[..., None]).squeeze(-1),
            d_info.sqrt() * (between / distances).log(),
            z_info.sqrt() * (points_c[..., 2] / depths).log(),
            1e3**0.5 * difference_of_heights(T_1w, T_2w, heights),
        )
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    start = problem.T_cw[None, 1:], problem.points_w[None]
    other = [tensor.clone().requires_grad_() for tensor in (*tensors.values(), problem.pixels)]
    expected = minimized(
        residual, start, [x[None] for x in other], ("se3", "euclidean"), iterations=100, tolerance=1e-18
    )
    assert expected.success.all()
    torch.testing.assert_close(solution.T_cw[1:], expected.unknowns[0][0], rtol=0, atol=1e-9)
    torch.testing.assert_close(solution.points_w, expected.unknowns[1][0], rtol=0, atol=1e-8)
    torch.testing.assert_close(solution.cost, expected.cost[0], rtol=1e-9, atol=0)
    weights = draw(3, 3, seed=9), draw(12, 3, seed=10)
    loss = (weights[0] * solution.T_cw[1:, :3, 3]).sum() + (weights[1] * solution.points_w).sum()
    wanted = (weights[0] * expected.unknowns[0][0, :, :3, 3]).sum() + (
        weights[1] * expected.unknowns[1][0]
    ).sum()
    found = torch.autograd.grad(loss, [*leaves.values(), pixels])
    for name, mine, right in zip((*leaves, "pixels"), found, torch.autograd.grad(wanted, other), strict=True):
        mine, right = (0.5 * (x + x.mT) if name == "T_information" else x for x in (mine, right))
        assert right.abs().max() > 0, name
        torch.testing.assert_close(mine, right, rtol=1e-5, atol=1e-9 * float(right.abs().max()), msg=name)


def test_the_gradient_agrees_with_differences_with_free_camera_and_kernel(bundle_scene):
    scene = bundle_scene(noise=1.0, frames=6, points=40, fixed_frames=(0,))
    with_all, tensors = mixed(scene, torch.tensor([(0, 2), (1, 5), (3, 4)]))
    along = torch.tensor([[1.0], [1.0], [0.0], [0.0]]).double()

    def solved(tensors, **start):
        options = BUNDLE_OPTIONS.replace(kernel="cauchy", scale=2.0, **CONVERGED)
        return solve_bundle(with_all(tensors, **start), free_camera=along, options=options)

    def loss(solution):
        return solution.T_cw[5, 0, 3]

    names = ("T_21", "distances", "depths", "depth_information", "heights")
    leaves = {name: tensors[name].clone().requires_grad_() for name in names}
    solution = solved(tensors | leaves)
    gradients = torch.autograd.grad(loss(solution), list(leaves.values()))
    near = started_at(solution)
    for name, gradient in zip(names, gradients, strict=True):
        step = 1e-4 * tensors[name].abs().mean() * draw(*gradient.shape, seed=11)
        with torch.no_grad():
            up, down = (
                loss(solved(tensors | {name: tensors[name] + sign * step}, **near)) for sign in (1, -1)
            )
        torch.testing.assert_close((gradient * step).sum(), 0.5 * (up - down), rtol=1e-3, atol=1e-12)


def test_what_an_error_closes_over_has_its_gradient(bundle_scene):
    """Parameters of a network and a tensor with a history, to second order and by every transform."""
    scene = bundle_scene(noise=1.0, frames=3, points=10, fixed_frames=(0,))
    frames = torch.tensor([(0, 2), (1, 2)])
    T_21, information = motions_of(scene.T_cw, frames), spd(2, 6)

    def position(weight, offset):
        def learned(T_1w, T_2w, T_21):
            error = relative_pose_error(T_1w, T_2w, T_21)
            shown = torch.tanh(error[..., :1] + 0.1 * offset.square())
            return error + torch.nn.functional.linear(shown, weight)

        factors = (Factors(frames, T_21, information, learned),)
        solution = adjusted(replace(scene.problem, factors=factors), kernel="none", **CONVERGED)
        return solution.T_cw[2, :3, 3]

    given = (0.1 * draw(6, 1)).requires_grad_(), draw(1, seed=1).requires_grad_()
    assert gradcheck(position, given, eps=1e-5, atol=1e-8, rtol=1e-6)
    assert gradgradcheck(lambda *x: position(*x)[0], given, eps=1e-5, atol=1e-7, rtol=1e-4, fast_mode=True)
    wanted = torch.autograd.functional.jacobian(position, given)
    for mode in (torch.func.jacrev, torch.func.jacfwd):
        for found, expected in zip(mode(position, (0, 1))(*given), wanted, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-10)
    with pytest.raises(RuntimeError, match="vmap over a tensor that an error closes over"):
        torch.vmap(position, (0, None))(torch.stack([given[0]] * 2), given[1])


def test_a_frame_that_sees_nothing_follows_its_factors(bundle_scene):
    scene = bundle_scene(noise=0.0, frames=5, points=40)
    problem = scene.problem
    frames = torch.tensor([(1, 4)])
    T_21 = motions_of(scene.T_cw, frames)
    factors = (Factors.relative_poses(frames, T_21, torch.eye(6).double()[None]),)
    blind = replace(problem, mask=problem.frame_index != 4, factors=factors)
    solution = adjusted(blind, kernel="none", **CONVERGED)
    torch.testing.assert_close(solution.T_cw, scene.T_cw, atol=1e-7, rtol=0)
    unheld = adjusted(replace(blind, factors=()), kernel="none")
    assert torch.equal(unheld.T_cw[4], problem.T_cw[4])


def test_covariances_shrink_by_what_is_measured(bundle_scene):
    scene = bundle_scene(noise=0.5, frames=5, points=40)  # two fixed frames: the scale is not open without
    with_all, tensors = mixed(scene, torch.tensor([(0, 2), (1, 2)]))
    bare, held = (adjusted(p, kernel="none").covariance().frames for p in (scene.problem, with_all(tensors)))
    assert (held[2:].diagonal(dim1=1, dim2=2) > 0).all()
    assert held[2].trace() < 0.9 * bare[2].trace()


def test_a_batch_gives_what_its_problems_alone_give(bundle_scene):
    scene = bundle_scene(noise=1.0, frames=5, points=30, visible=1.0)
    frames = torch.tensor([(1, 2), (3, 4)])
    with_all, tensors = mixed(scene, frames)
    noisy = scene.problem.pixels + torch.stack([draw(*scene.problem.pixels.shape, seed=s) for s in (0, 1)])
    both = with_all(tensors, pixels=noisy, T_cw=scene.problem.T_cw.repeat(2, 1, 1, 1))
    together = adjusted(both, **CONVERGED)
    for row in range(2):
        alone = adjusted(with_all(tensors, pixels=noisy[row]), **CONVERGED)
        torch.testing.assert_close(together.T_cw[row], alone.T_cw, rtol=0, atol=1e-10)
    T_21 = torch.stack([tensors["T_21"], se3_exp(0.01 * draw(2, 6)) @ tensors["T_21"]])
    own = (Factors.relative_poses(frames, T_21, tensors["T_information"].expand(2, -1, -1, -1)),)
    apart = adjusted(replace(both, factors=own), **CONVERGED)
    assert se3_log(apart.T_cw[1] @ se3_inverse(together.T_cw[1])).norm() > 1e-4


@pytest.mark.usefixtures("without_shape_checks")
def test_what_does_not_fit_is_refused(bundle_scene):
    problem = bundle_scene().problem
    one, eye = torch.eye(4).double()[None], torch.eye(6).double()[None]

    def refused(match, frames, measured=one, information=eye):
        factors = (Factors.relative_poses(torch.tensor(frames), measured, information),)
        with pytest.raises(ValueError, match=match):
            solve_bundle(replace(problem, factors=factors))

    refused("lie in 0", [(0, 5)])
    refused("with itself", [(1, 1)])
    refused(r"\(F, n\)", [0, 1])
    refused("F = 2", [(0, 1), (1, 2)])
    with pytest.raises(ValueError, match="depths must be"):
        solve_bundle(replace(problem, depth_prior=DepthPrior(torch.ones(3).double(), torch.ones(3).double())))
    one_factor = (Factors.relative_poses(torch.tensor([(0, 1)]), one, eye),)
    with pytest.raises(ValueError, match="use solve_bundle"):
        solve_bundle_numpy(replace(problem, factors=one_factor), 1.0, 5, 1e-8)


def test_second_derivatives_and_transforms(bundle_scene):
    """The Jacobian to the distances by both modes, under vmap."""
    scene = bundle_scene(noise=0.5, frames=4, points=20, fixed_frames=(0,))
    frames = torch.tensor([(0, 2), (1, 3)])
    long = (centers(scene.T_cw)[frames[:, 1]] - centers(scene.T_cw)[frames[:, 0]]).norm(dim=-1)

    def last(distances):
        factors = (Factors.distances(frames, distances, torch.full((2,), 1e3).double()),)
        return adjusted(replace(scene.problem, factors=factors), kernel="none").T_cw[3, :3, 3]

    reverse, forward = torch.func.jacrev(last)(long), torch.func.jacfwd(last)(long)
    torch.testing.assert_close(forward, reverse, rtol=1e-6, atol=1e-10)
    hessian = torch.func.jacfwd(torch.func.jacrev(lambda d: last(d)[0]))(long)
    step = 1e-4 * torch.tensor([1.0, -0.5]).double()
    difference = torch.func.jacrev(last)(long + step)[0] - torch.func.jacrev(last)(long - step)[0]
    torch.testing.assert_close(hessian @ step, 0.5 * difference, rtol=1e-3, atol=1e-10)


def of_all_kinds(scene):
    """Factors of frames, points and the camera with noise, and the tensors that they have gradients to."""
    T_cw, points_w = scene.T_cw, scene.points_w
    up, wall = torch.tensor((0.0, -1, 0)).double(), torch.tensor((0.0, 0.6, 0.8)).double()
    frames, points = torch.tensor([0, 3, 4]), torch.tensor([2, 5, 7, 11])
    pairs = torch.tensor([(0, 9), (5, 8)])
    down_c = T_cw[frames, :3, :3] @ -up
    tensors = {
        "T_cw": se3_exp(0.02 * draw(3, 6)) @ T_cw[frames],
        "T_information": spd(3, 6, 1e2),
        "heights": centers(T_cw)[frames] @ up + 0.02 * draw(3),
        "down_c": torch.nn.functional.normalize(down_c + 0.01 * draw(3, 3), dim=-1),
        "planes": torch.cat((wall.expand(4, 3), (points_w[points] @ wall + 0.02 * draw(4))[:, None]), dim=-1),
        "lengths": (points_w[pairs[:, 1]] - points_w[pairs[:, 0]]).norm(dim=-1) * 1.02,
        "bends": 0.1 * draw(1, 3),
        "depths": transform(T_cw[[2, 3]], points_w[[4, 6]][:, None])[:, 0, 2] + 0.01,
        "limit": torch.full((4,), 499.0).double(),
    }

    def bend(T_1w, T_2w, T_3w, measured):  # of three frames
        return centers(T_1w) - 2 * centers(T_2w) + centers(T_3w) - measured

    def depth(T_cw, point_w, measured):  # of a frame and a point
        return ((T_cw[..., :3, :3] @ point_w[..., None])[..., 2, :] + T_cw[..., 2, 3:]) - measured[..., None]

    def factors(tensors, points_too=True):
        ones, none = torch.full((4,), 400.0).double(), torch.full((4,), -torch.inf).double()
        high = torch.cat((tensors["limit"][:1], -none[1:]))
        of_points = (
            Factors.planes(points, tensors["planes"], ones),
            Factors.lengths(pairs, tensors["lengths"], ones[:2]),
            Factors(
                torch.tensor([[2], [3]]),
                tensors["depths"],
                ones[:2, None, None],
                depth,
                torch.tensor([[4], [6]]),
            ),
        )
        return (
            Factors.poses(frames, tensors["T_cw"], tensors["T_information"]),
            Factors.heights(frames, tensors["heights"], ones[:3], up),
            Factors.directions(frames, tensors["down_c"], -up, ones[:3]),
            Factors(torch.tensor([(1, 2, 4)]), tensors["bends"], 1e3 * torch.eye(3).double()[None], bend),
            Factors.camera_bounds(none, high, 10 * ones),
            *of_points * points_too,
        )

    return factors, tensors


@pytest.mark.parametrize("frames", [5, 40])
def test_factors_of_all_kinds_have_their_minimum_and_gradient(bundle_scene, frames):
    """The gradient of the written-out cost vanishes, and agrees with differences; nothing is fixed. In one
    direction of a few tensors at a time; with many frames, of all."""
    scene = bundle_scene(noise=1.0, frames=frames, points=30, fixed_frames=())
    factors, tensors = of_all_kinds(scene)
    focal = torch.tensor([[1.0], [1.0], [0.0], [0.0]]).double()

    def solved(tensors, **start):
        problem = replace(scene.problem, factors=factors(tensors), **start)
        return adjusted(problem, free_camera=focal, kernel="cauchy", scale=3.0, **CONVERGED)

    leaves = {name: tensor.clone().requires_grad_() for name, tensor in tensors.items()}
    solution = solved(leaves)
    weights = draw(frames, 4, 4, seed=6), draw(30, 3, seed=7)
    loss = (
        (weights[0] * solution.T_cw).sum()
        + (weights[1] * solution.points_w).sum()
        + solution.camera.params[0]
    )
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    slopes = dict(zip(tensors, gradients, strict=True))
    groups, near = 3 if frames < 10 else 1, started_at(solution)
    for names in (list(tensors)[group::groups] for group in range(groups)):
        steps = {name: 1e-4 * draw(*slopes[name].shape, seed=11) for name in names}
        if "T_information" in steps:
            steps["T_information"] = steps["T_information"] + steps["T_information"].mT
        with torch.no_grad():
            up, down = (
                solved(tensors | {name: tensors[name] + sign * step for name, step in steps.items()}, **near)
                for sign in (1, -1)
            )
        moved = weights[0] * (up.T_cw - down.T_cw), weights[1] * (up.points_w - down.points_w)
        difference = moved[0].sum() + moved[1].sum() + up.camera.params[0] - down.camera.params[0]
        expected = sum((slopes[name] * step).sum() for name, step in steps.items())
        torch.testing.assert_close(expected, 0.5 * difference, rtol=1e-5, atol=1e-10)
    covariance = solution.covariance()
    assert (covariance.frames.diagonal(dim1=1, dim2=2) > 0).all()
    assert (torch.linalg.eigvalsh(covariance.points) > 0).all()


@pytest.mark.parametrize("curvature", ["none", "exact"])
def test_derivatives_in_several_passes_are_those_in_one(bundle_scene, monkeypatch, curvature):
    """Many factors are differentiated a few components at a time."""
    scene = bundle_scene(noise=1.0, fixed_frames=())
    factors, tensors = of_all_kinds(scene)
    every, problem = factors(tensors), scene.problem
    packed = _factors.packed_factors(every, problem.T_cw[None], len(problem.points_w))
    at = problem.T_cw, problem.points_w, problem.camera.params[None]
    directions = torch.eye(4).double()[:, :2]

    def terms():
        given = (part[0] for part in packed)
        return _factors.factor_terms(_factors.factor_kinds(every), at, *given, directions, curvature)

    whole = terms()
    monkeypatch.setattr(_factors, "_AT_ONCE", 12)
    for part, expected in zip(terms()[:6], whole[:6], strict=True):
        torch.testing.assert_close(part, expected, rtol=1e-12, atol=1e-12)
