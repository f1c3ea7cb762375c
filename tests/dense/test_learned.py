"""The network on top of aggregation: shapes, gradients, batches, and what the weights of the package do."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.dense.slanted_plane import FAR, NEAR, scene
from torchslam.dense import learned
from torchslam.dense.confidence import confidence_alone
from torchslam.dense.estimate import Estimate, estimate_depth
from torchslam.dense.learned import DepthNet, changed_depth, learned_depth, net_inputs, steps_of, trained_net

WIDTH, HEIGHT = 96, 70
"""Half of the height is odd, as that of 320 x 238 pixels is."""


def found_in(
    count: int = 1, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> tuple[Estimate, Tensor, Tensor, Tensor, Tensor]:
    """Depth of the slanted plane, gray images, limits, and the exact depth."""
    reference, sources, camera, T_sr, depth = scene(WIDTH, HEIGHT)
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
    return found, gray, near, far, depth


def a_net(dtype: torch.dtype = torch.float32) -> DepthNet:
    """A small one with random weights, also of the last layer."""
    torch.manual_seed(0)
    net = DepthNet((3, 4, 4, 5))
    torch.nn.init.normal_(net.last.weight)
    return net.to(dtype)


def test_an_untrained_network_changes_nothing() -> None:
    found, gray, near, far, _ = found_in()
    depth, confidence = learned_depth(found, gray, near, far, DepthNet())
    assert torch.equal(depth, found.inverse_depth)
    assert (confidence == 0.5).all()


def test_of_any_type_on_any_device(device: torch.device, dtype: torch.dtype) -> None:
    found, gray, near, far, exact = found_in(dtype=dtype, device=device)
    depth, confidence = learned_depth(found, gray, near, far)
    assert depth.dtype == confidence.dtype == dtype
    assert depth.device == confidence.device == gray.device
    assert depth.shape == confidence.shape == (1, HEIGHT, WIDTH)
    assert float(((1 / depth[0].cpu()) / exact - 1).abs().median()) < 0.01


def test_the_same_bytes_again() -> None:
    found, gray, near, far, _ = found_in()
    first, again = (learned_depth(found, gray, near, far) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_a_batch_is_a_loop() -> None:
    found, gray, near, far, _ = found_in(2, torch.float64)
    other = found._replace(
        inverse_depth=found.inverse_depth * torch.tensor([1.0, 1.1])[:, None, None].double()
    )
    net = a_net(torch.float64)
    depth, confidence = learned_depth(other, gray, near, far, net)
    for row in range(2):
        one = slice(row, row + 1)
        part = Estimate(
            other.inverse_depth[one],
            other.std[one],
            type(found.coarse)(*(each[one] for each in other.coarse)),
            other.match[one],
            type(found.fine)(*(each[one] for each in other.fine)),
        )
        single, sure = learned_depth(part, gray[one], near[one], far[one], net)
        torch.testing.assert_close(depth[one], single)
        torch.testing.assert_close(confidence[one], sure)
    assert not torch.equal(depth[0], depth[1])


def test_gradients_of_the_network_and_of_changed_depth() -> None:
    net = a_net(torch.float64)
    inputs = torch.rand(1, 27, 9, 12, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, (inputs,), fast_mode=True)
    depth = torch.full((1, 18, 24), 0.5, dtype=torch.float64, requires_grad=True)
    change = torch.rand(1, 4, 9, 12, dtype=torch.float64, requires_grad=True)
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    changed = lambda depth, change: changed_depth(depth, change, 0.2 * one, 0.1 * one, 0.0)  # noqa: E731
    assert torch.autograd.gradcheck(changed, (depth, change))


def test_every_weight_has_a_gradient() -> None:
    found, gray, near, far, _ = found_in()
    net = a_net()
    depth, confidence = learned_depth(found, gray, near, far, net)
    (depth.sum() + confidence.sum()).backward()
    for name, weight in net.named_parameters():
        assert weight.grad is not None, name
        assert torch.isfinite(weight.grad).all(), name
        assert weight.grad.abs().max() > 0, name


@given(change=st.floats(-80, 80))
@settings(max_examples=30, deadline=None)
def test_small_changes_are_not_made_and_depth_stays_positive(change: float) -> None:
    depth, ones = torch.full((1, 2, 2), 0.5), torch.ones(1, 1, 1)
    changed = changed_depth(depth, torch.full((1, 4, 1, 1), change), 0.2 * ones, 0.05 * ones)
    expected = 0.5 if abs(change) < learned.LEAST_CHANGE else max(0.5 + 0.05 * change, 0.1)
    assert float(changed.min()) == float(changed.max()) == pytest.approx(expected, rel=1e-5)


def test_inputs_know_the_place_of_a_pixel() -> None:
    """A difference at one pixel of full size is in the inputs of its pixel of half size, and nowhere else in detail."""
    found, gray, near, far, _ = found_in()
    depth = found.inverse_depth.clone()
    step = steps_of(found, near, far)[1]
    depth[0, 21, 33] += float(step)
    changed = net_inputs(found._replace(inverse_depth=depth), gray, near, far)
    difference = (changed - net_inputs(found, gray, near, far)).abs() > 1e-6
    assert difference[0, :, 10, 16].any()
    difference[0, :, 10, 16] = False
    assert not difference.any()


def test_the_weights_of_the_package_rate_depth() -> None:
    """Noise has no depth; the plane has."""
    found, gray, near, far, _ = found_in()
    sure = learned_depth(found, gray, near, far)[1][..., 20:-20, 30:-30]
    _, sources, camera, T_sr, _ = scene(WIDTH, HEIGHT)
    noise = torch.rand(1, *sources.shape, generator=torch.Generator().manual_seed(0))
    lost = estimate_depth(gray, noise, camera, T_sr[None], near, far)
    unsure = learned_depth(lost, gray, near, far)[1]
    assert float(sure.median()) > 0.9
    assert float(unsure.median()) < 0.2
    assert float(unsure.median()) < float(confidence_alone(lost).median())


def test_the_weights_are_small() -> None:
    assert learned._WEIGHTS_FILE.stat().st_size < 1 << 20
    assert sum(each.numel() for each in trained_net(torch.device("cpu")).parameters()) < 110_000
