"""Monocular SLAM, the way of a frame:

frame -> features -> follow the world at hand (track, judge) -> keyframe? -> map -> seen before? -> StepResult
                  -> or find one: a known place, or the beginning of a new world
      -> or only patches of an earlier frame, where these will do (configured) -> StepResult
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchslam.config import Config
from torchslam.data.arrays import image_tensor
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError
from torchslam.front_end import FrontEnd, check_order, check_size, image_extractor, source
from torchslam.geometry import Camera, se3_inverse
from torchslam.loops.memory import Memory
from torchslam.mapping.culling import drop_covered
from torchslam.mapping.founding import Founder
from torchslam.mapping.keyframes import why_keyframe
from torchslam.mapping.mapper import Mapper
from torchslam.processes import helped
from torchslam.run import Run, run_sequence
from torchslam.session import Session
from torchslam.stopwatch import Stopwatch
from torchslam.tracking.anchors import Anchors
from torchslam.tracking.backwards import track_back
from torchslam.tracking.foreign import Foreign
from torchslam.tracking.independent_motion import NOTHING
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.judge import why_doubt
from torchslam.tracking.matcher import Matcher, as_wanted, matcher_of
from torchslam.tracking.probation import Probation
from torchslam.tracking.relocalization import Relocalizer
from torchslam.tracking.scout import Scout
from torchslam.tracking.tracker import Tracker
from torchslam.tracking.waiting import Waiting
from torchslam.tracking.youth import Youth
from torchslam.values import Anchor, Followed, Frame, Start, State, StepResult, Tracked, Trajectory, View
from torchslam.world.history import History
from torchslam.world.map import Map
from torchslam.world.map_check import why_not_alike
from torchslam.world.world import World
from torchslam.world.worlds import Worlds

STARTED = "started the map"
STARTED_ANEW = "later frames contradict the start: started the map anew"
FOUND_AGAIN = "found again"
STAYS = "some of the image does not move with the scene and is left out"


class SLAM:
    """Give it frames one after the other; ask it for the map and the trajectory at any time.

    It works on the device of the camera: SLAM(camera.to("cuda")) runs on the GPU, wherever the images are.
    `save` keeps its worlds in a file; `SLAM.load` goes on in them with a session of its own.

    Settings in pixels are those of images as `features.image_pixels` reduces them, and grow with larger ones.

    extractor: front end, from images to `Features`, such as ORB(); the configured one if None. Frames that bring
               features of their own, as those of `front_end.Simulated`, are not shown to it.
    matcher:   who matches two views, see `tracking.matcher.Matcher`; the configured one if None
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        extractor: FrontEnd | None = None,
        matcher: Matcher | None = None,
    ) -> None:
        self.config = config or Config()
        self.camera = camera.to(torch.float64)
        self.extractor = None  # where frames bring their features
        if extractor is not None or self.config.features.kind != "simulated":
            self.extractor = image_extractor(self.config, self.camera.params.device, extractor)
        self.has_own_parts = extractor is not None or matcher is not None  # which other processes do not have
        self.clock = Stopwatch()
        scaled = self.scaled = self.config.for_size(camera.size)  # what is told to the stages
        self.matcher = matcher_of(scaled.matching, matcher)
        self.tracker = Tracker(self.camera, scaled, self.matcher)
        self.relocalizer = Relocalizer(self.tracker, scaled)
        self.mapper = Mapper(self.camera, scaled, self.clock, self.matcher)
        self.founder = Founder(self.tracker, self.mapper, self.config.initialization.min_explained)
        self.reset()

    def reset(self) -> None:
        """Forget everything and wait for a new start."""
        self.enter(Session(self.camera, Worlds(self.camera.params)))

    @classmethod
    def load(
        cls,
        path: str | Path,
        config: Config | None = None,
        extractor: FrontEnd | None = None,
        mapping: bool = True,
        device: torch.device | str = "cpu",
        matcher: Matcher | None = None,
    ) -> SLAM:
        """Go on in the worlds of a file that `save` wrote, with its camera: lost at first, in a session of its own.

        mapping: without it, frames are only localised: no keyframe, point or world is made, none is changed

        Raises ResultsError for a file that is missing, damaged, or without a world to localise in.
        """
        session = Session.load(path, mapping, device)
        slam = cls(session.camera, config, extractor, matcher)
        slam.enter(session)
        return slam

    def save(self, path: str | Path) -> None:
        """Write worlds and camera to a file, whole or not at all; frames that were only localised are left out."""
        self.session.save(path)

    def enter(
        self, session: Session, world: World | None = None, last_frame: tuple[int, float] | None = None
    ) -> None:
        """Begin a session, lost at first; or go on in one of its worlds, from where the camera was in `last_frame`.

        last_frame: index and timestamp
        """
        self.session, self.worlds, self.mapping = session, session.worlds, session.mapping
        self.tracker.counts = session.mapping
        self.last_frame = last_frame
        self.memory = Memory(self.camera, self.scaled, self.worlds)
        self.foreign = Foreign(self.camera, self.scaled)
        self.scout = Scout(self.camera, self.scaled)
        # the last frame that was found by its features, and what the next ones can be followed from
        self.news: tuple[int, Anchor | None] = (-1, None)
        self.waiting = Waiting(self.config.initialization.max_waiting)
        self.mapper.adjusting.drop()
        # frames that are looked at while one is mapped may refer to as many anchors
        patches = self.config.patches
        self.anchors = Anchors(self.camera, patches.count, patches.delay + 2)
        self._seek()
        self.world: World | None = world  # the one that is followed
        if world is not None:
            self.state = State.TRACKING

    @property
    def is_settled(self) -> bool:
        """Whether a world is followed that has proved itself, and no frame is held back."""
        return self.world is not None and self.youth is None and not self.probation

    # --- the way of a frame ----------------------------------------------------------------------------------

    @torch.inference_mode()
    def step(self, frame: Frame) -> StepResult:
        """Process one frame. A frame without a pose is no error: the result says why there is none.

        Raises FrameError for an image of another size and for a frame that does not come after the last one.
        """
        self._check(frame)
        followed, scouts = frame.followed, self.config.patches.enabled and frame.followed is None
        scouts = scouts and frame.features is None and self.extractor is not None
        if scouts:
            with self.clock("patches"):
                followed = self.scout.follow(frame)
        if followed is not None and self.will_do(followed):
            return self._go_along(frame, followed)
        view = self._look(frame)
        self.news = view.index, None
        result = self._find(view) if self.world is None else self._follow(self.world, view, followed)
        if self.news[1] is None:
            self.anchors.clear()
        if scouts:
            self.scout.learn(*self.news)
        return result

    def step_image(self, image: np.ndarray, timestamp: float, channels: str = "rgb") -> StepResult:
        """Process an image of one's own loop: the frame after the last one.

        image: (H, W) or (H, W, C), uint8, or floats in [0, 1]; channels: their order, `channel_orders`

        Raises FrameError for an image that cannot be taken, and as `step` does.
        """
        index = 0 if self.last_frame is None else self.last_frame[0] + 1
        return self.step(Frame(index, float(timestamp), image_tensor(image, channels), f"image {index}"))

    def run(
        self,
        sequence: Sequence,
        progress: Callable[[StepResult], None] | None = None,
        processes: int | None = 1,
    ) -> Run:
        """Process a sequence: bad frames are skipped and counted, the whole map is adjusted at the end.

        processes: how many, this one included; None: what is best, as on the command line. The result is the same.
        """
        sequence = source(sequence, self.config, self.camera)
        with helped(sequence, self, processes) as frames:
            return run_sequence(self, sequence, progress, frames=frames)

    def trajectory(self) -> Trajectory:
        """Every posed frame of this session in its main world, by the map as it is now."""
        world = self.worlds.main(self.session.number)
        return Trajectory.empty() if world is None else world.trajectory(self.session.number)

    @property
    def map(self) -> Map:
        """Of the world that is followed, or else of the one with most frames; empty where there is none."""
        world = self.world or self.worlds.main(self.session.number)
        return Map() if world is None else world.map

    @property
    def history(self) -> History:
        """The posed frames of the same world as `map`."""
        world = self.world or self.worlds.main(self.session.number)
        return History() if world is None else world.history

    def _check(self, frame: Frame) -> None:
        if self.extractor is None and frame.features is None:
            raise ConfigError(
                "simulated features need true poses: use SLAM.run(sequence), or frames that bring features"
            )
        check_order(frame, self.last_frame)
        is_whole = frame.image.numel() > 0 or frame.features is None  # else only its features came
        if is_whole and frame.followed is None:
            check_size(frame, self.camera)

    def _look(self, frame: Frame) -> View:
        with self.clock("features"):
            features = frame.features
            if features is None:
                assert self.extractor is not None  # as `_check` saw to
                features = self.extractor(frame)
            view = as_wanted(View.of(frame, features, self.camera.params), frame, self.matcher)
            self.seen = replace(view, session=self.session.number)
            if self.last_frame is None:
                self._check_kind(self.seen)
            self.last_frame = frame.index, frame.timestamp
            return self.foreign.clear_of(self.seen)

    def _check_kind(self, view: View) -> None:
        """Raises ConfigError where the front end is another one than that of the worlds."""
        for world in self.worlds:
            wrong = why_not_alike(world.map, view, to_map=self.mapping)
            if wrong:
                raise ConfigError(f"the map was made with another front end: {wrong}")

    # --- between frames with features ------------------------------------------------------------------------

    def will_do(self, followed: Followed) -> bool:
        """Whether a frame that was followed by patches needs no features."""
        return not followed.why_not and self.world is not None and followed.anchor in self.anchors

    def _go_along(self, frame: Frame, followed: Followed) -> StepResult:
        """Take over where patches were followed to; nothing is mapped."""
        world = self.world
        assert world is not None
        self.last_frame = frame.index, frame.timestamp
        with self.clock("patches"):
            view, tracked = self.anchors.place(world, frame, self.session.number, followed)
            self.tracker.see(world.map, tracked)
            world.history.add(view, tracked, world.track.T_cr, world.track.reference)
        world = self._take_over(world, frame.index)
        return self._result(view, "", world, tracked)

    # --- following a world -----------------------------------------------------------------------------------

    def _follow(self, world: World, view: View, followed: Followed | None = None) -> StepResult:
        """Track the frame; what is doubtful is held back until later frames confirm it.

        followed: what its patches said, which is where it is looked for
        """
        with self.clock("tracking"):
            T_cw = None if followed is None else self.anchors.pose(world, followed)
            if T_cw is not None:
                world.track.velocity = T_cw @ se3_inverse(world.T_cw)
            expected = None if world.track.velocity is None else self.tracker.predict(world)
            tracked = self.tracker.track(world, view)
        if tracked is None:
            return self._lose(world, view)
        doubt = why_doubt(tracked, expected, world.track, self.config.judge)
        moves = self.foreign.moves(tracked) if not doubt else NOTHING
        if doubt or moves.is_doubt or self.probation:
            return self._hold(world, view, tracked, doubt or moves.words * moves.is_doubt)
        self.state, recalls = State.TRACKING, len(self.memory.recalls)
        why = self._take(
            world, view, tracked, is_later=self.youth is None and self.mapper.may_wait(world.map)
        )
        is_keyframe = bool(why)
        if is_keyframe and not self.mapper.adjusting:
            world = self._look_back(world)
        stays = self.mapping and self.foreign.stays(world.T_cw, tracked.depth)
        if stays:
            self.mapper.adjusting.hurry(view.index)
            world = self._take_over(world, view.index)
            drop_covered(world, self.foreign.stillness.covers)
        if self.youth is not None:
            self.youth.grow(view)
            if self._replace(self.youth):
                return self._result(view, STARTED_ANEW, self.world, is_keyframe=True)
            if self.youth.age >= self.config.initialization.min_frames:
                self.settle()
        if self.config.patches.enabled and not (stays or self.youth or len(self.memory.recalls) > recalls):
            self.news = view.index, self.anchors.add(world, view, tracked)
        world = self._take_over(world, view.index)
        why = "; ".join(filter(None, [why, STAYS * stays, moves.words]))
        return self._result(view, why, world, tracked, is_keyframe=is_keyframe)

    def _take(self, world: World, view: View, tracked: Tracked, is_later: bool = False) -> str:
        """Remember a frame that is believed; a keyframe grows the map. Returns why it is one, or nothing.

        is_later: what is around a keyframe is adjusted while the next frames are tracked; there is no other until then
        """
        why = why_keyframe(view, tracked, world, self.config.keyframes) if self.mapping else ""
        if why and self.mapper.adjusting:
            self.mapper.adjusting.hurry(view.index)
            why = ""
        if why:
            keyframe = self.mapper.insert(world.map, view, tracked, is_later)
            if not self.mapper.adjusting:
                self.memory.add(world.map, keyframe)
            self.tracker.follow(world, keyframe)
        self.tracker.vouch(world.map, tracked)
        world.history.add(view, tracked, world.track.T_cr, world.track.reference)
        return why

    def _take_over(self, world: World, frame: int) -> World:
        """If it is time, put the map to where the adjustment around the newest keyframe has it, and look back."""
        if not self.mapper.adjusting.is_due(frame):
            return world
        self.mapper.take_over(world.map)
        self.memory.add(world.map, world.map.num_keyframes - 1)
        return self._look_back(world)

    def _look_back(self, world: World) -> World:
        """What the newest keyframe has to do with those before it; nobody holds rows of the map now but anchors."""
        recalls = len(self.memory.recalls)
        world = self._recall(world)
        self._tidy(world)
        if len(self.memory.recalls) > recalls:
            self.anchors.clear()
            self.news = self.news[0], None
        return world

    def _recall(self, world: World) -> World:
        """Has the newest keyframe's place been seen before? Then the loop is closed, or two worlds become one."""
        with self.clock("loops"):
            found = self.memory.recognize(world, world.map.num_keyframes - 1)
            if found is None:
                return world
            if not found.is_loop:
                self.settle()
            self.world, keyframe = self.memory.take_up(found)
            self.tracker.follow(self.world, keyframe)
            self.foreign.forget_last()  # its pose was one of the map before
        return self.world

    def _tidy(self, world: World) -> None:
        """Let go of what the map can do without."""
        keys = world.map.keys
        renumbering = self.mapper.tidy(world)
        if renumbering is not None:
            self.memory.remove(keys[renumbering.keyframes < 0])
            self.anchors.renumber(renumbering)

    def _hold(self, world: World, view: View, tracked: Tracked, doubt: str) -> StepResult:
        """Do not build on a pose yet: enough certain frames in a row confirm what was held back."""
        self.probation.hold(view, tracked, world.track, doubt)
        if self.probation:
            self.state = State.UNCERTAIN
            return self._result(view, doubt or self.probation.reason, world, tracked)
        came_back, held = self.probation.came_back, self.probation.release()
        for earlier in held:
            self.tracker.vouch(world.map, earlier[1])
            world.history.add(*earlier)
        if came_back:
            first, located, _, _ = held[0]
            self._track_back(world, first, located)
        self.state = State.TRACKING
        return self._result(view, "", world, tracked)

    def _lose(self, world: World, view: View) -> StepResult:
        """No pose: what was held back waits again, and a world that was hardly begun is taken back."""
        self.mapper.adjusting.hurry(view.index)
        self._take_over(world, view.index)
        self.waiting.add(*self.probation.views(), view)
        reason = "lost"
        if self.youth is not None and self.youth.age < self.config.initialization.min_frames:
            self._take_back(self.youth)
            reason = "lost right after the start: starting anew"
        self.settle()
        self._seek()
        return self._result(view, reason)

    # --- finding one -----------------------------------------------------------------------------------------

    def _seek(self) -> None:
        """Nothing is followed any more."""
        self.world = None
        self.youth: Youth | None = None  # of the world that is followed, if it began lately
        self.initializer = Initializer(self.camera, self.scaled, self.matcher)
        self.probation = Probation(self.config)
        self.foreign.forget_last()
        self.lost_for = 0
        self.state = State.LOST if len(self.worlds) else State.INITIALIZING

    def _find(self, view: View) -> StepResult:
        """Come back to a known place, or else begin a new world; the frame waits until there is a pose for it."""
        self.lost_for += 1
        if len(self.worlds):
            with self.clock("relocalization"):
                found = self.relocalizer.locate(view, self.memory.likely(view))
            if found is not None:
                return self._return(view, *found)
        self.waiting.add(view)
        patient = self.lost_for <= self.config.relocalization.patience or not self.mapping
        if len(self.worlds) and patient:
            return self._result(view, "lost")
        with self.clock("initialization"):
            start, reason = self.initializer.step(view)
            self.foreign.stillness.add(self.initializer.still)
            if start is not None:
                reason = self._begin(start, self.initializer.views)
        if reason:
            return self._result(view, reason)
        return self._result(view, STARTED, self.world, is_keyframe=True)

    def _return(self, view: View, world: World, tracked: Tracked) -> StepResult:
        """Go on in a world that was recognised; the next frames have to confirm it."""
        self.tracker.start_at(world, view, tracked)
        self.world = world
        self.probation.come_back(view, tracked, world.track)
        self.state = State.UNCERTAIN
        return self._result(view, FOUND_AGAIN, world, tracked)

    # --- a new world -----------------------------------------------------------------------------------------

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
            self.memory.add(world.map, keyframe)
        known = set(world.history.frames["frame_index"].tolist()) if len(world.history) else set()
        posed = [view for view in views if view.index in known]
        self.waiting.remove(posed)
        self.world, self.youth, self.state = world, Youth(world, posed), State.TRACKING
        return ""

    def _take_back(self, youth: Youth) -> None:
        """A start that later frames contradict: its frames wait for another one."""
        self.waiting.add(*youth.views)
        self.memory.remove(youth.world.map.keys)
        self.worlds.forget(youth.world)
        self.youth = None

    def _replace(self, youth: Youth) -> bool:
        """Begin anew with the first and the last frame of a young world, if these contradict it."""
        with self.clock("initialization"):
            start = youth.rival(self.camera, self.scaled, self.matcher)
            replaced = start is not None and not self._begin(start, youth.views)
        if replaced:
            self.foreign.forget_last()  # its pose was one of the map before
        return replaced

    def settle(self) -> None:
        """A young world has proved itself: pose the frames from before its start."""
        if self.youth is None:
            return
        world, self.youth = self.youth.world, None
        behind = world.aside()
        self.tracker.follow(behind, 0)
        self._pose_waiting(behind, before=int(world.map.keyframes["frame_index"][0]))

    def conclude(self) -> None:
        """The last frame has come: what is held back keeps its pose, uncertain as it is, and nothing is built on it."""
        self.settle()
        for held in self.probation.hand_over():
            assert self.world is not None  # nothing is held back without one
            self.world.history.add(*held)
        if self.world is not None and self.last_frame is not None:
            self.mapper.adjusting.hurry(self.last_frame[0])
            self._take_over(self.world, self.last_frame[0])

    def _track_back(self, world: World, view: View, tracked: Tracked) -> None:
        """Pose the frames that were lost before a frame that was found again."""
        behind = world.aside()
        self.tracker.start_at(behind, view, tracked)
        self._pose_waiting(behind, before=view.index)

    def _pose_waiting(self, behind: World, before: int) -> None:
        """Follow the camera back through the frames that wait from before a frame."""
        with self.clock("backwards"):
            earlier = [view for view in self.waiting if view.index < before]
            posed = track_back(self.tracker, behind, reversed(earlier), self.config.judge, self._take)
        self.waiting.remove(posed)

    @torch.inference_mode(False)  # poses that leave may become part of a graph
    def _result(
        self,
        view: View,
        reason: str,
        world: World | None = None,
        tracked: Tracked | None = None,
        is_keyframe: bool = False,
    ) -> StepResult:
        return StepResult(
            index=view.index,
            timestamp=view.timestamp,
            state=self.state,
            T_cw=None if world is None else world.T_cw,
            world=None if world is None else world.number,
            covariance=None if tracked is None else tracked.covariance.clone(),
            is_keyframe=is_keyframe,
            matches=tracked.matches if tracked else 0,
            inliers=tracked.inliers if tracked else 0,
            reason=reason,
            stage_ms=self.clock.take(),
        )
