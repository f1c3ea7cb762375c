"""What the stages of a session share, and what they say of a frame."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config import Config
from torchslam.geometry import Camera
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.submap import Submap
from torchslam.mapping.mapper import Mapper
from torchslam.system.session import Session
from torchslam.tracking.dynamic.non_static_filter import NonStaticFilter
from torchslam.tracking.matcher import Matcher
from torchslam.tracking.pose_confirmation import PoseConfirmation
from torchslam.tracking.tracker import Tracker
from torchslam.types import PoseEstimate, State
from torchslam.utils.timing import Stopwatch


@dataclass
class ActiveMap:
    """The world that is followed, None where there is none, and in what state; changed as soon as it changes."""

    world: Submap | None
    state: State


@dataclass(frozen=True)
class SystemContext:
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
    memory: LoopCloser
    foreign: NonStaticFilter
    probation: PoseConfirmation
    here: ActiveMap


@dataclass(frozen=True)
class Outcome:
    """What became of a frame: without a world it has no pose, and `reason` says why."""

    reason: str
    world: Submap | None = None
    tracked: PoseEstimate | None = None
    is_keyframe: bool = False
