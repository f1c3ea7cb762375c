"""Training a front end through the poses of clips: an ordinary loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from experiments.learn_features.clips import Clip, errors_of
from torchslam import ClipSLAM


@dataclass(frozen=True)
class Settings:
    """steps: of the optimiser; clips: per step; frames: per clip; learning_rate: of Adam, falling to zero"""

    steps: int = 100
    clips: int = 1
    frames: int = 7
    learning_rate: float = 2e-3
    warm_up: int = 10
    max_gradient: float = 1.0


def train(
    clip_slam: ClipSLAM, draw: Callable[[torch.Generator], Clip], settings: Settings, seed: int = 0
) -> list[float]:
    """Lower the logarithms of both errors on clips that `draw` gives; the mean loss of every step that had one.

    With logarithms every clip counts alike, however far its camera moves. Clips with too few poses are passed over.
    """
    parameters = [parameter for parameter in clip_slam.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(parameters, settings.learning_rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / settings.warm_up) * (1 - step / settings.steps)
    )
    generator = torch.Generator().manual_seed(seed)
    losses = []
    for _ in range(settings.steps):
        optimizer.zero_grad()
        found = []
        for _ in range(settings.clips):
            errors = errors_of(clip_slam, draw(generator))
            if errors.enough:
                loss = errors.position.log() + errors.rotation.log()
                loss.backward()
                found.append(float(loss.detach()))
        torch.nn.utils.clip_grad_norm_(parameters, settings.max_gradient)
        optimizer.step()
        schedule.step()
        if found:
            losses.append(sum(found) / len(found))
        if found and len(losses) % 10 == 0:
            print(f"{len(losses):4d}  mean loss of the last ten {sum(losses[-10:]) / 10:.3f}", flush=True)
    return losses
