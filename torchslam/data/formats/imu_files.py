"""Files of inertial sensors: samples as CSV with a header, and the mounting and noise as YAML.

Samples are EuRoC's `imu0`, or what loggers of phones write: a column for the time and three each for rates and forces,
with units in brackets or at the end, as in `time [ms], gyro_x [deg/s], acc_x [g]` or `acc_x_g`. A unit that is not
stated is SI, and checked: a force at rest is 9.81 m/s^2, times between samples are those of a sensor.
Mountings are Kalibr's camchain-imucam, EuRoC's sensor.yaml of the camera, ORB-SLAM3's and VINS' settings.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.formats.calibration_files import Keys, read_keys
from torchslam.data.formats.csv_tables import UNITS
from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.data.text_file import parse_floats, read_text
from torchslam.data.trajectories import ORTHOGONAL
from torchslam.errors import CalibrationError, MeasurementError
from torchslam.geometry.lie import rigid, se3_inverse

DELIMITERS = (",", ";", "\t")
"""Between columns, in the order in which they are looked for; spaces otherwise."""
TIMES = ("timestamp", "time", "t", "secondselapsed", "elapsed", "seconds")
AXES = ("x", "y", "z")
GYROSCOPES = ("wrss", "gyro", "gyroscope", "gyr", "g", "w", "omega", "angularvelocity", "rotationrate")
ACCELEROMETERS = ("arss", "acc", "accel", "accelerometer", "acceleration", "a", "linearacceleration")
"""Names of columns without their axis, in lower case, letters alone."""
TIME_UNITS = {**UNITS, "sec": 1.0, "µs": 1e-6}
"""Units of times by their letters, in seconds."""
RATE_UNITS = {
    **dict.fromkeys(("rads", "radsec", "rads1", "rad"), 1.0),
    **dict.fromkeys(("degs", "degsec", "degs1", "deg", "dps", "°s"), np.pi / 180),
}
"""Units of rates by their letters and digits, in rad/s."""
STANDARD_GRAVITY = 9.80665
"""m/s^2, of which accelerometers in g count multiples, by definition (3rd CGPM, 1901)."""
FORCE_UNITS = {
    **dict.fromkeys(("ms2", "mss", "msec2"), 1.0),
    "g": STANDARD_GRAVITY,
    "mg": 1e-3 * STANDARD_GRAVITY,
}
"""Units by their letters and digits, in m/s^2."""
SHORTEST_PERIOD = 2e-4
"""Seconds; with a thousand times of it, 0.2 s, one unit of time alone is possible. Sensors have 1e-3 to 0.1 s."""
FORCE_RANGE = (7.0, 13.0)
"""m/s^2, of the median length of forces: gravity, with the worst bias and shaking. Tried on drones and at rest: 9.8."""
FASTEST = 100.0
"""rad/s, the fastest turn that is believed; the range of usual gyroscopes ends at 35."""
LONGEST_LEVER = 10.0
"""Meters between camera and sensor; more is a mistake of units."""
T_CAMERA_TO_BODY = ("tbscam0", "timucam", "bodytcam0", "imutbc1", "imutbc", "tbc1", "tbc", "tbs")
T_BODY_TO_CAMERA = ("tcamimu", "tic", "tcb")
GYROSCOPE_DENSITY = ("gyroscopenoisedensity", "imunoisegyro", "gyrn")
ACCELEROMETER_DENSITY = ("accelerometernoisedensity", "imunoiseacc", "accn")
TIME_SHIFT = ("timeshiftcamimu", "td")
"""Keys in lower case, letters and digits alone."""
BESIDE = ("sensor.yaml", "imu.yaml")
"""Files beside the samples that may have the noise of the sensor."""


def read_imu(path: str | Path) -> InertialSamples:
    """Read the samples of an inertial sensor.

    Args:
        path: a CSV with a header, or a folder with a `data.csv`, such as EuRoC's `imu0`.

    Raises:
        MeasurementError: naming the file and, where it has one, the line: unknown columns or units, times that do not
            increase, no gravity in the forces.
    """
    path = Path(path) / "data.csv" if Path(path).is_dir() else Path(path)
    lines = read_text(path, MeasurementError).splitlines()
    header = next((number for number, line in enumerate(lines) if line.strip()), None)
    if header is None:
        raise MeasurementError(f"{path}: no samples")
    first = lines[header].lstrip("\ufeff# ")
    delimiter = next((mark for mark in DELIMITERS if mark in first), None)
    columns, units = _columns([name.strip(" \"'") for name in first.split(delimiter)], path)
    table = _numbers(path, lines, header, delimiter, columns)
    if len(table) < 2:
        raise MeasurementError(f"{path}: {len(table)} samples; at least two are needed")
    times = table[:, 0] - table[0, 0]
    late = np.nonzero(np.diff(times) <= 0)[0]
    if len(late):
        raise MeasurementError(
            f"{path}: sample {late[0] + 2} is not later than the one before, of {len(table)} samples"
        )
    unit = units[0] if units[0] is not None else _unit_of_times(times, path)
    gyroscope = table[:, 1:4] * (units[1] or 1.0)
    accelerometer = table[:, 4:] * (units[2] or 1.0)
    if np.abs(gyroscope).max() > FASTEST:
        raise MeasurementError(
            f"{path}: a rate of {np.abs(gyroscope).max():.0f} rad/s is too fast; state the unit, as in gyro_x [deg/s]"
        )
    force = float(np.median(np.linalg.norm(accelerometer, axis=1)))
    if not FORCE_RANGE[0] < force < FORCE_RANGE[1]:
        raise MeasurementError(
            f"{path}: the median of the forces is {force:.3g} m/s^2, not that of gravity, 9.81; state the unit, as in "
            "acc_x [g], and leave gravity in"
        )
    seconds, rates, forces = (
        torch.from_numpy(np.ascontiguousarray(x)) for x in (table[:, 0] * unit, gyroscope, accelerometer)
    )
    return InertialSamples(seconds, rates, forces, str(path))


def _columns(names: list[str], path: Path) -> tuple[list[int], tuple[float | None, ...]]:
    """Where time, rates and forces are, and their units; None where they are not stated."""
    found: dict[str, tuple[int, float | None]] = {}
    kinds = (
        ("time", TIMES, TIME_UNITS),
        ("gyro", GYROSCOPES, RATE_UNITS),
        ("acc", ACCELEROMETERS, FORCE_UNITS),
    )
    for column, name in enumerate(names):
        for kind, words, known in kinds:
            parsed = _parsed(
                name, words, known, with_axis=kind != "time", where=f"{path}: column `{name[:80]}`"
            )
            if parsed is not None:
                found.setdefault(f"{kind}{parsed[0]}", (column, parsed[1]))
    wanted = ("time", *(f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in AXES))
    missing = [name for name in wanted if name not in found]
    if missing:
        raise MeasurementError(
            f"{path}: no column {missing[0]} in the header `{', '.join(names)[:200]}`; needed are "
            f"{', '.join(wanted)}, with units as in gyro_x [deg/s]"
        )
    units = [{found[name][1] for name in group} for group in (wanted[:1], wanted[1:4], wanted[4:])]
    if any(len(each) > 1 for each in units):
        raise MeasurementError(
            f"{path}: the axes of a sensor have different units: `{', '.join(names)[:200]}`"
        )
    return [found[name][0] for name in wanted], tuple(each.pop() for each in units)


def _parsed(
    name: str, words: tuple[str, ...], units: dict[str, float], with_axis: bool, where: str
) -> tuple[str, float | None] | None:
    """The axis, such as `_x`, and the unit of a column; None if it is another kind of column."""
    bare, *brackets = re.split(r"[\[(]", name.lower(), maxsplit=1)
    bracket = "".join(brackets)
    parts = [part for part in re.split(r"[^a-z0-9µ°]+", bare) if part]
    unit = re.sub(r"[^a-z0-9µ°]", "", bracket.replace("²", "2"))
    for length in range(len(parts), 0, -1):
        head, tail = "".join(parts[:length]), "".join(parts[length:])
        axis = ""
        if with_axis:
            if head[-1:] not in AXES:
                continue
            head, axis = head[:-1], f"_{head[-1]}"
        if head not in words:
            continue
        unit = unit or tail
        if unit and unit not in units:
            raise MeasurementError(f"{where}: the unit `{unit}` is not known; known are {', '.join(units)}")
        return axis, units[unit] if unit else None
    return None


def _numbers(
    path: Path, lines: list[str], header: int, delimiter: str | None, columns: list[int]
) -> Float[np.ndarray, "M 7"]:
    """The numbers of some columns in all lines behind the header."""
    rows = lines[header + 1 :]
    if not any(row.strip() for row in rows):
        raise MeasurementError(f"{path}: no samples")
    try:
        table = np.loadtxt(rows, dtype=np.float64, ndmin=2, delimiter=delimiter, usecols=columns)
    except ValueError:
        table = np.full((1, 1), np.nan)  # which line is wrong follows
    if np.isfinite(table).all():
        return table
    for number, row in enumerate(rows, start=header + 2):
        words = row.split("#")[0].split(delimiter)
        if "".join(words).strip():
            where = f"{path}:{number}"
            cells = [words[column].strip() if column < len(words) else "" for column in columns]
            if not all(cells):
                raise MeasurementError(f"{where}: no number in column {columns[cells.index('')] + 1}")
            for cell in cells:
                parse_floats(cell, where, MeasurementError)
    raise MeasurementError(f"{path}: the samples cannot be read")


def _unit_of_times(times: np.ndarray, path: Path) -> float:
    """The unit with which samples come at the rate of a sensor."""
    period = float(np.median(np.diff(times)))
    for unit in sorted(set(TIME_UNITS.values())):
        if SHORTEST_PERIOD <= period * unit < 1e3 * SHORTEST_PERIOD:
            return unit
    raise MeasurementError(
        f"{path}: times are {period:g} apart, in no unit that a sensor has; write time [ms], for instance"
    )


def read_inertial_calibration(path: str | Path | None, imu: str | Path | None = None) -> InertialCalibration:
    """Read how a sensor is mounted on the camera, and its noise.

    Args:
        path: Kalibr's camchain-imucam, EuRoC's sensor.yaml of the camera, or ORB-SLAM3's or VINS' settings; None: the
            mounting is unknown.
        imu: the file or folder of the samples, beside which a sensor.yaml may have the noise.

    Raises:
        MeasurementError: no mounting in it, or one that is no rigid transformation in meters.
    """
    T_bc, offset = None, 0.0
    densities: dict[str, float] = {}
    if path is not None:
        keys = _keys(Path(path))
        T_bc = _mounting(keys, Path(path))
        offset = next((shift for each in keys if (shift := _number(each, TIME_SHIFT)) is not None), 0.0)
        densities = _densities(keys)
    if imu is not None and not densities:
        folder = Path(imu) if Path(imu).is_dir() else Path(imu).parent
        file = next((folder / name for name in BESIDE if (folder / name).is_file()), None)
        densities = _densities(_keys(file)) if file is not None else {}
    return InertialCalibration(T_bc, offset=offset, **densities)


def _keys(path: Path) -> list[Keys]:
    try:
        return list(read_keys(path))
    except CalibrationError as error:
        raise MeasurementError(str(error)) from error


def _number(keys: Keys, names: tuple[str, ...]) -> float | None:
    try:
        return keys.number(*names)
    except CalibrationError as error:
        raise MeasurementError(str(error)) from error


def _densities(all_keys: list[Keys]) -> dict[str, float]:
    """White noise of the sensors, where there is any."""
    found: dict[str, float] = {}
    for name, words in (
        ("gyroscope_density", GYROSCOPE_DENSITY),
        ("accelerometer_density", ACCELEROMETER_DENSITY),
    ):
        for keys in all_keys:
            density = _number(keys, words)
            if density is not None:
                found.setdefault(name, density)
    return found


def _mounting(all_keys: list[Keys], path: Path) -> Float[Tensor, "4 4"]:
    """T_bc of the first camera."""
    for keys in all_keys:
        for names, is_inverse in ((T_BODY_TO_CAMERA, True), (T_CAMERA_TO_BODY, False)):
            if names not in keys:
                continue
            try:
                numbers = keys.numbers(*names) or []
            except CalibrationError as error:
                raise MeasurementError(str(error)) from error
            T = _rigid(numbers, path)
            if is_inverse:
                T = se3_inverse(T)
            if torch.equal(T, torch.eye(4, dtype=T.dtype, device="cpu")):
                raise MeasurementError(
                    f"{path}: the transformation between camera and body is the identity, as in the file of a sensor; "
                    "give the file of the camera"
                )
            return T
    raise MeasurementError(
        f"{path}: no transformation between camera and inertial sensor in it; looked for T_cam_imu (Kalibr), T_BS "
        "(EuRoC, of the camera), Tbc (ORB-SLAM3) and body_T_cam0 (VINS)"
    )


def _rigid(numbers: list[float], path: Path) -> Float[Tensor, "4 4"]:
    if len(numbers) != 16:
        raise MeasurementError(f"{path}: a transformation has 16 numbers, not {len(numbers)}")
    T = torch.tensor(numbers, dtype=torch.float64, device="cpu").view(4, 4)
    R = T[:3, :3]
    off = (R @ R.mT - torch.eye(3, dtype=R.dtype, device="cpu")).abs().max()
    if float(off) > ORTHOGONAL or float(torch.linalg.det(R)) < 0 or T[3].tolist() != [0, 0, 0, 1]:
        raise MeasurementError(f"{path}: the transformation between camera and body is not rigid")
    if float(T[:3, 3].norm()) > LONGEST_LEVER:
        raise MeasurementError(
            f"{path}: {float(T[:3, 3].norm()):g} m between camera and body; is it in meters?"
        )
    U, _, Vh = torch.linalg.svd(R)
    return rigid(U @ Vh, T[:3, 3])
