"""The start of a submap: two views initialize it, and it is provisional until enough frames were tracked in it."""

from __future__ import annotations

from collections.abc import Iterable

from torchslam.mapping.mapper import MapInitializer
from torchslam.system.local_mapping import BackwardTracking
from torchslam.system.savepoint import Savepoint
from torchslam.system.session import SystemContext
from torchslam.tracking.initialization import Initializer, contradicting_initialization
from torchslam.types import FrameFeatures, Rejection, TwoViewMap

PROVISIONAL_FRAMES = 20
"""Tracked frames after which a new map is no longer discarded when tracking is lost. Tried at this value only."""
CHECK_INTERVAL = 5
"""Tracked frames between two checks of a provisional map; a turning camera soon no longer sees what the first frame
saw. Tried at this value only."""
FRAMES_PER_KEYFRAME = 2
"""Frames that a keyframe is worth in the confirmation of a map: views far apart contradict a wrong one sooner. Tried at
this value only."""


class MapStart:
    """Creates submaps from two views, and confirms or discards them."""

    def __init__(self, context: SystemContext, backward: BackwardTracking) -> None:
        self.context, self.backward = context, backward
        self.map_initializer = MapInitializer(context.tracker, context.mapper)
        self.restart()

    def restart(self) -> None:
        """Forget the reference frame, and initialize with the frames from now on."""
        context = self.context
        self.initializer = Initializer(context.camera, context.config, context.matcher)

    def step(self, view: FrameFeatures) -> Rejection | None:
        """Create a submap if the frame, which is logged, and an earlier one determine it; return why not, or None."""
        context = self.context
        with context.clock("initialization"):
            result = self.initializer.step(view)
            context.scene_filter.static_overlay.add(self.initializer.static_pixels)
            if isinstance(result, Rejection):
                return result
            first = self.initializer.reference.index
            return self._create(result, [each for each in context.log.unposed() if each.index >= first])

    def add_frames(self, views: Iterable[FrameFeatures]) -> None:
        """Log further frames with poses in the provisional map."""
        savepoint = self.context.active_map.provisional
        if savepoint is not None:
            views = list(views)
            self.context.log.pose(*views)
            savepoint.frames += [view.index for view in views]

    @property
    def is_almost_confirmed(self) -> bool:
        """Whether one more tracked frame confirms the provisional map."""
        savepoint = self.context.active_map.provisional
        return savepoint is not None and savepoint.needed <= 1

    def count_frame(self, view: FrameFeatures) -> bool:
        """Count a frame with a certain pose; return whether another map replaces the provisional one."""
        savepoint = self.context.active_map.provisional
        if savepoint is None:
            return False
        self.add_frames([view])
        savepoint.count()
        if savepoint.num_certain % CHECK_INTERVAL == 0 and self._replace_if_contradicted(savepoint):
            return True
        if not savepoint.is_open:
            self.confirm()
        return False

    def confirm(self) -> None:
        """Confirm the provisional map, if any, and pose the frames from before its first keyframe."""
        context = self.context
        savepoint, context.active_map.provisional = context.active_map.provisional, None
        if savepoint is not None:
            context.log.forget(savepoint.frames)
            self.backward.from_first_keyframe(savepoint.submap)

    def end(self) -> bool:
        """Discard a map that is still provisional when the camera is lost, or confirm it; return whether it is gone."""
        savepoint = self.context.active_map.provisional
        is_discarded = savepoint is not None and self._is_young(savepoint)
        if savepoint is not None and is_discarded:
            self._discard(savepoint)
        self.confirm()
        return is_discarded

    def _is_young(self, savepoint: Savepoint) -> bool:
        """Whether a map is too small to be kept when the camera is lost; keyframes are worth several frames."""
        return FRAMES_PER_KEYFRAME * savepoint.submap.map.num_keyframes < savepoint.num_confirming

    def _create(self, start: TwoViewMap, views: list[FrameFeatures]) -> Rejection | None:
        """Create a submap from two views, and discard a provisional one; return why it is rejected, or None."""
        context, atlas, active_map = self.context, self.context.session.atlas, self.context.active_map
        submap = atlas.create()
        try:
            rejection = self.map_initializer.build(submap, start, views)
        except BaseException:  # of a user's matcher, or from the keyboard
            atlas.revoke(submap)
            raise
        if rejection:
            atlas.remove(submap)
            return rejection
        if active_map.provisional is not None:
            self._discard(active_map.provisional)
        for keyframe in range(submap.map.num_keyframes):
            context.loop_closer.add(submap.map, keyframe)
        known = set(submap.posed_frames.frames["frame_index"].tolist()) if len(submap.posed_frames) else set()
        active_map.submap = submap
        active_map.provisional = Savepoint(submap, PROVISIONAL_FRAMES)
        self.add_frames(view for view in views if view.index in known)
        return None

    def _discard(self, savepoint: Savepoint) -> None:
        """Remove a submap that later frames contradict; its frames are unposed again."""
        context = self.context
        context.log.release(savepoint.frames)
        context.mapper.adjustment.drop()
        context.online_camera.forget()
        context.loop_closer.remove(savepoint.submap.map.keys)
        context.session.atlas.remove(savepoint.submap)
        context.active_map.provisional = None

    def _replace_if_contradicted(self, savepoint: Savepoint) -> bool:
        """Initialize from the first and the last frame of a provisional map, if they contradict it."""
        context, submap, views = self.context, savepoint.submap, self.context.log.views(savepoint.frames)
        with context.clock("initialization"):
            start = contradicting_initialization(
                submap, views[0], views[-1], context.camera.current, context.config, context.matcher
            )
            return start is not None and not self._create(start, views)
