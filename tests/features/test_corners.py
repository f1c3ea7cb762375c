from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torchslam.features.corners import gather_patches, harris_responses, quadratic_peak, soft_peak


def paraboloid(x: float, y: float, side: int = 3) -> torch.Tensor:
    """A peak at (x, y) from the centre, turned and longer in one direction than in the other."""
    axis = torch.arange(side, dtype=torch.float64) - side // 2
    dy, dx = torch.meshgrid(axis - y, axis - x, indexing="ij")
    return 100 - 3 * dx**2 - 2 * dy**2 + dx * dy


def test_patches_are_cut_around_their_positions() -> None:
    image = torch.arange(100).view(10, 10)
    patches = gather_patches(image.flatten(), torch.tensor([44, 55]), 10, 2)
    assert torch.equal(patches[0], image[2:7, 2:7])
    assert torch.equal(patches[1], image[3:8, 3:8])


def test_harris_is_that_of_opencv() -> None:
    image = np.random.default_rng(0).integers(0, 256, (11, 11), dtype=np.uint8)
    expected = cv2.cornerHarris(image.astype(np.float32), 7, 3, 0.04)[4:7, 4:7]
    ours = harris_responses(torch.from_numpy(image)[None].double())[0]
    # OpenCV divides the derivatives by 4 and sums by 7.
    np.testing.assert_allclose(ours.numpy() / (4 * 7) ** 4, expected, rtol=1e-4)


def test_harris_gradcheck() -> None:
    patches = torch.rand(2, 10, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(harris_responses, (patches.requires_grad_(),))


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.3, -0.2), (-0.45, 0.4)])
def test_quadratic_peak_of_a_paraboloid(x: float, y: float) -> None:
    torch.testing.assert_close(
        quadratic_peak(paraboloid(x, y)[None]), torch.tensor([[x, y]], dtype=torch.float64)
    )


@pytest.mark.parametrize(
    "responses", [torch.zeros(1, 3, 3), torch.ones(1, 3, 3), -paraboloid(0.2, 0.2)[None]]
)
def test_without_a_peak_there_is_no_offset(responses: torch.Tensor) -> None:
    assert not quadratic_peak(responses).any()


def test_quadratic_peak_is_limited() -> None:
    assert quadratic_peak(paraboloid(2.0, 0.0)[None]).abs().max() <= 0.5


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.4, -0.3)])
def test_soft_peak_leans_towards_the_maximum(x: float, y: float) -> None:
    offset = soft_peak(paraboloid(x, y, 5)[None])[0]
    assert (offset - torch.tensor([x, y])).abs().max() < 0.25
    assert torch.equal(offset.sign(), torch.tensor([x, y], dtype=torch.float64).sign()) or x == 0


def test_soft_peak_of_nothing_is_the_centre() -> None:
    assert soft_peak(torch.zeros(2, 3, 3)).abs().max() < 1e-6


def test_soft_peak_gradcheck() -> None:
    responses = torch.rand(3, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(soft_peak, (responses.requires_grad_(),))
