"""Points, covariances and poses under another pose and another unit of length."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import (
    rigid,
    se3_exp,
    se3_inverse,
    sim3_exp,
    sim3_inverse,
    sim3_scale,
    so3_exp,
    transform,
)
from torchslam.geometry.correction import (
    carry_points,
    covariances_with_unit,
    with_unit,
    without_scale,
)


def problem(count: int = 5) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Points (n, 3), covariances, unit normals, poses T_cw (n, 4, 4) and similarities S_cw near them."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    A = normal(count, 3, 3)
    T_cw = se3_exp(0.5 * normal(count, 6))
    normals_w = torch.nn.functional.normalize(normal(count, 3), dim=-1)
    return normal(count, 3), A @ A.mT, normals_w, T_cw, sim3_exp(0.3 * normal(count, 7)) @ T_cw


def test_a_known_correction() -> None:
    """The camera goes from the origin to x = 10, turns by half a turn about y, and its unit is doubled."""
    T_cw = torch.eye(4, dtype=torch.float64)
    R = so3_exp(torch.tensor([0.0, torch.pi, 0.0], dtype=torch.float64))
    S_cw = sim3_inverse(torch.block_diag(2 * R.mT, torch.ones(1, 1, dtype=torch.float64)))
    S_cw = S_cw @ rigid(torch.eye(3, dtype=torch.float64), torch.tensor([-10.0, 0.0, 0.0]).double())
    point, normal = torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([0.0, 0.0, -1.0]).double()
    covariance = torch.diag(torch.tensor([1.0, 2.0, 3.0])).double()
    moved, spread, direction = carry_points(point, covariance, normal, T_cw, S_cw)
    torch.testing.assert_close(moved, torch.tensor([8.0, 4.0, -6.0]).double())
    torch.testing.assert_close(spread, 4 * covariance)
    torch.testing.assert_close(direction, -normal)
    torch.testing.assert_close(
        without_scale(S_cw), se3_inverse(rigid(R.mT, torch.tensor([10.0, 0, 0]).double()))
    )


def test_carried_points_are_seen_as_before_in_the_new_unit() -> None:
    points_w, covariances_w, normals_w, T_cw, S_cw = problem()
    moved_w, spread_w, turned_w = carry_points(points_w, covariances_w, normals_w, T_cw, S_cw)
    scale, new = sim3_scale(S_cw), without_scale(S_cw)
    before, after = (transform(T, p[:, None])[:, 0] for T, p in ((T_cw, points_w), (new, moved_w)))
    torch.testing.assert_close(after * scale[:, None], before)
    R, R_new = T_cw[:, :3, :3], new[:, :3, :3]
    torch.testing.assert_close(
        R_new @ spread_w @ R_new.mT * scale[:, None, None] ** 2, R @ covariances_w @ R.mT
    )
    torch.testing.assert_close(R_new @ turned_w[..., None], R @ normals_w[..., None])
    torch.testing.assert_close(turned_w.norm(dim=-1), torch.ones(5, dtype=torch.float64))


def test_the_pose_of_a_similarity_is_rigid_and_keeps_the_centre() -> None:
    S_cw = problem()[4]
    T_cw = without_scale(S_cw)
    gram = T_cw[:, :3, :3] @ T_cw[:, :3, :3].mT
    torch.testing.assert_close(gram, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    torch.testing.assert_close(se3_inverse(T_cw)[:, :3, 3], sim3_inverse(S_cw)[:, :3, 3])


def test_another_unit_of_length() -> None:
    _, _, _, T, _ = problem()
    unit = torch.tensor([2.0, 1.0, 0.5, 4.0, 8.0], dtype=torch.float64)
    shorter = with_unit(T, unit)
    torch.testing.assert_close(shorter[:, :3, 3] * unit[:, None], T[:, :3, 3])
    assert torch.equal(shorter[:, :3, :3], T[:, :3, :3])
    covariances = torch.ones(5, 6, 6, dtype=torch.float64)
    rescaled = covariances_with_unit(covariances, unit)
    torch.testing.assert_close(rescaled[0, 0], torch.tensor([1, 1, 1, 2, 2, 2]).double() / 4)
    torch.testing.assert_close(rescaled[0, 5], torch.tensor([1, 1, 1, 2, 2, 2]).double() / 2)
    assert torch.equal(rescaled[1], covariances[1])


def test_gradients_and_batches() -> None:
    inputs = [tensor.requires_grad_() for tensor in problem(2)]
    assert gradcheck(carry_points, inputs)
    unit = torch.tensor([2.0, 0.5], dtype=torch.float64, requires_grad=True)
    assert gradcheck(with_unit, (inputs[3], unit))
    assert gradcheck(without_scale, (inputs[4],))
    assert gradcheck(covariances_with_unit, (torch.ones(2, 6, 6, dtype=torch.float64), unit))
    whole = carry_points(*problem())
    for row in range(5):
        for one, all_of_them in zip(carry_points(*(x[row] for x in problem())), whole, strict=True):
            torch.testing.assert_close(one, all_of_them[row])


def test_device_and_dtype_are_those_of_the_input(device: torch.device, dtype: torch.dtype) -> None:
    moved = carry_points(*(tensor.to(device, dtype) for tensor in problem()))
    for one, expected in zip(moved, carry_points(*problem()), strict=True):
        assert one.dtype == dtype
        torch.testing.assert_close(one.cpu().double(), expected, atol=1e-4, rtol=1e-4)
