from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, KeypointNoise, innovation_covariances, mahalanobis_squared, passes_gate
from torchslam.geometry.gating import GATE_FACTOR, unpacked_information, whitening


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


def said(kind: str, sigmas: Tensor) -> KeypointNoise:
    """The same noise by scale, by a number, by a matrix."""
    matrix = sigmas[..., None, None] ** -2 * torch.eye(2, dtype=sigmas.dtype)
    information = {"scale": None, "number": sigmas**-2, "matrix": matrix}[kind]
    return KeypointNoise.of(sigmas if kind == "scale" else torch.ones_like(sigmas), information)


@pytest.mark.parametrize("kind", ["scale", "number", "matrix"])
def test_noise_is_the_same_in_every_representation(kind: str, generator: torch.Generator) -> None:
    camera = Camera.pinhole(400.0, 420.0, 159.5, 119.5, size=(320, 240))
    sigmas = 0.5 + torch.rand(7, generator=generator, dtype=torch.float64)
    points_c = torch.randn(7, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 6.0])
    points_c[3, 2] = -1.0
    errors = torch.randn(7, 2, generator=generator, dtype=torch.float64)
    pixels = camera.project(points_c)[0] + errors
    noise, rows = said(kind, sigmas), torch.tensor([2, 5])
    eye = torch.eye(2, dtype=torch.float64)
    weights, spread = (sigmas**-2, sigmas) if kind != "matrix" else (sigmas**-2, sigmas**2)
    if kind == "matrix":
        weights, spread = weights[:, None, None] * eye, spread[:, None, None] * eye
    margin = 1.0 if kind == "scale" else GATE_FACTOR
    wanted = errors.square().sum(-1) / (margin * sigmas) ** 2
    torch.testing.assert_close(noise.weights, weights)
    torch.testing.assert_close(noise.sigma_or_covariance, spread)
    torch.testing.assert_close(noise.sigmas, sigmas)
    torch.testing.assert_close(noise.gate_sigma, margin * sigmas)
    torch.testing.assert_close(noise.squared(errors), wanted)
    wanted[3] = torch.inf  # behind the camera
    torch.testing.assert_close(noise.squared_reprojection(points_c, pixels, camera), wanted)
    torch.testing.assert_close(noise[rows].squared(errors[rows]), wanted[rows])
    worse = noise.pairwise_max(said(kind, sigmas.flip(0)))
    torch.testing.assert_close(worse.sigmas, torch.maximum(sigmas, sigmas.flip(0)))
    back = unpacked_information(noise.information)
    assert (
        (back is None)
        if kind == "scale"
        else torch.equal(KeypointNoise.of(sigmas, back).weights, noise.weights)
    )


def test_half_the_scale_says_the_same_as_nothing(generator: torch.Generator) -> None:
    """Where the documentation says so: gates, and noise that was made explicit for the weights of a matcher."""
    scales = 1 + torch.rand(20, generator=generator, dtype=torch.float64)
    errors = torch.randn(20, 2, generator=generator, dtype=torch.float64)
    unstated, stated = KeypointNoise.of(scales, None), KeypointNoise.of(scales, (0.5 * scales) ** -2)
    torch.testing.assert_close(unstated.squared(errors), stated.squared(errors))
    torch.testing.assert_close(unstated.with_explicit_information().weights, stated.weights)


def test_the_gate_keeps_95_percent_of_anisotropic_noise(generator: torch.Generator) -> None:
    """Errors drawn with covariances of their own, ten times as long as wide, pass the gate as often as they should."""
    count = 20_000
    turn = 6.3 * torch.rand(count, generator=generator, dtype=torch.float64)
    axes = torch.stack((turn.cos(), -turn.sin(), turn.sin(), turn.cos()), -1).unflatten(-1, (2, 2))
    lengths = torch.tensor([3.0, 0.3], dtype=torch.float64)
    errors = (axes @ (lengths * torch.randn(count, 2, generator=generator, dtype=torch.float64))[..., None])[
        ..., 0
    ]
    information = axes @ torch.diag(lengths**-2) @ axes.mT
    noise = KeypointNoise.of(torch.ones(count, dtype=torch.float64), information)
    assert abs(float(passes_gate(noise.squared(GATE_FACTOR * errors)).double().mean()) - 0.95) < 0.01
    torch.testing.assert_close(noise.sigmas, torch.full_like(turn, math.sqrt(3.0 * 0.3)))
    torch.testing.assert_close(noise.sigma_or_covariance, axes @ torch.diag(lengths**2) @ axes.mT)
    S = innovation_covariances(
        torch.zeros(count, 2, 3).double(), torch.zeros(count, 3, 3).double(), noise.sigma_or_covariance
    )
    torch.testing.assert_close(mahalanobis_squared(errors, S), noise.squared(GATE_FACTOR * errors))


def test_a_root_of_an_information_whitens_and_has_gradients(generator: torch.Generator) -> None:
    root = torch.randn(5, 2, 2, generator=generator, dtype=torch.float64)
    A = root @ root.mT + 0.1 * torch.eye(2, dtype=torch.float64)
    W = whitening(A)
    torch.testing.assert_close(W.mT @ W, A)
    assert torch.autograd.gradcheck(whitening, (A.requires_grad_(),))
    bad = torch.tensor([[[0.0, 0.0], [0.0, 0.0]], [[1.0, 2.0], [2.0, 1.0]]], requires_grad=True)
    whitening(bad).sum().backward()
    assert not whitening(bad).any()
    assert bad.grad is not None
    assert not bad.grad.any()
