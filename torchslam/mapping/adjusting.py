"""The adjustment around the newest keyframe, while frames go on being tracked: begun now, taken over later."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torchslam.config import BundleConfig
from torchslam.geometry import Camera
from torchslam.mapping.local_bundle import Adjusted, Part, around, solve_around, take
from torchslam.solvers import BundleProblem
from torchslam.world.map import Map

Answer = Callable[[], Adjusted]
"""Waits until an adjustment is found."""


class Solver(Protocol):
    """Finds adjustments: (problem, iterations, covariances) -> what gives the outcome when that is wanted."""

    def __call__(self, problem: BundleProblem, iterations: int, covariances: bool) -> Answer: ...


def solve_here(problem: BundleProblem, iterations: int, covariances: bool) -> Answer:
    """A solver that begins when the outcome is wanted."""
    return lambda: solve_around(problem, iterations, covariances)


@dataclass(frozen=True)
class Begun:
    """What is adjusted, and what waits for the outcome."""

    part: Part
    answer: Answer


class Adjusting:
    """One adjustment at a time; the map must stay as it is, but for what frames count in it, until it is taken over.

    solver: may find it elsewhere; the outcome is the same
    """

    solver: Solver = staticmethod(solve_here)

    def __init__(self, camera: Camera, settings: BundleConfig, covariances: bool) -> None:
        self.camera, self.settings, self.covariances = camera, settings, covariances
        self._begun: Begun | None = None

    def begin(self, slam_map: Map, keyframe: int) -> None:
        """Have the solver begin with what is around a keyframe, if there is anything to adjust."""
        assert self._begun is None  # the map was to stay as it is
        part = around(slam_map, keyframe, self.camera, self.settings)
        if part is not None:
            find = self.solver
            self._begun = Begun(part, find(part.problem, self.settings.iterations, self.covariances))

    def take_over(self, slam_map: Map) -> None:
        """Put the map to where it belongs, if an adjustment was begun."""
        begun, self._begun = self._begun, None
        if begun is not None:
            take(slam_map, begun.part, begun.answer(), self.camera)

    def drop(self) -> None:
        """The map is gone: nothing is to be taken over."""
        self._begun = None
