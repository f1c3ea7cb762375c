from __future__ import annotations

import torch

from torchslam.geometry import innovation_covariances, mahalanobis_squared


def test_distance_of_uncertain_predictions_is_chi_square(generator: torch.Generator) -> None:
    """Points and pixels drawn with their covariances: squared distances average to two, 95 % are below 5.991."""
    count = 20_000
    root = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    J = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64) @ root.mT
    pixels = 0.5 * torch.randn(count, 2, generator=generator, dtype=torch.float64)
    sigmas = torch.full((count,), 0.5, dtype=torch.float64)
    S = innovation_covariances(J.expand(count, 2, 3), (root @ root.mT).expand(count, 3, 3), sigmas)
    squared = mahalanobis_squared(pixels - points @ J.mT, S)
    assert abs(float(squared.mean()) - 2) < 0.1
    assert abs(float((squared < 5.991).double().mean()) - 0.95) < 0.01


def test_certain_points_leave_the_noise_of_the_pixels() -> None:
    errors = torch.tensor([[3.0, 4.0], [0.0, 1.0]])
    S = innovation_covariances(torch.ones(2, 2, 3), torch.zeros(2, 3, 3), torch.tensor([5.0, 0.5]))
    torch.testing.assert_close(mahalanobis_squared(errors, S), torch.tensor([1.0, 4.0]))
