"""The unit of a map from speeds and from the odometry of another sensor."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.metric.drives import RATE, drive, error, measure, reason, sensor_odometry, view_of
from torchslam.data.formats.vehicle_files import Speeds, read_speeds
from torchslam.data.trajectories import write_trajectory
from torchslam.errors import MeasurementError, TorchslamError
from torchslam.geometry import rigid, se3_exp, se3_inverse
from torchslam.metric import odometry
from torchslam.metric.camera_path import Clock
from torchslam.metric.odometry import OdometrySource, SpeedSource, hand_eye
from torchslam.metric.slow_noise import slow_mean
from torchslam.metric.source import ScaleSource
from torchslam.types import Trajectory

FILE = Path("speeds.csv")


def wheel(T_ec: Tensor, noise: float = 0.05) -> Tensor:
    """Speeds at the times of the images."""
    steps = T_ec[:, :3, 3].diff(dim=0).norm(dim=-1) * RATE
    own = torch.cat((steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]))
    return own + noise * torch.randn(
        len(own), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )


def test_speeds_with_a_stop() -> None:
    times, T_ec = drive()
    found = measure(SpeedSource(Speeds(FILE, times, wheel(T_ec).abs())), view_of(times, T_ec))
    assert found.source is ScaleSource.SPEED
    assert abs(error(found)) < 0.003
    assert abs(error(found)) < 3 * found.relative_std < 0.03
    assert found.count < 59  # the stop says nothing
    assert found.rejected == ()


def test_wheels_that_slip() -> None:
    times, T_ec = drive()
    slipping = wheel(T_ec)
    slipping[50:90] *= 1.7
    slipping[400:420] *= 1.7
    found = measure(SpeedSource(Speeds(FILE, times, slipping.abs())), view_of(times, T_ec))
    assert abs(error(found)) < 0.005
    assert "as with wheels that slip" in found.rejected[0]


def test_speeds_that_a_phone_does_not_know_do_not_count(tmp_path: Path) -> None:
    """iOS writes -1; the rows that were left out are in the notes of the measurement."""
    times, T_ec = drive()
    own = wheel(T_ec)
    own[::3] = -1.0
    lines = [f"{time},{speed}" for time, speed in zip(times.tolist(), own.tolist(), strict=True)]
    (tmp_path / "v.csv").write_text("\n".join(["time,speed", *lines]))
    found = measure(SpeedSource(read_speeds(tmp_path / "v.csv")), view_of(times, T_ec))
    assert abs(error(found)) < 0.003
    assert (
        f"left out {len(own[::3])} rows without a speed or a time: -1 ({len(own[::3])} times)"
        in found.notes[0]
    )


def test_speeds_on_another_clock() -> None:
    times, T_ec = drive()
    view = view_of(times, T_ec)
    late = Speeds(FILE, times + 1.3, wheel(T_ec).abs())
    found = measure(SpeedSource(late), view)
    assert abs(error(found)) < 0.005
    assert any("its clock is 1.30 s ahead" in note for note in found.notes)
    given = measure(SpeedSource(late, Clock(seconds=-1.3)), view)
    assert given.meters_per_unit == pytest.approx(found.meters_per_unit, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [("gap", "share 0 stretches"), ("standing", "hardly moves"), ("noise", "from stretch to stretch")],
)
def test_speeds_that_say_nothing(change: str, words: str) -> None:
    times, T_ec = drive()
    own, at = wheel(T_ec), times
    if change == "gap":
        at, own = times[::40], own[::40]
    if change == "standing":
        own = torch.where(times < 3, own, 0.0)
    if change == "noise":
        each = torch.randn(61, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        own = (3 * each).exp().repeat_interleave(10)[: len(times)].clamp_max(900)
    assert words in reason(SpeedSource(Speeds(FILE, at, own.abs())), view_of(times, T_ec))


@pytest.mark.parametrize("delay", [0.0, 0.8])
def test_odometry_in_a_frame_of_its_own(delay: float) -> None:
    """Rotated and mounted a meter away, on another clock."""
    times, T_ec = drive()
    source = OdometrySource(FILE, Trajectory(times + delay, sensor_odometry(T_ec)))
    found = measure(source, view_of(times, T_ec))
    assert found.source is ScaleSource.ODOMETRY
    assert abs(error(found)) < 0.004
    assert abs(error(found)) < 3.5 * found.relative_std
    assert any("clock" in note for note in found.notes) == (delay > 0)
    (lever,) = re.findall(r"the camera is (\d\.\d\d) m from the sensor", found.notes[-1])
    assert float(lever) > 0.3


def test_odometry_that_turns_otherwise() -> None:
    times, T_ec = drive()
    poses = sensor_odometry(T_ec, drift=0.0)
    turn = se3_exp(torch.tensor((0.0, 0, 0, 0, 0, 0.5), dtype=torch.float64))
    poses[305:] = poses[305] @ turn @ se3_inverse(poses[305]) @ poses[305:]
    found = measure(OdometrySource(FILE, Trajectory(times, poses)), view_of(times, T_ec))
    assert abs(error(found)) < 0.004
    assert "rotate differently from the camera" in found.notes[0]


def test_the_lever_arm_and_the_rotation_between_two_sensors() -> None:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    X = se3_exp(torch.tensor((0.4, -0.2, 0.7, 0.3, 1.0, -0.5), dtype=torch.float64))
    motions = se3_exp(torch.cat((3 * normal(40, 3), 0.4 * normal(40, 3)), dim=1))
    camera = se3_inverse(X) @ motions @ X
    in_map = rigid(camera[:, :3, :3], camera[:, :3, 3] / 5)
    moved, lever, alike = hand_eye(motions, in_map, torch.ones(40, dtype=torch.bool))
    assert bool(alike.all())
    torch.testing.assert_close(lever, X[:3, 3], atol=1e-3, rtol=0)
    torch.testing.assert_close(moved, camera[:, :3, 3] @ X[:3, :3].mT, atol=1e-3, rtol=0)


def test_the_mean_of_a_series_that_wanders() -> None:
    """Its error is several times that of independent values, and values that are wrong on one side do not move it."""
    generator = torch.Generator().manual_seed(0)
    times = torch.arange(100, dtype=torch.float64)
    white = torch.randn(100, generator=generator, dtype=torch.float64)
    slow = torch.zeros(100, dtype=torch.float64)
    for row in range(1, 100):
        slow[row] = 0.9 * slow[row - 1] + 0.44 * torch.randn((), generator=generator, dtype=torch.float64)
    ones = torch.ones(100, dtype=torch.float64)
    independent, wandering = slow_mean(times, 5 + white, ones), slow_mean(times, 5 + 3 * slow, ones)
    assert independent.std == pytest.approx(0.2, rel=0.5)  # that it does not wander is not known
    assert wandering.std > 4 * 3 * float(slow.std()) / 10 / 2
    assert abs(independent.mean - 5) < 3 * independent.std
    assert abs(wandering.mean - 5) < 3 * wandering.std
    wrong = 5 + 0.01 * white
    wrong[::3] += 2
    found = slow_mean(times, wrong, ones)
    assert abs(found.mean - 5) < 0.01
    assert int(found.inliers.sum()) == 66


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("0,1.5\n0.5,-2\n", [1.5, 2.0]),
        ("# time speed\n0 1.5\n0.5 2\n", [1.5, 2.0]),
        ("time,speed\n0,1.5\n0.5,2\n", [1.5, 2.0]),
        ("time_ms;speed_km_h\n0;3.6\n500;7.2\n", [1.0, 2.0]),
        ("time,speed\n-1,-1\n0,1\n0.1,-1.0\n0.2,\n0.3,NaN\n0.5,2\n0.6,-9999\n", [1.0, 2.0]),
        ("time,speed (mph)\n0,2.2369363\n0.2,-2.24\n0.3,-1\n0.5,4.4738726\n", [1.0, 2.0]),
        ('"time" "GPS speed [kn]"\n"1" 0 1.9438445\n"2" 0.5 3.887689\n', [1.0, 2.0]),
    ],
)
def test_files_of_speeds(tmp_path: Path, content: str, expected: list[float]) -> None:
    (tmp_path / "v.csv").write_text(content, encoding="utf-8")
    found = read_speeds(tmp_path / "v.csv")
    assert found.timestamps.tolist() == [0.0, 0.5]
    assert found.speeds.tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "the first line must name the columns `time`"),
        ("time,rpm\n0,1\n", "no `time` or no `speed`"),
        ("time,speed\n0,1\n", "1 speeds, two are needed"),
        ("time,speed\n1,1\n0,1\n", "is earlier than the one before"),
        ("time,speed\n1,1\n2,5000\n", "5000 is no speed in meters per second"),
        ("time,speed\n1,1\n2,nan\n", "1 speeds, two are needed; .* left out 1 rows"),
        ("0,1,2\n", "expected `time speed`, got 3 numbers"),
    ],
)
def test_wrong_files_of_speeds(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "v.csv").write_text(content, encoding="utf-8")
    with pytest.raises(MeasurementError, match=message):
        read_speeds(tmp_path / "v.csv")


def test_options_read_their_files(tmp_path: Path) -> None:
    (tmp_path / "v.csv").write_text("0,1\n1,1\n", encoding="utf-8")
    (by_speed,) = odometry.speeds_from_options({"speed": ((str(tmp_path / "v.csv"),),)})
    assert isinstance(by_speed, SpeedSource)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    write_trajectory(tmp_path / "o.txt", Trajectory(torch.tensor((0.0, 1.0), dtype=torch.float64), poses))
    given = {"odometry": ((str(tmp_path / "o.txt"),),), "odometry_clock": (("2",),)}
    (by_odometry,) = odometry.from_options(given)
    assert isinstance(by_odometry, OdometrySource)
    assert by_odometry.clock == Clock(seconds=2.0)
    with pytest.raises(TorchslamError, match="cannot be read"):
        odometry.from_options({"odometry": ((str(tmp_path / "missing.txt"),),)})
