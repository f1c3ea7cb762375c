"""Walks that come back to where they were: the families of simulated graphs. One step is the unit of length.

Every walk is (K, 4, 4) poses, node to world: z ahead, along the walk.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Generator, Tensor

from torchslam.geometry import rigid

Walk = Callable[[int, Generator], Tensor]


def ring(nodes: int, generator: Generator) -> Tensor:
    """Two to four laps of a circle that is never met exactly."""
    laps = 2 + 2 * float(torch.rand(1, generator=generator))
    angle = torch.linspace(0, 2 * math.pi * laps, nodes, dtype=torch.float64)
    radius = nodes / (2 * math.pi * laps) * (1 + 0.04 * torch.sin(0.37 * angle))
    return along(torch.stack([radius * angle.cos(), radius * angle.sin(), 0.3 * torch.sin(0.21 * angle)], -1))


def wander(nodes: int, generator: Generator) -> Tensor:
    """A smooth walk on uneven ground that turns back where it goes too far."""
    noise = torch.randn(nodes, 2, generator=generator, dtype=torch.float64)
    limit, heading, rate, height = 0.8 * math.sqrt(nodes), 0.0, 0.0, 0.0
    place, places = torch.zeros(3, dtype=torch.float64), []
    for turn, slope in noise.tolist():
        places.append(place)
        rate = 0.8 * rate + 0.12 * turn
        home = math.atan2(-float(place[1]), -float(place[0])) - heading
        outside = max(0.0, float(place.norm()) / limit - 1.0)
        heading += rate + min(1.0, 2.0 * outside) * math.atan2(math.sin(home), math.cos(home))
        height = 0.9 * height + 0.03 * slope
        place = place + place.new_tensor([math.cos(heading), math.sin(heading), height])
    return along(torch.stack(places))


def lissajous(nodes: int, generator: Generator) -> Tensor:
    """A knot in space that crosses itself, walked more than once."""
    phase = 2 * math.pi * torch.rand(3, generator=generator, dtype=torch.float64)
    turns = 1.1 + 0.4 * float(torch.rand(1, generator=generator))
    t = torch.linspace(0, 2 * math.pi * turns, 4000, dtype=torch.float64)
    curve = torch.stack(
        [torch.sin(2 * t + phase[0]), torch.sin(3 * t + phase[1]), 0.3 * torch.sin(t + phase[2])], -1
    )
    return along(resampled(curve, nodes))


def manhattan(nodes: int, generator: Generator) -> Tensor:
    """A walk over the crossings of a square grid of streets."""
    return along(_streets(nodes, generator, blocks=4, lengths=(4, 4)))


def city(nodes: int, generator: Generator) -> Tensor:
    """A walk through long corridors: few crossings, long ways between them."""
    return along(_streets(nodes, generator, blocks=2, lengths=(9, 6)))


def sphere(nodes: int, generator: Generator) -> Tensor:
    """A spiral from pole to pole; what is next to it is a turn away."""
    turns = 0.5 * math.sqrt(nodes) + 0.5 * float(torch.rand(1, generator=generator))
    s = torch.linspace(0.1, 0.9, 4000, dtype=torch.float64)
    height, angle = 1 - 2 * s, 2 * math.pi * turns * s
    width = (1 - height.square()).sqrt()
    return along(resampled(torch.stack([width * angle.cos(), width * angle.sin(), height], -1), nodes))


def eight(nodes: int, generator: Generator) -> Tensor:
    """An eight, walked about twice."""
    turns = 1.8 + 0.6 * float(torch.rand(1, generator=generator))
    t = torch.linspace(0, 2 * math.pi * turns, 4000, dtype=torch.float64)
    curve = torch.stack([torch.sin(t), 0.6 * torch.sin(2 * t), 0.05 * torch.sin(0.3 * t)], -1)
    return along(resampled(curve, nodes))


TRAINING: dict[str, Walk] = {"ring": ring, "wander": wander, "lissajous": lissajous}
UNSEEN: dict[str, Walk] = {"manhattan": manhattan, "city": city, "sphere": sphere, "eight": eight}


def along(centres: Tensor) -> Tensor:
    """Poses (K, 4, 4) at centres (K, 3), looking along the way, upright as far as that goes."""
    ahead = torch.cat([centres.diff(dim=0), centres[-1:] - centres[-2:-1]])
    ahead = ahead / ahead.norm(dim=-1, keepdim=True)
    up = ahead.new_tensor([0.05, 0.03, 1.0]).expand_as(ahead)
    right = torch.linalg.cross(up, ahead, dim=-1)
    right = right / right.norm(dim=-1, keepdim=True)
    return rigid(torch.stack([right, torch.linalg.cross(ahead, right, dim=-1), ahead], -1), centres)


def resampled(curve: Tensor, nodes: int) -> Tensor:
    """(nodes, 3) points at equal distances along a curve (N, 3), scaled so that the distance is one."""
    way = torch.cat([curve.new_zeros(1), curve.diff(dim=0).norm(dim=-1).cumsum(0)])
    wanted = torch.linspace(0, float(way[-1]), nodes, dtype=curve.dtype)
    after = torch.searchsorted(way, wanted).clamp(1, len(way) - 1)
    share = (wanted - way[after - 1]) / (way[after] - way[after - 1])
    points = torch.lerp(curve[after - 1], curve[after], share[:, None])
    return points * (nodes - 1) / way[-1]


def _streets(nodes: int, generator: Generator, blocks: int, lengths: tuple[int, int]) -> Tensor:
    """(nodes, 3) a random walk over `blocks` by `blocks` blocks of given lengths, never straight back."""
    crossing, came = (0, 0), (0, 0)
    places: list[tuple[float, float, float]] = []
    while len(places) < nodes:
        ways = [
            (dx, dy)
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
            if (dx, dy) != (-came[0], -came[1])
            and 0 <= crossing[0] + dx <= blocks
            and 0 <= crossing[1] + dy <= blocks
        ]
        came = ways[int(torch.randint(len(ways), (1,), generator=generator))]
        steps = lengths[0] if came[0] else lengths[1]
        start = (lengths[0] * crossing[0], lengths[1] * crossing[1])
        places += [(start[0] + came[0] * step, start[1] + came[1] * step, 0.0) for step in range(steps)]
        crossing = (crossing[0] + came[0], crossing[1] + came[1])
    return torch.tensor(places[:nodes], dtype=torch.float64)
