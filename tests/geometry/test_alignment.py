import pytest
import torch
from evo.core.geometry import umeyama_alignment
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import sim3_exp, so3_exp, transform, umeyama


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
