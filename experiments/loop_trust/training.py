"""Training: first to tell genuine loops from false ones, then to make trajectories right, through the solver."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from experiments.loop_trust.graphs import Graphs, ate
from experiments.loop_trust.trust import Cues, LoopTrust, seen, trusted
from torchslam.learning import Log, Training


@dataclass(frozen=True)
class Settings:
    """warm: steps and graphs of a step of the classification; steps, batch: of the training through the solver."""

    warm_steps: int = 400
    warm_batch: int = 24
    warm_rate: float = 3e-3
    steps: int = 40
    batch: int = 8
    rate: float = 1e-3
    seed: int = 0


def classification_loss(logits: Tensor, graphs: Graphs) -> Tensor:
    """() binary cross entropy of the loops."""
    return F.binary_cross_entropy_with_logits(
        logits[graphs.mask], graphs.genuine[graphs.mask].to(logits.dtype)
    )


def trajectory_loss(network: LoopTrust, graphs: Graphs, cues: Cues, bounds: Tensor) -> Tensor:
    """() log(1 + ATE / bound), mean over graphs, sum over both rounds; bounds: (G,) the oracle's ATE."""
    total = torch.zeros((), dtype=bounds.dtype)
    for _, S_cw in trusted(network, graphs, cues, backward="implicit"):
        total = total + (ate(S_cw, graphs.S_cw_true) / bounds).log1p().mean()
    return total


def warm_up(
    network: LoopTrust, graphs: Graphs, cues: Cues, settings: Settings, log: Log | None = None
) -> list[float]:
    """Fit the first round to tell genuine loops, in place. Returns the losses."""
    network.first.measure(cues.alone, cues.paired, cues.mask)
    optimizer = torch.optim.AdamW(network.first.parameters(), settings.warm_rate, weight_decay=1e-3)
    training = Training(network, optimizer, settings.warm_steps, settings.seed, log)
    for _ in training:
        rows = torch.randint(len(graphs), (settings.warm_batch,), generator=training.generator)
        training.descend(classification_loss(network.logits(cues[rows]), graphs[rows]))
    return training.losses


def train(
    network: LoopTrust,
    graphs: Graphs,
    cues: Cues,
    bounds: Tensor,
    settings: Settings,
    log: Log | None = None,
) -> list[float]:
    """Fit both rounds by the error of trajectories, in place. Returns the losses."""
    with torch.no_grad():
        logits = network.logits(cues)
        # What the solution leaves is about what odometry says of loops that are trusted: its scale, not its value.
        extra = seen(cues, logits, cues.alone[..., 0].double().expm1())
        network.second.measure(extra, cues.paired, cues.mask)
    optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=1e-3)
    training = Training(network, optimizer, settings.steps, settings.seed, log)
    for _ in training:
        rows = torch.randint(len(graphs), (settings.batch,), generator=training.generator)
        training.descend(trajectory_loss(network, graphs[rows], cues[rows], bounds[rows]))
    return training.losses
