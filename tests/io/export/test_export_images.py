from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.io.export.scene import (
    ExampleFrame,
    ExportedScene,
    ImageSource,
    Undistorter,
    open_images,
    pinhole_within,
    write_images,
)

FRAMES = 7


FILES = {index: f"{index}.png" for index in range(FRAMES)}


def source(path: Path | str, **options: object) -> ImageSource:
    """Where the images of `folder` are."""
    return ImageSource(str(path), **{"files": FILES} | options)  # type: ignore[arg-type]


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
    images = open_images(source(folder), seen)
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
    plain, flat = (
        open_images(source(folder), seen),
        open_images(source(folder), seen, pinhole_within(seen.camera)),
    )
    expected = Undistorter(seen.camera)(plain.bgr(3)) if seen.camera.model != "pinhole" else plain.bgr(3)
    np.testing.assert_array_equal(flat.bgr(3), expected)
    assert (seen.camera.model == "pinhole") == np.array_equal(flat.bgr(3), plain.bgr(3))


def test_frames_of_a_video_are_found_by_their_times(
    seen: ExportedScene, folder: Path, tmp_path: Path
) -> None:
    later = replace(seen, timestamps=seen.frame_ids.double() / 10 + 0.01)
    with pytest.raises(ResultsError, match=r"not the sequence of this run.*other times.*--sequence"):
        open_images(ImageSource(film(tmp_path, seen.camera)), later)


def test_images_are_found_by_their_names(seen: ExportedScene, folder: Path) -> None:
    """Also after one of them was deleted, in another folder, as another kind of file, or with other times."""
    (folder / "rgb" / "1.png").unlink()
    (folder / "moved").mkdir()
    for name in ("3", "0", "2", "6"):
        (folder / "rgb" / f"{name}.png").rename(folder / "moved" / f"{name}.png")
    for path in (folder / "moved", folder / "moved" / "*.png"):
        images = open_images(source(path, fps=5.0), seen)
        for index in (0, 2, 3, 6):
            np.testing.assert_array_equal(images.bgr(index), picture(index, seen.camera))
    cv2.imwrite(str(folder / "moved" / "3.bmp"), picture(3, seen.camera))
    for name in ("0", "2", "6"):
        cv2.imwrite(str(folder / "moved" / f"{name}.bmp"), picture(int(name), seen.camera))
    np.testing.assert_array_equal(
        open_images(source(folder / "moved" / "*.bmp"), seen).bgr(3), picture(3, seen.camera)
    )


def test_a_missing_image_is_named(seen: ExportedScene, folder: Path) -> None:
    (folder / "rgb" / "2.png").unlink()
    with pytest.raises(ResultsError, match=r"rgb: 1 of 4 images .* missing, the first .* 2, 2\.png; use"):
        open_images(source(folder / "rgb"), seen)


def test_times_that_were_counted_find_no_images(seen: ExportedScene, folder: Path, tmp_path: Path) -> None:
    """Results of earlier versions, and frames that are files in one of run and sequence alone."""
    with pytest.raises(ResultsError, match=r"do not state the image of each frame: run again"):
        open_images(ImageSource(str(folder / "rgb"), fps=10.0), seen)
    with pytest.raises(ResultsError, match=r"film\.avi: not the sequence .* files such as 0\.png"):
        open_images(source(film(tmp_path, seen.camera)), seen)


def textured(index: int, camera: Camera) -> np.ndarray:
    """As a camera sees it that turns by 5 pixels a frame."""
    noise = np.random.default_rng(1).integers(0, 256, (camera.height // 4, camera.width // 4), np.uint8)
    large = cv2.resize(noise, camera.size, interpolation=cv2.INTER_CUBIC)
    return np.repeat(np.roll(large, 5 * index, axis=1)[..., None], 3, axis=2)


def test_files_that_were_overwritten_are_noticed(seen: ExportedScene, folder: Path) -> None:
    """By the one image that is kept with the results; brightness, contrast and codec do not matter."""
    for index in range(FRAMES):
        cv2.imwrite(str(folder / "rgb" / f"{index}.png"), textured(index, seen.camera))
    gray = torch.from_numpy(textured(3, seen.camera)[..., 0] / 255.0).float()[None, None]
    kept = source(folder / "rgb", example=ExampleFrame(3, 0.3, 0.2 + 0.5 * gray))
    np.testing.assert_array_equal(open_images(kept, seen).bgr(3), textured(3, seen.camera))
    cv2.imwrite(str(folder / "rgb" / "3.png"), textured(4, seen.camera))
    with pytest.raises(ResultsError, match=r"frame 3 shows something else than it did"):
        open_images(kept, seen)
    blank = torch.full_like(gray, 0.5)
    cv2.imwrite(str(folder / "rgb" / "3.png"), np.full_like(textured(3, seen.camera), 130))
    open_images(replace(kept, example=ExampleFrame(3, 0.3, blank)), seen)


def test_images_have_the_size_that_the_run_saw(seen: ExportedScene, folder: Path) -> None:
    half = Camera("pinhole", torch.tensor([100.0, 100, 40, 30]).double(), (seen.camera.width // 2, 60))
    image = open_images(source(folder), replace(seen, camera=half)).bgr(3)
    assert image.shape == (60, seen.camera.width // 2, 3)
    assert np.abs(image.mean((0, 1)) - picture(3, seen.camera).mean((0, 1))).max() < 1


def test_a_missing_sequence_is_named(seen: ExportedScene, tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"nowhere: does not exist; use --sequence.*--no-images"):
        open_images(source(tmp_path / "nowhere"), seen)


def film(folder: Path, camera: Camera) -> str:
    path = str(folder / "film.avi")
    video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10.0, camera.size)
    for index in range(FRAMES):
        video.write(picture(index, camera))
    video.release()
    return path


def test_a_video_has_colors_at_every_frame(seen: ExportedScene, tmp_path: Path) -> None:
    path = film(tmp_path, seen.camera)
    times = open_sequence(path).timestamps[seen.frame_ids]
    images = open_images(ImageSource(path), replace(seen, timestamps=times))
    for index in (3, 0, 6):  # backwards too
        assert np.abs(images.bgr(index).astype(int) - picture(index, seen.camera)).mean() < 4
