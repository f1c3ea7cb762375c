"""Frames between those with features: followed by patches of an earlier one, in the world that knows that one."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera
from torchslam.map.compaction import Renumbering
from torchslam.map.submap import World
from torchslam.tracking.anchors import Anchors
from torchslam.tracking.scout import Scout
from torchslam.types import Anchor, Followed, Frame, Tracked, View


class PatchTracking:
    """The scout, which knows images, the anchors, which the map knows, and what the one is told of the other.

    news: index of the last frame that was found by its features, and what the next ones can be followed from
    """

    def __init__(self, camera: Camera, config: Config) -> None:
        patches = config.patches
        self.is_enabled = patches.enabled
        self.scout = Scout(camera, config)
        # Frames that are looked at while one is mapped may refer to as many anchors.
        self.anchors = Anchors(camera, patches.count, patches.delay + 2)
        self.news: tuple[int, Anchor | None] = (-1, None)

    def will_do(self, world: World | None, followed: Followed | None) -> bool:
        """Whether a frame was followed by patches so well, in the world at hand, that it needs no features."""
        if world is None or followed is None:
            return False
        return not followed.why_not and followed.anchor in self.anchors

    def place(self, world: World, frame: Frame, session: int, followed: Followed) -> tuple[View, Tracked]:
        """A followed frame as one of the world: the world's track goes on to it."""
        return self.anchors.place(world, frame, session, followed)

    def pose(self, world: World, followed: Followed | None) -> Tensor | None:
        """(4, 4) where patches have a frame, world to camera, whether they will do or not; None where not known."""
        return None if followed is None else self.anchors.pose(world, followed)

    def expect(self, index: int) -> None:
        """A frame is looked for by its features: unless it becomes an anchor nothing is followed from here on."""
        self.news = index, None

    def add(self, world: World, view: View, tracked: Tracked) -> None:
        """The frame was found: the next ones are followed from it, if it sees enough."""
        self.news = view.index, self.anchors.add(world, view, tracked)

    def leave(self) -> None:
        """The map has moved, or is another one: what is known is not where it was."""
        self.anchors.clear()
        self.news = self.news[0], None

    def renumber(self, renumbering: Renumbering) -> None:
        """Rows of the map went elsewhere."""
        self.anchors.renumber(renumbering)

    def tell(self, scout_is_here: bool) -> None:
        """Pass on what came of the frame that was expected; a scout in another process asks for the news itself."""
        if self.news[1] is None:
            self.anchors.clear()
        if scout_is_here:
            self.scout.learn(*self.news)

    def forget(self) -> None:
        """Begin anew: there is nothing to follow, here or elsewhere."""
        self.scout.forget()
        self.anchors.clear()
