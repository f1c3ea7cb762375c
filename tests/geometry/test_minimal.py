"""The minimal solvers: P3P, five-point, homography, and the decompositions."""

import math

import poselib
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from torchslam import geometry as g

SAMPLES = 200


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def poses(count: int, translation: float = 0.4, rotation: float = 0.1) -> Tensor:
    return g.se3_exp(torch.cat((translation * normal(1, count, 3), rotation * normal(2, count, 3)), dim=-1))


def scene(count: int, size: int) -> Tensor:
    return normal(3, count, size, 3) * torch.tensor((1.0, 0.8, 1.5)) + torch.tensor((0.0, 0.0, 6.0))


def image(points: Tensor) -> Tensor:
    return points[..., :2] / points[..., 2:]


def test_p3p_finds_the_pose_and_only_poses() -> None:
    T_cw = poses(SAMPLES, 2.0, 1.0)
    points_c = scene(SAMPLES, 3)
    points_w = g.transform(g.se3_inverse(T_cw), points_c)
    rays = points_c / points_c.norm(dim=-1, keepdim=True)
    R, t, valid = g.p3p(rays, points_w)
    distance = (R - T_cw[:, None, :3, :3]).abs().amax((-2, -1)).masked_fill(~valid, torch.inf)
    assert float(distance.amin(-1).max()) < 1e-7
    seen = points_w[:, None] @ R.mT + t[:, :, None]
    parallel = torch.linalg.cross(
        seen / seen.norm(dim=-1, keepdim=True), rays[:, None].expand_as(seen), dim=-1
    )
    assert float(parallel[valid].abs().max()) < 1e-7
    torch.testing.assert_close(
        R[valid] @ R[valid].mT, torch.eye(3, dtype=R.dtype).expand(int(valid.sum()), 3, 3)
    )
    counts = [len(poselib.p3p(f.numpy(), x.numpy())) for f, x in zip(rays, points_w, strict=True)]
    assert abs(int(valid.sum()) - sum(counts)) <= 0.02 * sum(counts)


def test_p3p_of_degenerate_samples_does_not_raise() -> None:
    rays = normal(0, 4, 3, 3)
    points = normal(1, 4, 3, 3)
    points[0, 2] = 2 * points[0, 1] - points[0, 0]  # on a line
    points[1, 1] = points[1, 0]
    points[2] = torch.nan
    points[3] = 0.0
    _, _, valid = g.p3p(rays / rays.norm(dim=-1, keepdim=True), points)
    assert not valid[1:].any()


def test_five_point_finds_the_essential_matrix_and_only_essential_matrices() -> None:
    T_21 = poses(SAMPLES)
    points_1 = scene(SAMPLES, 5)
    x_1, x_2 = image(points_1), image(g.transform(T_21, points_1))
    E, sample = g.five_point(x_1, x_2)
    t = T_21[:, :3, 3] / T_21[:, :3, 3].norm(dim=-1, keepdim=True)
    true = g.essential_from_pose(T_21[:, :3, :3], t)[sample]
    distance = torch.minimum((E - true).abs().amax((-2, -1)), (E + true).abs().amax((-2, -1)))
    best = torch.full((SAMPLES,), torch.inf, dtype=E.dtype).scatter_reduce(0, sample, distance, "amin")
    assert float((best < 1e-5).double().mean()) > 0.9  # close pairs of roots can be missed
    assert float(g.sampson_errors(E, x_1[sample], x_2[sample]).abs().max()) < 1e-9
    singular = torch.linalg.svdvals(E)
    off = (singular - torch.tensor((1.0, 1.0, 0.0))).abs().amax(-1)
    assert float((off < 1e-4).double().mean()) > 0.97


def test_five_point_of_degenerate_samples_does_not_raise() -> None:
    x = normal(0, 3, 5, 2)
    x[0] = 0.0
    x[1] = torch.nan
    E, _ = g.five_point(x, x)
    assert torch.isfinite(E).all()


def test_an_essential_matrix_decomposes_into_its_pose() -> None:
    T_21 = poses(20, rotation=0.8)
    R_true, t_true = T_21[:, :3, :3], T_21[:, :3, 3]
    R, t = g.decompose_essential(-3.0 * g.essential_from_pose(R_true, t_true))
    assert float((R - R_true[:, None]).abs().amax((-2, -1)).amin(-1).max()) < 1e-10
    direction = t_true / t_true.norm(dim=-1, keepdim=True)
    torch.testing.assert_close((t * direction).sum(-1).abs(), torch.ones(20, dtype=t.dtype))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(20, 2, dtype=t.dtype))


def test_gradients_at_true_essential_matrices() -> None:
    E = g.essential_from_pose(poses(3)[:, :3, :3], poses(3)[:, :3, 3]).requires_grad_()
    assert gradcheck(g.decompose_essential, (E,))
    x_1, x_2 = normal(4, 3, 6, 2).requires_grad_(), normal(5, 3, 6, 2).requires_grad_()
    assert gradcheck(g.sampson_errors, (E, x_1, x_2))
    H = (torch.eye(3) + 0.1 * normal(6, 3, 3, 3)).requires_grad_()
    assert gradcheck(g.transfer_errors, (H, x_1, x_2))


CAMERA = g.Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240)).to(torch.float64)


def test_offsets_from_epipolar_lines_are_sampson_errors_and_disparities() -> None:
    points_1 = torch.tensor([[0.3, 0.2, 4.0], [-1.0, 0.5, 8.0], [0.1, 0.1, -5.0], [0.0, 0.0, 1e9]]).double()
    sideways = torch.eye(4, dtype=torch.float64)
    sideways[0, 3] = -0.5
    pixels_1, pixels_2 = (
        200 * points[:, :2] / points[:, 2:] + torch.tensor([159.5, 119.5])
        for points in (points_1, g.transform(sideways, points_1))
    )
    across, along = g.epipolar_offsets(sideways, pixels_1, pixels_2, CAMERA, CAMERA)
    torch.testing.assert_close(across, torch.zeros(4).double())
    expected = 200 * 0.5 / points_1[:, 2]
    torch.testing.assert_close(along, expected, atol=1e-6, rtol=1e-9)
    off = pixels_2 + torch.tensor([0.0, 3.0])
    across, along = g.epipolar_offsets(sideways, pixels_1, off, CAMERA, CAMERA)
    torch.testing.assert_close(across.abs(), torch.full((4,), 3 / math.sqrt(2)).double())
    torch.testing.assert_close(along, expected, atol=1e-6, rtol=1e-9)


def test_the_disparity_determines_the_depth_under_any_motion() -> None:
    T_21 = poses(20)
    points_1 = scene(20, 6)
    points_2 = g.transform(T_21, points_1)
    pixels_1, pixels_2 = (
        200 * image(points) + torch.tensor([159.5, 119.5]) for points in (points_1, points_2)
    )
    across, along = g.epipolar_offsets(T_21, pixels_1, pixels_2, CAMERA, CAMERA)
    assert float(across.abs().max()) < 1e-9
    far = points_1 @ T_21[:, :3, :3].mT
    t = T_21[:, None, :3, 3]
    way = t[..., :2] - t[..., 2:] * far[..., :2] / far[..., 2:]
    expected = torch.where(far[..., 2] > 0, 200 * way.norm(dim=-1) / points_2[..., 2], 0.0)
    torch.testing.assert_close(along, expected)
    double = T_21.clone()
    double[:, :3, 3] *= 2  # the unit of length does not matter
    torch.testing.assert_close(g.epipolar_offsets(double, pixels_1, pixels_2, CAMERA, CAMERA)[1], along)


def test_offsets_are_finite_and_differentiable() -> None:
    pixels = normal(7, 1, 6, 2) * 50 + 120

    def offsets(T_21: Tensor, pixels_1: Tensor, pixels_2: Tensor) -> tuple[Tensor, Tensor]:
        return g.epipolar_offsets(T_21, pixels_1, pixels_2, CAMERA, CAMERA)

    inputs = poses(1).requires_grad_(), pixels.requires_grad_(), (pixels + 3).detach().requires_grad_()
    assert gradcheck(offsets, inputs)
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))  # a half turn
    for T_21 in (
        torch.eye(4, dtype=torch.float64),
        back,
        g.se3_exp(torch.tensor([0, 0, 1.0, 0, 0, 0]).double()),
    ):
        T_21 = T_21.clone().requires_grad_()
        center = torch.tensor([[159.5, 119.5]], dtype=torch.float64)
        across, along = offsets(T_21, center, center)
        assert float((across.abs() + along.abs()).detach()) == 0
        (across.sum() + along.sum()).backward()
        assert torch.isfinite(T_21.grad).all()


def test_sampson_errors_are_finite_with_gradients_at_the_epipole() -> None:
    E = g.essential_from_pose(torch.eye(3), torch.tensor((0.0, 0.0, 1.0))).requires_grad_()
    x = torch.zeros(1, 2, requires_grad=True)
    error = g.sampson_errors(E, x, x)
    error.sum().backward()
    assert float(error.detach()) == 0
    assert torch.isfinite(E.grad).all()
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("size", [4, 20])
def test_homographies(size: int) -> None:
    T_21 = poses(SAMPLES)
    plane_normal = torch.tensor((0.1, -0.2, 0.25), dtype=torch.float64)
    x_1 = 0.5 * normal(7, SAMPLES, size, 2)
    H_true = T_21[:, :3, :3] + T_21[:, :3, 3:] * plane_normal
    mapped = torch.cat((x_1, torch.ones_like(x_1[..., :1])), dim=-1) @ H_true.mT
    H = g.homography_from_matches(x_1, image(mapped))
    torch.testing.assert_close(H, H_true / H_true[:, 2:, 2:], atol=1e-5, rtol=1e-5)
    R, t, n = g.decompose_homography(-2.5 * H)
    scaled = t * n.sum(-1, keepdim=True) / plane_normal.sum()  # only the product of t and n is determined
    off = (R - T_21[:, None, :3, :3]).abs().amax((-2, -1)) + (scaled - T_21[:, None, :3, 3]).abs().amax(-1)
    assert float(off.amin(-1).median()) < 1e-8
    rebuilt = R + t[..., :, None] * n[..., None, :]
    middle = torch.linalg.svdvals(H_true)[:, 1]
    torch.testing.assert_close(
        rebuilt, (H_true / middle[:, None, None])[:, None].expand(-1, 4, 3, 3), atol=1e-6, rtol=0
    )


def test_homography_of_a_pure_rotation_has_no_translation() -> None:
    R_true = g.so3_exp(0.3 * normal(0, 5, 3))
    R, t, _ = g.decompose_homography(2 * R_true)
    torch.testing.assert_close(R, R_true[:, None].expand(5, 4, 3, 3), atol=1e-6, rtol=0)
    assert float(t.abs().max()) < 1e-6


def test_rotation_from_two_rays() -> None:
    R_true = g.so3_exp(normal(0, 5, 3))
    rays = normal(1, 5, 2, 3)
    torch.testing.assert_close(g.rotation_from_matches(rays, rays @ R_true.mT), R_true)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.5])
def test_a_noisy_essential_matrix_decomposes_into_rotations(noise: float) -> None:
    T_21 = poses(20, rotation=0.8)
    E = g.essential_from_pose(T_21[:, :3, :3], T_21[:, :3, 3])
    R, t = g.decompose_essential(E + noise * E.norm(dim=(1, 2), keepdim=True) * normal(7, 20, 3, 3))
    eye = torch.eye(3, dtype=torch.float64).expand(20, 2, 3, 3)
    torch.testing.assert_close(R.mT @ R, eye, atol=1e-12, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(20, 2).double())
    torch.testing.assert_close(t.norm(dim=-1), torch.ones(20).double())
    turned = (R - T_21[:, None, :3, :3]).abs().amax((-2, -1)).amin(-1)
    assert float(turned.median()) < 1e-9 + 4 * noise
