"""The memory of places over all worlds: what was seen before, and what follows when it is seen again."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera
from torchslam.loop_closing.closing import close_loop, join, sew_on
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.loop_detector import LoopCandidate, LoopClosureRecord, LoopDetector
from torchslam.map.atlas import Atlas
from torchslam.map.map import Map
from torchslam.map.submap import Submap
from torchslam.tracking.relocalization import Candidate
from torchslam.types import FrameFeatures


class LoopCloser:
    """Knows the keyframes of all worlds by what they look like."""

    def __init__(self, camera: Camera, config: Config, worlds: Atlas) -> None:
        self.camera = camera
        self.config = config
        self.worlds = worlds
        self.places = KeyframeDatabase()
        self.recognizer = LoopDetector(camera, config, worlds, self.places)
        self.recalls: list[LoopClosureRecord] = []  # what was recognised so far, for the record
        self.looks_known: tuple[int, bool] | None = None  # a keyframe, by key, and what `look_ahead` saw
        for world in worlds:
            for keyframe in range(world.map.num_keyframes):
                self.add(world.map, keyframe)

    def add(self, slam_map: Map, keyframe: int) -> None:
        """The place of a keyframe can be recognised from now on."""
        view = slam_map.view(keyframe)
        self.places.add(slam_map.key(keyframe), view.descriptors, view.mask)

    def remove(self, keys: Tensor) -> None:
        """Keyframes that are gone, by their keys (n,)."""
        self.places.remove(keys)

    def likely(self, view: FrameFeatures) -> list[Candidate]:
        """Keyframes that look like a frame, in any world, the likeliest first."""
        keys, _ = self.places.query(view.descriptors, view.mask)
        found = (
            self.worlds.find(key) for key in keys[: 3 * self.config.relocalization.max_candidates].tolist()
        )
        return [candidate for candidate in found if candidate is not None]

    def look_ahead(self, world: Submap, keyframe: int) -> None:
        """Note whether a keyframe shows a place that was seen before, by the map as it is; the map is not changed."""
        is_known = self.config.loop_closing.enabled and self.recognizer.recognize(world, keyframe) is not None
        self.looks_known = world.map.key(keyframe), is_known

    def recognize(self, world: Submap, keyframe: int) -> LoopCandidate | None:
        """The place that a keyframe shows, if it was seen before and that is certain.

        Where none is found, or `look_ahead` saw none, what the map knows already of earlier visits is tied to the
        keyframe.
        """
        if not self.config.loop_closing.enabled:
            return None
        looks_new = self.looks_known == (world.map.key(keyframe), False)
        found = None if looks_new else self.recognizer.recognize(world, keyframe)
        if found is None:
            sew_on(world, keyframe, self.camera, self.config)
        return found

    def take_up(self, found: LoopCandidate) -> tuple[Submap, int]:
        """Close the loop, or make one world of two; returns the world and the row in it of the keyframe that asked."""
        self.recalls.append(found.recall)
        if found.is_loop:
            close_loop(found, self.camera, self.config)
            return found.world, found.keyframe
        world, keyframe = join(found, self.camera, self.config)
        self.worlds.forget(found.world if world is found.other else found.other)
        return world, keyframe
