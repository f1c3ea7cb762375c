"""The state of a training, in one place: what a step changes, what is reported, what a file needs to go on."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer
from torch.optim.lr_scheduler import CosineAnnealingLR, LRScheduler

from torchslam.errors import ResultsError
from torchslam.utils.atomic_write import write_whole

Log = Callable[[str, float, int], None]
"""Told a name, a value and a step, as `SummaryWriter.add_scalar` of TensorBoard is."""

MAX_NORM = 1.0
"""Of the gradient: one step through a badly determined pose must not undo a hundred others."""

_MANY = 1_000_003  # a prime: seeds of steps and epochs, of which torch takes 32 bits, do not soon meet those of others


class Training:
    """A number of steps of an optimiser, with a schedule and clipped gradients, that can be stopped and resumed.

        training = Training(module, torch.optim.Adam(module.parameters(), 1e-3), steps=1000, log=writer.add_scalar)
        training.resume("checkpoint.pt")
        for step in training:
            training.descend(loss_of(module, step))
            if training.step % 100 == 0:
                training.save("checkpoint.pt")

    Resumed, it makes the same bytes as if it had not been stopped: what is drawn comes from `generator`, is a function
    of the step (`Batches`), or is drawn from torch's own generator, as dropout is, which is seeded before every step.
    Of several processes each has a Training of its own, with the same `generator`; one of them saves.

    module:    what learns: the module itself, not its DistributedDataParallel
    schedule:  of the learning rate; along a cosine to zero at the last step if None
    max_norm:  of the gradient, longer ones are shortened
    step:      how many steps have been made
    losses:    of each of them
    generator: of random numbers, seeded with `seed`
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
        self.module, self.optimizer, self.steps, self.log = module, optimizer, steps, log
        self._seed, self._max_norm = seed, max_norm
        self.step = 0
        self.losses: list[float] = []
        self.generator = torch.Generator().manual_seed(seed)
        self._schedule = CosineAnnealingLR(optimizer, steps) if schedule is None else schedule

    def __iter__(self) -> Iterator[int]:
        """The steps that are left; the caller makes each of them, by `descend` or by `update`."""
        rank, ranks = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        while self.step < self.steps:
            torch.manual_seed(seed_of(self._seed, self.step * ranks + rank))
            yield self.step

    def descend(self, loss: Tensor) -> None:
        """One step down the gradient of a loss ()."""
        self.optimizer.zero_grad()
        loss.backward()
        self.update(float(loss.detach()))

    def update(self, loss: float) -> None:
        """One step along the gradients that the parameters have, whoever found them.

        Raises RuntimeError, the parameters being as they were, where a gradient is not finite.
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
        """Write a checkpoint: whole or not at all. Raises OSError."""
        buffer = io.BytesIO()
        torch.save(_plain(self._state()), buffer)
        write_whole(path, buffer.getvalue())

    def resume(self, path: str | Path) -> bool:
        """Go on where a checkpoint ended; False, and nothing changes, where there is no file.

        Raises ResultsError for a file that is not a checkpoint, or is one of another number of steps.
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
        except Exception as error:  # torch names no error of its own for a file that it cannot read
            raise ResultsError(f"{path} is not a checkpoint of a training: {error}") from error
        if not isinstance(state, dict) or state.keys() != self._state().keys():
            raise ResultsError(f"{path} is not a checkpoint of a training")
        if state["steps"] != self.steps:
            raise ResultsError(f"{path} is of a training of {state['steps']} steps, not {self.steps}")
        return state


def seed_of(seed: int, number: int) -> int:
    """The seed of a step or an epoch, of what has a seed itself."""
    return (seed * _MANY + number) % 2**32


def _plain(state: Any) -> Any:
    """The same nested state whose bytes depend on what it says alone: pickle tells equal strings from the same one."""
    if isinstance(state, dict):
        return {_plain(key): _plain(value) for key, value in state.items()}
    if isinstance(state, (list, tuple)):
        return type(state)(_plain(value) for value in state)
    return sys.intern(state) if isinstance(state, str) else state
