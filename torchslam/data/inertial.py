"""Samples of an inertial sensor, how it is mounted on the camera, and the files of both.

Samples are EuRoC's `imu0`, or what loggers of phones write: a column for the time and three each for rates and forces,
with units in brackets or at the end, as in `time [ms], gyro_x [deg/s], acc_x [g]` or `acc_x_g`. A unit that is not
stated is SI, and checked: a force at rest is 9.81 m/s^2, times between samples are those of a sensor.
Mountings are Kalibr's camchain-imucam, EuRoC's sensor.yaml of the camera, ORB-SLAM3's and VINS' settings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.fields import NO_SAMPLE
from torchslam.data.formats.key_files import Keys, read_keys
from torchslam.data.tables import TIME_UNITS, Column, read_table
from torchslam.data.text_file import float64
from torchslam.data.trajectories import ORTHOGONAL, orthogonality_error
from torchslam.errors import CalibrationError, MeasurementError
from torchslam.geometry.lie import rigid, se3_inverse
from torchslam.geometry.similarity import nearest_rotation

AXES = ("x", "y", "z")
STANDARD_GRAVITY = 9.80665
"""m/s^2, of which accelerometers in g count multiples, by definition (3rd CGPM, 1901)."""
SENSORS = {
    "gyro": (
        ("wrss", "gyro", "gyroscope", "gyr", "g", "w", "omega", "angularvelocity", "rotationrate"),
        dict.fromkeys(("rads", "radsec", "rads1", "rad"), 1.0)
        | dict.fromkeys(("degs", "degsec", "degs1", "deg", "dps", "°s"), np.pi / 180),
    ),
    "acc": (
        ("arss", "acc", "accel", "accelerometer", "acceleration", "a", "linearacceleration"),
        dict.fromkeys(("ms2", "mss", "msec2"), 1.0) | {"g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY},
    ),
}
"""Names of columns without their axis, in lower case, letters alone; and their units, in rad/s and m/s^2."""
COLUMNS = {
    "time": Column(("timestamp", "time", "t", "secondselapsed", "elapsed", "seconds"), TIME_UNITS),
    **{
        f"{kind}_{axis}": Column(tuple(word + axis for word in words), units, NO_SAMPLE)
        for kind, (words, units) in SENSORS.items()
        for axis in AXES
    },
}
SHORTEST_PERIOD = 2e-4
"""Seconds; with a thousand times of it, 0.2 s, one unit of time alone is possible. Sensors have 1e-3 to 0.1 s."""
FORCE_RANGE = (7.0, 13.0)
"""m/s^2, of the median length of forces: gravity, with the worst bias and shaking. Tried on drones and at rest: 9.8."""
# Keys in lower case, letters and digits alone.
T_CAMERA_TO_BODY = (
    *("tbscam0", "timucam", "timucam0", "bodytcam0", "imutbc1", "imutbc", "tbc1", "tbc", "tbs"),
    *("tic", "tsc"),
)
T_BODY_TO_CAMERA = ("tcamimu", "tcam0imu", "tci", "tcb")
"""As the tools document them: Kalibr's T_cam_imu and T_ci lead to the camera, its T_ic, OKVIS' T_SC, OpenVINS' and
Basalt's T_imu_cam, ORB-SLAM3's Tbc, maplab's T_B_C, VINS' body_T_cam0 and EuRoC's T_BS from it."""
DENSITIES = {
    "gyroscope_density": ("gyroscopenoisedensity", "imunoisegyro", "gyrn"),
    "accelerometer_density": ("accelerometernoisedensity", "imunoiseacc", "accn"),
}


@dataclass(frozen=True)
class InertialSamples:
    """What an inertial sensor measures in its own frame, which is called the body's, at strictly increasing seconds.

    Angular rates are in rad/s; specific forces, which point up at rest, in m/s^2.
    """

    timestamps: Float[Tensor, " M"]
    gyroscope: Float[Tensor, "M 3"]
    accelerometer: Float[Tensor, "M 3"]
    source: str = "inertial samples"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.timestamps) < 2:
            raise MeasurementError(f"{self.source}: {len(self.timestamps)} samples; at least two are needed")
        if not bool((self.timestamps.detach().diff() > 0).all()):
            raise MeasurementError(f"{self.source}: the times of the samples do not increase")


@dataclass(frozen=True)
class InertialCalibration:
    """How an inertial sensor is mounted, and its noise.

    Attributes:
        T_bc: camera to body, meters; None: neither the rotation nor the lever arm is known.
        gyroscope_density, accelerometer_density: white noise, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
        offset: seconds to add to times of the camera for those of the sensor, as far as they are known.
    """

    T_bc: Float[Tensor, "4 4"] | None = None
    gyroscope_density: float = 5e-4
    accelerometer_density: float = 5e-3
    offset: float = 0.0

    def __post_init__(self) -> None:
        for name in DENSITIES:
            if not 0 < getattr(self, name) < math.inf:
                raise MeasurementError(f"{name} must be above zero, not {getattr(self, name)}")


def read_imu(path: str | Path) -> InertialSamples:
    """Read the samples of an inertial sensor from a CSV with a header, or a folder with a `data.csv` (EuRoC's `imu0`).

    Raises MeasurementError naming the file and, where it has one, the line: for unknown columns or units, times that do
    not increase, no gravity in the forces.
    """
    path = Path(path) / "data.csv" if Path(path).is_dir() else Path(path)
    places, rows, units = list[str](), list[list[float]](), dict[str, float]()
    for row in read_table(path, COLUMNS, MeasurementError, needed=COLUMNS, are_unique=False):
        units = dict(row.units)
        places.append(row.where)
        rows.append([row.number(column) for column in COLUMNS])
    for kind in SENSORS:
        if len({str(units.get(f"{kind}_{axis}")) for axis in AXES}) > 1:
            raise MeasurementError(f"{path}: the axes of a sensor have different units")
    table = np.array(rows).reshape(-1, 7)
    for column, kind in enumerate(COLUMNS):
        table[:, column], _ = COLUMNS[kind].known(table[:, column])
    # Forces are exactly zero only before the first one came.
    kept = np.flatnonzero(np.isfinite(table).all(1) & (table[:, 4:] != 0).any(1))
    lost = len(rows) - len(kept)
    notes = [f"{path}: left out {lost} rows without all values"] if lost else []
    if len(kept) < 2:
        raise MeasurementError("; ".join([f"{path}: {len(kept)} samples; at least two are needed", *notes]))
    table, places = table[kept], [places[row] for row in kept]
    periods = np.diff(table[:, 0])
    late = np.nonzero(periods <= 0)[0]
    if len(late):
        raise MeasurementError(f"{places[late[0] + 1]}: the sample is not later than the one before")
    period, unit = float(np.median(periods)), 1.0
    if math.isnan(units["time"]):  # the one with which samples come at the rate of a sensor
        possible = [u for u in TIME_UNITS.values() if SHORTEST_PERIOD <= period * u < 1e3 * SHORTEST_PERIOD]
        if not possible:
            raise MeasurementError(
                f"{path}: times are {period:g} apart, in no unit that a sensor has; write time [ms], for instance"
            )
        unit = min(possible)
    gyroscope, accelerometer = table[:, 1:4], table[:, 4:]
    if np.abs(gyroscope).max() > 100:  # the range of usual gyroscopes ends at 35 rad/s
        raise MeasurementError(
            f"{path}: a rate of {np.abs(gyroscope).max():.0f} rad/s is too fast; state the unit, as in gyro_x [deg/s]"
        )
    force = float(np.median(np.linalg.norm(accelerometer, axis=1)))
    if not FORCE_RANGE[0] < force < FORCE_RANGE[1]:
        raise MeasurementError(
            f"{path}: the median of the forces is {force:.3g} m/s^2, not that of gravity, 9.81; state the unit, as in "
            "acc_x [g], and leave gravity in"
        )
    return InertialSamples(
        float64(table[:, 0] * unit), float64(gyroscope), float64(accelerometer), str(path), tuple(notes)
    )


def read_inertial_calibration(path: str | Path | None, imu: str | Path | None = None) -> InertialCalibration:
    """Read how a sensor is mounted on the camera, and its noise.

    Files are Kalibr's camchain-imucam, EuRoC's sensor.yaml of the camera, or ORB-SLAM3's or VINS' settings; None leaves
    the mounting unknown. Beside the file or folder of the samples, a sensor.yaml or imu.yaml may have the noise. Raises
    MeasurementError for no mounting in the file, or one that is no rigid transformation in meters.
    """
    T_bc, offset = None, 0.0
    densities: dict[str, float] = {}
    try:
        if path is not None:
            keys = list(read_keys(Path(path)))
            T_bc = _mounting(keys, Path(path))
            offset = _first_number(keys, ("timeshiftcamimu", "td")) or 0.0
            densities = _densities(keys)
        if imu is not None and not densities:
            folder = Path(imu) if Path(imu).is_dir() else Path(imu).parent
            beside = [file for file in (folder / "sensor.yaml", folder / "imu.yaml") if file.is_file()]
            densities = _densities(list(read_keys(beside[0]))) if beside else {}
    except CalibrationError as error:
        raise MeasurementError(str(error)) from error
    return InertialCalibration(T_bc, offset=offset, **densities)


def _first_number(all_keys: list[Keys], names: tuple[str, ...]) -> float | None:
    numbers = (keys.number(*names) for keys in all_keys)
    return next((number for number in numbers if number is not None), None)


def _densities(all_keys: list[Keys]) -> dict[str, float]:
    """White noise of the sensors, where there is any."""
    found = {name: _first_number(all_keys, words) for name, words in DENSITIES.items()}
    return {name: density for name, density in found.items() if density is not None}


def _mounting(all_keys: list[Keys], path: Path) -> Float[Tensor, "4 4"]:
    """T_bc of the first camera."""
    for keys in all_keys:
        for names in (T_BODY_TO_CAMERA, T_CAMERA_TO_BODY):
            if names not in keys:
                continue
            T = _rigid(keys.numbers(*names), path)
            if torch.equal(T, torch.eye(4, dtype=T.dtype, device="cpu")):
                raise MeasurementError(
                    f"{path}: the transformation between camera and body is the identity, as in the file of a sensor; "
                    "give the file of the camera"
                )
            return se3_inverse(T) if names is T_BODY_TO_CAMERA else T
    others = [name for keys in all_keys for name in keys.matrices(16)]
    unknown = (
        f"the direction of {', '.join(others[:3])} is not known" if others else "no transformation in it"
    )
    raise MeasurementError(
        f"{path}: {unknown}; looked for that between camera and inertial sensor: T_cam_imu (Kalibr), T_BS (EuRoC, of "
        "the camera), Tbc (ORB-SLAM3), T_imu_cam (OpenVINS, Basalt), T_SC (OKVIS) and body_T_cam0 (VINS)"
    )


def _rigid(numbers: list[float], path: Path) -> Float[Tensor, "4 4"]:
    if len(numbers) != 16:
        raise MeasurementError(f"{path}: a transformation has 16 numbers, not {len(numbers)}")
    T = float64(numbers).view(4, 4)
    R, lever = T[:3, :3], float(T[:3, 3].norm())
    is_rotation = float(orthogonality_error(R)) <= ORTHOGONAL and float(torch.linalg.det(R)) > 0
    if not is_rotation or T[3].tolist() != [0, 0, 0, 1]:
        raise MeasurementError(f"{path}: the transformation between camera and body is not rigid")
    if lever > 10:
        raise MeasurementError(f"{path}: {lever:g} m between camera and body; is it in meters?")
    return rigid(nearest_rotation(R), T[:3, 3])
