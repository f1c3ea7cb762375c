"""A drive over two blocks, what a map in another unit and frame has of it, and what instruments measure of it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import torch
from torch import Tensor

from torchslam.geometry import rigid, se3_inverse, sim3_exp, sim3_inverse, sim3_scale, so3_exp, transform
from torchslam.metric.source import MetricSource, ScaleMeasurement, SubmapView, Unmeasured

RATE = 10.0
"""Images a second."""
ORIGIN = (48.98, 8.39, 112.0)
S_WE = sim3_exp(torch.tensor([3.0, -2.0, 1.0, 0.4, -1.1, 0.7, math.log(0.12)], dtype=torch.float64))
"""From east, north, up to the map."""
METERS_PER_UNIT = 1 / float(sim3_scale(S_WE))


def level_poses(positions_e: Tensor, heading: Tensor) -> Tensor:
    """Camera poses T_ec (N, 4, 4) of a vehicle: z ahead, y down."""
    zero, one = torch.zeros_like(heading), torch.ones_like(heading)
    ahead = torch.stack((heading.cos(), heading.sin(), zero), dim=-1)
    down = torch.stack((zero, zero, -one), dim=-1)
    R = torch.stack((torch.linalg.cross(down, ahead, dim=-1), down, ahead), dim=-1)
    return rigid(R, positions_e)


def drive(seconds: float = 60.0, kind: str = "turns") -> tuple[Tensor, Tensor]:
    """Times (N,) and poses T_ec (N, 4, 4) of a car that stops once; along "turns" or a "line"."""
    times = torch.arange(int(seconds * RATE) + 1, dtype=torch.float64) / RATE
    speed = 6 + 3 * (times / 4).sin()
    speed = speed * (((times / seconds - 0.45).abs() - 0.05) / 0.03).clamp(0, 1)
    turning = torch.zeros_like(times) if kind == "line" else 0.25 * (times / 5).sin().clamp(-0.6, 1.0)
    heading = 0.3 + (turning * (speed > 0)).cumsum(0) / RATE
    step = (
        torch.stack((heading.cos(), heading.sin(), 0.02 * (times / 7).cos()), dim=-1) * speed[:, None] / RATE
    )
    return times, level_poses(step.cumsum(0) - step, heading)


def view_of(times: Tensor, T_ec: Tensor, names: list[str] | None = None) -> SubmapView:
    """What a source is shown of a map of the drive."""
    R_we = S_WE[:3, :3] / sim3_scale(S_WE)
    T_wc = rigid(R_we @ T_ec[:, :3, :3], transform(S_WE, T_ec[:, :3, 3]))
    images = None if names is None else SimpleNamespace(file_name=lambda index: names[index])
    shown: Any = SimpleNamespace(
        timestamps=times, T_cw=se3_inverse(T_wc), frame_index=torch.arange(len(times)), sequence=images
    )
    return cast(SubmapView, shown)


def receiver(
    times: Tensor,
    T_ec: Tensor,
    *,
    every: float = 1.0,
    noise: float = 1.0,
    walk: float = 0.0,
    wrong: float = 0.0,
    seed: int = 0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Times, positions east, north, up, with noise twice as large along the vertical, and which are 50 m off."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.arange(0, len(times), round(every * RATE))
    shape = (len(rows), 3)

    def normal() -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    positions_e = T_ec[rows, :3, 3] + noise * normal() * torch.tensor((1.0, 1.0, 2.0), dtype=torch.float64)
    positions_e = positions_e + walk / math.sqrt(len(rows)) * normal().cumsum(0)
    bad = torch.rand(len(rows), generator=generator) < wrong
    direction = torch.nn.functional.normalize(normal(), dim=-1)
    return times[rows], positions_e + 50 * bad[:, None] * direction, bad


def sensor_odometry(T_ec: Tensor, drift: float = 0.01, seed: int = 0) -> Tensor:
    """Poses of a sensor beside the camera, in a frame of its own, with errors of every step, meters."""
    generator = torch.Generator().manual_seed(seed)
    T_cs = rigid(
        so3_exp(torch.tensor((0.3, -0.7, 1.2), dtype=torch.float64)),
        torch.tensor((0.5, 0.2, 1.0), dtype=torch.float64),
    )
    T_es = T_ec @ T_cs
    steps = se3_inverse(T_es[:-1]) @ T_es[1:]
    steps[:, :3, 3] += drift * torch.randn(len(steps), 3, generator=generator, dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return torch.stack(poses)


def true_S_ew() -> Tensor:
    """From the map to east, north, up."""
    return sim3_inverse(S_WE)


def measure(source: MetricSource, view: SubmapView) -> ScaleMeasurement:
    """What a source measures."""
    found = source.measure(view)
    assert isinstance(found, ScaleMeasurement), found
    return found


def reason(source: MetricSource, view: SubmapView) -> str:
    """Why a source measures nothing."""
    found = source.measure(view)
    assert isinstance(found, Unmeasured), found
    return found.reason


def error(found: ScaleMeasurement) -> float:
    """The logarithm of a measured scale of the drive over the true one."""
    return math.log(found.meters_per_unit / METERS_PER_UNIT)
