"""The network on top of aggregation: shapes, gradients, batches, and what the weights of the package do."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.dense.slanted_plane import FAR, NEAR, scene
from torchslam.dense import learned
from torchslam.dense.consistency import confidence_alone
from torchslam.dense.estimate import Estimate, estimate_depth
from torchslam.dense.learned import RatingNet, learned_confidence, net_inputs, trained_net

WIDTH, HEIGHT = 96, 70
"""Half of the height is odd, as that of 320 x 238 pixels is."""


def found_in(
    count: int = 1, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> tuple[Estimate, Tensor, Tensor, Tensor]:
    """Depth of the slanted plane, gray images, and limits."""
    reference, sources, camera, T_sr, _ = scene(WIDTH, HEIGHT)
    gray = reference.expand(count, -1, -1).to(device, dtype)
    near, far = (torch.full((count,), each, dtype=dtype, device=device) for each in (NEAR, FAR))
    found = estimate_depth(
        gray,
        sources.expand(count, -1, -1, -1).to(device, dtype),
        camera.to(device),
        T_sr.expand(count, -1, -1, -1).to(device),
        near,
        far,
    )
    return found, gray, near, far


def small_net(dtype: torch.dtype = torch.float32) -> RatingNet:
    """A small one with random weights, also of the last layer."""
    torch.manual_seed(0)
    net = RatingNet((3, 4, 4, 5))
    torch.nn.init.normal_(net.last.weight)
    return net.to(dtype)


def test_for_an_untrained_network_all_is_as_probable_as_not() -> None:
    assert (learned_confidence(*found_in(), RatingNet()) == 0.5).all()


def test_of_any_type_on_any_device(device: torch.device, dtype: torch.dtype) -> None:
    if device.type == "sim" and dtype == torch.float64:
        pytest.skip("tried in single precision")
    found, gray, near, far = found_in(dtype=dtype, device=device)
    confidence = learned_confidence(found, gray, near, far)
    assert confidence.dtype == dtype
    assert confidence.device == gray.device
    assert confidence.shape == (1, HEIGHT, WIDTH)
    expected = learned_confidence(*found_in())
    torch.testing.assert_close(confidence.cpu().float(), expected, atol=0.02, rtol=0)


def test_the_same_bytes_again() -> None:
    given = found_in()
    assert torch.equal(learned_confidence(*given), learned_confidence(*given))


def test_a_batch_is_a_loop() -> None:
    found, gray, near, far = found_in(2, torch.float64)
    other = found._replace(
        inverse_depth=found.inverse_depth * torch.tensor([1.0, 1.1])[:, None, None].double()
    )
    net = small_net(torch.float64)
    confidence = learned_confidence(other, gray, near, far, net)
    for row in range(2):
        one = slice(row, row + 1)
        part = Estimate(
            other.inverse_depth[one],
            other.std[one],
            type(found.coarse)(*(each[one] for each in other.coarse)),
            other.match[one],
            type(found.fine)(*(each[one] for each in other.fine)),
        )
        torch.testing.assert_close(
            confidence[one], learned_confidence(part, gray[one], near[one], far[one], net)
        )
    assert not torch.equal(confidence[0], confidence[1])


def test_gradients_of_the_network() -> None:
    inputs = torch.rand(1, 27, 9, 12, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(small_net(torch.float64), (inputs,), fast_mode=True)


def test_every_weight_has_a_gradient() -> None:
    net = small_net()
    learned_confidence(*found_in(), net).sum().backward()
    for name, weight in net.named_parameters():
        assert weight.grad is not None, name
        assert torch.isfinite(weight.grad).all(), name
        assert weight.grad.abs().max() > 0, name


def test_inputs_know_the_place_of_a_pixel() -> None:
    """A difference at one pixel of full size is in the inputs of its pixel of half size, and nowhere else in detail."""
    found, gray, near, far = found_in()
    depth = found.inverse_depth.clone()
    depth[0, 21, 33] *= 1.1
    changed = net_inputs(found._replace(inverse_depth=depth), gray, near, far)
    difference = (changed - net_inputs(found, gray, near, far)).abs() > 1e-6
    assert difference[0, :, 10, 16].any()
    difference[0, :, 10, 16] = False
    assert not difference.any()


def test_the_weights_of_the_package_rate_depth() -> None:
    """Noise has no depth; the plane has."""
    found, gray, near, far = found_in()
    sure = learned_confidence(found, gray, near, far)[..., 20:-20, 30:-30]
    _, sources, camera, T_sr, _ = scene(WIDTH, HEIGHT)
    noise = torch.rand(3, *sources.shape, generator=torch.Generator().manual_seed(0))
    near, far, gray = near.expand(3), far.expand(3), gray.expand(3, -1, -1)
    lost = estimate_depth(gray, noise, camera, T_sr.expand(3, -1, -1, -1), near, far)
    unsure = learned_confidence(lost, gray, near, far)
    assert float(sure.median()) > 0.9
    assert float(unsure.median()) < 0.2
    assert float(unsure.median()) < float(confidence_alone(lost).median())


def test_the_weights_are_small() -> None:
    assert learned._WEIGHTS_FILE.stat().st_size < 1 << 20
    assert sum(each.numel() for each in trained_net(torch.device("cpu")).parameters()) < 110_000
