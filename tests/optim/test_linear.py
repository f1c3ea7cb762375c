import torch

from torchslam.optim._core.linear import factorize, inverse_roots


def test_solves_definite_and_flags_the_rest(dtype, device):
    good = torch.tensor([[4.0, 1.0], [1.0, 3.0]], dtype=dtype, device=device)
    singular = torch.ones(2, 2, dtype=dtype, device=device)
    indefinite = torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=dtype, device=device)
    zero = torch.zeros(2, 2, dtype=dtype, device=device)
    matrices = torch.stack((good, singular, indefinite, zero))
    factored = factorize(matrices)
    assert factored.definite.tolist() == [True, False, False, False]
    right = torch.ones(4, 2, 1, dtype=dtype, device=device)
    solution = factored.solve(right)
    torch.testing.assert_close(good @ solution[0], right[0])
    assert (solution[1:] == 0).all()


def test_inverse_roots_of_definite_blocks_that_count(dtype, device):
    L = torch.tensor([[2.0, 0, 0], [0.5, 1, 0], [-1, 0.3, 3]], dtype=dtype, device=device)
    singular = torch.ones(3, 3, dtype=dtype, device=device)
    blocks = torch.stack((L @ L.mT, L @ L.mT, singular, -L @ L.mT, 0 * L), dim=-1)
    mask = torch.tensor([True, False, True, True, True], device=device)
    damping = torch.full((1,), 0.1, dtype=dtype, device=device)
    for grow in (None, damping):
        root = inverse_roots(blocks, mask, grow).permute(2, 0, 1)
        grown = blocks[..., 0] + (0 if grow is None else 0.1 * blocks[..., 0].diagonal().diag())
        torch.testing.assert_close(root[0].mT @ root[0], torch.linalg.inv(grown))
        assert (root[1] == 0).all()
        assert (root[3:] == 0).all()
    assert (inverse_roots(blocks, mask, None)[..., 2] == 0).all()


def test_definiteness_does_not_depend_on_units():
    matrix = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    units = torch.tensor([1e-9, 1e9], dtype=torch.float64)
    assert factorize(units[:, None] * matrix * units).definite


def test_gradients_stay_finite_next_to_a_singular_matrix():
    matrices = torch.stack((torch.eye(2), torch.zeros(2, 2))).double().requires_grad_()
    solution = factorize(matrices, strict=False).solve(torch.ones(2, 2, 1, dtype=torch.float64))
    solution.sum().backward()
    assert matrices.grad is not None
    assert matrices.grad.isfinite().all()
