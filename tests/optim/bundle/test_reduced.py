"""The reduced system as blocks of covisible pairs: the same as the dense one, with less of it."""

from dataclasses import replace

import pytest
import torch

from torchslam.geometry import Camera, se3_exp, se3_inverse, transform
from torchslam.optim import (
    BUNDLE_OPTIONS,
    BundleProblem,
    CameraPrior,
    DepthPrior,
    Factors,
    PosePrior,
    relative_pose_error,
    solve_bundle,
)
from torchslam.optim.bundle import _schur as schur
from torchslam.optim.bundle import _sparse as sparse
from torchslam.optim.bundle._reduced import MOST_CAMERAS, SPARSE_FRAMES, BlockReduced, covisible_pairs

CONVERGED = BUNDLE_OPTIONS.replace(kernel="cauchy", scale=2.0, iterations=60, tolerance=1e-18)


def walk(frames=60, seen=4, born=6, seed=0, noise=0.5, loop=True, **options):
    """A camera walks sideways along a wall; each point is seen by `seen` frames, and at the end some of the first."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480))
    twists = 0.02 * normal(frames, 6)
    around = torch.arange(frames) * 0.5
    twists[:, 0] -= around
    T_cw = se3_exp(twists)
    first = torch.arange(frames).repeat_interleave(born)
    points_w = torch.stack(
        (around[first] + normal(len(first)), normal(len(first)), 5 + normal(len(first))), -1
    )
    points_w[:, 2].clamp_(min=3.0)
    frame_index = (first[:, None] + torch.arange(seen)).flatten().clamp(max=frames - 1)
    point_index = torch.arange(len(first)).repeat_interleave(seen)
    frame_index, point_index = torch.unique(torch.stack((frame_index, point_index)), dim=1)
    if loop:  # the last frames see the points of the first one, from afar
        late = torch.arange(frames - 3, frames).repeat_interleave(born)
        frame_index = torch.cat((frame_index, late))
        point_index = torch.cat((point_index, torch.arange(born).repeat(3)))
    pixels, _ = camera.project(transform(T_cw[frame_index], points_w[point_index][:, None])[:, 0])
    start = 1e-3 * normal(frames, 6)
    start[:2] = 0
    return BundleProblem(
        se3_exp(start) @ T_cw,
        points_w + 1e-2 * normal(len(points_w), 3),
        frame_index,
        point_index,
        pixels + noise * normal(len(pixels), 2),
        camera,
        **({"fixed_frames": (0,)} | options),
    )


@pytest.fixture
def solved(monkeypatch):
    """Solves a problem as one dense matrix, or by blocks, and says how."""

    def solve(problem, by_blocks, task=solve_bundle, **options):
        monkeypatch.setattr(schur, "SPARSE_FRAMES", 2 if by_blocks else 1000)
        monkeypatch.setattr(schur, "_TILE_POINTS", 16)
        found = []
        factorized = schur.NormalEquations.factorized

        def remember(*args, **kwargs):
            found.append(factorized(*args, **kwargs))
            return found[-1]

        with monkeypatch.context() as patch:
            patch.setattr(schur.NormalEquations, "factorized", remember)
            result = task(problem, **({"options": CONVERGED} | options))
        assert found
        assert {isinstance(each.reduced, BlockReduced) for each in found} == {by_blocks}
        return result

    return solve


def with_several_cameras(problem):
    params = problem.camera.params.repeat(3, 1)
    return replace(
        problem,
        camera=problem.camera.with_params(params),
        camera_index=torch.arange(len(problem.T_cw)) % 3,
        camera_prior=CameraPrior(params, 1e-2 * torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)),
    )


def with_factors(problem):
    """Motions between frames that see no common point, one of which is fixed, and one pair twice, both ways."""
    frames = torch.tensor([(5, 40), (0, 30), (50, 20), (20, 50)])
    T_cw = problem.T_cw
    T_21 = T_cw[frames[:, 1]] @ se3_inverse(T_cw[frames[:, 0]])
    information = 1e4 * torch.eye(6, dtype=torch.float64).repeat(4, 1, 1)
    return replace(problem, factors=(Factors(frames, T_21, information, relative_pose_error),))


def with_priors(problem):
    information = torch.zeros(len(problem.T_cw), 6, 6, dtype=torch.float64)
    information[10, :3, :3] = information[55, :3, :3] = 1e3 * torch.eye(3)
    return replace(problem, fixed_frames=(), pose_prior=PosePrior(problem.T_cw, information))


CASES = {
    "scale": lambda: walk(),
    "no loop": lambda: walk(loop=False),
    "no fixed frame": lambda: walk(fixed_frames=()),
    "two fixed frames": lambda: walk(fixed_frames=(0, 1)),
    "ten fixed frames, which see points alone": lambda: walk(fixed_frames=range(10)),
    "fixed points": lambda: walk(fixed_frames=(), fixed_points=(0, 1, 2, 3, 4)),
    "factors": lambda: with_factors(walk()),
    "two positions, which hold all but a turn": lambda: with_priors(walk()),
    "cameras": lambda: with_several_cameras(walk()),
}


@pytest.mark.parametrize("free_camera", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_minimum_and_covariances_are_those_of_the_dense_matrix(solved, case, free_camera):
    problem = CASES[case]()
    one, other = (solved(problem, by_blocks, free_camera=free_camera) for by_blocks in (False, True))
    assert one.success
    assert other.success
    assert one.converged
    assert other.converged
    torch.testing.assert_close(other.cost, one.cost, rtol=1e-12, atol=0)
    torch.testing.assert_close(other.T_cw, one.T_cw, rtol=0, atol=1e-8)
    torch.testing.assert_close(other.points_w, one.points_w, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(other.camera.params, one.camera.params, rtol=1e-8, atol=0)
    for mine, dense in zip(other.covariance(), one.covariance(), strict=True):
        torch.testing.assert_close(mine, dense, rtol=1e-5, atol=1e-9 * float(dense.norm()))


@pytest.mark.parametrize("backward", ["implicit", "unroll", "truncated"])
@pytest.mark.parametrize("case", ["scale", "no fixed frame", "factors"])
def test_gradients_are_those_of_the_dense_matrix(solved, case, backward):
    problem = CASES[case]()
    options = CONVERGED.replace(backward=backward, **({"iterations": 4} if backward == "unroll" else {}))

    def gradient(by_blocks):
        pixels = problem.pixels.clone().requires_grad_()
        found = solved(replace(problem, pixels=pixels), by_blocks, free_camera=True, options=options)
        distances = se3_inverse(found.T_cw)[:, :3, 3].diff(dim=0).norm(dim=-1)
        loss = (distances / distances.mean()).square() @ torch.linspace(-1, 1, len(distances)).double()
        return torch.autograd.grad(loss, pixels)[0]

    torch.testing.assert_close(gradient(True), gradient(False), rtol=1e-5, atol=1e-9)


def test_what_is_not_determined_is_flagged(solved):
    """Two walks without a common point: each has a scale, and the second a place, of its own."""
    problem = walk(loop=False)
    first = torch.zeros_like(problem.point_index).scatter_reduce(
        0, problem.point_index, problem.frame_index, "amin", include_self=False
    )
    apart = first[problem.point_index]
    apart = ((problem.frame_index < 30) & (apart < 26)) | ((problem.frame_index >= 30) & (apart >= 30))
    for by_blocks in (False, True):
        assert solved(problem, by_blocks).success
        assert not solved(replace(problem, mask=apart), by_blocks).success


def test_the_same_bytes_again(solved):
    problem = walk()
    one, other = solved(problem, True), solved(problem, True)
    assert torch.equal(one.T_cw, other.T_cw)
    assert torch.equal(one.covariance().points, other.covariance().points)


def structure_of(frames, cameras=1):
    slots = torch.arange(frames).repeat_interleave(2)
    points = torch.arange(2 * frames) // 2 + torch.tensor([0, 1]).repeat(frames)
    own = torch.arange(frames) % cameras
    return schur.build_structure(slots, points, frames + 1, own, own[slots], cameras)


def test_many_frames_are_factorized_by_blocks():
    assert structure_of(SPARSE_FRAMES - 1).pairs is None
    assert structure_of(SPARSE_FRAMES, MOST_CAMERAS).pairs is not None
    assert structure_of(SPARSE_FRAMES, MOST_CAMERAS + 1).pairs is None
    pairs = structure_of(2000).pairs  # a chain
    assert len(pairs.keys) - 1 == 1999
    entries = sum(front.size[1] ** 2 for front in pairs.structure.fronts)
    assert entries < 2000 * 6 * 6 * 100  # 1.3 % of the dense matrix


def test_blocks_are_numbered_by_the_pairs_that_share_a_point_or_a_factor():
    seen = [(torch.tensor([0, 1, 3]), torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, 1.0]]))]
    pairs = covisible_pairs(5, seen, torch.tensor([(4, 2)]), 0.3)
    assert covisible_pairs(5, seen, torch.tensor([(4, 2)]), 0.29) is None
    numbers = pairs.number(*torch.meshgrid(torch.arange(5), torch.arange(5), indexing="ij"))
    none = 5 + 2 * 3
    assert numbers.tolist() == [
        [0, 5, none, none, none],
        [8, 1, none, 6, none],
        [none, none, 2, none, 7],
        [none, 9, none, 3, none],
        [none, none, 10, none, 4],
    ]


@pytest.mark.parametrize("free_camera", [False, True])
@pytest.mark.parametrize("with_depths", [False, True])
def test_observations_in_runs_give_the_same_bytes(free_camera, with_depths, monkeypatch):
    """Those of large problems are linearized in runs, which bounds the memory."""
    problem = walk(frames=35)
    if with_depths:
        seen = transform(problem.T_cw[problem.frame_index], problem.points_w[problem.point_index][:, None])
        depths, information = seen[:, 0, 2], torch.full((len(seen),), 4.0, dtype=torch.float64)
        problem = replace(problem, depth_prior=DepthPrior(depths, information))
    options = CONVERGED.replace(iterations=2)
    found = []
    for at_once in (schur.AT_ONCE, 100):
        for module in (schur, sparse):
            monkeypatch.setattr(module, "AT_ONCE", at_once)
        solution = solve_bundle(problem, free_camera=free_camera, options=options)
        parts = solution.T_cw, solution.points_w, solution.camera.params, solution.cost
        found.append([part.numpy().tobytes() for part in parts])
    assert found[0] == found[1]
