"""Samples and mountings of inertial sensors."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from torchslam.data.inertial import read_imu, read_inertial_calibration
from torchslam.errors import MeasurementError

EUROC_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
PLAIN = "time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"
T_BC = [[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
DATA = ", ".join(str(value) for row in T_BC for value in row)


def write(path: Path, header: str, rows: list[str]) -> Path:
    path.write_text("\n".join([header, *rows, ""]))
    return path


def rows_of(times: list[str], rate: float = 0.5, force: float = 9.8, mark: str = ",") -> list[str]:
    return [mark.join([time, str(rate), "0", "-0.1", "0.2", str(force), "0"]) for time in times]


@pytest.mark.parametrize(
    ("header", "times", "rate", "force"),
    [
        (EUROC_HEADER, ["1403636579758555392", "1403636579763555392", "1403636579768555392"], 0.5, 9.8),
        (PLAIN, ["0", "0.005", "0.01"], 0.5, 9.8),
        (PLAIN, ["0", "5", "10"], 0.5, 9.8),  # ms, since no sensor has a period of 5 s
        (PLAIN, ["0", "5000", "10000"], 0.5, 9.8),
        (PLAIN, ["0", "5000000", "10000000"], 0.5, 9.8),
        (
            "time [ms],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],acc_x [g],acc_y [g],acc_z [g]",
            ["0", "5", "10"],
            math.degrees(0.5),
            9.8 / 9.80665,
        ),
        ("t_us,gx_dps,gy_dps,gz_dps,ax_g,ay_g,az_g", ["0", "5e3", "1e4"], math.degrees(0.5), 9.8 / 9.80665),
        (
            "timestamp (s),wx (rad/s),wy (rad/s),wz (rad/s),ax (m/s²),ay (m/s²),az (m/s²)",
            ["0", ".005", ".01"],
            0.5,
            9.8,
        ),
        (
            "Timestamp,Accelerometer_X,Accelerometer_Y,Accelerometer_Z,gyroscope.x,gyroscope.y,gyroscope.z",
            ["0", "0.005", "0.01"],
            0.5,
            9.8,
        ),
    ],
)
def test_columns_and_units(tmp_path: Path, header: str, times: list[str], rate: float, force: float) -> None:
    rows = rows_of(times, rate, force)
    if header.startswith("Timestamp,Acc"):
        rows = [",".join([(words := row.split(","))[0], *words[4:], *words[1:4]]) for row in rows]
    samples = read_imu(write(tmp_path / "imu.csv", header, rows))
    assert samples.timestamps.dtype == torch.float64
    torch.testing.assert_close(samples.timestamps.diff(), torch.full((2,), 0.005).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(samples.gyroscope[:, 0], torch.full((3,), 0.5).double())
    torch.testing.assert_close(samples.accelerometer[:, 1], torch.full((3,), 9.8).double())


def test_other_columns_and_separators(tmp_path: Path) -> None:
    header = "name;" + PLAIN.replace(",", ";") + ";temperature"
    rows = [f"a b;{row};warm" for row in rows_of(["1.0", "1.01"], mark=";")]
    assert len(read_imu(write(tmp_path / "imu.csv", header, rows)).timestamps) == 2


def test_a_folder_is_that_of_its_data(tmp_path: Path) -> None:
    write(tmp_path / "data.csv", EUROC_HEADER, rows_of(["1403636579758555392", "1403636579763555392"]))
    assert read_imu(tmp_path).source.endswith("data.csv")


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("", [], "the first line must name the columns `time`"),
        (PLAIN, [], "0 samples; at least two"),
        (PLAIN, rows_of(["0"]), "1 samples; at least two"),
        ("time,gyro_x,gyro_y,gyro_z,acc_x,acc_y", rows_of(["0", "0.01"]), "no column acc_z in the header"),
        ("1,2,3,4,5,6,7", rows_of(["0", "0.01"]), "the first line must name the columns `time`"),
        (
            PLAIN.replace("gyro_x", "gyro_x [turns/s]"),
            rows_of(["0", "0.01"]),
            "the unit `turnss` is not known",
        ),
        (PLAIN.replace("gyro_x", "gyro_x [deg/s]"), rows_of(["0", "0.01"]), "have different units"),
        (PLAIN, rows_of(["0", "0.01", "0.01"]), ":4: the sample is not later than the one before"),
        (
            PLAIN,
            rows_of(["0", "0.01"], force=1.0),
            r"the median of the forces is 1.02 m/s\^2, not that of gravity",
        ),
        (PLAIN, rows_of(["0", "0.01"], rate=300.0), "a rate of 300 rad/s is too fast"),
        (PLAIN, rows_of(["0", "1e30"]), "in no unit that a sensor has"),
        (
            PLAIN,
            [*rows_of(["0", "0.01"]), "0.02,1,2,x,4,5,6"],
            r"imu.csv:4: column gyro_z: `x` is not a number",
        ),
        (PLAIN, [*rows_of(["0", "0.01"]), "0.02,1,2"], r"imu.csv:4: 3 cells, the header has 7 columns"),
        (PLAIN, [*rows_of(["0"]), "0.02,1,nan,3,4,5,6"], r"imu.csv: 1 samples; .* left out 1 rows"),
    ],
)
def test_wrong_samples_are_one_clear_error(
    tmp_path: Path, header: str, rows: list[str], message: str
) -> None:
    with pytest.raises(MeasurementError, match=message) as caught:
        read_imu(write(tmp_path / "imu.csv", header, rows))
    assert "imu.csv" in str(caught.value)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"none.csv: cannot be read"):
        read_imu(tmp_path / "none.csv")
    with pytest.raises(MeasurementError, match=r"none.yaml: cannot be read"):
        read_inertial_calibration(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    "text",
    [
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{DATA}]\nintrinsics: [1, 2, 3, 4]\n",
        f"T_BS_cam0:\n  rows: 4\n  cols: 4\n  data: [{DATA}]\ngyroscope_noise_density: 1e-4\n",
        "cam0:\n  T_cam_imu:\n  - [0.0, 1.0, 0.0, -0.2]\n  - [-1.0, 0.0, 0.0, 0.1]\n  - [0.0, 0.0, 1.0, -0.3]\n"
        "  - [0.0, 0.0, 0.0, 1.0]\n  timeshift_cam_imu: 0.012\n",
        f"%YAML:1.0\nIMU.T_b_c1: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: f\n   data: [{DATA}]\n"
        "IMU.NoiseGyro: 1e-4\n",
        f"%YAML:1.0\nTbc: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: f\n   data: [{DATA}]\n",
        f"T_ic: [{DATA}]\n",
        "T_ci: [0, 1, 0, -0.2, -1, 0, 0, 0.1, 0, 0, 1, -0.3, 0, 0, 0, 1]\n",
        f"T_SC: [{DATA}]\n",
        f"cam0:\n  T_imu_cam: [{DATA}]\n",
    ],
    ids=[
        "euroc",
        "torchslam",
        "kalibr",
        "orb-slam3",
        "orb-slam3-old",
        "kalibr-ic",
        "kalibr-ci",
        "okvis",
        "openvins",
    ],
)
def test_mountings_of_other_programs(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    found = read_inertial_calibration(path)
    torch.testing.assert_close(found.T_bc, torch.tensor(T_BC, dtype=torch.float64), atol=1e-12, rtol=0)
    assert found.offset == (0.012 if "timeshift" in text else 0.0)
    if "oise" in text:
        assert found.gyroscope_density == 1e-4


def test_noise_beside_the_samples(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(
        "sensor_type: imu\ngyroscope_noise_density: 2.0e-04\naccelerometer_noise_density: 3.0e-3\n"
    )
    found = read_inertial_calibration(None, tmp_path / "data.csv")
    assert (found.T_bc, found.gyroscope_density, found.accelerometer_density) == (None, 2e-4, 3e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no keys in it"),
        ("fx: 3\n", "no transformation in it; looked for that between camera and inertial sensor"),
        (f"T_from_factory: [{DATA}]\n", "the direction of T_from_factory is not known; looked for"),
        ("T_BS: [1, 0, 0]\n", "16 numbers, not 3"),
        ("T_BS: [1, 0, 0, x]\n", "`x` is not a number"),
        ("T_BS: [" + DATA.replace("-1.0", "-2.0") + "]\n", "is not rigid"),
        ("T_BS: [" + DATA.replace("0.3", "300") + "]\n", "300 m between camera and body; is it in meters"),
        ("T_BS: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n", "is the identity"),
        (f"T_BS: [{DATA}]\ngyroscope_noise_density: -1\n", "gyroscope_density must be above zero"),
    ],
)
def test_wrong_mountings_are_one_clear_error(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(MeasurementError, match=message):
        read_inertial_calibration(path)


def test_rows_without_all_values_are_left_out(tmp_path: Path) -> None:
    lines = [
        *rows_of(["0", "0.01", "0.02"]),
        "0.03,1,nan,3,4,5,6",
        "0.04,1,,3,4,5,6",
        "0.05,1,2,3,0,0,0.0",
        "0.06,1,2,3,-9999,9,1",
    ]
    found = read_imu(write(tmp_path / "imu.csv", PLAIN, lines))
    assert len(found.timestamps) == 3
    assert "left out 4 rows without all values" in found.notes[0]
