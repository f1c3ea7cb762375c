"""ETH3D and TUM folders: what is read, and what every kind of damage leads to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.errors import CalibrationError, FrameError, SequenceError, TrajectoryError

Folder = Callable[..., Path]


def test_reads_frames_camera_and_groundtruth(tum_folder: Folder) -> None:
    folder = tum_folder()
    sequence = open_sequence(folder)
    assert (len(sequence), sequence.name, sequence.size) == (5, "sequence", (64, 48))
    assert sequence.frame_rate == pytest.approx(10.0)
    assert sequence.camera.model == "pinhole"
    assert sequence.camera.params.tolist() == [60.0, 61.0, 31.5, 23.5]
    assert sequence.groundtruth is not None
    assert len(sequence.groundtruth) == 7

    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, 1000.2)
    assert frame.image.shape == (1, 1, 48, 64)
    assert frame.image.dtype == torch.float32
    gray = cv2.imread(str(folder / "rgb" / "2.png"), cv2.IMREAD_GRAYSCALE)
    assert torch.equal(frame.image[0, 0], torch.from_numpy(gray).float() / 255)
    assert frame.T_cw_groundtruth is not None
    torch.testing.assert_close(frame.T_cw_groundtruth[:3, 3], torch.tensor([-0.2, 0, 0], dtype=torch.float64))


def test_groundtruth_is_optional(tum_folder: Folder) -> None:
    folder = tum_folder()
    assert [frame.T_cw_groundtruth is not None for frame in open_sequence(folder)] == [True] * 4 + [False]
    (folder / "groundtruth.txt").unlink()
    sequence = open_sequence(folder)
    assert sequence.groundtruth is None
    assert sequence[0].T_cw_groundtruth is None


def test_part_is_renumbered_and_keeps_its_poses(tum_folder: Folder) -> None:
    sequence = open_sequence(tum_folder(), limit=2, stride=2)
    whole = open_sequence(tum_folder())
    assert len(sequence) == 2
    assert [frame.index for frame in sequence] == [0, 1]
    assert torch.equal(sequence[1].image, whole[2].image)
    assert torch.equal(sequence[1].T_cw_groundtruth, whole[2].T_cw_groundtruth)
    assert sequence.frame_rate == pytest.approx(5.0)


def test_negative_index_counts_from_the_end(tum_folder: Folder) -> None:
    sequence = open_sequence(tum_folder())
    assert sequence[-1].index == 4
    with pytest.raises(IndexError, match="frame 5 of 5"):
        sequence[5]


def test_describe_names_the_sequence(tum_folder: Folder) -> None:
    described = open_sequence(tum_folder()).describe()
    assert described["frames"] == "5"
    assert described["size"] == "64x48"
    assert "60 61 31.5 23.5" in described["camera"]
    assert described["ground truth"] == "7 poses, 0.30 m, for 4 of 5 frames"


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".pgm"])
def test_truncated_image_names_list_and_line(tum_folder: Folder, suffix: str) -> None:
    folder = tum_folder(suffix)
    image = folder / "rgb" / f"3{suffix}"
    data = image.read_bytes()
    sequence = open_sequence(folder)
    for length in (0, 20, len(data) // 2, len(data) - 12):
        image.write_bytes(data[:length])
        with pytest.raises(FrameError, match=r"rgb\.txt:6: .*3\.\w+ is (truncated|not an image)"):
            sequence[3]


@pytest.mark.parametrize("index", [0, 3])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path, _: path.unlink(), "cannot be read: No such file"),
        (lambda path, _: path.write_text("<html>404</html>"), "not an image"),
        (lambda path, write: write(path, size=(32, 48)), "is 32x48, the others are 64x48"),
    ],
)
def test_a_wrong_image_names_list_and_line(
    tum_folder: Folder, write_picture: Callable, index: int, damage: Callable, message: str
) -> None:
    folder = tum_folder()
    damage(folder / "rgb" / f"{index}.png", write_picture)
    sequence = open_sequence(folder)  # the size is that of the others
    assert sequence.size == (64, 48)
    with pytest.raises(FrameError, match=rf"rgb\.txt:{index + 3}: .*{index}\.png .*{message}"):
        sequence[index]
    assert sequence[2].index == 2  # the others are still there


def test_no_images_at_all(tum_folder: Folder) -> None:
    folder = tum_folder()
    for image in (folder / "rgb").iterdir():
        image.unlink()
    with pytest.raises(SequenceError, match="none of the first 5 images can be read"):
        open_sequence(folder)
    (folder / "rgb.txt").write_text("# timestamp filename\n\n")
    with pytest.raises(SequenceError, match=r"rgb\.txt: no files are listed"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1000.1 rgb/2.png", "repeats the one before"),
        ("1000.05 rgb/2.png", "is earlier than the one before"),
        ("nan rgb/2.png", "`nan` is not a finite number"),
        ("rgb/2.png", "expected `timestamp file`"),
        ("1000.2", "expected `timestamp file`"),
    ],
)
def test_bad_line_of_the_list(tum_folder: Folder, line: str, message: str) -> None:
    folder = tum_folder()
    lines = (folder / "rgb.txt").read_text().splitlines()
    lines[4] = line
    (folder / "rgb.txt").write_text("\n".join(lines))
    with pytest.raises(SequenceError, match=rf"rgb\.txt:5: .*{message}"):
        open_sequence(folder)


def test_names_with_spaces_and_hashes(tum_folder: Folder, write_picture: Callable) -> None:
    folder = tum_folder()
    image = write_picture(folder / "my images" / "a b#1.png", 7)
    (folder / "rgb.txt").write_text("1.0 my images/a b#1.png # a comment\n")
    assert torch.equal(open_sequence(folder)[0].image[0, 0], torch.from_numpy(image).float() / 255)


def test_a_missing_calibration_is_reported(tum_folder: Folder) -> None:
    folder = tum_folder(calibration=None)
    with pytest.raises(CalibrationError, match="--camera fx,fy,cx,cy"):
        _ = open_sequence(folder).camera
    assert open_sequence(folder, camera="70,70,32,24").camera.params.tolist() == [70.0, 70.0, 32.0, 24.0]
    (folder / "calib.txt").write_text("60 61 31.5 23.5")  # its other name
    assert float(open_sequence(folder).camera.fy) == 61.0


def test_camera_of_another_size(tum_folder: Folder) -> None:
    folder = tum_folder()
    camera = open_sequence(folder).camera
    other = type(camera).pinhole(60, 61, 31.5, 23.5, size=(128, 96))
    assert open_sequence(folder, camera=camera).camera is camera
    with pytest.raises(CalibrationError, match="128x96, these are 64x48"):
        open_sequence(folder, camera=other)


def test_bad_groundtruth_names_file_and_line(tum_folder: Folder) -> None:
    folder = tum_folder()
    with (folder / "groundtruth.txt").open("a") as file:
        file.write("1002 0 0 0 0 0 0 nan\n")
    with pytest.raises(TrajectoryError, match=r"groundtruth\.txt:9: `nan` is not a finite number"):
        open_sequence(folder)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "frames", "size", "model", "poses"),
    [
        ("redkitchen", 1000, (640, 480), "pinhole", 1000),
        ("kitti07", 160, (1226, 370), "pinhole", 160),
        ("machine_hall", 320, (752, 480), "radial_tangential", 3430),
        ("fr2_desk_20", 20, (640, 480), "radial_tangential", 1166),
        ("shelf_bin", 50, (640, 480), "pinhole", 50),
        ("standstill", 40, (752, 480), "radial_tangential", None),
    ],
)
def test_real_sequences(
    data_dir: Path, name: str, frames: int, size: tuple[int, int], model: str, poses: int | None
) -> None:
    sequence = open_sequence(data_dir / name)
    assert (len(sequence), sequence.size, sequence.camera.model) == (frames, size, model)
    assert (None if sequence.groundtruth is None else len(sequence.groundtruth)) == poses
    for index in (0, frames // 2, frames - 1):
        frame = sequence[index]
        assert frame.image.shape == (1, 1, size[1], size[0])
        assert (frame.T_cw_groundtruth is not None) == (poses is not None)


@pytest.mark.parametrize("parts", [1, 10**3, 10**6, 10**9])
def test_times_since_1970_are_converted(tum_folder: Folder, parts: int) -> None:
    """As images and poses have them: the poses of ORB-SLAM3 are in nanoseconds where the list is not."""
    folder, start = tum_folder(), 1403636579
    frames = [f"{start * parts + index * parts // 10} rgb/{index}.png\n" for index in range(5)]
    if parts == 1:
        frames = [f"{start}.{index} rgb/{index}.png\n" for index in range(5)]
    (folder / "rgb.txt").write_text("".join(frames))
    poses = [f"{(start * 10 + index) * 10**8}.000000 {index} 0 0 0 0 0 1\n" for index in range(5)]
    (folder / "groundtruth.txt").write_text("".join(poses))
    sequence = open_sequence(folder)
    torch.testing.assert_close(sequence.timestamps, start + torch.arange(5).double() / 10, rtol=0, atol=1e-6)
    torch.testing.assert_close(sequence.pose(3)[:3, 3].double(), torch.tensor([-3.0, 0, 0]).double())


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([1.2e11, 1.3e11, 1.4e11], r"rgb\.txt:1: timestamp 1.2e\+11: times are seconds"),  # since the start
        ([-1e18, 1, 2], r"rgb\.txt:1: timestamp -1e\+18"),
        ([0, 33e6, 66e6, 99e6], r"rgb\.txt:4: the images are 3.3e\+07 s apart"),
        ([0, 33e-6, 66e-6, 99e-6], r"rgb\.txt:4: the images are 3.3e-05 s apart"),
    ],
)
def test_times_of_another_unit_are_refused(tum_folder: Folder, times: list[float], message: str) -> None:
    folder = tum_folder()
    (folder / "rgb.txt").write_text("".join(f"{time} rgb/{row}.png\n" for row, time in enumerate(times)))
    with pytest.raises(SequenceError, match=message):
        open_sequence(folder)
