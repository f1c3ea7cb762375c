"""`synthetic:storey`: a storey with a corridor and one room, for experiments; importing this module adds the scene.
`synthetic:storeys`: three of them, one above the other, joined by a shaft in the corner at (-6, -5).

python -m experiments.storey run synthetic:storey -o results/storey     # the command line of torchslam with it
python -m experiments.storey render synthetic:storeys results/storeys/recording     # its images, as a folder

The corridor of the storey is weak in texture; it leads all around a core with a furnished room. Seen from above, x to
the right and z up the page:

    +---------------------------+  z = 5
    |  corridor, 1.8 m wide     |
    |  +---------------------+  |
    |  |         |           |  |
    |  |         |   room       <- door
    |  |         |           |  |
    |  +---------------------+  |
    |  start ->                 |
    +---------------------------+  z = -5
  x = -6                      x = 6
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchslam.cli.main import console
from torchslam.data import open_sequence
from torchslam.data.synthetic.scene import (
    BUILDING_TEXEL,
    FLOOR,
    HEIGHT,
    PARTITION,
    Painter,
    Rectangle,
    Vector,
    X,
    Y,
    Z,
)
from torchslam.data.synthetic.sequence import SCENES, Scene, poses
from torchslam.data.trajectories import write_trajectory

TOP = np.array((0.0, -HEIGHT / 2, 0.0))
STOREY_OUTER = (6.0, 5.0)
"""Meters from the center to the outer walls, along x and z."""
STOREY_CORE = (4.2, 3.2)
"""Meters from the center to the inner walls of the corridor."""
STOREY_ROOM = (0.4, 4.1, -2.4, 2.4)
"""x from and to, z from and to."""
STOREY_DOOR = (-0.6, 0.6)
"""Begin and end of the door along z."""
STOREY_DOOR_TOP = -0.75
PLAIN = 0.03
"""Coverage of a wall of the corridor by the largest shapes: an eighth of that of other surfaces."""
BOARD_EVERY = 3.2
"""Meters along the corridor between two notice boards, on one wall and on the other."""
BOARD = (0.6, 0.9, 0.03)
"""Width, height and depth of one: up to that share larger or smaller by `SPREAD`."""
SPREAD = 0.3

STOREY_FURNITURE = (
    (
        (0.75, 0.45, -1.2),
        (0.4, 1.9, 1.4),
        0.0,
    ),  # along the wall that faces the door: shelves, a table, a box on it
    ((0.7, 0.95, 0.5), (0.6, 0.9, 1.1), 0.0),
    ((0.7, 0.35, 0.6), (0.3, 0.3, 0.35), 0.4),
    ((1.3, 0.5, 2.1), (1.1, 1.8, 0.4), -0.2),  # a cupboard and a chest along the side walls
    ((2.9, 0.9, 2.05), (0.9, 1.0, 0.5), 0.1),
    ((1.6, 0.8, -2.1), (1.2, 1.2, 0.4), 0.1),
    ((3.2, 1.0, -1.95), (0.6, 0.8, 0.6), 0.5),
    ((2.0, -1.1, 1.2), (0.5, 0.3, 0.5), 0.3),  # lamps
    ((2.2, -1.1, -1.2), (0.4, 0.4, 0.4), -0.5),
)
"""Center, size and turn of each piece in the room."""

WALK = (  # over the storey: x, z and heading in quarter turns to the right from z, of each end of a step or a turn
    (-4.0, -4.1, 1),
    (5.1, -4.1, 1),
    (5.1, -4.1, 0),
    (5.1, 0.0, 0),
    (5.1, 0.0, -1),  # into the room ...
    (2.2, 0.0, -1),
    (2.2, 0.0, -3),  # ... around, and out again
    (5.1, 0.0, -3),
    (5.1, 0.0, -4),
    (5.1, 4.1, -4),
    (5.1, 4.1, -5),
    (-5.1, 4.1, -5),
    (-5.1, 4.1, -6),
    (-5.1, -4.1, -6),
    (-5.1, -4.1, -7),
    (-4.0, -4.1, -7),
)
SHAFT = (-4.2, -3.2)
"""Corner of the shaft, along x and z: it reaches from there to the outer walls."""
SLAB = 0.3
"""Meters between the ceiling of a storey and the floor of the next."""
STOREYS = 3
PAUSE_TIME = 2.5
"""A pause takes as long as a walk of so many meters: three seconds at the scene's pace."""
GLANCE = (0.6, 0.25)
"""Quarter turns of a quick glance to the side, and how long it takes, as meters of the walk: three times as fast as
other turns."""
QUARTER_TIME = 1.4
"""A quarter turn takes as long as a walk of so many meters."""
EASING = 0.6
"""Meters of the walk before and after over which speeds even out."""
ARM = 0.3
"""Meters: so far in front of the body is the camera held, so that it moves where the body only turns."""


def storey(seed: int) -> list[Rectangle]:
    """12 x 2.8 x 10 meters around the origin; textures from a seed."""
    painter = Painter(np.random.default_rng(seed), BUILDING_TEXEL)
    plain = replace(painter, coverage=PLAIN)
    return _corridor(plain) + _boards(painter) + _storey_room(painter, plain)


def storeys(seed: int) -> list[Rectangle]:
    """`STOREYS` storeys with textures of their own; each is `HEIGHT + SLAB` above the one before."""
    rectangles = []
    x, z = STOREY_OUTER
    for number in range(STOREYS):
        painter = Painter(np.random.default_rng((seed, number)), BUILDING_TEXEL)
        plain = replace(painter, coverage=PLAIN)
        parts = _corridor(plain, below=number > 0, above=number < STOREYS - 1)
        if number:  # the four sides of the shaft through the slab below
            corner = FLOOR * Y - np.array((x, 0.0, z))
            sides = SHAFT[0] + x, SHAFT[1] + z
            parts += [painter.rectangle(corner + far * X, Z, Y, (sides[1], SLAB)) for far in (0.0, sides[0])]
            parts += [painter.rectangle(corner + far * Z, X, Y, (sides[0], SLAB)) for far in (0.0, sides[1])]
        parts += _boards(painter) + _storey_room(painter, plain)
        up = -number * (HEIGHT + SLAB) * Y
        rectangles += [replace(rectangle, origin=rectangle.origin + up) for rectangle in parts]
    return rectangles


def _corridor(plain: Painter, below: bool = False, above: bool = False) -> list[Rectangle]:
    """Its ceiling and FLOOR, which the room has as well, the outer walls, three of the core's.

    below, above: the shaft leads on through the floor, the ceiling
    """
    x, z = STOREY_OUTER
    core_x, core_z = STOREY_CORE
    lengths = (2 * x, 2 * z)
    corner = TOP + np.array((-x, 0.0, -z))
    inner = TOP + np.array((-core_x, 0.0, -core_z))

    def level(at: np.ndarray, is_open: bool) -> list[Rectangle]:
        if not is_open:
            return [plain.rectangle(at, X, Z, lengths)]
        width, depth = SHAFT[0] + x, SHAFT[1] + z
        beside = plain.rectangle(at + width * X, X, Z, (2 * x - width, depth))
        return [beside, plain.rectangle(at + depth * Z, X, Z, (2 * x, 2 * z - depth))]

    return [
        *level(corner, above),
        *level(corner + HEIGHT * Y, below),
        *(plain.rectangle(corner + far * Z, X, Y, (2 * x, HEIGHT)) for far in (0.0, 2 * z)),
        *(plain.rectangle(corner + far * X, Z, Y, (2 * z, HEIGHT)) for far in (0.0, 2 * x)),
        *(plain.rectangle(inner + far * Z, X, Y, (2 * core_x, HEIGHT)) for far in (0.0, 2 * core_z)),
        plain.rectangle(inner, Z, Y, (2 * core_z, HEIGHT)),
    ]


def _boards(painter: Painter) -> list[Rectangle]:
    """Notice boards on all walls of the corridor, at the door one that faces it."""
    rectangles = []
    for half, across in zip(STOREY_OUTER, STOREY_OUTER[::-1], strict=True):
        runs_along_x = half == STOREY_OUTER[0]
        for wall in (across, STOREY_CORE[1 if runs_along_x else 0]):
            is_outer = wall == across
            for side in (-1.0, 1.0):
                reach = half - 0.6 if is_outer else (STOREY_CORE[0] if runs_along_x else STOREY_CORE[1]) - 0.5
                for along in np.arange(-reach, reach + 1e-9, 2 * reach / round(2 * reach / BOARD_EVERY)):
                    inward = -0.5 * BOARD[2] if is_outer else 0.5 * BOARD[2]
                    at = (along + painter.rng.uniform(-SPREAD, SPREAD), side * (wall + inward))
                    if (
                        not runs_along_x
                        and side > 0
                        and not is_outer
                        and abs(at[0]) < STOREY_DOOR[1] + BOARD[0]
                    ):
                        continue
                    rectangles += _board(painter, at, runs_along_x)
    return rectangles + _board(painter, (0.0, STOREY_OUTER[0] - 0.02), False)


def _board(painter: Painter, at: tuple[float, float], runs_along_x: bool) -> list[Rectangle]:
    """at: how far along its wall, and where that is."""
    width, height = np.array(BOARD[:2]) * painter.rng.uniform(1 - SPREAD, 1 + SPREAD, 2)
    y = painter.rng.uniform(-0.5, 0.2)
    center: Vector = (at[0], y, at[1]) if runs_along_x else (at[1], y, at[0])
    size: Vector = (width, height, BOARD[2]) if runs_along_x else (BOARD[2], height, width)
    return painter.box(center, size, 0.0)


def _storey_room(painter: Painter, plain: Painter) -> list[Rectangle]:
    """Its walls, the wall with the door, the furniture."""
    x0, x1, z0, z1 = STOREY_ROOM
    corner = TOP + np.array((x0, 0.0, z0))
    rectangles = [
        painter.rectangle(corner, Z, Y, (z1 - z0, HEIGHT)),
        painter.rectangle(corner, X, Y, (x1 - x0, HEIGHT)),
        painter.rectangle(corner + (z1 - z0) * Z, X, Y, (x1 - x0, HEIGHT)),
    ]
    middle = STOREY_CORE[0] - PARTITION / 2
    for start, end, bottom in (
        (-STOREY_CORE[1], STOREY_DOOR[0], FLOOR),
        (STOREY_DOOR[1], STOREY_CORE[1], FLOOR),
        (*STOREY_DOOR, STOREY_DOOR_TOP),
    ):
        center = (middle, (bottom - FLOOR) / 2, (start + end) / 2)
        rectangles += plain.box(center, (PARTITION, bottom + FLOOR, end - start), 0.0)
    for center, size, turn in STOREY_FURNITURE:
        rectangles += painter.box(center, size, turn)
    return rectangles


def round_the_storey(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """Around the corridor of the storey and into its room, one round a phase of 2 pi; the body turns in place."""
    ends = torch.tensor([(x, 0.0, z, turns) for x, z, turns in WALK], dtype=torch.float64, device="cpu")
    return _held(phase, *_walked(phase, ends, ends.new_zeros(len(ends) - 1), again=True))


def through_the_storeys(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """Once around each storey, from one to the next in the shaft, and down again: a phase of 2 pi.

    Each round ends where it began, with a view along the corridor that was seen before. In every storey a pause and two
    quick glances.
    """
    corner, turns = (-5.1, -4.1), 1.0
    ends, pauses = list[tuple[float, float, float, float]](), list[float]()

    def go(x: float, up: float, z: float, heading: float, pause: float = 0.0) -> None:
        ends.append((x, -up * (HEIGHT + SLAB), z, heading))
        pauses.append(pause)

    for number in range(STOREYS):
        go(corner[0], number, corner[1], turns)
        for place, (x, z, heading) in enumerate(WALK[1:-1]):
            go(x, number, z, turns + heading - 1)
            if place == 6:
                go(x, number, z, turns + heading - 1, PAUSE_TIME)
            if place in (3, 9):  # the pause takes away from the time of the turn
                for side in (GLANCE[0], 0.0):
                    go(x, number, z, turns + heading - 1 + side, GLANCE[1] - QUARTER_TIME * GLANCE[0])
        turns -= 8
    go(corner[0], 0.0, corner[1], turns)  # down, over the start
    go(0.0, 0.0, corner[1], turns)
    at = torch.tensor(ends, dtype=torch.float64, device="cpu")
    walked = _walked(phase, at, torch.tensor(pauses[1:], dtype=torch.float64, device="cpu"), again=False)
    return _held(STOREYS_FRAMES / STOREY_FRAMES * phase, *walked)


def _held(phase: Tensor, x: Tensor, y: Tensor, z: Tensor, yaw: Tensor) -> Float[Tensor, "N 4 4"]:
    """The camera is held at arm's length before a body and looks ahead, it sways and glances to the sides."""
    yaw = yaw + 0.15 * torch.sin(17.3 * phase) + 0.015 * torch.sin(61.7 * phase)
    return poses(
        x + ARM * torch.sin(yaw) + 0.012 * torch.sin(49.1 * phase),
        y - 0.1 + 0.015 * torch.sin(83.7 * phase) + 0.05 * torch.sin(5.3 * phase + 0.5),
        z + ARM * torch.cos(yaw) + 0.012 * torch.sin(43.9 * phase + 1.0),
        yaw,
        -0.02 + 0.012 * torch.sin(57.7 * phase + 0.4),
        0.01 * torch.sin(71.2 * phase),
    )


def _walked(
    phase: Float[Tensor, " N"], ends: Float[Tensor, "E 4"], pauses: Float[Tensor, " E1"], again: bool
) -> Float[Tensor, "4 N"]:
    """x, y, z and yaw of the body, eased by a Hann window over the time.

    ends: x, y, z and heading, quarter turns, of each end of a step or a turn
    pauses: by how much each step takes longer
    again: from the end on to the start
    """
    steps = ends.diff(dim=0)
    durations = steps[:, :3].norm(dim=-1) + QUARTER_TIME * steps[:, 3].abs() + pauses
    starts = torch.cat((durations.new_zeros(1), durations.cumsum(0)))
    window = torch.linspace(-1, 1, 25, dtype=torch.float64, device="cpu")[1:-1]
    weights = torch.cos(0.5 * math.pi * window) ** 2
    time = phase[:, None] * (starts[-1] / (2 * math.pi)) + EASING * window
    time = time % starts[-1] if again else time.clamp(min=0.0).minimum(starts[-1])
    row = (torch.searchsorted(starts, time, right=True) - 1).clamp(max=len(steps) - 1)
    share = (time - starts[row]) / durations[row]
    at = ends[row] + share[..., None] * steps[row]
    # A round ends eight quarter turns from where it began: in a window over its end the heading goes on from there.
    jump = torch.round((at[..., 3] - at[:, len(window) // 2, None, 3]) / 8) * 8
    at = torch.stack((*at[..., :3].unbind(-1), 0.5 * math.pi * (at[..., 3] - jump)))
    return (at * weights).sum(-1) / weights.sum()


STOREY_FRAMES, STOREYS_FRAMES = 1160, 5000
"""Of a round of one storey, and of the walk through all."""
# A corridor all around with a room on the way, and 100 frames on, over the start.
SCENES["storey"] = Scene(storey, round_the_storey, STOREY_FRAMES, STOREY_FRAMES + 100)
SCENES["storeys"] = Scene(storeys, through_the_storeys, STOREYS_FRAMES, STOREYS_FRAMES)


def render(name: str, folder: Path) -> None:
    """Write a rendered sequence as a folder in the format of TUM RGB-D: a run then takes no time to render."""
    sequence = open_sequence(name)
    truth = sequence.groundtruth
    assert truth is not None
    (folder / "rgb").mkdir(parents=True)
    files = [f"{time:.6f} rgb/{number:05}.jpg" for number, time in enumerate(sequence.timestamps.tolist())]
    for number in tqdm(range(len(sequence)), unit="image"):
        gray = (255 * sequence.image(number)[0, 0]).round().to(torch.uint8).numpy()
        cv2.imwrite(str(folder / f"rgb/{number:05}.jpg"), gray, [cv2.IMWRITE_JPEG_QUALITY, 95])
    (folder / "rgb.txt").write_text("\n".join(files) + "\n")
    write_trajectory(folder / "groundtruth.txt", truth)


if __name__ == "__main__":
    if sys.argv[1:2] == ["render"]:
        render(sys.argv[2], Path(sys.argv[3]))
    else:
        console()
