"""`torchslam refine`: poses of each kind come back in the form in which they came, better."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from tests.cli.conftest import FAST, write_tum_folder
from tests.cli.test_align_command import Known
from tests.refine.test_refine import disturbed
from torchslam.cli.main import main
from torchslam.data import open_sequence, read_trajectory
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.data.formats.given_poses import read_poses
from torchslam.data.trajectories import write_trajectory
from torchslam.geometry import Camera, se3_exp, se3_inverse
from torchslam.geometry.transforms import opengl, quaternion_wxyz
from torchslam.io.export.nerfstudio import nerfstudio_camera
from torchslam.refine.pose_refinement import align_to_input
from torchslam.types import Trajectory

pytestmark = pytest.mark.usefixtures("without_pictures")
FRAMES = 8
WRONG = Camera.pinhole(525.0, 525.0, 319.5, 239.5, size=(640, 480))  # it is 500


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rendered images, each of a part of the room, in files `rgb/0.png` to `rgb/7.png`."""
    return write_tum_folder(tmp_path_factory.mktemp("images") / "room", FRAMES)


@pytest.fixture(scope="module")
def truth() -> Tensor:
    sequence = open_sequence(f"synthetic:room?frames={FRAMES}")
    return torch.stack([pose for i in range(FRAMES) if (pose := sequence.pose(i)) is not None])


@pytest.fixture(scope="module")
def given(truth: Tensor) -> Tensor:
    return se3_inverse(disturbed(truth, centimeters=2.0, degrees=1.0).T_wc)


def write(kind: str, given: Tensor, folder: Path) -> Path:
    """The poses as another program would have written them, of the first seven images and of one that is not there."""
    names = [f"{index}.png" for index in range(FRAMES - 1)] + ["100.png"]
    if kind == "tum":
        times = torch.arange(FRAMES, dtype=torch.float64) / 20 + 0.001
        times[-1] = 100
        write_trajectory(folder / "phone.txt", Trajectory(times, se3_inverse(given)))
        return folder / "phone.txt"
    if kind == "nerfstudio":
        frames = [
            {"file_path": f"images/{name}", "transform_matrix": T, "sharpness": 7}
            for name, T in zip(names, opengl(se3_inverse(given)).tolist(), strict=True)
        ]
        content = nerfstudio_camera(WRONG) | {"applied_scale": 2.0, "camera_angle_x": 1.0, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(content))
        return folder / "transforms.json"
    model = folder / "sparse"
    model.mkdir()
    lines = [
        " ".join(map(str, [index + 5, *quaternion, *translation, 1, name])) + "\n\n"
        for index, (quaternion, translation, name) in enumerate(
            zip(quaternion_wxyz(given[:, :3, :3]).tolist(), given[:, :3, 3].tolist(), names, strict=True)
        )
    ]
    (model / "images.txt").write_text("# by hand\n" + "".join(lines))
    (model / "cameras.txt").write_text("1 SIMPLE_PINHOLE 640 480 525 320 240\n")
    return model


@pytest.mark.parametrize("kind", ["tum", "nerfstudio", "colmap"])
def test_refined_poses_keep_the_format_of_the_input(
    kind: str, folder: Path, given: Tensor, truth: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, results = write(kind, given, tmp_path), tmp_path / "results"
    camera = ["--camera", "525,525,319.5,239.5"] if kind == "tum" else []
    arguments = ["refine", str(folder), "--poses", str(poses), "-o", str(results), "--refine-camera"]
    assert main([*arguments, *camera, *FAST]) == 0
    printed = capsys.readouterr().out
    assert "8 from" in printed
    assert "1 have no image; 1 of 8 images have no pose" in printed
    names = {"tum": "phone.txt", "nerfstudio": "transforms.json", "colmap": "."}
    refined = read_poses(results / "refined" / names[kind])
    assert refined.kind == kind
    assert len(refined) == FRAMES - 1
    before = read_poses(poses)
    assert set(refined.names) == set(before.names) - {"100.png", "images/100.png"}
    if before.timestamps is not None and refined.timestamps is not None:
        torch.testing.assert_close(refined.timestamps, before.timestamps[:-1])
    else:
        assert refined.calibration is not None
        found = refined.calibration.camera((640, 480))
        written = read_calibration(results / "calibration.txt").camera((640, 480)).params[:4]
        torch.testing.assert_close(found.params[:4], written)
    off = shape_errors(refined.T_cw, truth[:-1])
    assert off < 0.5 * shape_errors(given[:-1], truth[:-1])
    figures = json.loads((results / "metrics.json").read_text())
    assert figures["posed"] == FRAMES - 1
    assert abs(figures["focal_px"][1] - 500) < abs(figures["focal_px"][0] - 500)
    assert len(read_trajectory(results / "trajectory.txt")) == FRAMES - 1
    text = (results / "refined" / "covariances.txt").read_text()
    lines = [line for line in text.splitlines() if line[0] != "#"]
    assert len(lines) == figures["keyframes"]
    assert all(len(line.split()) == 22 for line in lines)
    if kind == "nerfstudio":
        content = json.loads((results / "refined" / "transforms.json").read_text())
        assert content["applied_scale"] == 2.0
        assert content["frames"][0]["sharpness"] == 7
        assert "camera_angle_x" not in content


def test_refined_poses_are_in_meters_where_a_length_is_known(
    folder: Path,
    given: Tensor,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(
        "torchslam.cli.arguments.sources_of", lambda given: [Known(3.0)] if "camera_height" in given else []
    )
    poses = write("tum", given, tmp_path)
    call = ["refine", str(folder), "--poses", str(poses), "-o", str(tmp_path / "a"), *FAST]
    assert main([*call, "--camera-height", "1", "--camera", "500,500,319.5,239.5"]) == 0
    assert "scale 1.000 ± 0.010 (1 known length)" in capsys.readouterr().out
    refined = read_poses(tmp_path / "a" / "refined" / "phone.txt")
    grown = extent(refined.T_cw) / extent(given[:-1])
    assert grown == pytest.approx(3.0, rel=0.02)
    assert json.loads((tmp_path / "a" / "metrics.json").read_text())["metric"]["relative_std"] == 0.01


def extent(T_cw: Tensor) -> float:
    return float(torch.pdist(se3_inverse(T_cw)[:, :3, 3]).sum())


def test_a_rendered_sequence_takes_the_camera_of_the_poses(
    given: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = write("colmap", given, tmp_path)
    assert main(["refine", "synthetic:room?frames=2", "--poses", str(poses), "-o", str(tmp_path / "a")]) == 2
    assert "no pose is that of an image of room: no image has one of its names" in capsys.readouterr().err


def test_images_with_an_orientation_are_refined_as_colmap_saw_them(
    folder: Path, given: Tensor, truth: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """COLMAP ignores the EXIF orientation; what reads the images of the results again does so, too."""
    exif, images, results = Image.Exif(), tmp_path / "images", tmp_path / "results"
    exif[0x0112] = 3
    images.mkdir()
    for index in range(FRAMES):
        with Image.open(folder / "rgb" / f"{index}.png") as image:
            image.save(images / f"{index}.jpg", quality=95, exif=exif)
    poses = write("colmap", given, tmp_path)
    text = (poses / "images.txt").read_text().replace(".png", ".jpg")
    (poses / "images.txt").write_text(text)
    arguments = ["refine", str(images), "--poses", str(poses), "-o", str(results), "--refine-camera"]
    assert main([*arguments, *FAST]) == 0
    refined = read_poses(results / "refined")
    assert shape_errors(refined.T_cw, truth[:-1]) < 0.5 * shape_errors(given[:-1], truth[:-1])
    assert main(["export", str(results), "--to", "colmap", "-o", str(tmp_path / "model")]) == 0
    with (
        Image.open(tmp_path / "model" / "images" / "000000.png") as written,
        Image.open(folder / "rgb" / "0.png") as image,
    ):
        difference = np.asarray(written.convert("L"), float) - np.asarray(image.convert("L"), float)
    assert np.abs(difference).mean() < 3
    capsys.readouterr()
    again = ["refine", str(images), "--poses", str(poses), "-o", str(tmp_path / "b")]
    assert main([*again, "--camera", "500,500,319.5,239.5"]) == 2
    assert "0.jpg: its EXIF orientation turns it" in capsys.readouterr().err


def shape_errors(T_cw: Tensor, truth: Tensor) -> float:
    """Root mean square of the distances of the centers, after a similarity."""
    S = align_to_input(T_cw, truth)
    centers = se3_inverse(T_cw)[:, :3, 3] @ S[:3, :3].mT + S[:3, 3]
    return float((centers - se3_inverse(truth)[:, :3, 3]).square().sum(-1).mean().sqrt())


def test_invalid_arguments_are_one_line_with_status_2(
    folder: Path, given: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, output = write("tum", given, tmp_path), str(tmp_path / "results")
    both = ["--fix-camera", "--refine-distortion"]
    cases = {
        "--refine-distortion cannot be combined with --fix-camera": ["--poses", str(poses), *both],
        "nothing.txt: cannot be read": ["--poses", str(tmp_path / "nothing.txt")],
        "neither images.bin": ["--poses", str(tmp_path)],
    }
    for message, arguments in cases.items():
        assert main(["refine", str(folder), "-o", output, *arguments]) == 2
        assert message in capsys.readouterr().err
    late = read_trajectory(poses)
    write_trajectory(tmp_path / "late.txt", Trajectory(late.timestamps + 1000, late.T_wc))
    assert main(["refine", str(folder), "-o", output, "--poses", str(tmp_path / "late.txt")]) == 2
    assert "are not those of the images" in capsys.readouterr().err


def test_images_without_a_map_are_reported(folder: Path, given: Tensor, tmp_path: Path) -> None:
    """The results say why, there are no refined poses, and the status is 3."""
    poses = write("tum", given, tmp_path)
    arguments = ["refine", str(folder), "--poses", str(poses), "-o", str(tmp_path / "results"), *FAST]
    assert main([*arguments, "--limit", "1"]) == 3
    assert "not enough" in json.loads((tmp_path / "results" / "metrics.json").read_text())["failure"]
    assert not (tmp_path / "results" / "refined").exists()


@pytest.mark.parametrize("kind", ["tum", "nerfstudio", "colmap"])
def test_poses_of_the_inverse_convention_are_refused_by_name(
    kind: str, folder: Path, truth: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of so few images, noisy poses would fit other conventions as well."""
    poses = write(kind, se3_inverse(truth), tmp_path)
    call = ["refine", str(folder), "--poses", str(poses), "-o", str(tmp_path / "a"), *FAST]
    assert main([*call, "--camera", "500,500,319.5,239.5"]) == 2
    other = "camera to world" if kind == "colmap" else "world to camera"
    assert f"% as {other}" in capsys.readouterr().err
    assert not (tmp_path / "a" / "refined").exists()


def test_poses_that_no_convention_fits_are_named(
    folder: Path, given: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = write("tum", given[[3, 0, 6, 1, 5, 2, 4, 7]], tmp_path)
    call = ["refine", str(folder), "--poses", str(poses), "-o", str(tmp_path / "a"), *FAST]
    assert main([*call, "--camera", "500,500,319.5,239.5"]) == 0
    assert "of the image pairs contradict the given poses, in every convention" in capsys.readouterr().err


def test_orientations_that_contradict_the_images_are_no_frame(
    folder: Path, given: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turns = torch.randn(FRAMES, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = write("tum", se3_exp(3 * turns) @ given, tmp_path)
    call = ["refine", str(folder), "--poses", str(poses), "-o", str(tmp_path / "a"), *FAST]
    assert main([*call, "--camera", "500,500,319.5,239.5"]) == 3
    assert "degrees off those that the images determine" in capsys.readouterr().err
    assert not (tmp_path / "a" / "refined").exists()
