"""What the stages of a session share, and what they say of a frame."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config import Config
from torchslam.geometry import Camera
from torchslam.loop_closing.loop_closer import Memory
from torchslam.map.submap import World
from torchslam.mapping.mapper import Mapper
from torchslam.system.session import Session
from torchslam.tracking.dynamic.non_static_filter import Foreign
from torchslam.tracking.matcher import Matcher
from torchslam.tracking.patch_tracking import PatchTracking
from torchslam.tracking.pose_confirmation import Probation
from torchslam.tracking.tracker import Tracker
from torchslam.types import State, Tracked
from torchslam.utils.timing import Stopwatch


@dataclass
class Whereabouts:
    """The world that is followed, None where there is none, and in what state; changed as soon as it changes."""

    world: World | None
    state: State


@dataclass(frozen=True)
class Parts:
    """What the stages of one session work with.

    config: for images of the camera's size (`Config.for_size`)
    """

    camera: Camera
    config: Config
    clock: Stopwatch
    matcher: Matcher
    tracker: Tracker
    mapper: Mapper
    session: Session
    memory: Memory
    foreign: Foreign
    patches: PatchTracking
    probation: Probation
    here: Whereabouts


@dataclass(frozen=True)
class Outcome:
    """What became of a frame: without a world it has no pose, and `reason` says why."""

    reason: str
    world: World | None = None
    tracked: Tracked | None = None
    is_keyframe: bool = False
