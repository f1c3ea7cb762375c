"""Similarities of corresponding points."""

from __future__ import annotations

import pytest
import torch
from evo.core.geometry import umeyama_alignment
from geometry_scenes import CAMERA, FISHEYE, RADIAL, make_pairs, rotation_error
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import (
    Camera,
    estimate_similarity,
    rigid,
    se3_exp,
    se3_inverse,
    sim3_exp,
    sim3_inverse,
    sim3_scale,
    so3_exp,
    transform,
    umeyama,
)
from torchslam.geometry.similarity import _inverse, _Problem, _View, align_poses, in_place_of
from torchslam.geometry.transforms import without_scale


def cloud(count: int = 12, batch: int = 2) -> Tensor:
    return torch.randn(batch, count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def moved(points: Tensor) -> Tensor:
    xi = torch.randn(len(points), 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return transform(sim3_exp(0.5 * xi), points)


@pytest.mark.parametrize("with_scale", [True, False])
def test_agrees_with_evo_on_noisy_points(with_scale: bool) -> None:
    source = cloud()
    target = moved(source) + 0.1 * cloud().flip(1)
    scale, R, t = umeyama(source, target, with_scale=with_scale)
    for i in range(2):
        expected = umeyama_alignment(source[i].numpy().T, target[i].numpy().T, with_scale)
        torch.testing.assert_close(R[i], torch.from_numpy(expected[0]))
        torch.testing.assert_close(t[i], torch.from_numpy(expected[1]))
        assert float(scale[i]) == pytest.approx(expected[2])


def test_masked_rows_may_hold_anything() -> None:
    source, target = cloud(), moved(cloud())
    mask = torch.arange(12) < 8
    expected = umeyama(source[:, :8], target[:, :8])
    source[:, 8], target[:, 9], target[:, 10] = torch.nan, torch.inf, 1e9
    for one, other in zip(umeyama(source, target, mask.expand(2, -1)), expected, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("with_scale", [True, False])
@pytest.mark.parametrize("exact", [True, False])
def test_gradients(with_scale: bool, exact: bool) -> None:
    source = cloud(5)
    target = moved(source) if exact else cloud(5).flip(1)
    weights = torch.rand(2, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64) + 0.1
    inputs = [x.requires_grad_() for x in (source, target, weights)]
    assert gradcheck(lambda x, y, w: umeyama(x, y, w, with_scale), inputs)


def test_gradients_with_equal_singular_values_and_in_the_plane() -> None:
    octahedron = torch.cat((torch.eye(3), -torch.eye(3))).double()[None]
    flat = cloud(6, 1) * torch.tensor((1.0, 1.0, 0.0))
    for source in (octahedron, flat):
        target = (source @ so3_exp(torch.tensor((0.1, 0.2, 0.3), dtype=torch.float64)).mT).requires_grad_()
        assert gradcheck(lambda y, x=source: umeyama(x, y), (target,))


@pytest.mark.parametrize("kind", ["one point", "two points", "line", "nothing"])
def test_degenerate_points_give_finite_results_and_gradients(kind: str, dtype: torch.dtype) -> None:
    source = cloud(4).to(dtype)
    mask = torch.ones(2, 4, dtype=torch.bool)
    if kind == "line":
        source = source[..., :1] * torch.tensor((1.0, 2.0, 3.0), dtype=dtype)
    else:
        mask[:, {"one point": 1, "two points": 2, "nothing": 0}[kind] :] = False
    source = source.requires_grad_()
    target = moved(source.detach().double()).to(dtype).requires_grad_()
    result = umeyama(source, target, mask)
    assert all(torch.isfinite(x).all() for x in result)
    sum(x.sum() for x in result).backward()
    assert torch.isfinite(source.grad).all()
    assert torch.isfinite(target.grad).all()
    torch.testing.assert_close(torch.linalg.det(result[1]), torch.ones(2, dtype=dtype))


def test_reflected_points_still_give_a_rotation() -> None:
    source = cloud()
    _, R, _ = umeyama(source, source * torch.tensor((1.0, 1.0, -1.0)))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(2, dtype=torch.float64))


def rotation(S: Tensor) -> Tensor:
    return S[:, :3, :3] / sim3_scale(S)[:, None, None]


def check(S_21: Tensor, truth: Tensor, degrees: float = 0.3, length: float = 0.03) -> None:
    scales = sim3_scale(S_21), sim3_scale(truth)
    assert float((scales[0] / scales[1]).log().abs().max()) < 0.01
    R, R_true = rotation(S_21), rotation(truth)
    assert rotation_error(R, R_true) < degrees
    assert float((S_21 - truth)[:, :3, 3].norm(dim=-1).max()) < length * float(scales[1].max())


@pytest.mark.parametrize("camera", [CAMERA, RADIAL, FISHEYE], ids=["pinhole", "radial_tangential", "fisheye"])
@pytest.mark.parametrize(
    "options",
    [{"outliers": 0.0}, {"outliers": 0.6}, *({"baseline": 0.0, "log_scale": x} for x in (-1.5, 1.5))],
)
def test_finds_the_similarity_among_wrong_pairs(camera: Camera, options: dict[str, float]) -> None:
    """Also its scale where both cameras are at one place, where no pixel depends on it."""
    for seed in range(4):
        pairs = make_pairs(seed, camera_1=camera, **options)
        result = estimate_similarity(*pairs.inputs(), camera_1=camera, camera_2=CAMERA)
        assert result.success.all()
        check(result.S_21, pairs.S_21)
        assert float((result.inliers == pairs.right).double().mean()) > 0.95


@pytest.mark.parametrize("log_scale", [-2.0, 0.0, 2.0])
def test_exact_data_give_the_exact_similarity(log_scale: float) -> None:
    pairs = make_pairs(0, outliers=0.2, noise=0.0, log_scale=log_scale, camera_2=RADIAL)
    result = estimate_similarity(*pairs.inputs(), camera_1=CAMERA, camera_2=RADIAL)
    torch.testing.assert_close(result.S_21, pairs.S_21, atol=1e-8, rtol=0)
    assert torch.equal(result.inliers, pairs.right)
    assert float(result.score) == pytest.approx(int(pairs.right.sum()))


def test_without_scale() -> None:
    pairs = make_pairs(1, log_scale=0.0)
    result = estimate_similarity(*pairs.inputs(), camera_1=CAMERA, camera_2=CAMERA, with_scale=False)
    assert result.success.all()
    torch.testing.assert_close(sim3_scale(result.S_21), torch.ones(1).double(), atol=1e-12, rtol=0)
    check(result.S_21, pairs.S_21)
    wrong_scale = make_pairs(1, log_scale=0.6)
    free = estimate_similarity(*wrong_scale.inputs(), camera_1=CAMERA, camera_2=CAMERA)
    fixed = estimate_similarity(*wrong_scale.inputs(), camera_1=CAMERA, camera_2=CAMERA, with_scale=False)
    assert fixed.score < 0.5 * free.score


def test_an_inlier_agrees_in_both_images() -> None:
    """Points too near in one of the maps, on the same ray there, fit in that image alone."""
    pairs = make_pairs(2, outliers=0.0, noise=0.0)
    for side in (0, 1):
        inputs = list(pairs.inputs())
        inputs[side] = inputs[side].clone()
        inputs[side][:, :20] *= 0.5
        result = estimate_similarity(*inputs, camera_1=CAMERA, camera_2=CAMERA)
        assert result.success.all()
        assert not result.inliers[:, :20].any()
        assert result.inliers[:, 20:].all()
        torch.testing.assert_close(result.S_21, pairs.S_21, atol=1e-8, rtol=0)


def test_errors_are_whitened_by_their_standard_deviations() -> None:
    """The threshold follows sigma, in each image by itself."""
    pairs = make_pairs(3, outliers=0.0, noise=0.0)
    ones = torch.ones_like(pairs.right, dtype=torch.float64)
    for side, name in ((2, "sigmas_1"), (3, "sigmas_2")):
        inputs = list(pairs.inputs())
        inputs[side] = inputs[side].clone()
        inputs[side][:, :10, 0] += 4.0
        sigmas = ones.clone()
        sigmas[:, :5] = 2.0  # of these 4 pixels are two, of the next five rows four
        result = estimate_similarity(*inputs, camera_1=CAMERA, camera_2=CAMERA, **{name: sigmas})
        assert result.inliers[0, :10].tolist() == [True] * 5 + [False] * 5
        assert result.inliers[:, 10:].all()
        wide = estimate_similarity(*inputs, camera_1=CAMERA, camera_2=CAMERA, threshold=5.0, **{name: sigmas})
        assert wide.inliers.all()


def test_the_refinement_beats_the_alignment_of_points() -> None:
    """Depths are far less certain than pixels, which `umeyama` does not know."""
    ours, theirs = [], []
    for seed in range(10):
        pairs = make_pairs(seed, outliers=0.0, noise=1.0)
        result = estimate_similarity(*pairs.inputs(), camera_1=CAMERA, camera_2=CAMERA)
        _, R, _ = umeyama(pairs.points_1, pairs.points_2)
        for errors, found in ((ours, rotation(result.S_21)), (theirs, R)):
            errors.append(rotation_error(found, rotation(pairs.S_21)))
        check(result.S_21, pairs.S_21, degrees=0.5, length=0.1)
    assert sum(ours) < sum(theirs)


@pytest.mark.parametrize("with_scale", [True, False])
def test_the_fit_is_a_minimum_of_both_errors(with_scale: bool) -> None:
    pairs = make_pairs(4, outliers=0.0, camera_1=RADIAL)
    views = (
        _View.of(pairs.points_1, pairs.pixels_2, torch.ones(1, 120).double(), CAMERA, 3.0),
        _View.of(pairs.points_2, pairs.pixels_1, torch.ones(1, 120).double(), RADIAL, 3.0),
    )
    start = pairs.S_21[:, :3] if with_scale else sim3_exp(torch.zeros(1, 7).double())[:, :3]
    P, cost = _Problem(*views, pairs.right, with_scale, 0.3).fit(start, 100, 1e6)
    dims = 7 if with_scale else 6

    def error(xi: Tensor) -> Tensor:
        S = sim3_exp(torch.nn.functional.pad(xi, (0, 7 - dims))) @ torch.nn.functional.pad(
            P, (0, 0, 0, 1)
        ).index_put((torch.tensor(0), torch.tensor(3), torch.tensor(3)), torch.ones(()).double())
        there = CAMERA.project(transform(S, pairs.points_1))[0] - pairs.pixels_2
        back = RADIAL.project(transform(sim3_inverse(S), pairs.points_2))[0] - pairs.pixels_1
        deeper = (transform(S, pairs.points_1)[..., 2] / pairs.points_2[..., 2]).log() / 0.1
        return 0.5 * sum(x.square().sum() for x in (there, back, deeper)) / 9

    xi = torch.zeros(1, dims, dtype=torch.float64, requires_grad=True)
    value = error(xi)
    torch.testing.assert_close(value.detach(), cost[0])
    (gradient,) = torch.autograd.grad(value, xi)
    assert gradient.abs().max() < 1e-6 * value
    torch.testing.assert_close(
        (_inverse(P)[..., :3] @ P[..., :3]), torch.eye(3).double()[None], atol=1e-12, rtol=0
    )


def test_a_batch_holds_independent_problems() -> None:
    """Good, masked, with NaN rows, too few, on a line, pure noise, sigmas that are none, nothing."""
    pairs = make_pairs(5)
    points_1, points_2, pixels_1, pixels_2 = (x.repeat(8, 1, 1) for x in pairs.inputs())
    mask = torch.ones(8, 120, dtype=torch.bool)
    sigmas = torch.ones(8, 120, dtype=torch.float64)
    mask[1, 40:60] = False
    points_1[1, 40:60], pixels_2[1, 45:50] = 1e12, torch.inf
    points_2[2, ::7], pixels_1[2, 1::7], sigmas[2, 2::7] = torch.nan, torch.inf, 0.0
    mask[3, 39:] = False  # three right pairs
    line = torch.linspace(0, 1, 120, dtype=torch.float64)[:, None] * torch.tensor((1.0, 0.5, 2.0)).double()
    points_1[4] = torch.tensor((-0.5, 0.2, 2.0)) + line
    points_2[4] = transform(pairs.S_21[0], points_1[4])
    pixels_1[4], pixels_2[4] = CAMERA.project(points_1[4])[0], CAMERA.project(points_2[4])[0]
    order = torch.randperm(120, generator=torch.Generator().manual_seed(0))
    points_2[5], pixels_2[5] = points_2[5, order], pixels_2[5, order]
    sigmas[6] = -1.0
    mask[7] = False
    result = estimate_similarity(
        points_1, points_2, pixels_1, pixels_2, camera_1=CAMERA, camera_2=CAMERA, sigmas_1=sigmas, mask=mask
    )
    assert result.success.tolist() == [True] * 3 + [False] * 5
    for tensor in (result.S_21, result.score):
        assert torch.isfinite(tensor).all()
    assert not result.inliers[~result.success].any()
    assert not (result.inliers & ~mask).any()
    check(result.S_21[:3], pairs.S_21.expand(3, 4, 4))
    torch.testing.assert_close(result.S_21[3:], torch.eye(4).double().expand(5, 4, 4))


def test_result_is_detached() -> None:
    inputs = [x.requires_grad_() for x in make_pairs(0).inputs()]
    assert not estimate_similarity(*inputs, camera_1=CAMERA, camera_2=CAMERA).S_21.requires_grad


@pytest.mark.parametrize("line", [False, True])
def test_poses_are_aligned_with_their_rotations(line: bool) -> None:
    """Also where the centers are on a line, about which they could turn."""
    generator = torch.Generator().manual_seed(3)
    T_ac = se3_exp(torch.randn(12, 6, generator=generator, dtype=torch.float64))
    if line:
        T_ac[:, 1:3, 3] = 0.0
    S_ba = sim3_exp(torch.tensor([0.3, -1.0, 2.0, 0.4, -0.7, 0.2, 0.5], dtype=torch.float64))
    T_bc = se3_inverse(without_scale(se3_inverse(T_ac) @ sim3_inverse(S_ba)))
    torch.testing.assert_close(align_poses(T_ac, T_bc), S_ba, rtol=0, atol=1e-12)
    points_a = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    T_cb, points_b = in_place_of(se3_inverse(T_bc), se3_inverse(T_ac), points_a)
    torch.testing.assert_close(T_cb, se3_inverse(T_bc), rtol=0, atol=1e-12)
    torch.testing.assert_close(points_b, transform(S_ba, points_a), rtol=0, atol=1e-12)


def test_poses_at_one_place_keep_their_unit() -> None:
    T_ac = rigid(so3_exp(torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)), torch.ones(1, 3).double())
    S_ba = align_poses(T_ac, torch.eye(4, dtype=torch.float64)[None])
    torch.testing.assert_close(S_ba @ T_ac[0], torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("both", [False, True])
def test_points_at_one_place_have_no_scale_and_no_gradient(both: bool) -> None:
    """Their mean differs from them by rounding, which must not count as a spread."""
    source = torch.tensor([0.1, 0.7, -0.3]).double().expand(9, 3).clone().requires_grad_()
    target = source.detach() if both else torch.linspace(0, 1, 27).double().view(9, 3)
    scale, R, _ = umeyama(source, target)
    (gradient,) = torch.autograd.grad(scale + R.sum(), source)
    assert float(scale) == 1
    assert torch.equal(R, torch.eye(3).double())
    assert not gradient.any()
