"""The state machine of a session: initialize a map, track the camera in it, find it again when lost.

INITIALIZING, LOST -> `LostState`: relocalize in a known submap, or begin a new one (`InitializationState`)
TRACKING, UNCERTAIN -> `StateMachine`: track, validate the pose, map it or hold it back until it is confirmed
"""

from __future__ import annotations

from torchslam.map.submap import Submap
from torchslam.mapping.culling import drop_covered
from torchslam.mapping.map_initialization import MapInitializer
from torchslam.system.backward_tracking import TrackingBack
from torchslam.system.context import Outcome, SystemContext
from torchslam.system.local_mapping import LocalMapping
from torchslam.system.tentative_mapping import TentativeMapping
from torchslam.tracking.dynamic.independent_motion import NOTHING
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.pose_validation import why_strange, why_unsound
from torchslam.tracking.provisional_map import ProvisionalMap
from torchslam.tracking.relocalization import Relocalizer
from torchslam.types import FrameFeatures, PoseEstimate, Reason, State, TwoViewMap


class InitializationState:
    """Begins worlds.

    youth: of the world that is followed, if it began lately
    """

    def __init__(self, parts: SystemContext, back: TrackingBack) -> None:
        self.parts, self.back = parts, back
        self.worlds, self.settings = parts.session.worlds, parts.config.initialization
        self.founder = MapInitializer(parts.tracker, parts.mapper, self.settings.min_explained_ratio)
        self.youth: ProvisionalMap | None = None
        self.seek()

    def seek(self) -> None:
        """Look for a start with the frames from now on."""
        parts = self.parts
        self.initializer = Initializer(parts.camera, parts.config, parts.matcher)

    def step(self, view: FrameFeatures) -> str:
        """Begin a world if the frame makes a start with an earlier one; why it does not, or nothing."""
        with self.parts.clock("initialization"):
            start, reason = self.initializer.step(view)
            self.parts.foreign.stillness.add(self.initializer.still)
            return reason if start is None else self._begin(start, self.initializer.views)

    @property
    def is_almost_confirmed(self) -> bool:
        """Whether the young world that is followed has proved itself with one more frame."""
        return self.youth is not None and self.youth.age + 1 >= self.settings.provisional_frames

    def grow(self, view: FrameFeatures) -> bool:
        """The world that is followed tracked another frame; whether that shows that it has to be begun anew."""
        if self.youth is None:
            return False
        self.youth.grow(view)
        if self._replace(self.youth):
            return True
        if self.youth.age >= self.settings.provisional_frames:
            self.confirm_map()
        return False

    def confirm_map(self) -> None:
        """A young world has proved itself: pose the frames from before its start."""
        if self.youth is None:
            return
        world, self.youth = self.youth.world, None
        self.back.from_start(world)

    def lose(self) -> bool:
        """The camera is lost; whether the world was hardly begun, and is taken back."""
        taken_back = self.youth is not None and self.youth.age < self.settings.provisional_frames
        if self.youth is not None and taken_back:
            self._take_back(self.youth)
        self.confirm_map()
        return taken_back

    def _begin(self, start: TwoViewMap, views: list[FrameFeatures]) -> str:
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
        self.youth = ProvisionalMap(world, posed)
        self.parts.here.world, self.parts.here.state = world, State.TRACKING
        return ""

    def _take_back(self, youth: ProvisionalMap) -> None:
        """A start that later frames contradict: its frames wait for another one."""
        self.back.waiting.add(*youth.views)
        self.parts.mapper.adjusting.drop()
        self.parts.memory.remove(youth.world.map.keys)
        self.worlds.forget(youth.world)
        self.youth = None

    def _replace(self, youth: ProvisionalMap) -> bool:
        """Begin anew with the first and the last frame of a young world, if these contradict it."""
        parts = self.parts
        with parts.clock("initialization"):
            start = youth.rival(parts.camera, parts.config, parts.matcher)
            replaced = start is not None and not self._begin(start, youth.views)
        if replaced:
            parts.foreign.forget_last()  # its pose was one of the map before
        return replaced


class KeyframeActions:
    """Looks back from keyframes. To be called while nobody holds rows of the map."""

    def __init__(self, parts: SystemContext, mapping: LocalMapping, beginning: InitializationState) -> None:
        self.parts, self.mapping, self.beginning = parts, mapping, beginning

    @property
    def count(self) -> int:
        """How many places were recognised so far."""
        return len(self.parts.memory.recalls)

    def apply_adjustment_before_frame(self, world: Submap) -> Submap:
        """As `apply_pending_adjustment`, before a frame is tracked."""
        return self.detect_and_close(world) if self.mapping.take_over_first(world) else world

    def apply_pending_adjustment(self, world: Submap, frame: int | None = None) -> Submap:
        """Take over the adjustment around the newest keyframe when it is due after a frame, or, without one, now.

        Then look back from there.
        """
        return self.detect_and_close(world) if self.mapping.take_over(world, frame) else world

    def precheck_loop(self, world: Submap) -> None:
        """Ask whether the newest keyframe's place looks known while the adjustment around it is waited for.

        Nearly always it does not, and nothing is left to be asked in the frame in which the adjustment is taken over.
        """
        memory, keyframe = self.parts.memory, world.map.num_keyframes - 1
        was_asked = memory.looks_known is not None and memory.looks_known[0] == world.map.key(keyframe)
        if self.mapping.adjusting and not was_asked:
            with self.parts.clock("loops"):
                memory.look_ahead(world, keyframe)

    def detect_and_close(self, world: Submap) -> Submap:
        """Recognise the newest keyframe's place, and let go of what the map can do without.

        Returns the world that is followed from now on: another one where two were joined.
        """
        world = self._detect_loop(world)
        self._cull_and_compact(world)
        return world

    def _detect_loop(self, world: Submap) -> Submap:
        """Has the newest keyframe's place been seen before? Then the loop is closed, or two worlds become one."""
        parts, newest = self.parts, world.map.num_keyframes - 1
        with parts.clock("loops"):
            found = parts.memory.recognize(world, newest)
            if found is None:
                return world
            if not found.is_loop:
                self.beginning.confirm_map()
            world, keyframe = parts.memory.take_up(found)
            parts.here.world = world
            parts.tracker.follow(world, keyframe)
            parts.foreign.forget_last()  # its pose was one of the map before
        return world

    def _cull_and_compact(self, world: Submap) -> None:
        """Let go of what the map can do without."""
        keys = world.map.keys
        renumbering = self.parts.mapper.tidy(world)
        if renumbering is not None:
            self.parts.memory.remove(keys[renumbering.keyframes < 0])


class LostState:
    """Looks for a world to follow; frames wait until there is a pose for them."""

    def __init__(self, parts: SystemContext, beginning: InitializationState, back: TrackingBack) -> None:
        self.parts, self.beginning, self.back = parts, beginning, back
        self.relocalizer = Relocalizer(parts.tracker, parts.config)
        self.lost_for = 0  # frames

    def seek(self) -> None:
        """Nothing is followed any more."""
        parts, here = self.parts, self.parts.here
        here.world = None
        self.beginning.seek()
        parts.probation.release()
        parts.foreign.forget_last()
        self.lost_for = 0
        here.state = State.LOST if len(parts.session.worlds) else State.INITIALIZING

    def find(self, view: FrameFeatures) -> Outcome:
        """Relocalise the frame, or begin a world with it; it waits where that cannot be done."""
        parts = self.parts
        self.lost_for += 1
        if len(parts.session.worlds):
            with parts.clock("relocalization"):
                found = self.relocalizer.locate(view, parts.memory.likely(view))
            if found is not None:
                return self._return(view, *found)
        self.back.waiting.add(view)
        patient = (
            self.lost_for <= parts.config.relocalization.frames_before_new_submap or not parts.session.mapping
        )
        if len(parts.session.worlds) and patient:
            return Outcome(Reason.LOST)
        reason = self.beginning.step(view)
        return Outcome(reason) if reason else Outcome(Reason.STARTED, parts.here.world, is_keyframe=True)

    def _return(self, view: FrameFeatures, world: Submap, tracked: PoseEstimate) -> Outcome:
        """Go on in a world that was recognised; the next frames have to confirm it."""
        parts = self.parts
        parts.tracker.start_at(world, view, tracked)
        parts.here.world, parts.here.state = world, State.UNCERTAIN
        parts.probation.come_back(view, tracked, world.track)
        return Outcome(Reason.FOUND_AGAIN, world, tracked)


class StateMachine:
    """Follows the camera through a world, frame by frame."""

    def __init__(self, parts: SystemContext) -> None:
        self.parts = parts
        self.mapping = LocalMapping(parts)
        self.on_trial = TentativeMapping(parts, self.mapping)
        self.back = TrackingBack(parts, self.mapping)
        self.beginning = InitializationState(parts, self.back)
        self.loop_closing = KeyframeActions(parts, self.mapping, self.beginning)
        self.finding = LostState(parts, self.beginning, self.back)

    def step(self, view: FrameFeatures) -> Outcome:
        """Process the features of one frame: track the active map, or look for one."""
        world = self.parts.here.world
        return self.finding.find(view) if world is None else self.follow(world, view)

    def follow(self, world: Submap, view: FrameFeatures) -> Outcome:
        """Track the frame; what is doubtful is held back until later frames confirm it."""
        parts = self.parts
        self.mapping.begin_adjusting()
        world = self.loop_closing.apply_adjustment_before_frame(world)
        with parts.clock("tracking"):
            expected = None if world.track.velocity is None else parts.tracker.predict(world)
            tracked = parts.tracker.track(world, view, is_sure=not parts.probation)
        if tracked is None:
            return self._on_lost(world, view)
        unsound = why_unsound(tracked, expected, parts.config.pose_validation)
        doubt = unsound or why_strange(tracked, world.track, parts.config.pose_validation)
        moves = parts.foreign.moves(tracked) if not doubt else NOTHING
        if doubt or moves.is_doubt or parts.probation:
            if not unsound and not moves.is_doubt and self._wants_map(doubt):
                self.on_trial.take(world, view, tracked)
            return self._on_uncertain(world, view, tracked, doubt or (moves.words if moves.is_doubt else ""))
        return self._on_confident(world, view, tracked, moves.words)

    def finalize(self) -> None:
        """The last frame has come: what is held back keeps its pose, uncertain as it is."""
        here = self.parts.here
        if here.world is not None:
            self._keep_uncertain(here.world)
            self.loop_closing.apply_pending_adjustment(here.world)
        self.beginning.confirm_map()

    def confirm_map(self) -> None:
        """Believe a young world as it is, with what was mapped on trial: the way back adds to the same map."""
        world = self.parts.here.world
        if world is not None and self.beginning.youth is not None:
            self.on_trial.keep(world)
            self.mapping.take_over(world)
        self.beginning.confirm_map()

    def _on_confident(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate, moves: str) -> Outcome:
        """A frame that is believed: map it, look back, let a young world grow, follow the next ones from here.

        moves: what was said of what moves against the scene
        """
        parts, mapping, closing = self.parts, self.mapping, self.loop_closing
        parts.here.state = State.TRACKING
        why = mapping.take(world, view, tracked, self._delay(world))
        is_keyframe = bool(why)
        if is_keyframe and not mapping.adjusting:
            world = closing.detect_and_close(world)
        stays = parts.session.mapping and parts.foreign.stays(world.T_cw, tracked.depth)
        if stays:
            world = closing.apply_pending_adjustment(world)
            drop_covered(world, parts.foreign.stillness.covers)
        if self.beginning.is_almost_confirmed:
            world = closing.apply_pending_adjustment(world)
        if self.beginning.grow(view):
            return Outcome(Reason.STARTED_ANEW, parts.here.world, is_keyframe=True)
        if not is_keyframe and not mapping.is_due(view.index):
            closing.precheck_loop(world)
        if not is_keyframe:
            world = closing.apply_pending_adjustment(world, view.index)
        why = "; ".join(filter(None, [why, Reason.STATIC_OVERLAY if stays else "", moves]))
        return Outcome(why, world, tracked, is_keyframe)

    def _delay(self, world: Submap) -> int | None:
        """Frames that are tracked before a keyframe's adjustment is taken over: none while each moves the whole map."""
        settings = self.parts.config.bundle_adjustment
        if settings.delay_frames == 0:
            return None
        is_small = world.map.num_keyframes < settings.local_window
        return 0 if is_small or self.beginning.youth is not None else settings.delay_frames

    def _wants_map(self, doubt: str) -> bool:
        """Whether frames that are held back are to be mapped: not what came back and is certain so far."""
        return bool(doubt or self.on_trial) and not self.parts.probation.came_back

    def _on_uncertain(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate, doubt: str) -> Outcome:
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

    def _keep_uncertain(self, world: Submap) -> None:
        """What is held back keeps its pose, uncertain as it is, and so does what was mapped of it."""
        self.on_trial.keep(world)
        for held in self.parts.probation.hand_over():
            world.history.add(*held)

    def _on_lost(self, world: Submap, view: FrameFeatures) -> Outcome:
        """No pose: what was held back waits again, and a world that was hardly begun is taken back."""
        self.loop_closing.apply_pending_adjustment(world)
        self.on_trial.take_back(world)
        self.back.waiting.add(*self.parts.probation.views(), view)
        taken_back = self.beginning.lose()
        self.finding.seek()
        return Outcome(Reason.LOST_AT_START if taken_back else Reason.LOST)
