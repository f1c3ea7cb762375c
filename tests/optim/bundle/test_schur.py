import pytest
import torch

from torchslam.optim.bundle import _schur as schur
from torchslam.optim.bundle._schur import BundleTangent, NormalEquations, build_structure


def random_system(generator, num_frames=5, num_points=12, num_camera=2):
    """Normal equations of a random J^T J, with the dense matrix they stand for."""

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    seen = torch.rand(num_frames + 1, num_points, generator=generator) < 0.6
    slots, points = seen.nonzero().unbind(-1)
    slots, points = torch.cat((slots, slots[-1:])), torch.cat((points, points[-1:]))  # one of them twice
    count, size = len(slots), 6 * num_frames + 3 * num_points + num_camera
    J_frame, J_point, J_camera = normal(count, 4, 6), normal(count, 4, 3), normal(count, 4, num_camera)
    J = torch.zeros(count, 4, size, dtype=torch.float64)
    for row in range(count):
        if slots[row] < num_frames:
            J[row, :, 6 * slots[row] : 6 * slots[row] + 6] = J_frame[row]
        start = 6 * num_frames + 3 * points[row]
        J[row, :, start : start + 3] = J_point[row]
        J[row, :, size - num_camera :] = J_camera[row]
    dense = J.flatten(0, 1).mT @ J.flatten(0, 1)

    structure = build_structure(slots, points, num_frames, num_points)
    linked = structure.num_linked
    blocks = (J_frame.mT @ J_point)[:linked]
    coupling = blocks.new_zeros(structure.storage_rows, 6)
    coupling.index_add_(0, structure.coupling, blocks.mT.reshape(-1, 6))
    split = 6 * num_frames
    diagonal = dense[:split, :split].unflatten(0, (-1, 6)).unflatten(2, (-1, 6)).diagonal(dim1=0, dim2=2)
    gradient = normal(size)
    equations = NormalEquations(
        structure,
        BundleTangent(
            gradient[:split].view(-1, 6), gradient[split:-num_camera].view(-1, 3), gradient[-num_camera:]
        ),
        diagonal.movedim(-1, 0),
        structure.sum_by_point(J_point.mT @ J_point),
        dense[-num_camera:, -num_camera:],
        dense[:split, -num_camera:].unflatten(0, (-1, 6)),
        structure.sum_by_point(J_point.mT @ J_camera),
        coupling,
        torch.ones(num_points, dtype=torch.bool),
    )
    return equations, dense, gradient


@pytest.fixture(params=["one tile", "many tiles"])
def system(request, generator, monkeypatch):
    if request.param == "many tiles":
        monkeypatch.setattr(schur, "_TILE_POINTS", 2)
    return random_system(generator)


def flat(tangent):
    return torch.cat((tangent.frames.flatten(), tangent.points.flatten(), tangent.camera))


def test_schur_complement_solves_the_dense_system(system):
    equations, dense, gradient = system
    solution = equations.factorized().solve(equations.gradient)
    torch.testing.assert_close(flat(solution), torch.linalg.solve(dense, gradient))


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
    torch.testing.assert_close(marginals.camera, inverse[-2:, -2:])


def test_a_singular_system_is_flagged_and_has_a_zero_solution(system):
    equations, _, _ = system
    fields = vars(equations) | {"frames": torch.zeros_like(equations.frames)}
    factorized = NormalEquations(**fields).factorized()
    assert not factorized.reduced.definite
    assert (flat(factorized.solve(equations.gradient)) == 0).all()
