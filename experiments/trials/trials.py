"""The trials: unchanged sequences, starts, losses, loops and lookalikes, faults, a saved map, gradients."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from experiments.common import DATA_DIR, DRONE_CAMERA, DRONE_TRUTH, place_of
from experiments.trials import edits
from experiments.trials.edited import Edited, Shot, shots, strangers
from experiments.trials.faults import FAULTS, Fault
from experiments.trials.gradient import SETTINGS as GRADIENT_SETTINGS
from experiments.trials.gradient import Round
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.data.trajectories import nearest, read_trajectory
from torchslam.geometry import rigid, se3_inverse, so3_exp

POSED = ("redkitchen", "kitti07", "machine_hall", "shelf_bin", "fr2_desk_20")
WAITING = 60  # frames before the camera goes
TURN = math.radians(8.0)
STARTS = {
    "shelf_bin": (0, 50),
    "machine_hall": (0, 320),
    "redkitchen": (0, 1000),
    "kitti07": (0, 160),
    "fr2_desk_20": (0, 20),
}
LOOKALIKE_CAMERA = "460.8,460.8,255.5,191.5"  # a guess: the focal length is 0.9 widths
CUTS = {"redkitchen": (20, 190), "machine_hall": (0, 130), "shelf_bin": (0, 50), "kitti07": (0, 160)}
ON_THE_ROAD = ("vignette", "halfres", "blur15", "overexposed")  # faults that make a start on a road harder
LENDERS = {
    "redkitchen": "machine_hall",
    "machine_hall": "redkitchen",
    "shelf_bin": "machine_hall",
    "kitti07": "machine_hall",
}
HARD_LOOP = "synthetic:loop?noise=12&blur=1.5"
STOREY = "synthetic:storey?noise=6&blur=1"
SEEDS = (1, 2, 3)  # of textures, furniture and noise of the hard loop, in addition to 0


@dataclass(frozen=True)
class Trial:
    """One run over an edited sequence.

    settings: of the configuration
    map_of:   makes another sequence, of which the map is made first, saved and loaded to localize in
    cut_at:   fraction of the frames after which the run is killed and resumed from its last checkpoint
    unit:     of the ATE; without one it is a fraction of the extent of the true path
    is_differentiated: whether the gradient of the run is checked afterwards
    """

    sequence: Callable[[], Edited]
    settings: tuple[str, ...] = ()
    map_of: Callable[[], Edited] | None = None
    cut_at: float | None = None
    unit: str = "m"
    is_differentiated: bool = False


def opened(name: str) -> Sequence:
    """Raises SequenceError if it is not available."""
    return open_sequence(place_of(name))


def frames(name: str, *ranges: tuple[int, int]) -> Edited:
    """Ranges of a sequence's frames, concatenated; all frames if none is given."""
    whole = opened(name)
    parts = ranges or ((0, len(whole)),)
    return Edited(name, whole.camera, [shot for part in parts for shot in shots(whole, range(*part))])


def every_second(name: str, first: int) -> Edited:
    whole = opened(name)
    return Edited(name, whole.camera, shots(whole, range(first, len(whole), 2)))


def drone() -> Edited:
    """A user's video with COLMAP's poses where available."""
    video = open_sequence(DATA_DIR / "drone.mp4", camera=DRONE_CAMERA)
    truth = read_trajectory(DATA_DIR / DRONE_TRUTH)
    rows, distances = nearest(video.timestamps, truth.timestamps)
    parts = [
        Shot(video, index, None, se3_inverse(truth.T_wc[row]) if distance < 0.5 / video.frame_rate else None)
        for index, (row, distance) in enumerate(zip(rows.tolist(), distances.tolist(), strict=True))
    ]
    return Edited("drone", video.camera, parts, video.frame_rate)


def lookalike() -> Edited:
    """Two walks through corridors that look alike, an image every few steps, without ground truth."""
    whole = open_sequence(DATA_DIR / "lookalike" / "images", camera=LOOKALIKE_CAMERA)
    return Edited("lookalike", whole.camera, shots(whole, range(len(whole))))


def standing(name: str) -> Edited:
    """The camera stands still before it moves."""
    whole = opened(name)
    return Edited(name, whole.camera, shots(whole, [0] * WAITING) + shots(whole, range(*STARTS[name])))


def turning(name: str) -> Edited:
    """The camera only turns before it goes: the first frame seen under other angles, to and fro."""
    whole, (start, stop) = opened(name), STARTS[name]
    first = whole.pose(start)
    assert first is not None
    parts = []
    for step in range(WAITING):
        angle = TURN * math.sin(2 * math.pi * step / WAITING)
        R = so3_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))
        T_cw = rigid(R, torch.zeros(3, dtype=torch.float64)) @ first
        parts.append(Shot(whole, start, edits.turned(whole.camera, angle), T_cw))
    return Edited(name, whole.camera, parts + shots(whole, range(start, stop)))


def blackout() -> Edited:
    """redkitchen in the dark for 31 frames, after which 50 are missing."""
    kitchen = opened("redkitchen")
    dark = strangers(kitchen, range(400, 431), edits.black)
    rest = shots(kitchen, range(481, len(kitchen)))
    return Edited("redkitchen", kitchen.camera, shots(kitchen, range(400)) + dark + rest)


def elsewhere() -> Edited:
    """redkitchen with 60 frames of a machine hall in place of 50 of its own."""
    kitchen = opened("redkitchen")
    hall = strangers(opened("machine_hall"), range(60))
    rest = shots(kitchen, range(550, len(kitchen)))
    return Edited("redkitchen", kitchen.camera, shots(kitchen, range(500)) + hall + rest)


def faulty(name: str, fault: Fault) -> Edited:
    return fault(opened(name).part(*CUTS[name]), opened(LENDERS[name]))


TRIALS: dict[str, Trial] = {
    **{f"plain/{name}": Trial(partial(frames, name)) for name in POSED},
    "plain/drone": Trial(drone, unit=""),
    **{f"still/{name}": Trial(partial(standing, name)) for name in STARTS},
    **{f"turn/{name}": Trial(partial(turning, name)) for name in STARTS},
    "loss/black": Trial(blackout),
    "loss/elsewhere": Trial(elsewhere),
    "loss/two_parts": Trial(partial(frames, "redkitchen", (0, 250), (720, 1000))),
    "loop/closed": Trial(partial(frames, HARD_LOOP)),
    "loop/open": Trial(partial(frames, HARD_LOOP), ("loop_closing.enabled=false",)),
    **{f"loop/closed_{seed}": Trial(partial(frames, f"{HARD_LOOP}&seed={seed}")) for seed in SEEDS},
    **{
        f"loop/open_{seed}": Trial(
            partial(frames, f"{HARD_LOOP}&seed={seed}"), ("loop_closing.enabled=false",)
        )
        for seed in SEEDS
    },
    "loop/storey": Trial(partial(frames, STOREY)),
    "loop/storey_3": Trial(partial(frames, f"{STOREY}&seed=3")),
    "loop/storey_8": Trial(partial(frames, f"{STOREY}&seed=8")),
    "loop/storey_open": Trial(partial(frames, STOREY), ("loop_closing.enabled=false",)),
    "loop/corridors": Trial(partial(frames, "synthetic:corridors")),
    "loop/lookalike": Trial(lookalike),
    **{
        f"{fault}/{name}": Trial(partial(faulty, name, FAULTS[fault]))
        for name in CUTS
        for fault in (ON_THE_ROAD if name == "kitti07" else FAULTS)
        if (name, fault) != ("shelf_bin", "none")  # plain/shelf_bin is the same
    },
    "localize/redkitchen": Trial(
        partial(every_second, "redkitchen", 1), map_of=partial(every_second, "redkitchen", 0)
    ),
    "resume/redkitchen": Trial(partial(frames, "redkitchen"), cut_at=0.6),
    "gradient/round": Trial(Round.shots, GRADIENT_SETTINGS, is_differentiated=True),
}
