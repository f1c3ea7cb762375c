"""Frames that wait for a pose."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from torchslam.types import FrameFeatures


class UnposedFrames:
    """The last frames without a pose, in order of time, at most so many: once there is a map they may find theirs."""

    def __init__(self, limit: int) -> None:
        self._views: deque[FrameFeatures] = deque(maxlen=limit)

    def __len__(self) -> int:
        return len(self._views)

    def __iter__(self) -> Iterator[FrameFeatures]:
        return iter(self._views)

    def add(self, *views: FrameFeatures) -> None:
        """Frames that are to wait, later ones than all that wait already, or in between."""
        late = len(self._views) and views and views[0].index < self._views[-1].index
        self._views.extend(views)
        if late:
            ordered = sorted(self._views, key=lambda view: view.index)
            self._views.clear()
            self._views.extend(ordered)

    def remove(self, views: list[FrameFeatures]) -> None:
        """Frames that have a pose now."""
        done = {view.index for view in views}
        kept = [view for view in self._views if view.index not in done]
        self._views.clear()
        self._views.extend(kept)
