"""EuRoC folders."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.fuzz.valid_inputs import SENSOR, euroc, place
from torchslam.config import MetricConfig
from torchslam.data import Calibrated, open_sequence
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.metric.inertial import InertialSource
from torchslam.metric.options import given_options, sources_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return place(tmp_path / "MH_01_easy", euroc())


def test_brings_its_inertial_sensor_along(folder: Path) -> None:
    assert open_sequence(folder).measurements == {}
    sensor = folder / "mav0" / "imu0"
    sensor.mkdir()
    (sensor / "data.csv").write_text(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],"
        "a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
        "1403636579758555392,0.1,0.2,0.3,9.8,0.1,-0.2\n1403636579763555392,0.1,0.2,0.3,9.8,0.1,-0.2\n"
    )
    (source,) = sources_of(given_options(MetricConfig(), open_sequence(folder).measurements))
    assert isinstance(source, InertialSource)
    assert len(source.samples.timestamps) == 2
    assert source.calibration.T_bc is not None
    assert source.calibration.T_bc[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert sources_of(given_options(MetricConfig(own=False), open_sequence(folder).measurements)) == []


def test_reads_frames_camera_and_poses(folder: Path) -> None:
    for path in (folder, folder / "mav0"):
        sequence = open_sequence(path)
        assert (len(sequence), sequence.name, sequence.kind) == (3, "MH_01_easy", "EuRoC folder")
    assert sequence.camera.model == "radial_tangential"
    expected = [58.6, 57.2, 31.2, 23.3, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0]
    assert sequence.camera.params.tolist() == expected
    assert sequence[1].timestamp == pytest.approx(1403636579.813555584, abs=1e-6)


def test_poses_are_those_of_the_camera(folder: Path) -> None:
    groundtruth = open_sequence(folder).groundtruth
    assert groundtruth is not None
    expected = torch.tensor(
        [[0, -1, 0, 1.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]], dtype=torch.float64
    )
    torch.testing.assert_close(groundtruth.T_wc[1], expected)


def test_groundtruth_is_optional(folder: Path) -> None:
    (folder / "mav0" / "state_groundtruth_estimate0" / "data.csv").unlink()
    assert open_sequence(folder).groundtruth is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[58.6, 57.2, 31.2, 23.3]", "[58.6, 57.2]", r"expected `intrinsics: \[fx, fy, cx, cy\]`, got 2"),
        ("58.6", "-58.6", "focal lengths must be positive"),
        ("58.6", "nan", r"intrinsics: `nan`"),
        (
            "radial-tangential",
            "polynomial",
            "distortion model `polynomial` is not known; there are plumb_bob",
        ),
        ("  data: [0.0, -1.0,", "  data: [-1.0,", r"T_BS: expected 16 numbers, got 15"),
    ],
)
def test_bad_calibration(folder: Path, old: str, new: str, message: str) -> None:
    assert old in SENSOR
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(SENSOR.replace(old, new))
    with pytest.raises(CalibrationError, match=rf"sensor\.yaml: {message}"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[58.6, 57.2, 31.2, 23.3]", "[fx: 58.6, fy: 57.2, cx: 31.2, cy: 23.3]"),
        ("[58.6, 57.2, 31.2, 23.3]", "{fu: 58.6, fv: 57.2, cu: 31.2, cv: 23.3}"),
        ("[58.6, 57.2, 31.2, 23.3] #fu, fv, cu, cv", "\n  - 58.6\n  - 57.2\n  - 31.2\n  - 23.3"),
        ("1.76187114e-05]", "1.76187114e-05, 0.0]"),
    ],
)
def test_calibrations_written_by_hand(folder: Path, old: str, new: str) -> None:
    assert old in SENSOR
    expected = open_sequence(folder).camera.params.tolist()
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(SENSOR.replace(old, new))
    assert open_sequence(folder).camera.params.tolist() == expected


def test_a_calibration_of_another_resolution(folder: Path) -> None:
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(SENSOR.replace("[64, 48]", "[128, 96]"))
    with pytest.raises(CalibrationError, match="images of 128x96, these are 64x48"):
        open_sequence(folder)


def test_equidistant_is_fisheye(folder: Path) -> None:
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(SENSOR.replace("radial-tangential", "equidistant"))
    assert open_sequence(folder).camera.model == "fisheye"


def test_bad_lists(folder: Path) -> None:
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join([*lines, lines[-1]]))
    with pytest.raises(TrajectoryError, match=r"data\.csv:5: timestamp .* repeats"):
        open_sequence(folder)
    truth.write_text("1403636579763555584,1,2,3\n")
    with pytest.raises(TrajectoryError, match=r"data\.csv:1: expected nanoseconds, position and quaternion"):
        open_sequence(folder)
    truth.unlink()
    images = folder / "mav0" / "cam0" / "data.csv"
    images.write_text("#timestamp [ns],filename\n1403636579.76,x.png\n")
    with pytest.raises(SequenceError, match=r"data\.csv:2: expected `nanoseconds,file`"):
        open_sequence(folder)


def test_without_a_sensor_file_the_camera_is_unknown(folder: Path) -> None:
    (folder / "mav0" / "cam0" / "sensor.yaml").unlink()
    sequence = open_sequence(folder)
    assert (sequence.calibrated, sequence.groundtruth) == (Calibrated.MISSING, None)
    (note,) = sequence.notes
    assert (
        "sensor.yaml: the camera is unknown unless --camera is given, and the ground truth is not used"
        in note
    )
    assert open_sequence(folder, "60,60,32,24").calibrated is Calibrated.GIVEN


def test_a_third_radial_coefficient(folder: Path) -> None:
    path = folder / "mav0" / "cam0" / "sensor.yaml"
    path.write_text(SENSOR.replace("1.76187114e-05]", "1.76187114e-05, 0.25]"))
    camera = open_sequence(folder).camera
    assert (camera.model, float(camera.params[-1])) == ("radial_tangential", 0.25)
    path.write_text(SENSOR.replace("1.76187114e-05]", "1.76187114e-05, 0.25, 0.1, 0, 0, 0.3]"))
    with pytest.raises(CalibrationError, match="of 9 distortion coefficients more than k1 k2 p1 p2"):
        open_sequence(folder)
