"""The adjustment around the newest keyframe, while frames go on being tracked: asked for now, taken over later."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from torchslam.config import BundleAdjustmentConfig
from torchslam.geometry import Camera
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import Adjusted, Part, around, solve_around, take
from torchslam.optim import BundleProblem

Answer = Callable[[], Adjusted]
"""Waits until an adjustment is found."""


class Solver(Protocol):
    """Finds adjustments: (problem, iterations, covariances) -> what gives the outcome when that is wanted."""

    def __call__(self, problem: BundleProblem, iterations: int, covariances: bool) -> Answer: ...


def solve_here(problem: BundleProblem, iterations: int, covariances: bool) -> Answer:
    """A solver that begins when the outcome is wanted."""
    return lambda: solve_around(problem, iterations, covariances)


@dataclass(frozen=True)
class AdjustmentRequest:
    """An adjustment around a keyframe, to be taken over after frame `due`, or, without one, before the next frame."""

    due: int | None
    slam_map: Map
    keyframe: int


@dataclass(frozen=True)
class RunningAdjustment:
    """What is adjusted, and what waits for the outcome; neither where there is nothing to adjust."""

    part: Part | None
    answer: Answer | None


class AsyncBundleAdjustment:
    """One adjustment at a time; the map must stay as it is, but for what frames count in it, until it is taken over.

    solver: may find it elsewhere; the outcome is the same
    """

    solver: Solver = staticmethod(solve_here)

    def __init__(self, camera: Camera, settings: BundleAdjustmentConfig, covariances: bool) -> None:
        self.camera, self.settings, self.covariances = camera, settings, covariances
        self._asked: AdjustmentRequest | None = None
        self._begun: RunningAdjustment | None = None

    def __bool__(self) -> bool:
        """Whether there is one to be taken over."""
        return self._asked is not None

    @property
    def due_before_next_frame(self) -> bool:
        """Whether the outcome is to be taken over before the next frame is tracked."""
        return self._asked is not None and self._asked.due is None

    @property
    def due(self) -> int | None:
        """The last frame that is tracked before the outcome is taken over; None where no other one is."""
        return None if self._asked is None else self._asked.due

    def is_due(self, frame: int) -> bool:
        """Whether the outcome is to be taken over after a frame."""
        return self._asked is not None and (self._asked.due is None or frame >= self._asked.due)

    def set_deadline(self, frame: int) -> None:
        """Take the outcome over after this frame already: the map is to change."""
        if self._asked is not None:
            self._asked = replace(self._asked, due=frame)

    def ask(self, slam_map: Map, keyframe: int, due: int | None) -> None:
        """Have what is around a keyframe adjusted, to be taken over after frame `due`; None: before the next one."""
        assert self._asked is None  # the map was to stay as it is
        self._asked = AdjustmentRequest(due, slam_map, keyframe)

    def begin(self) -> None:
        """Have the solver begin with what was asked for, if it has not: it is all the same when, as the map stays."""
        if self._asked is None or self._begun is not None:
            return
        part = around(self._asked.slam_map, self._asked.keyframe, self.camera, self.settings)
        find = self.solver
        answer = (
            None if part is None else find(part.problem, self.settings.local_iterations, self.covariances)
        )
        self._begun = RunningAdjustment(part, answer)

    def take_over(self, slam_map: Map) -> None:
        """Put the map to where it belongs, if that was asked for."""
        self.begin()
        begun, self._asked, self._begun = self._begun, None, None
        if begun is not None and begun.part is not None and begun.answer is not None:
            take(slam_map, begun.part, begun.answer(), self.camera)

    def drop(self) -> None:
        """The map is gone: nothing is to be taken over."""
        self._asked = self._begun = None
