"""Scale and gravity from an inertial sensor, on simulated ways and on a real one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.metric.simulated_imu import T_BC, Simulation, simulate
from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.errors import MeasurementError
from torchslam.geometry import so3_exp, so3_log
from torchslam.metric.inertial import (
    SENSOR_STD,
    InertialAlignment,
    InertialReason,
    align_inertial,
    lies_still,
)
from torchslam.metric.inertial_rotation import align_rotations, thinned


def aligned(simulation: Simulation, **changes: object) -> InertialAlignment:
    changed = replace(simulation, **changes)
    return align_inertial(changed.timestamps, changed.T_cw, changed.samples, changed.calibration)


def angle(a: Tensor, b: Tensor) -> float:
    return float(torch.atan2(torch.linalg.cross(a, b).norm(), a @ b))


@pytest.mark.parametrize("offset", [0.0, 0.02, -0.3])
def test_exact_data_give_the_truth(offset: float) -> None:
    simulation = simulate(offset=offset)
    found = aligned(simulation)
    assert found.reason is InertialReason.MEASURED
    assert found.rotation is not None
    assert float(found.meters_per_unit) == pytest.approx(simulation.meters_per_unit, rel=3e-4)
    assert angle(found.gravity_w, simulation.gravity_w) < 3e-4
    torch.testing.assert_close(found.rotation.bias, simulation.bias[:3], atol=1e-4, rtol=0)
    torch.testing.assert_close(found.accelerometer_bias, simulation.bias[3:], atol=3e-3, rtol=0)
    assert float(found.rotation.offset) == pytest.approx(offset, abs=1e-5)
    assert found.relative_std == pytest.approx(SENSOR_STD, rel=0.1)
    assert found.rejected == ()


def test_a_rotation_that_is_not_known_is_found() -> None:
    found = aligned(simulate(offset=0.05), calibration=InertialCalibration())
    assert found.rotation is not None
    assert angle_of(found.rotation.R_bc @ T_BC[:3, :3].mT) < 1e-4
    assert float(found.meters_per_unit) == pytest.approx(3.7, rel=2e-3)
    # the lever arm, too, since the camera turns
    torch.testing.assert_close(found.lever_c, -(T_BC[:3, :3].mT @ T_BC[:3, 3]), atol=5e-3, rtol=0)


def angle_of(R: Tensor) -> float:
    return float(so3_log(R).norm())


def test_stated_errors_contain_the_errors() -> None:
    """Of noisy ways, in standard errors: about one on average."""
    scales, tilts, offsets = [], [], []
    for seed in range(8):
        simulation = simulate(
            seconds=8, position_noise=2e-3, turn_noise=1e-3, sensor_noise=True, seed=seed, offset=0.01
        )
        found = aligned(simulation)
        assert found.rotation is not None
        own_std = math.sqrt(found.relative_std**2 - SENSOR_STD**2)
        scales.append((float(found.meters_per_unit) / simulation.meters_per_unit - 1) / own_std)
        tilts.append(angle(found.gravity_w, simulation.gravity_w) / found.gravity_std)
        offsets.append((float(found.rotation.offset) - 0.01) / float(found.rotation.offset_std))
        assert found.position_std == pytest.approx(2e-3, rel=0.5)
    for errors in (scales, tilts, offsets):
        rms = math.sqrt(sum(error**2 for error in errors) / len(errors))
        assert 0.1 < rms < 1.5


def test_a_sensor_that_lies_still_says_so() -> None:
    simulation = simulate(seconds=5, size=0.0, sensor_noise=True)
    assert lies_still(simulation.samples, 1000.0, 1005.0)
    assert aligned(simulation).reason is InertialReason.STILL
    assert not lies_still(simulate(seconds=5, sensor_noise=True).samples, 1000.0, 1005.0)


def test_a_camera_that_turns_in_place_has_no_scale() -> None:
    simulation = simulate(seconds=6, sensor_noise=True)
    T_cw = simulation.T_cw.clone()
    generator = torch.Generator().manual_seed(1)
    T_cw[:, :3, 3] = 1e-4 * torch.randn(len(T_cw), 3, generator=generator).double()
    found = aligned(simulation, T_cw=T_cw)
    assert found.reason is InertialReason.NOT_DETERMINED


def test_times_without_samples_have_no_scale() -> None:
    simulation = simulate()
    late = replace(simulation.samples, timestamps=simulation.samples.timestamps + 100)
    assert aligned(simulation, samples=late).reason is InertialReason.NO_OVERLAP
    few = slice(0, 30)
    assert (
        aligned(simulation, timestamps=simulation.timestamps[few], T_cw=simulation.T_cw[few]).reason
        is InertialReason.NO_OVERLAP
    )


def test_a_gap_in_the_samples_is_left_out() -> None:
    simulation = simulate()
    times = simulation.samples.timestamps
    kept = (times < 1003.0) | (times > 1003.7)
    samples = InertialSamples(
        *(x[kept] for x in (times, simulation.samples.gyroscope, simulation.samples.accelerometer))
    )
    found = aligned(simulation, samples=samples)
    assert float(found.meters_per_unit) == pytest.approx(3.7, rel=1e-3)


def test_frames_without_poses_are_left_out() -> None:
    simulation = simulate()
    times = simulation.timestamps
    kept = (times < 1003.0) | (times > 1004.5)
    found = aligned(simulation, timestamps=times[kept], T_cw=simulation.T_cw[kept])
    assert float(found.meters_per_unit) == pytest.approx(3.7, rel=1e-3)


def test_a_stretch_that_contradicts_the_others_is_named() -> None:
    simulation = simulate(seconds=20, position_noise=1e-3)
    T_cw = simulation.T_cw.clone()
    bent = (simulation.timestamps >= 1008.1) & (simulation.timestamps < 1012)
    seconds = simulation.timestamps[bent] - 1008.1
    T_cw[bent, :3, 3] += 0.1 * (seconds * 3).sin()[:, None]
    found = aligned(simulation, T_cw=T_cw)
    assert len(found.rejected) == 1
    assert found.rejected[0] == pytest.approx(1008.0, abs=0.1)
    assert found.stretches == 4
    assert float(found.meters_per_unit) == pytest.approx(3.7, rel=1e-2)


def test_the_gradient_is_that_of_finite_differences() -> None:
    simulation = simulate(seconds=5, position_noise=1e-3, turn_noise=1e-3, sensor_noise=True)
    generator = torch.Generator().manual_seed(2)
    samples, T_cw = simulation.samples, simulation.T_cw
    directions = [
        torch.randn(x.shape, generator=generator).double() for x in (samples.gyroscope, samples.accelerometer)
    ]
    along = torch.nn.functional.pad(torch.randn(len(T_cw), 3, 1, generator=generator).double(), (3, 0, 0, 1))

    def scale(step: Tensor) -> Tensor:
        changed = replace(
            samples,
            gyroscope=samples.gyroscope + 1e-2 * step[0] * directions[0],
            accelerometer=samples.accelerometer + 1e-1 * step[1] * directions[1],
        )
        moved = T_cw + 1e-3 * step[2] * along
        return align_inertial(
            simulation.timestamps, moved, changed, simulation.calibration, turn_std=1e-3, position_std=1e-3
        ).meters_per_unit

    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(scale(zero), zero)
    with torch.no_grad():
        eye = 1e-4 * torch.eye(3, dtype=torch.float64)
        expected = torch.stack([(scale(step) - scale(-step)) / 2e-4 for step in eye])
    torch.testing.assert_close(gradient[1:], expected[1:], rtol=1e-5, atol=0)
    torch.testing.assert_close(
        gradient[0], expected[0], rtol=5e-3, atol=0
    )  # whose stated errors, held here, weigh its bias


def test_samples_are_checked() -> None:
    zero = torch.zeros(3, 3, dtype=torch.float64)
    with pytest.raises(MeasurementError, match="do not increase"):
        InertialSamples(torch.tensor([0.0, 1.0, 1.0]).double(), zero, zero)
    with pytest.raises(MeasurementError, match="at least two"):
        InertialSamples(torch.zeros(1).double(), zero[:1], zero[:1])
    with pytest.raises(MeasurementError, match="gyroscope_density must be above zero"):
        InertialCalibration(gyroscope_density=0.0)


def test_thinned_times() -> None:
    times = torch.arange(0, 1, 0.02).double()
    assert thinned(times, 0.1).tolist() == list(range(0, 50, 5))


def test_a_camera_that_hardly_turns_keeps_the_offset_that_was_given() -> None:
    simulation = simulate(seconds=5)
    still = replace(simulation.calibration, offset=0.1)
    R = so3_exp(torch.zeros(3).double()).expand(len(simulation.T_cw), 3, 3)
    samples = replace(simulation.samples, gyroscope=0 * simulation.samples.gyroscope + 0.01)
    found = align_rotations(simulation.timestamps[:-10], R[:-10], samples, still)
    assert float(found.offset) == pytest.approx(0.1, abs=1e-6)
    torch.testing.assert_close(found.bias, torch.full((3,), 0.01).double(), atol=1e-4, rtol=0)


@pytest.mark.parametrize("size", [0.02, 0.05])
def test_a_motion_that_drowns_in_noise_has_no_scale(size: float) -> None:
    simulation = simulate(seconds=20, size=size, position_noise=2e-3, turn_noise=1e-3, sensor_noise=True)
    assert aligned(simulation).reason is InertialReason.NOT_DETERMINED


def test_noise_of_the_map_does_not_make_the_scale_too_small() -> None:
    """By least squares alone it is 5 % too small."""
    errors = []
    for seed in range(3):
        simulation = simulate(size=0.2, position_noise=2e-3, turn_noise=1e-3, sensor_noise=True, seed=seed)
        errors.append(float(aligned(simulation).meters_per_unit) / simulation.meters_per_unit - 1)
    assert abs(sum(errors) / len(errors)) < 0.01
