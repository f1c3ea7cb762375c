"""Two separate submaps of one scene."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import se3_exp


@pytest.fixture
def S_21() -> Tensor:
    """(4, 4) a similarity: turned by half a radian or so, moved, 1.6 times as large."""
    S = se3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, -0.4, 0.2], dtype=torch.float64))
    S[:3, :3] *= 1.6
    return S
