from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap

from tests.optim.conftest import draw
from torchslam.geometry import matrix_from_quaternion, so3_exp, so3_log
from torchslam.optim import ROTATION_OPTIONS, UNWEIGHTED_ROTATION_OPTIONS, RotationAverage, solve_rotations

CONVERGED = {"iterations": 200, "tolerance": 1e-26}
NOISE = math.radians(1.0)


@dataclass
class Views:
    """True rotations, measured relative ones, which of them are wrong, and their inverse variances."""

    R_cw: Tensor
    edges: Tensor
    R_ji: Tensor
    is_wrong: Tensor
    weights: Tensor


def make_views(
    edges: list[tuple[int, int]], noise: float = NOISE, wrong: float = 0.0, seed: int = 0
) -> Views:
    """Random views; a share of the edges, spread over the graph, is replaced by random rotations."""
    index = torch.tensor(edges)
    R_cw = so3_exp(3 * draw(seed, int(index.max()) + 1, 3))
    R_ji = so3_exp(noise * draw(seed + 1, len(edges), 3)) @ R_cw[index[:, 1]] @ R_cw[index[:, 0]].mT
    is_wrong = torch.arange(len(edges)) < round(wrong * len(edges))
    is_wrong = is_wrong[torch.randperm(len(edges), generator=torch.Generator().manual_seed(seed))]
    any_rotation = matrix_from_quaternion(draw(seed + 2, len(edges), 4))
    R_ji = torch.where(is_wrong[:, None, None], any_rotation, R_ji)
    return Views(R_cw, index, R_ji, is_wrong, torch.full((len(edges),), (noise or 1.0) ** -2).double())


def chain(count: int, reach: int, loops: int = 0) -> list[tuple[int, int]]:
    """Each view with the next few, and pairs of views halfway around."""
    near = [(k, k + step) for step in range(1, reach + 1) for k in range(count - step)]
    return near + [(k, k + count // 2) for k in range(loops)]


def scattered(count: int, degree: int, seed: int = 0) -> list[tuple[int, int]]:
    """Random pairs among which all views are joined."""
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count)]
    order = torch.randperm(len(pairs), generator=torch.Generator().manual_seed(seed)).tolist()
    return sorted({pairs[k] for k in order[: count * degree // 2]} | set(chain(count, 1)))


def average(views: Views, **options: Any) -> RotationAverage:
    weights, start = options.pop("weights", views.weights), options.pop("start", None)
    given = UNWEIGHTED_ROTATION_OPTIONS if weights is None else ROTATION_OPTIONS
    options = given.replace(**options)
    return solve_rotations(views.edges, views.R_ji, len(views.R_cw), weights, start, options=options)


def errors(R_cw: Tensor, expected: Tensor) -> Tensor:
    """(K,) angles in radians from what is expected, after the rotation of the world that makes them small."""
    U, _, Vh = torch.linalg.svd((R_cw.mT @ expected).sum(0))
    U[:, 2] *= torch.linalg.det(U @ Vh)
    return so3_log(R_cw @ U @ Vh @ expected.mT).norm(dim=-1)


def test_exact_rotations_come_out_up_to_the_gauge() -> None:
    views = make_views(scattered(20, 6), noise=0.0)
    solution = average(views, weights=None)
    torch.testing.assert_close(solution.R_cw, views.R_cw @ views.R_cw[0].mT, rtol=0, atol=1e-9)
    assert solution.success.all()
    assert (solution.component == 0).all()
    assert solution.angles.max() < 1e-9
    assert solution.convergence.converged.all()


@pytest.mark.parametrize(
    ("weights", "shares"), [((1, 1, 1), (0.1, 0.1, 0.1)), ((1, 2, 2), (0.15, 0.075, 0.075))]
)
def test_the_error_of_a_loop_is_shared_by_variance(
    weights: tuple[int, ...], shares: tuple[float, ...]
) -> None:
    """0.3 radians about one axis around three views."""
    around = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    R_ji = so3_exp(torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)[:, None] * around)
    solution = solve_rotations(
        torch.tensor([(0, 1), (1, 2), (2, 0)]),
        R_ji,
        3,
        torch.tensor(weights).double(),
        options=ROTATION_OPTIONS.replace(kernel="none", **CONVERGED),
    )
    expected = torch.stack((0 * around, (0.3 - shares[0]) * around, shares[2] * around))
    torch.testing.assert_close(so3_log(solution.R_cw), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(solution.angles, torch.tensor(shares, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("edges", [scattered(60, 12), chain(60, 5, loops=20)], ids=["scattered", "chain"])
def test_a_third_of_wrong_edges_does_no_harm(edges: list[tuple[int, int]], seed: int) -> None:
    views = make_views(edges, wrong=0.3, seed=seed)
    solution = average(views)
    right = average(views, weights=torch.where(views.is_wrong, 0.0, views.weights))
    assert solution.success.all()
    assert right.success.all()
    assert (right.component == 0).all()
    assert errors(solution.R_cw, right.R_cw).max() < 0.5 * NOISE
    limit = 5 * NOISE
    assert (solution.angles[~views.is_wrong] < limit).all()
    assert (solution.angles[views.is_wrong] > limit).double().mean() > 0.99
    assert torch.isinf(right.angles[views.is_wrong]).all()


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("edges", [scattered(100, 7), chain(100, 4, loops=20)], ids=["scattered", "chain"])
def test_where_wrong_edges_outvote_right_ones_the_minimum_is_as_low(
    edges: list[tuple[int, int]], seed: int
) -> None:
    """As that which begins with the right edges alone. A few views have more wrong ones."""
    views = make_views(edges, wrong=0.3, seed=seed)
    i, j = views.edges.unbind(-1)

    def cost(R_cw: Tensor) -> float:
        squared = views.weights * so3_log(R_cw[j] @ R_cw[i].mT @ views.R_ji.mT).square().sum(-1)
        return float((squared / (1 + squared / 2.8**2)).sum())

    right = average(views, weights=torch.where(views.is_wrong, 0.0, views.weights))
    assert cost(average(views).R_cw) < 1.0001 * cost(right.R_cw)


def test_a_wrong_edge_that_claims_to_be_accurate_is_not_believed() -> None:
    views = make_views(chain(12, 3), wrong=0.1)
    weights = torch.where(views.is_wrong, 1e4 * views.weights, views.weights)
    assert errors(average(views, weights=weights).R_cw, views.R_cw).max() < 3 * NOISE


def test_the_minimum_equals_that_of_colmap() -> None:
    """Its kernel is the same one, of 5 degrees without weights, minimized by reweighted least squares."""
    pycolmap = pytest.importorskip("pycolmap")
    views = make_views(scattered(40, 10), wrong=0.15)
    reconstruction, graph = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
    reconstruction.add_camera_with_trivial_rig(camera)
    for view in range(len(views.R_cw)):
        image = pycolmap.Image(f"{view}", image_id=view + 1, camera_id=1)
        reconstruction.add_image_with_trivial_frame(image)
    for (i, j), R in zip(views.edges.tolist(), views.R_ji.numpy(), strict=True):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), torch.zeros(3).numpy())
        graph.add_edge(i + 1, j + 1, pycolmap.PoseGraphEdge(pose))
    options = pycolmap.RotationEstimatorOptions(
        random_seed=0, max_num_irls_iterations=1000, irls_step_convergence_threshold=1e-12
    )
    assert pycolmap.run_rotation_averaging(options, graph, reconstruction, [])
    poses = [reconstruction.image(view + 1).cam_from_world() for view in range(len(views.R_cw))]
    expected = torch.stack([torch.from_numpy(pose.rotation.matrix()) for pose in poses])
    solution = average(views, weights=None)
    assert errors(solution.R_cw, expected).max() < 1e-5


def test_parts_that_no_edge_joins_are_averaged_on_their_own() -> None:
    """Even views, odd ones, and view 24, with edges that do not count: to others, and between the parts."""
    even, odd = (make_views(chain(12, 3), seed=seed) for seed in (0, 1))
    edges = torch.cat((2 * even.edges, 2 * odd.edges + 1, torch.tensor([(24, 0), (1, 24), (5, 8)])))
    useless = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
    useless[0] = torch.nan
    weights = torch.cat((even.weights, odd.weights, torch.tensor([1e4, 0.0, torch.nan], dtype=torch.float64)))
    R_ji = torch.cat((even.R_ji, odd.R_ji, useless)).requires_grad_()
    weights.requires_grad_()
    solution = solve_rotations(edges, R_ji, 25, weights, options=ROTATION_OPTIONS.replace(**CONVERGED))
    assert solution.component.tolist() == [0, 1] * 12 + [24]
    assert solution.success.all()
    assert torch.isinf(solution.angles).tolist() == [False] * (len(edges) - 3) + [True] * 3
    eye = torch.eye(3, dtype=torch.float64)
    for view in (0, 1, 24):
        assert torch.equal(solution.R_cw[view], eye)
    for first, part in enumerate((even, odd)):
        expected = average(part, **CONVERGED)
        torch.testing.assert_close(solution.R_cw[first:24:2], expected.R_cw, rtol=0, atol=1e-6)
    solution.R_cw.sum().backward()
    for gradient in (R_ji.grad, weights.grad):
        assert torch.isfinite(gradient).all()
        assert (gradient[-3:] == 0).all()
        assert (gradient[:-3].flatten(1) if gradient.ndim > 1 else gradient[:-3, None]).any(-1).all()


@pytest.mark.parametrize("backward", ["implicit", "unroll", "truncated", "detached"])
def test_views_without_edges_stay_where_they_are(backward: str) -> None:
    nothing = torch.zeros(0, 3, 3, dtype=torch.float64, requires_grad=True)
    solution = solve_rotations(
        torch.zeros(0, 2, dtype=torch.int64),
        nothing,
        2,
        options=UNWEIGHTED_ROTATION_OPTIONS.replace(backward=backward),
    )
    assert torch.equal(solution.R_cw, torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    assert solution.component.tolist() == [0, 1]
    assert solution.success.tolist() == [True, True]
    assert solution.angles.shape == (0,)
    start = so3_exp(draw(0, 1, 3))
    alone = solve_rotations(
        torch.zeros(0, 2, dtype=torch.int64),
        nothing,
        1,
        start=start,
        options=UNWEIGHTED_ROTATION_OPTIONS.replace(backward=backward),
    )
    assert torch.equal(alone.R_cw, start)


def test_a_part_that_is_not_determined_costs_no_other_its_gradient() -> None:
    """Views 4 and 5 hang on view 3 by an edge that is lost in the rounding of the one between them."""
    edges = torch.tensor([(0, 1), (1, 2), (2, 0), (3, 4), (4, 5)])
    weights = torch.tensor([1e3, 1e3, 1e3, 1e-4, 1e12], dtype=torch.float64)
    R_ji = so3_exp(0.01 * draw(0, 5, 3)).requires_grad_()
    solution = solve_rotations(edges, R_ji, 6, weights)
    assert solution.success.tolist() == [True] * 3 + [False] * 3
    assert torch.isfinite(solution.R_cw).all()
    solution.R_cw.sum().backward()
    assert R_ji.grad[:3].flatten(1).any(-1).all()
    assert (R_ji.grad[3:] == 0).all()


def test_a_view_that_loses_all_its_edges_is_flagged() -> None:
    """Six views agree; each asks the seventh for a rotation just beyond the kernel, all of them different."""
    among = [(a, b) for b in range(6) for a in range(b)]
    edges = torch.tensor(among + [(k, 6) for k in range(6)])
    axes = torch.eye(3, dtype=torch.float64)
    R_ji = torch.cat((axes.expand(15, 3, 3), so3_exp(0.105 * torch.cat((axes, -axes))))).requires_grad_()
    weights = torch.tensor([1e4] * 15 + [1.0] * 6, dtype=torch.float64)
    for kernel, is_kept in (("geman_mcclure", True), ("truncated", False)):
        solution = solve_rotations(
            edges, R_ji, 7, weights, options=ROTATION_OPTIONS.replace(kernel=kernel, scale=0.1)
        )
        assert solution.success.tolist() == [is_kept] * 7
        (gradient,) = torch.autograd.grad(solution.R_cw[6].sum(), R_ji)
        assert bool(gradient.any()) == is_kept


@pytest.mark.parametrize("kernel", ["geman_mcclure", "huber"])
def test_gradcheck(kernel: str) -> None:
    """Of the measured rotations, the weights and the scale, with one wrong edge and large residuals."""
    views = make_views(chain(4, 3), noise=0.1)
    R_ji = views.R_ji.clone()
    R_ji[2] = so3_exp(draw(5, 3)) @ R_ji[2]

    def rotations(twist: Tensor, log_weights: Tensor, scale: Tensor) -> Tensor:
        weights = views.weights * log_weights.exp()
        solution = solve_rotations(
            views.edges,
            so3_exp(twist) @ R_ji,
            4,
            weights,
            options=ROTATION_OPTIONS.replace(kernel=kernel, scale=scale, **CONVERGED),
        )
        return solution.R_cw[1:]

    inputs = (torch.zeros(len(R_ji), 3).double(), 0.3 * draw(6, len(R_ji)), torch.tensor(3.0).double())
    leaves = [x.requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(rotations, leaves, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=True)


def test_gradient_to_the_start_is_that_of_the_first_view() -> None:
    views = make_views(scattered(6, 4))
    start = (views.R_cw @ so3_exp(torch.ones(3).double())).requires_grad_()
    solution = average(views, start=start, **CONVERGED)
    assert torch.equal(solution.R_cw[0], start[0])
    grad = torch.autograd.grad(solution.R_cw[4, 0, 1], start)[0]
    assert (grad[1:] == 0).all()
    # R_4 = R_40 R_0 turns with the world.
    expected = torch.zeros(3, 3).double()
    expected[:, 1] = (solution.R_cw[4] @ solution.R_cw[0].mT)[0].detach()
    world = expected.mT @ start[0].detach() - start[0].detach().mT @ expected
    found = grad[0].mT @ start[0].detach() - start[0].detach().mT @ grad[0]
    torch.testing.assert_close(found, world, rtol=0, atol=1e-8)


def test_wrong_edges_have_nearly_no_gradient() -> None:
    views = make_views(scattered(20, 8), wrong=0.2)
    R_ji, weights = views.R_ji.clone().requires_grad_(), views.weights.clone().requires_grad_()
    solution = solve_rotations(views.edges, R_ji, 20, weights, options=ROTATION_OPTIONS.replace(**CONVERGED))
    (solution.R_cw * draw(7, 20, 3, 3)).sum().backward()
    for gradient in (R_ji.grad.flatten(1).norm(dim=-1), (weights.grad * weights.detach()).abs()):
        assert gradient[views.is_wrong].max() < 1e-2 * gradient[~views.is_wrong].median()


def test_derivatives_in_both_directions_and_twice() -> None:
    views = make_views(scattered(5, 4), noise=0.05)

    ramp, sums = torch.linspace(-1, 1, len(views.R_ji)).double()[:, None], draw(8, 2, 5, 3, 3)

    def mixed(x: Tensor) -> Tensor:
        solution = solve_rotations(
            views.edges,
            so3_exp(x[:3] * ramp) @ views.R_ji,
            5,
            views.weights * (1 + x[3].square()),
            options=ROTATION_OPTIONS.replace(**CONVERGED),
        )
        return (solution.R_cw * sums).flatten(1).sum(-1)

    x = torch.tensor([0.1, -0.2, 0.05, 0.3], dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(mixed, x)
    assert expected.abs().min() > 1e-3
    torch.testing.assert_close(jacrev(mixed)(x), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(jacfwd(mixed)(x), expected, rtol=0, atol=1e-9)
    second = hessian(lambda x: mixed(x)[0])(x)
    step = 1e-5 * torch.eye(4, dtype=torch.float64)
    central = torch.stack([(jacrev(mixed)(x + d)[0] - jacrev(mixed)(x - d)[0]) / 2e-5 for d in step])
    torch.testing.assert_close(second, central, rtol=1e-4, atol=1e-6)
    with pytest.raises(RuntimeError, match="components"):
        vmap(mixed)(x[None])


def test_order_and_direction_of_edges_do_not_change_a_bit() -> None:
    """Also of two measurements of one pair."""
    views = make_views([*scattered(30, 8), (0, 1), (3, 4)], wrong=0.2)
    order = torch.randperm(len(views.edges), generator=torch.Generator().manual_seed(3))
    is_reversed = order % 3 == 0
    edges = torch.where(is_reversed[:, None], views.edges[order].flip(-1), views.edges[order])
    R_ji = torch.where(is_reversed[:, None, None], views.R_ji[order].mT, views.R_ji[order])
    plain = average(views)
    other = solve_rotations(edges, R_ji, 30, views.weights[order])
    assert torch.equal(other.R_cw, plain.R_cw)
    assert torch.equal(other.angles, plain.angles[order])


@settings(max_examples=6, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.integers(0, 100))
def test_turning_the_world_of_the_start_turns_the_result(turn: list[float], seed: int) -> None:
    views = make_views(scattered(8, 4, seed), wrong=0.1, seed=seed)
    start = so3_exp(0.1 * draw(seed + 9, 8, 3)) @ views.R_cw
    turned = so3_exp(torch.tensor(turn, dtype=torch.float64))
    plain = average(views, start=start, **CONVERGED)
    other = average(views, start=start @ turned, **CONVERGED)
    torch.testing.assert_close(other.R_cw, plain.R_cw @ turned, rtol=0, atol=1e-7)
    torch.testing.assert_close(other.angles, plain.angles, rtol=0, atol=1e-7)
    assert torch.equal(plain.R_cw[0], start[0])


def test_a_view_whose_start_is_not_finite_is_left_out() -> None:
    views = make_views(chain(8, 3))
    start = views.R_cw.clone()
    start[3] = torch.nan
    solution = average(views, start=start)
    assert solution.component.tolist() == [0, 0, 0, 3, 0, 0, 0, 0]
    assert torch.equal(solution.R_cw[3], torch.eye(3, dtype=torch.float64))
    assert torch.isinf(solution.angles).tolist() == (views.edges == 3).any(-1).tolist()
    assert errors(solution.R_cw, views.R_cw)[[0, 1, 2, 4, 5, 6, 7]].isfinite().all()


@pytest.mark.usefixtures("without_shape_checks")
def test_invalid_input_is_rejected_by_name() -> None:
    views = make_views(chain(4, 2))
    edges, R_ji = views.edges, views.R_ji
    with pytest.raises(ValueError, match="start"):
        solve_rotations(edges, R_ji, 4, start=views.R_cw[1:])
    with pytest.raises(ValueError, match=r"0 \.\.\. 2"):
        solve_rotations(edges, R_ji, 3)
    with pytest.raises(ValueError, match="itself"):
        solve_rotations(0 * edges, R_ji, 4)
    with pytest.raises(ValueError, match="num_views"):
        solve_rotations(edges[:0], R_ji[:0], 0)
    with pytest.raises(ValueError, match="scale"):
        solve_rotations(edges, R_ji, 4, options=UNWEIGHTED_ROTATION_OPTIONS.replace(scale=0.0))
