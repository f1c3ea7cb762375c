"""The worlds of a run: most runs have one; what cannot be joined to it stays beside it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from torch import Tensor

from torchslam.map.submap import Submap


class Atlas:
    """All worlds that a run keeps, in the order in which they began; numbers are not used again."""

    def __init__(self, like: Tensor) -> None:
        """like: device and floating-point type of the worlds' tensors."""
        self._like = like
        self._worlds: list[Submap] = []
        self._next = 0

    @classmethod
    def of(cls, worlds: Iterable[Submap], begun: int, like: Tensor) -> Atlas:
        """Worlds that there were already; `begun`: how many ever began, so that no number is used again."""
        made = cls(like)
        made._worlds, made._next = list(worlds), begun
        return made

    @property
    def begun(self) -> int:
        """How many worlds ever began."""
        return self._next

    def __len__(self) -> int:
        return len(self._worlds)

    def __iter__(self) -> Iterator[Submap]:
        return iter(self._worlds)

    def begin(self) -> Submap:
        """A new, empty world."""
        world = Submap.empty(self._next, self._like)
        self._next += 1
        self._worlds.append(world)
        return world

    def forget(self, world: Submap) -> None:
        """Drop a world that was taken back, or that is part of another one now."""
        self._worlds = [other for other in self._worlds if other is not world]

    def main(self, session: int | None = None) -> Submap | None:
        """As `main_of`."""
        return main_of(self._worlds, session)

    def find(self, key: int) -> tuple[Submap, int] | None:
        """The world and the row of the keyframe of that name; None where no world has it."""
        for world in self._worlds:
            row = world.map.row(key)
            if row >= 0:
                return world, row
        return None


def main_of(worlds: Iterable[Submap], session: int | None = None) -> Submap | None:
    """The world in which most frames of a session are posed, then most of all; of equals the first; None without."""
    return max(worlds, key=lambda world: (world.history.count(session), len(world.history)), default=None)
