from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchslam.features.patches import RADIUS, Patches, align, at_level, cut, offsets, pyramid, sample


def texture(height: int = 96, width: int = 128, seed: int = 0) -> Tensor:
    """(1, 1, H, W) smooth noise of all scales."""
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    smooth = sum(sigma**1.5 * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 3.0, 6.0, 12.0))
    assert isinstance(smooth, np.ndarray)
    return torch.from_numpy((smooth - smooth.min()) / (smooth.max() - smooth.min()))[None, None]


def warped(image: Tensor, A: Tensor, shift: Tensor, middle: Tensor) -> Tensor:
    """The image that shows at A (x - middle) + middle + shift what the first one shows at x."""
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    there = torch.stack([x, y], dim=-1).to(image)
    back = (there - middle - shift) @ torch.linalg.inv(A).mT + middle
    return sample(image, back[None].flatten(1, 2)[:, None]).reshape(1, 1, height, width)


def grid() -> Tensor:
    """(1, 20, 2) pixels well inside of the image."""
    y, x = torch.meshgrid(torch.linspace(30.2, 65.7, 4), torch.linspace(32.4, 95.1, 5), indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=-1)[None]


def identity(pixels: Tensor) -> Tensor:
    return torch.eye(2).to(pixels).expand(*pixels.shape, 2)


@given(st.floats(-4, 4), st.floats(-4, 4), st.integers(0, 50))
@settings(max_examples=15, deadline=None)
def test_a_shift_is_found(dx: float, dy: float, seed: int) -> None:
    image, pixels = texture(seed=seed), grid()
    shift = torch.tensor([dx, dy])
    other = warped(image, torch.eye(2), shift, torch.zeros(2))
    found = align(cut(pyramid(image), pixels), pyramid(other), pixels, identity(pixels))
    assert found.mask.float().mean() > 0.8
    error = (found.pixels - pixels - shift).norm(dim=-1)[found.mask & (found.similarity > 0.9)]
    assert len(error) > 15
    assert error.median() < 0.1


def test_gain_and_offset_make_no_difference() -> None:
    image, pixels = texture(), grid()
    other = warped(image, torch.eye(2), torch.tensor([1.3, -0.8]), torch.zeros(2))
    patches = cut(pyramid(image), pixels)
    plain = align(patches, pyramid(other), pixels, identity(pixels), iterations=10)
    dim = align(patches, pyramid(0.4 * other + 0.3), pixels, identity(pixels), iterations=10)
    assert torch.allclose(plain.pixels, dim.pixels, atol=1e-3)
    assert torch.allclose(plain.similarity, dim.similarity, atol=1e-4)


def test_the_warp_says_how_the_other_image_lies() -> None:
    image, pixels, middle = texture(), grid(), torch.tensor([64.0, 48.0])
    angle = torch.tensor(0.5)
    A = 1.3 * torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    shift = torch.tensor([0.7, -1.1])
    expected = (pixels - middle) @ A.mT + middle + shift
    other = warped(image, A, shift, middle)
    patches, start = cut(pyramid(image), pixels), expected + torch.tensor([1.2, 0.9])
    found = align(patches, pyramid(other), start, A.expand(1, 20, 2, 2))
    good = found.mask & (found.similarity > 0.9)
    assert good.sum() >= 10
    assert (found.pixels - expected).norm(dim=-1)[good].max() < 0.1
    blind = align(patches, pyramid(other), start, identity(pixels))
    assert (blind.mask & (blind.similarity > 0.9)).sum() <= good.sum() // 2


def test_where_opencv_finds_them() -> None:
    image, pixels = texture(seed=4), grid()
    other = warped(image, torch.eye(2), torch.tensor([2.4, 1.7]), torch.zeros(2))
    as_bytes = [(each[0, 0].numpy() * 255).round().astype(np.uint8) for each in (image, other)]
    side = 2 * RADIUS + 1
    expected, status, _ = cv2.calcOpticalFlowPyrLK(
        as_bytes[0], as_bytes[1], pixels[0].numpy()[:, None], np.empty(0), winSize=(side, side), maxLevel=2
    )
    found = align(cut(pyramid(image), pixels), pyramid(other), pixels, identity(pixels))
    both = found.mask[0] & torch.from_numpy(status[:, 0] > 0)
    apart = (found.pixels[0] - torch.from_numpy(expected[:, 0])).norm(dim=-1)[both]
    assert len(apart) > 15
    assert apart.median() < 0.05


def test_another_thing_in_its_place_is_noticed() -> None:
    image, pixels = texture(seed=1), grid()
    found = align(cut(pyramid(image), pixels), pyramid(texture(seed=2)), pixels, identity(pixels))
    assert (found.mask & (found.similarity > 0.8)).float().mean() <= 0.2
    same = align(cut(pyramid(image), pixels), pyramid(image), pixels, identity(pixels))
    assert torch.allclose(same.similarity, torch.ones(1, 20), atol=1e-5)
    assert torch.allclose(same.pixels, pixels, atol=1e-3)


def test_nothing_to_tell_a_displacement_by() -> None:
    plain = torch.full((1, 1, 96, 128), 0.4)
    found = align(cut(pyramid(plain), grid()), pyramid(texture()), grid(), identity(grid()))
    assert not found.mask.any()
    assert torch.equal(found.pixels, grid())
    at_the_edge = torch.tensor([[[2.0, 50.0], [126.0, 50.0], [60.0, 2.0], [60.0, 94.0], [60.0, 50.0]]])
    assert cut(pyramid(texture()), at_the_edge).mask.tolist() == [[False, False, False, False, True]]


def test_a_batch_is_as_one_after_the_other() -> None:
    images = torch.cat([texture(seed=seed) for seed in range(3)])
    others = torch.cat(
        [warped(image[None], torch.eye(2), torch.tensor([1.0, 2.0]), torch.zeros(2)) for image in images]
    )
    pixels = grid().expand(3, 20, 2)
    together = align(cut(pyramid(images), pixels), pyramid(others), pixels, identity(pixels))
    for row in range(3):
        one = slice(row, row + 1)
        alone = align(
            cut(pyramid(images[one]), pixels[one]), pyramid(others[one]), pixels[one], identity(pixels[one])
        )
        assert torch.allclose(alone.pixels, together.pixels[one], atol=1e-4)
        assert torch.equal(alone.mask, together.mask[one])


def test_levels_have_the_same_top_left_corner() -> None:
    image = texture()
    halves = pyramid(image)
    assert [tuple(each.shape[-2:]) for each in halves] == [(96, 128), (48, 64), (24, 32)]
    assert torch.allclose(halves[1][0, 0, 3, 5], image[0, 0, 6:8, 10:12].mean())
    assert torch.equal(at_level(torch.tensor([0.5, 10.5]), 1), torch.tensor([0.0, 5.0]))
    assert torch.equal(offsets(1, image)[:4], torch.tensor([[-1.0, -1], [0, -1], [1, -1], [-1, 0]]))


def aligned(image: Tensor, other: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    found = align(cut((image,), pixels), (other,), pixels, identity(pixels), iterations=60)
    assert found.mask.all()
    return found.pixels, found.similarity


def test_gradients_with_respect_to_both_images() -> None:
    image = texture(20, 22, seed=7).double()
    other = warped(image, torch.eye(2).double(), torch.tensor([0.4, -0.3]).double(), torch.zeros(2).double())
    pixels = torch.tensor([[[9.3, 10.1], [11.6, 9.2]]], dtype=torch.float64)
    inputs = (image.requires_grad_(), other.detach().requires_grad_(), pixels)
    assert torch.autograd.gradcheck(aligned, inputs, eps=1e-7, atol=1e-5, fast_mode=True)


def test_what_is_not_found_has_no_gradient() -> None:
    image, other = torch.full((1, 1, 96, 128), 0.4).requires_grad_(), texture().requires_grad_()
    found = align(cut(pyramid(image), grid()), pyramid(other), grid(), identity(grid()))
    gradients = torch.autograd.grad(found.pixels.sum(), (image, other), allow_unused=True)
    assert all(gradient is None or bool((gradient == 0).all()) for gradient in gradients)


def test_on_devices(device: torch.device, dtype: torch.dtype) -> None:
    image, pixels = texture().to(device, dtype), grid().to(device, dtype)
    patches: Patches = cut(pyramid(image), pixels)
    found = align(patches, pyramid(image), pixels, identity(pixels))
    assert found.pixels.device.type == device.type
    assert found.pixels.dtype == dtype
    assert torch.allclose(found.pixels.cpu(), pixels.cpu(), atol=1e-3)
    assert F.cosine_similarity(patches.template, patches.template, dim=-1).min() > 0.99
