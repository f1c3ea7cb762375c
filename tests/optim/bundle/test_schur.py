from dataclasses import replace

import pytest
import torch

from torchslam.optim.bundle import _schur as schur
from torchslam.optim.bundle._schur import BundleTangent, NormalEquations, build_structure


def random_system(generator, num_cameras, num_frames=5, num_points=12, num_free=2):
    """Normal equations of a random J^T J, with the dense matrix they stand for; the last frame is fixed."""

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    seen = torch.rand(num_frames + 1, num_points, generator=generator) < 0.6
    slots, points = seen.nonzero().unbind(-1)
    slots, points = torch.cat((slots, slots[-1:])), torch.cat((points, points[-1:]))  # one of them twice
    cameras = torch.randperm(num_frames + 1, generator=generator) % num_cameras
    camera_of = cameras[slots]
    split, count = 6 * num_frames, len(slots)
    before_cameras = split + 3 * num_points
    size = before_cameras + num_cameras * num_free
    J_frame, J_point, J_camera = normal(count, 4, 6), normal(count, 4, 3), normal(count, 4, num_free)
    J = torch.zeros(count, 4, size, dtype=torch.float64)
    for row in range(count):
        if slots[row] < num_frames:
            J[row, :, 6 * slots[row] : 6 * slots[row] + 6] = J_frame[row]
        start = split + 3 * points[row]
        J[row, :, start : start + 3] = J_point[row]
        start = before_cameras + num_free * camera_of[row]
        J[row, :, start : start + num_free] = J_camera[row]
    dense = J.flatten(0, 1).mT @ J.flatten(0, 1)

    structure = build_structure(slots, points, num_points, cameras[:-1], camera_of, num_cameras)
    linked = structure.num_linked
    by_frame, by_camera = (x.movedim(0, -1) for x in (J_frame, J_camera))
    gradient = normal(size)
    equations = NormalEquations(
        structure,
        BundleTangent(
            gradient[:split].view(-1, 6),
            gradient[split:before_cameras].view(-1, 3),
            gradient[before_cameras:].view(-1, num_free),
        ),
        structure.sum_by_frame(of_each(by_frame, by_frame)[..., :linked]),
        structure.sum_by_point(J_point.mT @ J_point),
        structure.sum_by_camera(of_each(by_camera, by_camera)),
        structure.sum_by_frame(of_each(by_frame, by_camera)[..., :linked]),
        structure.coupling.stored((J_point.mT @ J_frame)[:linked]),
        structure.camera_coupling.stored(structure.sum_by_pair(J_point.mT @ J_camera)),
        torch.ones(num_points, dtype=torch.bool),
    )
    return equations, dense, gradient


def of_each(A, B):
    """A^T B of matrices (4, m, O) and (4, n, O)."""
    return torch.einsum("amo,ano->mno", A, B)


@pytest.fixture(params=["one tile", "many tiles", "blocks of pairs"])
def height(request, monkeypatch):
    if request.param != "one tile":
        monkeypatch.setattr(schur, "_TILE_POINTS", 2)
    if request.param == "blocks of pairs":
        monkeypatch.setattr(schur, "SPARSE_FRAMES", 2)
        monkeypatch.setattr(schur, "MOST_COVISIBLE", 1.0)


@pytest.fixture(params=[1, 2, 6], ids=["one camera", "two cameras", "a camera per frame"])
def system(request, height, generator):
    return random_system(generator, request.param)


def flat(tangent):
    return torch.cat((tangent.frames.flatten(), tangent.points.flatten(), tangent.cameras.flatten()))


def test_schur_complement_solves_the_dense_system(system):
    equations, dense, gradient = system
    solution = equations.factorized().solve(equations.gradient)
    torch.testing.assert_close(flat(solution), torch.linalg.solve(dense, gradient))


def test_cameras_of_one_frame_each_need_as_much_room_as_the_frames(height, generator):
    slots, points = (torch.rand(6, 40, generator=generator) < 0.2).nonzero().unbind(-1)
    structure = build_structure(slots, points, 40, torch.arange(6), slots, 6)
    blocks = torch.randn(len(slots), 3, 2, generator=generator)
    of_cameras = structure.camera_coupling.stored(structure.sum_by_pair(blocks))
    assert torch.equal(of_cameras, structure.coupling.stored(blocks))


def test_damping_increases_the_diagonal(system):
    equations, dense, gradient = system
    damping = torch.tensor([0.3], dtype=torch.float64)
    damped = dense + torch.diag(0.3 * dense.diagonal())
    solution = equations.factorized(damping).solve(equations.gradient)
    torch.testing.assert_close(flat(solution), torch.linalg.solve(damped, gradient))


def test_marginals_are_blocks_of_the_inverse(system):
    equations, dense, _ = system
    inverse = torch.linalg.inv(dense)
    marginals = equations.factorized().marginals()
    for row in range(5):
        block = slice(6 * row, 6 * row + 6)
        torch.testing.assert_close(marginals.frames[row], inverse[block, block])
    for row in range(12):
        block = slice(30 + 3 * row, 33 + 3 * row)
        torch.testing.assert_close(marginals.points[row], inverse[block, block])
    torch.testing.assert_close(marginals.camera, inverse[66:, 66:])


def test_a_singular_system_is_flagged_and_has_a_zero_solution(system):
    equations, _, _ = system
    factorized = replace(equations, frames=torch.zeros_like(equations.frames)).factorized()
    assert not factorized.reduced.definite
    assert (flat(factorized.solve(equations.gradient)) == 0).all()
