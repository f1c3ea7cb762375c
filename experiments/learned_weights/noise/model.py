"""A model from cues to the information of a keypoint, and a feature extractor with it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from experiments.learned_weights.noise.cues import NAMES, describe
from torchslam import ORB, Features

HIDDEN = 8


class NoiseModel(nn.Module):
    """Log of the information in units of scale^-2, and how it is shared out between directions.

    values (..., C) are standardized by the mean and the deviation of those trained on; then a line and a hidden layer.
    kind: "constant": one number for all; "isotropic": a number each; "directed": the power of the structure tensor
          besides, so that the information is larger along the gradient
    level_of_image: what the information times scale squared is in the geometric mean of every image; zero: as it is
    """

    mean: Tensor
    deviation: Tensor
    level_of_image: Tensor

    def __init__(self, kind: str = "directed", seed: int = 0, num_cues: int = len(NAMES)) -> None:
        super().__init__()
        self.kind = kind
        generator = torch.Generator().manual_seed(seed)
        self.level = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.line = nn.Parameter(torch.zeros(num_cues, dtype=torch.float64))
        self.inner = nn.Parameter(
            0.5 * torch.randn(num_cues, HIDDEN, generator=generator, dtype=torch.float64)
        )
        self.bend = nn.Parameter(torch.zeros(HIDDEN, dtype=torch.float64))
        self.outer = nn.Parameter(torch.zeros(HIDDEN, dtype=torch.float64))
        self.power = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.register_buffer("level_of_image", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(num_cues, dtype=torch.float64))
        self.register_buffer("deviation", torch.ones(num_cues, dtype=torch.float64))

    def standardize(self, values: Tensor) -> None:
        """Take mean and deviation from values (n, C)."""
        self.mean.copy_(values.mean(0))
        self.deviation.copy_(values.std(0))

    def log_factor(self, values: Tensor) -> Tensor:
        """(...) log of the information times scale squared, of values (..., C)."""
        if self.kind == "constant":
            return self.level.expand(values.shape[:-1])
        x = ((values - self.mean) / self.deviation).clamp(
            -3, 3
        )  # what was never seen is taken for the outermost
        return self.level + x @ self.line + torch.tanh(x @ self.inner + self.bend) @ self.outer

    def forward(self, values: Tensor, directions: Tensor, scales_squared: Tensor, images: Tensor) -> Tensor:
        """Information px^-2 (n,), or (n, 2, 2) if directed, of keypoints (n,).

        directions: (n, 2, 2); scales_squared: (n,) px^2; images: (n,) int64, in which image each is
        """
        logs = self.log_factor(values)
        if self.level_of_image > 0:
            logs = logs - means(logs, images)[images] + self.level_of_image.log()
        number = logs.exp() / scales_squared
        if self.kind != "directed":
            return number
        return number[..., None, None] * powers(directions, self.power)


def constant(level: float) -> NoiseModel:
    """Of one information for all, in units of scale^-2."""
    model = NoiseModel("constant")
    torch.nn.init.constant_(model.level, math.log(level))
    return model


def means(values: Tensor, groups: Tensor) -> Tensor:
    """(G,) of the values (n,) of each group, zero where it is empty; groups: (n,) int64."""
    sums = values.new_zeros(int(groups.max()) + 1).index_add(0, groups, values)
    return sums / torch.bincount(groups).clamp_min(1)


def powers(A: Tensor, exponent: Tensor) -> Tensor:
    """(..., 2, 2) the powers of definite matrices, of determinant one. Differentiable in the exponent."""
    half, across = (A[..., 0, 0] - A[..., 1, 1]) / 2, A[..., 0, 1]
    middle, gap = (A[..., 0, 0] + A[..., 1, 1]) / 2, (half.square() + across.square()).sqrt()
    ratio = 0.5 * torch.log((middle + gap) / (middle - gap))
    unit = torch.stack((half, across, across, -half), dim=-1).unflatten(-1, (2, 2))
    unit = unit / gap.clamp_min(torch.finfo(gap.dtype).tiny)[..., None, None]
    eye = torch.eye(2, dtype=A.dtype, device=A.device)
    angle = (exponent * ratio)[..., None, None]
    return torch.cosh(angle) * eye + torch.sinh(angle) * unit


def save(model: NoiseModel, path: Path) -> None:
    safetensors.torch.save_file(model.state_dict(), path, {"kind": model.kind})


def load(path: str | Path) -> NoiseModel:
    with safetensors.safe_open(str(path), framework="pt") as file:
        model = NoiseModel(file.metadata()["kind"])
    model.load_state_dict(safetensors.torch.load_file(path))
    return model


class Informed(nn.Module):
    """ORB with predicted information of its keypoints: `--features experiments.learned_weights.noise.model:Informed`.

    weights: a file that `save` wrote
    """

    def __init__(self, num_keypoints: int, weights: str) -> None:
        super().__init__()
        self.orb, self.model = ORB(num_keypoints), load(weights)

    @torch.no_grad()
    def forward(self, images: Tensor, mask: Tensor | None = None) -> Features:
        features = self.orb(images, mask)
        cues = describe(self.orb, images, features)
        squared, mask = features.scales.double().square(), features.mask
        of = torch.arange(len(mask), device=mask.device)[:, None].expand_as(mask)
        found = self.model(
            cues.values[mask].double(), cues.directions[mask].double(), squared[mask], of[mask]
        )
        shape = (*mask.shape, *found.shape[1:])
        information = torch.zeros(shape, dtype=images.dtype, device=mask.device)
        information[mask] = found.to(images.dtype)
        return replace(features, information=information)
