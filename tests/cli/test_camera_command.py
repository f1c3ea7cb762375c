"""`torchslam run` without a calibration, with one to refine, and the file of the camera that was found."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch

from tests.cli.conftest import FAST, write_tum_folder
from torchslam.cli.main import main
from torchslam.data import open_sequence
from torchslam.data.calibration import check_replaceable, write_calibration
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.errors import ResultsError
from torchslam.geometry import Camera

FRAMES = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images whose true focal length is 500 px, without a calibration."""
    made = write_tum_folder(tmp_path_factory.mktemp("images") / "room", FRAMES)
    (made / "calibration.txt").unlink()
    return made


@pytest.mark.usefixtures("without_pictures")
def test_images_without_a_calibration_are_calibrated(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They decide, the run says so and how certain it is, and the file it leaves is read by the next command."""
    results = tmp_path / "results"
    assert main(["run", str(folder), "-o", str(results), *FAST]) == 0
    captured = capsys.readouterr()
    assert "no calibration found; estimating intrinsics" in captured.err
    assert "torchslam: camera: " in captured.err
    said = json.loads((results / "metrics.json").read_text())["camera"]
    assert said in captured.out
    before, _, after = said.partition("; over all frames ")
    assert before in captured.err
    assert re.match(r"focal length \d+ ± \d+ px, k1 ", after)
    found = read_calibration(results / "calibration.txt")
    sequence = open_sequence(folder, results / "calibration.txt")
    assert sequence.camera.params.tolist() == list(found.params)
    assert abs(found.params[0] / 500 - 1) < 0.25  # of so short a way
    given = ["--overwrite", "--limit", "8", "--camera", "500,500,319.5,239.5"]
    assert main(["run", str(folder), "-o", str(results), *given, *FAST]) == 0
    assert json.loads((results / "metrics.json").read_text())["camera"].endswith("(given 500.0 px)")
    exact = [*given, "--camera-std", "0"]
    assert main(["run", str(folder), "-o", str(results), *exact, *FAST]) == 0
    assert json.loads((results / "metrics.json").read_text())["camera"] == ""
    assert not (results / "calibration.txt").exists()


@pytest.mark.usefixtures("without_pictures")
def test_a_wrong_calibration_is_reported(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The summary has a better focal length than 400 px, and the option that helps; none for the true one."""
    camera = "400,400,319.5,239.5"
    arguments = ["run", str(folder), "-o", str(tmp_path), "--overwrite", "--camera"]
    for exact in ([], ["--camera-std", "0"]):
        assert main([*arguments, camera, *exact, *FAST]) == 0
        said = json.loads((tmp_path / "metrics.json").read_text())["camera"]
        assert said in capsys.readouterr().out
        better = re.search(
            r"the images agree better with a focal length of (\d+) px or more than with 400 px; ", said
        )
        assert better is not None
        assert 430 < int(better[1]) < 520
        assert said.startswith("focal length 4") != bool(exact)
        assert said.endswith("--refine-camera estimates a better one")


def test_a_calibration_file_of_the_user_is_not_overwritten(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "calibration.txt").write_text("1 1 1 1\n")
    assert main(["run", str(folder), "-o", str(tmp_path), "--camera", "auto", *FAST]) == 2
    assert "not written by torchslam" in capsys.readouterr().err
    assert (tmp_path / "calibration.txt").read_text() == "1 1 1 1\n"


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--features", "simulated"], "simulated features are made with the camera"),
        (["--refine-camera", "--map", "nothing"], "--refine-camera cannot be combined with --map"),
    ],
)
def test_conflicting_options_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], message: str
) -> None:
    assert main(["run", str(folder), "-o", str(tmp_path / "x"), "--camera", "auto", *extra]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "camera",
    [
        Camera.pinhole(150.5, 225.25, 300.0, 400.0, size=(800, 600)),
        Camera.radial_tangential(150.5, 225.25, 300.0, 400.0, -0.1, 0.25, 0.0, 1e-3, size=(800, 600)),
        Camera.fisheye(150.5, 225.25, 300.0, 400.0, -0.1, 0.25, 0.0, 1e-3, size=(800, 600)),
        Camera(
            "rational",
            torch.tensor([150.5, 225.25, 300.0, 400.0, *8 * [0.125]], dtype=torch.float64),
            (800, 600),
        ),
    ],
)
def test_the_calibration_file_round_trips(camera: Camera, tmp_path: Path) -> None:
    path = tmp_path / "calibration.txt"
    check_replaceable(path)
    write_calibration(path, camera, ["focal length 150.5 ± 0.1 px"])
    read = read_calibration(path).camera(camera.size)
    assert read.model == camera.model
    torch.testing.assert_close(read.params, camera.params)
    assert "# focal length 150.5 ± 0.1 px\n" in path.read_text(encoding="utf-8")
    check_replaceable(path)
    path.write_text("1 1 1 1\n")
    with pytest.raises(ResultsError, match="not replaced, since"):
        check_replaceable(path)
