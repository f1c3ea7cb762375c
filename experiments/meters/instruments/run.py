"""How right is the scale by simulated GPS, speeds and odometry, and is its stated error? See README.md."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import parser_of, publish, sequences, table
from experiments.meters.scale import view_of_run
from torchslam import evaluate
from torchslam.data.fixes import Fixes
from torchslam.data.formats.vehicle_files import Speeds
from torchslam.data.trajectories import interpolate_poses
from torchslam.geometry import geodetic_from_enu, rigid, se3_exp, se3_inverse, so3_exp
from torchslam.metric.odometry import OdometrySource, SpeedSource
from torchslam.metric.positions import PositionSource
from torchslam.metric.source import MetricSource, ScaleMeasurement
from torchslam.types import Trajectory

ORIGIN = torch.tensor((48.98, 8.39, 112.0), dtype=torch.float64)
LEVEL = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0)), dtype=torch.float64)
"""From the axes of KITTI's first camera to east, north, up."""
FILE = Path("simulated")
WRONG = 50.0
"""Meters of a gross error."""
HEADER = (
    "measured | error of scale, rms | largest | stated, median | within 1 and 2 stated | "
    "ATE without alignment of scale, median"
)


def normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def times_of(truth: Trajectory, rate: float) -> Tensor:
    return torch.arange(
        float(truth.timestamps[0]), float(truth.timestamps[-1]), 1 / rate, dtype=torch.float64
    )


def gps(truth: Trajectory, seed: int, noise: tuple[float, float], walk: float, wrong: float) -> MetricSource:
    """Positions at 1 Hz: white noise, horizontal and vertical, a walk that reaches so many meters at the end, and
    some that are 50 m off, all in meters."""
    generator = torch.Generator().manual_seed(seed)
    times = times_of(truth, 1.0)
    T_wc, _ = interpolate_poses(truth, times, 1.0)
    count = len(times)
    white = normal(generator, count, 3) * torch.tensor((noise[0], *noise), dtype=torch.float64)
    slow = walk / math.sqrt(count) * normal(generator, count, 3).cumsum(0)
    bad = torch.rand(count, generator=generator) < wrong
    gross = WRONG * bad[:, None] * torch.nn.functional.normalize(normal(generator, count, 3), dim=-1)
    geodetic = geodetic_from_enu(T_wc[:, :3, 3] @ LEVEL.mT + white + slow + gross, ORIGIN)
    return PositionSource(Fixes(FILE, geodetic, torch.full((count, 2), math.nan).double(), times))


def wheels(truth: Trajectory, seed: int, noise: float, slipping: float) -> MetricSource:
    """Speeds at 10 Hz with white noise, m/s; for a part of the seconds 1.8 times too fast."""
    generator = torch.Generator().manual_seed(seed)
    times, step = times_of(truth, 10.0), 0.05
    ahead, behind = (interpolate_poses(truth, times + each, 1.0)[0][:, :3, 3] for each in (step, -step))
    speeds = (ahead - behind).norm(dim=-1) / (2 * step)
    slips = torch.rand(int(times[-1]) + 1, generator=generator) < slipping
    speeds = torch.where(slips[times.long()], 1.8 * speeds, speeds) + noise * normal(generator, len(times))
    return SpeedSource(Speeds(FILE, times, speeds.abs()))


def odometry(truth: Trajectory, seed: int, noise: float, degrees: float) -> MetricSource:
    """Poses of a sensor that is turned and 1.6 m away, with errors of every tenth of a second, meters and degrees."""
    generator = torch.Generator().manual_seed(seed)
    T_cs = rigid(so3_exp(torch.tensor((0.3, -0.7, 1.2)).double()), torch.tensor((0.5, 0.2, 1.5)).double())
    T_ws = truth.T_wc.double() @ T_cs
    steps = se3_inverse(T_ws[:-1]) @ T_ws[1:]
    size = torch.tensor([noise] * 3 + [math.radians(degrees)] * 3, dtype=torch.float64)
    off = size * normal(generator, len(steps), 6)
    poses = [torch.eye(4, dtype=torch.float64)]
    for step in se3_exp(off) @ steps:
        poses.append(poses[-1] @ step)
    return OdometrySource(FILE, Trajectory(truth.timestamps, torch.stack(poses)))


INSTRUMENTS: dict[str, Callable[[Trajectory, int], MetricSource]] = {
    "GPS 1.5 m, 3 m vertical, walk of 1 m": lambda truth, seed: gps(truth, seed, (1.5, 3.0), 1.0, 0.0),
    "the same, 10 % wrong by 50 m": lambda truth, seed: gps(truth, seed, (1.5, 3.0), 1.0, 0.1),
    "GPS 0.3 m, 0.6 m vertical, walk of 1 m": lambda truth, seed: gps(truth, seed, (0.3, 0.6), 1.0, 0.0),
    "GPS 0.3 m, 0.6 m vertical, walk of 0.2 m": lambda truth, seed: gps(truth, seed, (0.3, 0.6), 0.2, 0.0),
    "the same, 10 % wrong by 50 m ": lambda truth, seed: gps(truth, seed, (0.3, 0.6), 0.2, 0.1),
    "speeds, 0.1 m/s": lambda truth, seed: wheels(truth, seed, 0.1, 0.0),
    "speeds, 0.1 m/s, a tenth slips by 1.8": lambda truth, seed: wheels(truth, seed, 0.1, 0.1),
    "odometry, 0.01 m and 0.1 degrees a step": lambda truth, seed: odometry(truth, seed, 0.01, 0.1),
    "odometry, 0.03 m and 0.3 degrees a step": lambda truth, seed: odometry(truth, seed, 0.03, 0.3),
}


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--trials", type=int, default=50)
    options = parser.parse_args()
    torch.set_num_threads(1)
    (sequence,) = sequences(["kitti07"])
    truth = sequence.groundtruth
    assert truth is not None
    run, view = view_of_run(sequence)
    with_scale = evaluate(run.trajectory, truth)
    rows = []
    for name, instrument in INSTRUMENTS.items():
        errors, stated, ates = [], [], []
        for seed in range(options.trials):
            found = instrument(truth, seed).measure(view)
            if not isinstance(found, ScaleMeasurement):
                continue
            T_wc = run.trajectory.T_wc.double().clone()
            T_wc[:, :3, 3] *= found.meters_per_unit
            ates.append(evaluate(Trajectory(run.trajectory.timestamps, T_wc), truth).ate_se3_m)
            errors.append(math.log(found.meters_per_unit / with_scale.scale))
            stated.append(found.relative_std)
        off, std = torch.tensor(errors), torch.tensor(stated)
        shares = [float(((off / std).abs() < width).double().mean()) for width in (1, 2)]
        silent = options.trials - len(errors)
        rows.append(
            [
                name.strip() + (f" ({silent} of {options.trials} without a scale)" if silent else ""),
                f"{float(off.square().mean().sqrt()):.2%}",
                f"{float(off.abs().max()):.2%}",
                f"{float(std.median()):.2%}",
                f"{shares[0]:.0%}, {shares[1]:.0%}",
                f"{float(torch.tensor(ates).median()):.2f} m",
            ]
        )
        print(*rows[-1], sep=" | ", flush=True)
    print(f"ATE with alignment of scale: {with_scale.ate_m:.3f} m")
    publish(table(HEADER, rows), options, __file__)


if __name__ == "__main__":
    main()
