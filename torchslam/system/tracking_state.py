"""Following a world: frames are tracked and judged; what is believed is built on, what is doubtful held back."""

from __future__ import annotations

from torchslam.geometry import se3_inverse
from torchslam.map.submap import World
from torchslam.mapping.culling import drop_covered
from torchslam.system.backward_tracking import TrackingBack
from torchslam.system.context import Outcome, Parts
from torchslam.system.initializing import Beginning
from torchslam.system.keyframe_actions import LoopClosing
from torchslam.system.local_mapping import LocalMapping
from torchslam.system.lost import Finding
from torchslam.system.tentative_mapping import OnTrial
from torchslam.tracking.dynamic.independent_motion import NOTHING
from torchslam.tracking.pose_validation import why_strange, why_unsound
from torchslam.types import Followed, Frame, State, Tracked, View

STARTED_ANEW = "later frames contradict the start: started the map anew"
STAYS = "some of the image does not move with the scene and is left out"


class Following:
    """Follows the camera through a world, frame by frame."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self.mapping = LocalMapping(parts)
        self.on_trial = OnTrial(parts, self.mapping)
        self.back = TrackingBack(parts, self.mapping)
        self.beginning = Beginning(parts, self.back)
        self.loop_closing = LoopClosing(parts, self.mapping, self.beginning)
        self.finding = Finding(parts, self.beginning, self.back)

    def go_along(self, world: World, frame: Frame, followed: Followed) -> tuple[View, Outcome]:
        """Take over where patches were followed to; nothing is mapped."""
        parts = self.parts
        self.mapping.begin_adjusting()
        with parts.clock("patches"):
            view, tracked = parts.patches.place(world, frame, parts.session.number, followed)
            parts.tracker.expect(world.map, tracked)
            parts.tracker.vouch(world.map, tracked)
            world.history.add(view, tracked, world.track.T_cr, world.track.reference)
        return view, Outcome("", self.loop_closing.catch_up(world, frame.index), tracked)

    def follow(self, world: World, view: View, followed: Followed | None = None) -> Outcome:
        """Track the frame; what is doubtful is held back until later frames confirm it.

        followed: what its patches said, which is where it is looked for
        """
        parts = self.parts
        self.mapping.begin_adjusting()
        world = self.loop_closing.catch_up_first(world)
        with parts.clock("tracking"):
            T_cw = parts.patches.pose(world, followed)
            if T_cw is not None:
                world.track.velocity = T_cw @ se3_inverse(world.T_cw)
            expected = None if world.track.velocity is None else parts.tracker.predict(world)
            tracked = parts.tracker.track(world, view, is_sure=not parts.probation)
        if tracked is None:
            return self._lose(world, view)
        unsound = why_unsound(tracked, expected, parts.config.judge)
        doubt = unsound or why_strange(tracked, world.track, parts.config.judge)
        moves = parts.foreign.moves(tracked) if not doubt else NOTHING
        if doubt or moves.is_doubt or parts.probation:
            if not unsound and not moves.is_doubt and self._wants_map(doubt):
                self.on_trial.take(world, view, tracked)
            return self._hold(world, view, tracked, doubt or moves.words * moves.is_doubt)
        return self._build(world, view, tracked, moves.words)

    def conclude(self) -> None:
        """The last frame has come: what is held back keeps its pose, uncertain as it is."""
        here = self.parts.here
        if here.world is not None:
            self._keep_uncertain(here.world)
            self.loop_closing.catch_up(here.world)
        self.beginning.settle()

    def settle(self) -> None:
        """Believe a young world as it is, with what was mapped on trial: the way back adds to the same map."""
        world = self.parts.here.world
        if world is not None and self.beginning.youth is not None:
            self.on_trial.keep(world)
            self.mapping.take_over(world)
        self.beginning.settle()

    def _build(self, world: World, view: View, tracked: Tracked, moves: str) -> Outcome:
        """A frame that is believed: map it, look back, let a young world grow, follow the next ones from here.

        moves: what was said of what moves against the scene
        """
        parts, mapping, closing = self.parts, self.mapping, self.loop_closing
        parts.here.state, recalls = State.TRACKING, closing.count
        why = mapping.take(world, view, tracked, self._delay(world))
        is_keyframe = bool(why)
        if is_keyframe and not mapping.adjusting:
            world = closing.look_back(world)
        stays = parts.session.mapping and parts.foreign.stays(world.T_cw, tracked.depth)
        if stays:
            world = closing.catch_up(world)
            drop_covered(world, parts.foreign.stillness.covers)
        if self.beginning.is_almost_settled:
            world = closing.catch_up(world)
        if self.beginning.grow(view):
            return Outcome(STARTED_ANEW, parts.here.world, is_keyframe=True)
        is_settled = self.beginning.youth is None and closing.count == recalls
        if parts.patches.is_enabled and is_settled and not stays:
            parts.patches.add(world, view, tracked)
        if not is_keyframe and not mapping.is_due(view.index):
            closing.look_ahead(world)
        if not is_keyframe:
            world = closing.catch_up(world, view.index)
        why = "; ".join(filter(None, [why, STAYS * stays, moves]))
        return Outcome(why, world, tracked, is_keyframe)

    def _delay(self, world: World) -> int | None:
        """Frames that are tracked before a keyframe's adjustment is taken over: none while each moves the whole map."""
        settings = self.parts.config.bundle
        if settings.delay == 0:
            return None
        is_small = world.map.num_keyframes < settings.window
        return 0 if is_small or self.beginning.youth is not None else settings.delay

    def _wants_map(self, doubt: str) -> bool:
        """Whether frames that are held back are to be mapped: not what came back and is certain so far."""
        return bool(doubt or self.on_trial) and not self.parts.probation.came_back

    def _hold(self, world: World, view: View, tracked: Tracked, doubt: str) -> Outcome:
        """Do not build on a pose yet: enough certain frames in a row confirm what was held back."""
        parts, probation = self.parts, self.parts.probation
        probation.hold(view, tracked, world.track, doubt, bool(self.on_trial))
        if probation:
            if probation.is_full:
                self._keep_uncertain(world)
            parts.here.state = State.UNCERTAIN
            return Outcome(doubt or probation.reason, world, tracked)
        self.on_trial.keep(world)
        came_back, held = probation.came_back, probation.release()
        for earlier in held:
            parts.tracker.expect(world.map, earlier[1])
            parts.tracker.vouch(world.map, earlier[1])
            world.history.add(*earlier)
        if came_back:
            first, located, _, _ = held[0]
            self.back.from_frame(world, first, located)
        parts.here.state = State.TRACKING
        return Outcome("", world, tracked)

    def _keep_uncertain(self, world: World) -> None:
        """What is held back keeps its pose, uncertain as it is, and so does what was mapped of it."""
        self.on_trial.keep(world)
        for held in self.parts.probation.hand_over():
            world.history.add(*held)

    def _lose(self, world: World, view: View) -> Outcome:
        """No pose: what was held back waits again, and a world that was hardly begun is taken back."""
        self.loop_closing.catch_up(world)
        self.on_trial.take_back(world)
        self.back.waiting.add(*self.parts.probation.views(), view)
        taken_back = self.beginning.lose()
        self.finding.seek()
        return Outcome("lost right after the start: starting anew" if taken_back else "lost")
