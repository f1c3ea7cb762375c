from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from tests.optim.conftest import draw, optimized
from torchslam.geometry import (
    sim3_adjoint,
    sim3_exp,
    sim3_inverse,
    sim3_left_jacobian,
    sim3_left_jacobian_inverse,
    sim3_log,
    sim3_scale,
    so3_exp,
)
from torchslam.optim import PoseGraph, solve_pose_graph
from torchslam.optim._core.linear import build_block_structure, dissect, factorize_sparse
from torchslam.optim.pose_graph import PoseGraphProblem, _sanitized, build_pose_graph_layout

CONVERGED = {"iterations": 200, "tolerance": 1e-26}
SIGMAS = torch.tensor([0.02, 0.02, 0.02, 0.005, 0.005, 0.005, 0.01], dtype=torch.float64)


def rotation_of(angle: float, sigma: float, seed: int = 0) -> Tensor:
    """A tangent vector (7,) with this angle and log scale."""
    xi = draw(seed, 7)
    xi[3:6] *= angle / xi[3:6].norm()
    xi[6] = sigma
    return xi


@dataclass
class Scene:
    """Truth (B, K, 4, 4), and a graph that starts away from it."""

    S_cw: Tensor
    graph: PoseGraph


def make_scene(
    nodes: int = 12,
    batch: int = 2,
    noise: float = 1.0,
    outliers: int = 0,
    spread: float = 0.1,
    seed: int = 0,
    with_scale: bool = True,
    **options: object,
) -> Scene:
    """A round trip with edges to the next two nodes, and one that closes the loop."""
    dims = 7 if with_scale else 6
    steps = 0.1 * draw(seed, batch, nodes, 7)
    steps[..., 2] += 1.0
    steps[..., 4] += 2 * math.pi / nodes
    steps[..., dims:] = 0
    S = [sim3_exp(draw(seed + 1, batch, 7) * (torch.arange(7) < dims))]
    for k in range(nodes - 1):
        S.append(sim3_exp(steps[:, k]) @ S[-1])
    S_cw = torch.stack(S, dim=1)
    edges = torch.tensor(
        [(k, k + d) for d in (1, 2) for k in range(nodes - d)] + [(nodes - 1, 0), (0, nodes // 2)]
    )
    errors = noise * SIGMAS * draw(seed + 2, batch, len(edges), 7)
    errors[:, : 5 * outliers : 5] *= 20
    errors[..., dims:] = 0
    S_ji = sim3_exp(errors) @ S_cw[:, edges[:, 1]] @ sim3_inverse(S_cw[:, edges[:, 0]])
    start = spread * draw(seed + 3, batch, nodes, 7)
    start[..., dims:] = 0
    start[:, 0] = 0
    information = torch.diag(SIGMAS[:dims] ** -2).expand(len(edges), dims, dims)
    fields = {"information": information, "with_scale": with_scale} | options
    return Scene(S_cw, PoseGraph(sim3_exp(start) @ S_cw, edges, S_ji, **fields))


@pytest.mark.parametrize("angle", [0.0, 1e-4, 1.0, math.pi - 1e-6, 4.0])
@pytest.mark.parametrize("sigma", [0.0, 1e-7, -0.7, 3.0])
def test_left_jacobian_of_sim3_agrees_with_autograd(angle: float, sigma: float) -> None:
    """Against the integral of exp(s ad) over s, as the corner of an exponential of twice the size."""
    xi = rotation_of(angle, sigma)
    at_zero = torch.zeros(7, dtype=torch.float64)
    # ad is the derivative of the adjoint at the identity.
    ad = torch.autograd.functional.jvp(lambda x: sim3_adjoint(sim3_exp(x)), at_zero, xi)[1]
    big = torch.nn.functional.pad(ad, (0, 7, 0, 7))
    big[:7, 7:] = torch.eye(7)
    expected = torch.linalg.matrix_exp(big)[:7, 7:]
    torch.testing.assert_close(sim3_left_jacobian(xi), expected, rtol=1e-12, atol=1e-12)
    product = sim3_left_jacobian_inverse(xi) @ expected
    torch.testing.assert_close(product, torch.eye(7).double(), rtol=0, atol=1e-11)


@pytest.mark.parametrize("angle", [0.0, 0.5, math.pi - 1e-3])
@pytest.mark.parametrize("sigma", [0.0, 2.5])
@pytest.mark.parametrize("dims", [6, 7])
def test_derivatives_of_an_edge_agree_with_autograd(angle: float, sigma: float, dims: int) -> None:
    """Gradient and exact Hessian over both ends of one edge, for a large residual and a robust kernel."""
    S_cw = sim3_exp(torch.stack((rotation_of(1.0, 0.4), rotation_of(2.0, -0.3, seed=1))))
    S_ji = sim3_exp(-rotation_of(angle, sigma, seed=2)) @ S_cw[1] @ sim3_inverse(S_cw[0])
    A = draw(3, 7, 7)[:dims, :dims]
    graph = PoseGraph(
        torch.cat((S_cw, S_cw[:1])),
        torch.tensor([(0, 1), (0, 2)]),
        torch.stack((S_ji, torch.eye(4).double())),
        torch.stack((A @ A.T, torch.eye(dims).double())),
        fixed=(2,),
        with_scale=dims == 7,
    )
    inputs = _sanitized(graph, 2.0)
    layout = build_pose_graph_layout(inputs.edges, inputs.counted, inputs.fixed, dims)
    problem = PoseGraphProblem(layout, inputs, "cauchy")

    def cost(xi: Tensor) -> Tensor:
        moves = sim3_exp(torch.nn.functional.pad(xi.view(2, dims), (0, 7 - dims)))
        S = torch.cat((moves @ graph.S_cw[:2], graph.S_cw[2:]))
        e = sim3_log(S[graph.edges[:, 1]] @ sim3_inverse(S[graph.edges[:, 0]]) @ sim3_inverse(graph.S_ji))
        squared = torch.einsum("ed,edf,ef->e", e[:, :dims], graph.information, e[:, :dims])
        return 2.0 * torch.log1p(squared / 4).sum()

    at = torch.zeros(2 * dims, dtype=torch.float64)
    gradient = torch.autograd.functional.jacobian(cost, at)
    hessian = torch.autograd.functional.hessian(cost, at)
    model = problem.exact_model(inputs.S_cw)
    scale = float(hessian.abs().max())
    torch.testing.assert_close(model.cost[0], cost(at))
    torch.testing.assert_close(model.gradient[0, :2].flatten(), gradient, rtol=1e-9, atol=1e-9 * scale)
    for row, diagonal in enumerate(model.diagonal[0, :2]):
        rows = slice(dims * row, dims * (row + 1))
        torch.testing.assert_close(diagonal, hessian[rows, rows], rtol=1e-8, atol=1e-8 * scale)
    assert problem.layout.structure.pairs.tolist() == [[0, 1]]
    torch.testing.assert_close(model.across[0, 0], hessian[:dims, dims:], rtol=1e-8, atol=1e-8 * scale)


def test_rotations_are_rigid_poses_without_translation() -> None:
    """The same minimum and gradients, with an outlier, information of their own and no node fixed by name."""
    scene = make_scene(outliers=1, with_scale=False, fixed=())
    S_cw, S_ji = (
        torch.nn.functional.pad(S[..., :3, :3], (0, 1, 0, 1)) for S in (scene.graph.S_cw, scene.graph.S_ji)
    )
    S_cw[..., 3, 3] = S_ji[..., 3, 3] = 1
    A = 0.3 * draw(5, len(scene.graph.edges), 3, 3) + torch.eye(3)
    results = []
    for dims in (3, 6):
        n = 3 if dims == 3 else 4
        twist = torch.zeros(2, len(A), 3, dtype=torch.float64, requires_grad=True)
        root = A.clone().requires_grad_()
        information = torch.nn.functional.pad(4e4 * root.mT @ root, (dims - 3, 0, dims - 3, 0))
        information = information + torch.diag((torch.arange(dims) < dims - 3).double())
        turned = so3_exp(twist) if dims == 3 else sim3_exp(torch.nn.functional.pad(twist, (3, 1)))
        graph = replace(
            scene.graph, S_cw=S_cw[..., :n, :n], S_ji=turned @ S_ji[..., :n, :n], information=information
        )
        solution = optimized(graph, kernel="cauchy", **CONVERGED)
        assert solution.success.all()
        R_cw = solution.S_cw[..., :3, :3]
        gradient = torch.autograd.grad((R_cw * draw(6, 2, 12, 3, 3)).sum(), (twist, root))
        results.append((R_cw.detach(), solution.cost, *gradient))
    for rotations, poses in zip(*results, strict=True):
        torch.testing.assert_close(rotations, poses, rtol=1e-6, atol=1e-9)


def test_a_start_at_the_minimum_is_seen_to_be_one() -> None:
    """Along edges without a loop nothing is left to be reduced but roundings."""
    scene = make_scene()
    tree = scene.graph.edges[:, 1] == scene.graph.edges[:, 0] + 1
    S = [scene.graph.S_cw[:, 0]]
    for S_ji in scene.graph.S_ji[:, tree].unbind(1):
        S.append(S_ji @ S[-1])
    graph = replace(
        scene.graph,
        S_cw=torch.stack(S, dim=1),
        edges=scene.graph.edges[tree],
        S_ji=scene.graph.S_ji[:, tree],
        information=scene.graph.information[tree],
    )
    convergence = solve_pose_graph(graph).convergence
    assert convergence.converged.all()
    assert (convergence.iterations <= 1).all()


@pytest.mark.parametrize("with_scale", [True, False])
def test_exact_measurements_give_the_exact_nodes(with_scale: bool) -> None:
    scene = make_scene(noise=0.0, with_scale=with_scale)
    solution = solve_pose_graph(scene.graph)
    assert solution.success.all()
    assert solution.moved.tolist() == [[False] + [True] * 11] * 2
    torch.testing.assert_close(solution.S_cw, scene.S_cw, rtol=0, atol=1e-9)
    assert (solution.cost < 1e-12).all()


def test_a_loop_in_log_scale_has_the_known_solution() -> None:
    """Scale drift 0.3 around a loop of three equal edges: a third of it on each of them."""
    eye = torch.eye(4, dtype=torch.float64)
    S_ji = eye.repeat(3, 1, 1)
    S_ji[0, :3, :3] *= math.exp(0.3)
    graph = PoseGraph(eye.repeat(3, 1, 1), torch.tensor([(0, 1), (1, 2), (2, 0)]), S_ji)
    solution = optimized(graph, kernel="none", **CONVERGED)
    expected = torch.tensor([0.0, 0.2, 0.1], dtype=torch.float64)
    torch.testing.assert_close(sim3_scale(solution.S_cw).log(), expected, rtol=0, atol=1e-12)
    assert float(solution.cost) == pytest.approx(0.5 * 3 * 0.1**2)


def test_a_scalar_weight_scales_the_identity_and_none_means_one() -> None:
    scene = make_scene()
    weights = torch.linspace(1, 5, len(scene.graph.edges), dtype=torch.float64)
    eye = torch.eye(7, dtype=torch.float64)
    for short, full in (
        (weights, weights[:, None, None] * eye),
        (None, torch.ones_like(weights)[:, None, None] * eye),
    ):
        one, other = (solve_pose_graph(replace(scene.graph, information=value)) for value in (short, full))
        assert torch.equal(one.S_cw, other.S_cw)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman_mcclure"])
def test_robust_kernels_survive_wrong_edges(kernel: str) -> None:
    scene = make_scene(nodes=20, outliers=3, noise=0.5, spread=0.02)
    error = {
        name: (optimized(scene.graph, kernel=name).S_cw - scene.S_cw).abs().max() for name in (kernel, "none")
    }
    assert error[kernel] < 0.5 * error["none"]


@pytest.mark.parametrize("with_scale", [True, False])
def test_the_optimum_equals_that_of_gtsam(with_scale: bool) -> None:
    gtsam = pytest.importorskip("gtsam")
    scene = make_scene(nodes=30, batch=1, with_scale=with_scale)
    graph = scene.graph
    dims = graph.information.shape[-1]
    order = [3, 4, 5, 0, 1, 2, 6][:dims]  # rotation first
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def element(S_wc: Tensor) -> object:
        s = float(sim3_scale(S_wc))
        R, t = gtsam.Rot3((S_wc[:3, :3] / s).numpy()), gtsam.Point3((S_wc[:3, 3] / s).numpy())
        return gtsam.Similarity3(R, t, s) if with_scale else gtsam.Pose3(R, t)

    factor = gtsam.BetweenFactorSimilarity3 if with_scale else gtsam.BetweenFactorPose3
    prior = gtsam.PriorFactorSimilarity3 if with_scale else gtsam.PriorFactorPose3
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS[order].numpy())
    for (i, j), S_ij in zip(graph.edges.tolist(), sim3_inverse(graph.S_ji[0]), strict=True):
        factors.add(factor(i, j, element(S_ij), noise))
    for node, S_wc in enumerate(sim3_inverse(graph.S_cw[0])):
        values.insert(node, element(S_wc))
    fixed = gtsam.noiseModel.Isotropic.Sigma(dims, 1e-7)
    factors.add(prior(0, element(sim3_inverse(graph.S_cw[0, 0])), fixed))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setMaxIterations(100)
    found = gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()

    solution = optimized(graph, kernel="none", **CONVERGED)
    ours = gtsam.Values()
    for node, S_wc in enumerate(sim3_inverse(solution.S_cw[0])):
        ours.insert(node, element(S_wc))
    assert float(solution.cost) == pytest.approx(factors.error(ours), rel=1e-9)
    # Its similarities have approximate derivatives, with which it stops a little before the minimum.
    assert float(solution.cost) <= factors.error(found) * (1 + 1e-9)
    assert float(solution.cost) == pytest.approx(factors.error(found), rel=1e-4 if with_scale else 1e-8)


@pytest.mark.parametrize(("kernel", "with_scale"), [("none", True), ("cauchy", True), ("huber", False)])
def test_implicit_gradient_by_gradcheck(kernel: str, with_scale: bool) -> None:
    """With large residuals, one of them an outlier, so that only the exact Hessian passes."""
    scene = make_scene(nodes=5, noise=3.0, outliers=1, with_scale=with_scale, fixed=(0, 4))
    dims = 7 if with_scale else 6
    mask = torch.ones(2, len(scene.graph.edges), dtype=torch.bool)
    mask[1, 2] = False

    def solve(twist: Tensor, root: Tensor, anchor: Tensor, scale: Tensor) -> Tensor:
        moves = torch.nn.functional.pad(anchor, (0, 7 - dims))[:, None] * (torch.arange(5) % 4 == 0)[:, None]
        graph = replace(
            scene.graph,
            S_cw=sim3_exp(moves) @ scene.graph.S_cw,
            S_ji=sim3_exp(torch.nn.functional.pad(twist, (0, 7 - dims))) @ scene.graph.S_ji,
            information=root.mT @ scene.graph.information @ root,
            mask=mask,
        )
        return optimized(graph, kernel=kernel, scale=scale, **CONVERGED).S_cw[..., :3, :]

    edges = len(scene.graph.edges)
    inputs = (
        torch.zeros(2, edges, dims, dtype=torch.float64),
        torch.eye(dims, dtype=torch.float64) + 0.1 * draw(9, edges, dims, dims),
        torch.zeros(2, dims, dtype=torch.float64),
        torch.tensor([3.0, 4.0], dtype=torch.float64),
    )
    leaves = [x.clone().requires_grad_(kernel != "none" or n < 3) for n, x in enumerate(inputs)]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_unconnected_nodes_stay_and_have_no_gradient() -> None:
    """Nodes 10 and 11 only see each other; node 9 is joined by an edge without weight, one that is NaN, one masked."""
    for backward in ("implicit", "unroll", "truncated", "detached"):
        scene = make_scene(batch=1)
        edges = scene.graph.edges
        cut = (edges >= 9).any(-1)
        S_ji, mask = scene.graph.S_ji.clone(), torch.ones(len(edges), dtype=torch.bool)
        weights = torch.ones(len(edges), dtype=torch.float64)
        at = cut.nonzero().flatten().tolist()
        within = [row for row in at if edges[row].tolist() == [10, 11]]
        others = [row for row in at if row not in within]
        S_ji[0, others[0]] = torch.nan
        weights[others[1]] = 0.0
        mask[others[2:]] = False
        S_ji.requires_grad_()
        weights.requires_grad_()
        solution = optimized(
            replace(scene.graph, S_ji=S_ji, information=weights, mask=mask), backward=backward
        )
        assert solution.success.all()
        assert solution.moved[0].tolist() == [False] + [True] * 8 + [False] * 3
        assert torch.equal(solution.S_cw[0, 9:], scene.graph.S_cw[0, 9:])
        if backward == "detached":
            assert not solution.S_cw.requires_grad
            continue
        solution.S_cw.sum().backward()
        for gradient in (S_ji.grad[0], weights.grad):
            assert torch.isfinite(gradient).all()
            assert (gradient[cut] == 0).all()
            assert (gradient[~cut].flatten(1) if gradient.ndim > 1 else gradient[~cut]).abs().max() > 0


def test_failures_are_flagged_and_have_no_gradient() -> None:
    """Nothing fixed that is finite; information that leaves the position of node 3 open; nothing but masked edges."""
    scene = make_scene(nodes=6, batch=4)
    S_cw = scene.graph.S_cw.clone()
    S_cw[1, 0] = torch.nan
    information = scene.graph.information.repeat(4, 1, 1, 1)
    touches = (scene.graph.edges == 3).any(-1)
    information[2, touches] = information[2, touches] * (torch.arange(7) >= 3)
    mask = torch.ones(4, len(scene.graph.edges), dtype=torch.bool)
    mask[3] = False
    S_ji = scene.graph.S_ji.clone().requires_grad_()
    graph = replace(scene.graph, S_cw=S_cw, S_ji=S_ji, information=information, mask=mask)
    solution = solve_pose_graph(graph)
    assert solution.success.tolist() == [True, False, False, False]
    assert torch.isfinite(solution.S_cw).all()
    assert torch.equal(solution.S_cw[1, 1:], S_cw[1, 1:])
    assert torch.equal(solution.S_cw[3], S_cw[3])
    torch.testing.assert_close(solution.S_cw[1, 0], torch.eye(4).double())
    solution.S_cw.sum().backward()
    assert torch.isfinite(S_ji.grad).all()
    assert (S_ji.grad[1:] == 0).all()
    assert (S_ji.grad[0] != 0).any()


def test_batch_is_the_same_as_a_loop() -> None:
    scene = make_scene(batch=3, outliers=2)
    mask = torch.rand(3, len(scene.graph.edges), generator=torch.Generator().manual_seed(0)) < 0.9
    scale = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    together = optimized(replace(scene.graph, mask=mask), scale=scale)
    for row in range(3):
        one = replace(scene.graph, S_cw=scene.graph.S_cw[row], S_ji=scene.graph.S_ji[row], mask=mask[row])
        alone = optimized(one, scale=scale[row])
        assert alone.S_cw.shape == (12, 4, 4)
        assert alone.cost.shape == alone.success.shape == ()
        torch.testing.assert_close(alone.S_cw, together.S_cw[row], rtol=0, atol=1e-9)
        torch.testing.assert_close(alone.cost, together.cost[row])
        assert torch.equal(alone.moved, together.moved[row])
        assert alone.convergence.iterations[0] == together.convergence.iterations[row]


def test_order_and_direction_of_edges_do_not_matter() -> None:
    scene = make_scene(batch=1)
    order = torch.randperm(len(scene.graph.edges), generator=torch.Generator().manual_seed(0))
    S_ji = scene.graph.S_ji[:, order]
    information = scene.graph.information[order]
    plain = optimized(scene.graph, kernel="none", **CONVERGED)
    shuffled = replace(scene.graph, edges=scene.graph.edges[order], S_ji=S_ji, information=information)
    # The error of the reversed edge is minus the adjoint of the reversed measurement times that of the edge.
    carry = sim3_adjoint(S_ji)
    transposed = replace(
        shuffled,
        edges=shuffled.edges.flip(-1),
        S_ji=sim3_inverse(S_ji),
        information=carry.mT @ information @ carry,
    )
    for graph in (shuffled, transposed):
        other = optimized(graph, kernel="none", **CONVERGED)
        torch.testing.assert_close(other.S_cw, plain.S_cw, rtol=0, atol=1e-8)
        torch.testing.assert_close(other.cost, plain.cost)


def test_two_measurements_of_one_pair_both_count() -> None:
    scene = make_scene()
    graph = scene.graph
    doubled = replace(
        graph,
        edges=graph.edges.repeat(2, 1),
        S_ji=graph.S_ji.repeat(1, 2, 1, 1),
        information=graph.information.repeat(2, 1, 1),
    )
    heavy = replace(graph, information=2 * graph.information)
    one, other = (optimized(g, kernel="none", **CONVERGED) for g in (doubled, heavy))
    torch.testing.assert_close(one.S_cw, other.S_cw, rtol=0, atol=1e-9)
    torch.testing.assert_close(one.cost, other.cost)


def test_scales_stay_fixed_without_scale_estimation() -> None:
    scene = make_scene()
    graph = replace(scene.graph, information=None, with_scale=False)
    solution = solve_pose_graph(graph)
    torch.testing.assert_close(sim3_scale(solution.S_cw), sim3_scale(graph.S_cw), rtol=1e-12, atol=0)
    assert (solution.S_cw - graph.S_cw).abs().max() > 1e-3


@pytest.mark.parametrize("kind", ["chain", "loops", "star", "clique", "islands", "grid"])
def test_sparse_factorization_solves_the_dense_system(kind: str) -> None:
    generator = torch.Generator().manual_seed(0)
    K, D = 130, 3
    pairs = {
        "chain": [(k, k + 1) for k in range(K - 1)],
        "loops": [(k, k + 1) for k in range(K - 1)] + [(k, 129 - k) for k in range(0, 60, 7)],
        "star": [(0, k) for k in range(1, K)],
        "clique": [(a, b) for a in range(30) for b in range(a)],
        "islands": [(k, k + 1) for k in range(K - 1) if k % 30],
        "grid": [(k, k + 1) for k in range(K - 1) if k % 10 != 9] + [(k, k + 10) for k in range(K - 10)],
    }[kind]
    index = torch.tensor(pairs)
    across = torch.randn(2, len(pairs), D, D, generator=generator, dtype=torch.float64)
    dense = torch.zeros(2, K, D, K, D, dtype=torch.float64)
    for number, (a, b) in enumerate(pairs):
        dense[:, a, :, b] = across[:, number]
        dense[:, b, :, a] = across[:, number].mT
    dense = dense.view(2, K * D, K * D)
    dense = dense + torch.diag_embed(dense.abs().sum(-1) + 0.5)
    diagonal = torch.stack([dense[:, D * k : D * k + D, D * k : D * k + D] for k in range(K)], dim=1)
    right = torch.randn(2, K, D, generator=generator, dtype=torch.float64)
    structure = build_block_structure(K, D, index)
    factor = factorize_sparse(structure, diagonal, across)
    assert factor.definite.all()
    expected = torch.linalg.solve(dense, right.view(2, -1, 1)).view_as(right)
    torch.testing.assert_close(factor.solve(right), expected, rtol=1e-9, atol=1e-11)
    inverse = torch.linalg.inv(dense).view(2, K, D, K, D).transpose(2, 3)
    of_nodes, of_pairs = factor.inverse_blocks()
    torch.testing.assert_close(of_nodes, inverse.diagonal(dim1=1, dim2=2).movedim(-1, 1))
    torch.testing.assert_close(of_pairs, inverse[:, index[:, 0], index[:, 1]])

    diagonal[1, K // 2] *= -1.0
    broken = factorize_sparse(structure, diagonal, across)
    assert broken.definite.tolist() == [True, False]
    solution = broken.solve(right)
    torch.testing.assert_close(solution[0], expected[0], rtol=1e-9, atol=1e-11)
    assert (solution[1] == 0).all()
    for blocks in broken.inverse_blocks():
        assert (blocks[1] == 0).all()


def test_fronts_of_a_trajectory_stay_small() -> None:
    pairs = [(k, k + d) for d in (1, 2, 3) for k in range(1000 - d)] + [(0, 999), (100, 700)]
    fronts = dissect(1000, pairs)
    assert sorted(node for front in fronts for node in front.eliminated) == list(range(1000))
    assert max(len(front.eliminated) + len(front.boundary) for front in fronts) < 50
    for index, front in enumerate(fronts):
        assert all(child < index for child in front.children)


@pytest.mark.usefixtures("without_shape_checks")
def test_invalid_input_is_rejected_by_name() -> None:
    graph = make_scene().graph
    with pytest.raises(ValueError, match="information"):
        solve_pose_graph(replace(graph, with_scale=False))
    with pytest.raises(ValueError, match=r"0 \.\.\. 11"):
        solve_pose_graph(replace(graph, edges=graph.edges + 1))
    with pytest.raises(ValueError, match="itself"):
        solve_pose_graph(replace(graph, edges=0 * graph.edges))
    with pytest.raises(ValueError, match="fixed"):
        solve_pose_graph(replace(graph, fixed=torch.ones(3, dtype=torch.bool)))
