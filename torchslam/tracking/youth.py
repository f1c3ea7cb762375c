"""A world that was begun lately: later frames may show that it was begun wrongly."""

from __future__ import annotations

from torchslam.values import View
from torchslam.world.world import World


class Youth:
    """A young world and the frames posed in it so far, which wait again if it is taken back."""

    def __init__(self, world: World, views: list[View]) -> None:
        self.world = world
        self.views = views
        self.age = 0  # frames tracked since the start

    def grow(self, view: View) -> None:
        """Another frame was posed."""
        self.views.append(view)
        self.age += 1
