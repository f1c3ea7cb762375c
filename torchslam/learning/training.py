"""Training loop state: optimizer steps, logging and resumable checkpoints."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer
from torch.optim.lr_scheduler import CosineAnnealingLR, LRScheduler

from torchslam.errors import ResultsError
from torchslam.utils.files import write_whole

Log = Callable[[str, float, int], None]
"""Called with name, value and step, like `SummaryWriter.add_scalar` of TensorBoard."""

MAX_NORM = 1.0  # of the gradient: one step through a poorly determined pose must not undo a hundred others


class Training:
    """A number of optimizer steps with a schedule and clipped gradients that can be stopped and resumed.

        training = Training(module, torch.optim.Adam(module.parameters(), 1e-3), steps=1000, log=writer.add_scalar)
        training.resume("checkpoint.pt")
        for step in training:
            training.descend(loss_of(module, step))
            if training.step % 100 == 0:
                training.save("checkpoint.pt")

    Resumed training gives the same bytes as uninterrupted training: random numbers come from `generator`, depend on
    the step alone (`Batches`), or come from torch's default generator (dropout), which is seeded before every step.
    With several processes each has its own Training with the same `generator`, and one of them saves.

    Args:
        module: The trained module itself, not its DistributedDataParallel.
        optimizer: Of its parameters.
        steps: Number of steps.
        seed: Of `generator`.
        log: Receives loss and gradient norm of every step.
        schedule: Of the learning rate; a cosine to zero at the last step if None.
        max_norm: Longer gradients are scaled to this norm.

    Attributes:
        step: Number of steps made.
        losses: Of each step.
        generator: Of random numbers.
    """

    def __init__(
        self,
        module: nn.Module,
        optimizer: Optimizer,
        steps: int,
        seed: int = 0,
        log: Log | None = None,
        schedule: LRScheduler | None = None,
        max_norm: float = MAX_NORM,
    ) -> None:
        """Start at step 0."""
        self.module, self.optimizer, self.steps, self.log = module, optimizer, steps, log
        self._seed, self._max_norm = seed, max_norm
        self.step = 0
        self.losses: list[float] = []
        self.generator = torch.Generator().manual_seed(seed)
        self._schedule = CosineAnnealingLR(optimizer, steps) if schedule is None else schedule

    def __iter__(self) -> Iterator[int]:
        """Yield the remaining steps; the caller performs each with `descend` or `update`."""
        rank, ranks = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        while self.step < self.steps:
            torch.manual_seed(seed_of(self._seed, self.step * ranks + rank))
            yield self.step

    def descend(self, loss: Float[Tensor, ""]) -> None:
        """Backpropagate a loss and make one step.

        Raises:
            RuntimeError: As `update`.
        """
        self.optimizer.zero_grad()
        loss.backward()
        self.update(float(loss.detach()))

    def update(self, loss: float) -> None:
        """Make one step with the current gradients of the parameters, for a loss that is only logged.

        Raises:
            RuntimeError: A gradient is not finite; the parameters are unchanged.
        """
        parameters = [parameter for group in self.optimizer.param_groups for parameter in group["params"]]
        norm = float(clip_grad_norm_(parameters, self._max_norm, error_if_nonfinite=True))
        if self.log is not None:
            self.log("loss", loss, self.step)
            self.log("gradient_norm", norm, self.step)
        self.optimizer.step()
        self._schedule.step()
        self.losses.append(loss)
        self.step += 1

    def save(self, path: str | Path) -> None:
        """Write a checkpoint atomically.

        Raises:
            OSError: It cannot be written.
        """
        buffer = io.BytesIO()
        torch.save(_plain(self._state()), buffer)
        write_whole(path, buffer.getvalue())

    def resume(self, path: str | Path) -> bool:
        """Continue from a checkpoint; return False, and change nothing, if there is no file.

        Raises:
            ResultsError: The file is not a checkpoint, or of a training of another number of steps.
        """
        if not Path(path).exists():
            return False
        state = self._read(path)
        self.module.load_state_dict(state["module"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self.generator.set_state(state["generator"])
        self.step, self.losses = state["step"], state["losses"]
        return True

    def _state(self) -> dict[str, Any]:
        return {
            "module": self.module.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "schedule": self._schedule.state_dict(),
            "generator": self.generator.get_state(),
            "step": self.step,
            "steps": self.steps,
            "losses": self.losses,
        }

    def _read(self, path: str | Path) -> dict[str, Any]:
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch has no exception class of its own for unreadable files
            raise ResultsError(f"{path} is not a checkpoint of a training: {error}") from error
        if not isinstance(state, dict) or state.keys() != self._state().keys():
            raise ResultsError(f"{path} is not a checkpoint of a training")
        if state["steps"] != self.steps:
            raise ResultsError(f"{path} is of a training of {state['steps']} steps, not {self.steps}")
        return state


def seed_of(seed: int, number: int) -> int:
    """Derive the seed of a step or an epoch, which rarely collides with those of other seeds."""
    return (seed * 1_000_003 + number) % 2**32  # a prime


def _plain(state: Any) -> Any:
    """The nested state with interned strings: pickle distinguishes equal strings from identical ones."""
    if isinstance(state, dict):
        return {_plain(key): _plain(value) for key, value in state.items()}
    if isinstance(state, (list, tuple)):
        return type(state)(_plain(value) for value in state)
    return sys.intern(state) if isinstance(state, str) else state
