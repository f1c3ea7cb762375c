"""An inertial sensor as a source of meters: simulated, and that of a real recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import jaxtyping
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from tests.metric.simulated_imu import simulate
from torchslam import SLAM, Config, open_sequence
from torchslam.data.inertial import InertialCalibration, InertialSamples, read_imu, read_inertial_calibration
from torchslam.data.trajectories import interpolate_poses
from torchslam.errors import MeasurementError
from torchslam.geometry import se3_inverse, so3_exp, so3_log, umeyama
from torchslam.metric.inertial import InertialReason, InertialSource, align_inertial, from_options
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.types import Trajectory


def view_of(timestamps: Tensor, T_cw: Tensor) -> SubmapView:
    """What a source looks at in a submap: times and poses."""
    return cast(SubmapView, SimpleNamespace(timestamps=timestamps, T_cw=T_cw))


def test_a_measurement_of_scale_and_vertical() -> None:
    simulation = simulate()
    source = InertialSource(simulation.samples, simulation.calibration)
    found = source.measure(view_of(simulation.timestamps, simulation.T_cw))
    assert isinstance(found, ScaleMeasurement)
    assert (found.source, found.count, found.unit) == (ScaleSource.INERTIAL, 3, "stretches")
    assert found.meters_per_unit == pytest.approx(simulation.meters_per_unit, rel=1e-3)
    assert found.up_w is not None
    torch.testing.assert_close(found.up_w, -simulation.gravity_w / 9.807, atol=1e-3, rtol=0)


def test_what_is_not_measured_has_a_reason() -> None:
    simulation = simulate(seconds=5, size=0.0, sensor_noise=True)
    source = InertialSource(simulation.samples, simulation.calibration)
    found = source.measure(view_of(simulation.timestamps, simulation.T_cw))
    assert isinstance(found, Unmeasured)
    assert found.reason.startswith("the camera does not move")
    few = source.measure(view_of(simulation.timestamps[:5], simulation.T_cw[:5]))
    assert few == Unmeasured(ScaleSource.INERTIAL, str(InertialReason.NO_OVERLAP))


EXCHANGED = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
TURNED = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("gyroscope", "accelerometer", "words"),
    [
        (None, -torch.eye(3).double(), "accelerations of the opposite sign"),
        (EXCHANGED, EXCHANGED, "the axes of the sensor read as (y, x, z)"),
        (TURNED, TURNED, "the axes of the sensor read as (-y, x, z)"),
        (None, TURNED, "the axes of the accelerometer read as (-y, x, z)"),
        (TURNED, None, "the axes of the gyroscope read as (-y, x, z)"),
        (
            EXCHANGED,
            -EXCHANGED,
            "the axes of the sensor read as (y, x, z) and accelerations of the opposite sign",
        ),
    ],
)
@pytest.mark.parametrize("noise", [False, True])
def test_axes_and_signs_that_would_fit_are_named(
    gyroscope: Tensor | None, accelerometer: Tensor | None, words: str, noise: bool
) -> None:
    simulation = simulate(sensor_noise=noise)
    samples = simulation.samples
    if gyroscope is not None:
        samples = replace(samples, gyroscope=samples.gyroscope @ gyroscope.T)
    if accelerometer is not None:
        samples = replace(samples, accelerometer=samples.accelerometer @ accelerometer.T)
    source = InertialSource(samples, simulation.calibration)
    found = source.measure(view_of(simulation.timestamps, simulation.T_cw))
    assert isinstance(found, Unmeasured)
    assert f"but do with {words}:" in found.reason


def test_an_inverse_mounting_that_would_fit_is_named() -> None:
    simulation = simulate(sensor_noise=True)
    assert simulation.calibration.T_bc is not None
    inverse = replace(simulation.calibration, T_bc=se3_inverse(simulation.calibration.T_bc))
    found = InertialSource(simulation.samples, inverse).measure(
        view_of(simulation.timestamps, simulation.T_cw)
    )
    assert isinstance(found, Unmeasured)
    assert "but do with the inverse of the transformation between camera and sensor:" in found.reason


def test_an_unknown_mounting_of_a_left_handed_sensor() -> None:
    """Without a mounting no rotation is wrong, but a mirrored sensor is."""
    simulation = simulate(sensor_noise=True)
    samples = replace(
        simulation.samples,
        gyroscope=simulation.samples.gyroscope @ EXCHANGED.T,
        accelerometer=simulation.samples.accelerometer @ EXCHANGED.T,
    )
    found = InertialSource(samples).measure(view_of(simulation.timestamps, simulation.T_cw))
    assert isinstance(found, Unmeasured)
    assert "but do with the axes of the sensor read as" in found.reason


def test_clocks_that_have_nothing_in_common() -> None:
    simulation = simulate(seconds=5)
    source = InertialSource(simulation.samples)
    with pytest.raises(MeasurementError, match=r"but images from 0.000 to 4.950 s: both need the same clock"):
        source.measure(view_of(simulation.timestamps - 1000, simulation.T_cw))


def test_rates_in_another_unit_than_the_camera_turns() -> None:
    simulation = simulate(seconds=5)
    samples = replace(simulation.samples, gyroscope=simulation.samples.gyroscope * 57.3)
    source = InertialSource(samples, simulation.calibration)
    with pytest.raises(MeasurementError, match=r"turns 5. times as fast as the camera"):
        source.measure(view_of(simulation.timestamps, simulation.T_cw))


def test_options(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(
        "time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z\n0,0,0,0,0,9.8,0\n0.01,0,0,0,0,9.8,0\n"
    )
    name = str(tmp_path / "imu.csv")
    (source,) = from_options({"imu": ((name,),)})
    assert source.samples.source == name
    assert source.calibration.T_bc is None
    with pytest.raises(MeasurementError, match="--imu is given twice"):
        from_options({"imu": ((name,), (name,))})


@dataclass(frozen=True)
class Recording:
    """A run on a real recording, its truth and its sensor."""

    trajectory: Trajectory
    true_T_wc: Float[Tensor, "K 4 4"]
    samples: InertialSamples
    calibration: InertialCalibration

    def part(self, rows: slice) -> Recording:
        times, T_wc = self.trajectory.timestamps[rows], self.trajectory.T_wc[rows]
        return replace(self, trajectory=Trajectory(times, T_wc), true_T_wc=self.true_T_wc[rows])

    def errors(self, **changes: object) -> tuple[float, float, float, float]:
        """Relative error of the scale, that of gravity in degrees, and the stated ones."""
        given = {"samples": self.samples, "calibration": self.calibration} | changes
        T_wc = self.trajectory.T_wc
        found = align_inertial(self.trajectory.timestamps, se3_inverse(T_wc), **given)
        assert found.reason is InertialReason.MEASURED
        scale = umeyama(T_wc[:, :3, 3], self.true_T_wc[:, :3, 3])[0]
        apart = self.true_T_wc[:, :3, :3] @ T_wc[:, :3, :3].mT
        mean = apart[0]
        for _ in range(5):
            mean = so3_exp(so3_log(apart @ mean.mT).mean(0)) @ mean
        down = mean @ found.gravity_w
        tilt = torch.atan2(down[:2].norm(), -down[2]).rad2deg()
        stated = float(torch.tensor(found.gravity_std).rad2deg())
        return float(found.meters_per_unit / scale) - 1, float(tilt), found.relative_std, stated


@pytest.fixture(scope="module")
def machine_hall() -> Recording:
    from tests.conftest import DATA_DIR

    folder = DATA_DIR / "machine_hall"
    if not folder.is_dir():
        pytest.skip("no real sequences")
    sequence = open_sequence(str(folder))
    jaxtyping.config.update("jaxtyping_disable", True)  # as in the tests of whole runs
    trajectory = SLAM(sequence.camera, Config()).run(sequence).trajectory
    jaxtyping.config.update("jaxtyping_disable", False)
    assert sequence.groundtruth is not None
    truth, _ = interpolate_poses(sequence.groundtruth, trajectory.timestamps, 0.02)
    return Recording(
        trajectory, truth, read_imu(folder / "imu.csv"), read_inertial_calibration(folder / "imu.yaml")
    )


@pytest.mark.data
@pytest.mark.slow
def test_a_real_recording(machine_hall: Recording) -> None:
    scale, tilt, scale_std, tilt_std = machine_hall.errors()
    assert abs(scale) < min(0.012, 2 * scale_std)
    assert tilt < min(0.7, 2 * tilt_std)
    unknown, _, unknown_std, _ = machine_hall.errors(calibration=InertialCalibration())
    assert abs(unknown) < min(0.012, 2 * unknown_std)


@pytest.mark.data
@pytest.mark.slow
def test_four_seconds_of_a_real_recording(machine_hall: Recording) -> None:
    found = [machine_hall.part(slice(first, first + 80)).errors() for first in range(0, 241, 20)]
    assert sum(scale**2 for scale, *_ in found) / len(found) < 0.02**2
    assert sum((scale / std) ** 2 for scale, _, std, _ in found) / len(found) < 1.5**2


@pytest.mark.data
@pytest.mark.slow
def test_clocks_of_a_real_recording(machine_hall: Recording) -> None:
    late = replace(machine_hall.samples, timestamps=machine_hall.samples.timestamps + 0.02)
    found = align_inertial(
        machine_hall.trajectory.timestamps,
        se3_inverse(machine_hall.trajectory.T_wc),
        late,
        machine_hall.calibration,
    )
    assert found.rotation is not None
    assert float(found.rotation.offset) == pytest.approx(0.02, abs=0.001)
