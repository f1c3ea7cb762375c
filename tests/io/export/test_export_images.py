from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.errors import FrameError, ResultsError
from torchslam.geometry import Camera
from torchslam.io.export.scene import ExportedScene, Undistorter, open_images, pinhole_within, write_images

FRAMES = 7


def picture(index: int, camera: Camera) -> np.ndarray:
    """Blue, green, red: different in every frame, smooth, so that a codec does it little harm."""
    y, x = np.mgrid[: camera.height, : camera.width]
    return np.stack((x % 256 // 2, 200 - y // 2, np.full_like(x, 30 * index)), axis=-1).astype(np.uint8)


@pytest.fixture
def seen(scene: ExportedScene) -> ExportedScene:
    """The scene with its frames at 10 Hz within a short sequence."""
    ids = torch.tensor((0, 2, 3, 6))
    return replace(scene, frame_ids=ids, timestamps=torch.arange(FRAMES).double()[ids] / 10.0)


@pytest.fixture
def folder(tmp_path: Path, lens: Camera) -> Path:
    """A TUM folder."""
    (tmp_path / "rgb").mkdir()
    lines = []
    for index in range(FRAMES):
        cv2.imwrite(str(tmp_path / "rgb" / f"{index}.png"), picture(index, lens))
        lines.append(f"{index / 10:.1f} rgb/{index}.png\n")
    (tmp_path / "rgb.txt").write_text("".join(lines))
    return tmp_path


def test_every_frame_gets_its_own_image(seen: ExportedScene, folder: Path, tmp_path: Path) -> None:
    images = open_images(str(folder), seen)
    (tmp_path / "out").mkdir()
    stale, unrelated = tmp_path / "out" / "000001.png", tmp_path / "out" / "holiday.png"
    for other in (stale, unrelated):
        other.write_bytes(b"")
    write_images(tmp_path / "out", seen, images)
    for index, name in zip(seen.frame_ids.tolist(), seen.image_names, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / name)), picture(index, seen.camera))
    assert not stale.exists()
    assert unrelated.exists()


def test_without_distortion(seen: ExportedScene, folder: Path) -> None:
    plain, flat = open_images(str(folder), seen), open_images(str(folder), seen, pinhole_within(seen.camera))
    expected = Undistorter(seen.camera)(plain.bgr(3)) if seen.camera.model != "pinhole" else plain.bgr(3)
    np.testing.assert_array_equal(flat.bgr(3), expected)
    assert (seen.camera.model == "pinhole") == np.array_equal(flat.bgr(3), plain.bgr(3))


def test_another_sequence_is_refused(seen: ExportedScene, folder: Path) -> None:
    later = replace(seen, timestamps=seen.frame_ids.double() / 10 + 0.01)
    with pytest.raises(ResultsError, match=r"not the sequence of this run.*--sequence"):
        open_images(str(folder), later)


def test_images_without_times_have_the_rate_of_the_run(seen: ExportedScene, folder: Path) -> None:
    images = str(folder / "rgb" / "*.png")
    np.testing.assert_array_equal(open_images(images, seen, fps=10.0).bgr(3), picture(3, seen.camera))
    with pytest.raises(ResultsError, match=r"other times"):
        open_images(images, seen)
    # thinned frames that begin elsewhere than the sequence does: their own times find them
    np.testing.assert_array_equal(open_images(str(folder), seen, fps=3.0).bgr(3), picture(3, seen.camera))


def test_frames_are_found_by_their_times(seen: ExportedScene, folder: Path) -> None:
    """The run may have begun later in the sequence."""
    part = replace(seen, frame_ids=seen.frame_ids - 2)
    np.testing.assert_array_equal(open_images(str(folder), part).bgr(1), picture(3, seen.camera))


def test_images_have_the_size_that_the_run_saw(seen: ExportedScene, folder: Path) -> None:
    half = Camera("pinhole", torch.tensor([100.0, 100, 40, 30]).double(), (seen.camera.width // 2, 60))
    image = open_images(str(folder), replace(seen, camera=half)).bgr(3)
    assert image.shape == (60, seen.camera.width // 2, 3)
    assert np.abs(image.mean((0, 1)) - picture(3, seen.camera).mean((0, 1))).max() < 1


def test_a_missing_sequence_is_named(seen: ExportedScene, tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"nowhere: does not exist; use --sequence.*--no-images"):
        open_images(str(tmp_path / "nowhere"), seen)


def test_a_video_has_colors_at_every_frame(seen: ExportedScene, tmp_path: Path) -> None:
    path = str(tmp_path / "film.avi")
    video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10.0, seen.camera.size)
    for index in range(FRAMES):
        video.write(picture(index, seen.camera))
    video.release()
    times = open_sequence(path).timestamps[seen.frame_ids]
    images = open_images(path, replace(seen, timestamps=times))
    for index in (3, 0, 6):  # backwards too
        assert np.abs(images.bgr(index).astype(int) - picture(index, seen.camera)).mean() < 4


def test_a_rendered_sequence_has_three_equal_channels() -> None:
    sequence = open_sequence("synthetic:room?frames=2&blank=1").part(1)
    assert sequence.color(0).shape == (480, 640, 3)
    assert sequence.color(0).unique().tolist() == [128]


def test_a_damaged_image_is_a_frame_error(seen: ExportedScene, folder: Path) -> None:
    sequence = open_sequence(folder, seen.camera)
    (folder / "rgb" / "3.png").write_bytes(b"not an image")
    with pytest.raises(FrameError, match=r"rgb\.txt:4"):
        sequence.color(3)
    cv2.imwrite(str(folder / "rgb" / "4.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(FrameError, match="10x10"):
        sequence.color(4)
