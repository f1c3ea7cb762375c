"""The beginning of worlds: begun with two views, on trial while they are young, then settled or taken back."""

from __future__ import annotations

from torchslam.mapping.map_initialization import Founder
from torchslam.system.backward_tracking import TrackingBack
from torchslam.system.context import Parts
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.provisional_map import Youth
from torchslam.types import Start, State, View


class Beginning:
    """Begins worlds.

    youth: of the world that is followed, if it began lately
    """

    def __init__(self, parts: Parts, back: TrackingBack) -> None:
        self.parts, self.back = parts, back
        self.worlds, self.settings = parts.session.worlds, parts.config.initialization
        self.founder = Founder(parts.tracker, parts.mapper, self.settings.min_explained)
        self.youth: Youth | None = None
        self.seek()

    def seek(self) -> None:
        """Look for a start with the frames from now on."""
        parts = self.parts
        self.initializer = Initializer(parts.camera, parts.config, parts.matcher)

    def step(self, view: View) -> str:
        """Begin a world if the frame makes a start with an earlier one; why it does not, or nothing."""
        with self.parts.clock("initialization"):
            start, reason = self.initializer.step(view)
            self.parts.foreign.stillness.add(self.initializer.still)
            return reason if start is None else self._begin(start, self.initializer.views)

    @property
    def is_almost_settled(self) -> bool:
        """Whether the young world that is followed has proved itself with one more frame."""
        return self.youth is not None and self.youth.age + 1 >= self.settings.min_frames

    def grow(self, view: View) -> bool:
        """The world that is followed tracked another frame; whether that shows that it has to be begun anew."""
        if self.youth is None:
            return False
        self.youth.grow(view)
        if self._replace(self.youth):
            return True
        if self.youth.age >= self.settings.min_frames:
            self.settle()
        return False

    def settle(self) -> None:
        """A young world has proved itself: pose the frames from before its start."""
        if self.youth is None:
            return
        world, self.youth = self.youth.world, None
        self.back.from_start(world)

    def lose(self) -> bool:
        """The camera is lost; whether the world was hardly begun, and is taken back."""
        taken_back = self.youth is not None and self.youth.age < self.settings.min_frames
        if self.youth is not None and taken_back:
            self._take_back(self.youth)
        self.settle()
        return taken_back

    def _begin(self, start: Start, views: list[View]) -> str:
        """Begin a world with two views, in the place of a young one; why it is not believed, or nothing."""
        world = self.worlds.begin()
        reason = self.founder.found(world, start, views)
        if reason:
            self.worlds.forget(world)
            return reason
        if self.youth is not None:
            self._take_back(self.youth)
        for keyframe in range(world.map.num_keyframes):
            self.parts.memory.add(world.map, keyframe)
        known = set(world.history.frames["frame_index"].tolist()) if len(world.history) else set()
        posed = [view for view in views if view.index in known]
        self.back.waiting.remove(posed)
        self.youth = Youth(world, posed)
        self.parts.here.world, self.parts.here.state = world, State.TRACKING
        return ""

    def _take_back(self, youth: Youth) -> None:
        """A start that later frames contradict: its frames wait for another one."""
        self.back.waiting.add(*youth.views)
        self.parts.mapper.adjusting.drop()
        self.parts.memory.remove(youth.world.map.keys)
        self.worlds.forget(youth.world)
        self.youth = None

    def _replace(self, youth: Youth) -> bool:
        """Begin anew with the first and the last frame of a young world, if these contradict it."""
        parts = self.parts
        with parts.clock("initialization"):
            start = youth.rival(parts.camera, parts.config, parts.matcher)
            replaced = start is not None and not self._begin(start, youth.views)
        if replaced:
            parts.foreign.forget_last()  # its pose was one of the map before
        return replaced
