"""How right are scale and gravity by an inertial sensor, and are their stated errors? See README.md."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from experiments.common import DATA_DIR, parser_of, publish, sequences, table
from torchslam import SLAM, Config
from torchslam.data.inertial import InertialCalibration, InertialSamples, read_imu, read_inertial_calibration
from torchslam.data.trajectories import interpolate_poses
from torchslam.geometry import se3_inverse, so3_exp, so3_log, umeyama
from torchslam.metric.inertial import InertialAlignment, align_inertial
from torchslam.types import Trajectory

RATE = 20
"""Images a second."""
LATE = 0.02
"""Seconds between the clocks."""
HEADER = "machine_hall (EuRoC MH_01, 16 s) | error | stated | asked"


def scale_error(found: InertialAlignment, T_wc: Tensor, true_T_wc: Tensor) -> float:
    """Of the logarithm of the scale."""
    scale = umeyama(T_wc[:, :3, 3], true_T_wc[:, :3, 3])[0]
    return math.log(float(found.meters_per_unit / scale))


def tilt_degrees(found: InertialAlignment, T_wc: Tensor, true_T_wc: Tensor) -> float:
    """Between gravity and the truth's z axis, with the mean rotation between both worlds."""
    apart = true_T_wc[:, :3, :3] @ T_wc[:, :3, :3].mT
    mean = apart[0]
    for _ in range(5):
        mean = so3_exp(so3_log(apart @ mean.mT).mean(0)) @ mean
    down = mean @ found.gravity_w
    return float(torch.atan2(down[:2].norm(), -down[2]).rad2deg())


def main() -> None:
    options = parser_of(__doc__, readme=True).parse_args()
    torch.set_num_threads(1)
    (sequence,) = sequences(["machine_hall"])
    folder = DATA_DIR / "machine_hall"
    samples, known = read_imu(folder / "imu.csv"), read_inertial_calibration(folder / "imu.yaml")
    trajectory = SLAM(sequence.camera, Config()).run(sequence).trajectory
    assert sequence.groundtruth is not None
    truth, _ = interpolate_poses(sequence.groundtruth, trajectory.timestamps, 0.02)

    def aligned(
        part: slice, own: InertialSamples = samples, calibration: InertialCalibration = known
    ) -> tuple[InertialAlignment, Trajectory, Tensor]:
        some = Trajectory(trajectory.timestamps[part], trajectory.T_wc[part])
        found = align_inertial(some.timestamps, se3_inverse(some.T_wc), own, calibration)
        return found, some, truth[part]

    rows = []
    whole = slice(0, len(trajectory))
    for name, calibration in (("", known), (", mounting unknown", InertialCalibration())):
        found, some, true = aligned(whole, calibration=calibration)
        off = scale_error(found, some.T_wc, true)
        rows.append([f"scale{name}", f"{off:+.2%}", f"{found.relative_std:.2%}", "1.2 %"])
        tilt, std = tilt_degrees(found, some.T_wc, true), math.degrees(found.gravity_std)
        rows.append([f"gravity{name}", f"{tilt:.2f}°", f"{std:.2f}°", "0.7°"])
    for seconds, asked in ((8, ""), (4, "2 %")):
        length = seconds * RATE
        parts = [
            aligned(slice(first, first + length)) for first in range(0, len(trajectory) - length + 1, RATE)
        ]
        errors = [scale_error(found, some.T_wc, true) for found, some, true in parts]
        rms = math.sqrt(sum(error**2 for error in errors) / len(errors))
        stated = sum(found.relative_std for found, *_ in parts) / len(parts)
        rows.append([f"scale of parts of {seconds} s, rms", f"{rms:.2%}", f"{stated:.2%}, mean", asked])
    late, *_ = aligned(whole, replace(samples, timestamps=samples.timestamps + LATE))
    assert late.rotation is not None
    shift = 1e3 * (float(late.rotation.offset) - LATE)
    stated = 1e3 * float(late.rotation.offset_std)
    rows.append([f"clocks {1e3 * LATE:g} ms apart", f"{shift:+.2f} ms", f"{stated:.2f} ms", "4 ms"])
    publish(table(HEADER, rows), options, __file__)


if __name__ == "__main__":
    main()
