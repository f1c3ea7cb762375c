"""Parts, fewer frames, other sizes and masks of any sequence, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.data.transforms import scale_camera
from torchslam.errors import SequenceError
from torchslam.geometry.camera import Camera


def numbers(sequence) -> list[str]:
    return [Path(sequence.image_name(index)).stem for index in range(len(sequence))]


@pytest.mark.parametrize(
    ("options", "frames"),
    [
        ({"start": 1}, "1234"),
        ({"start": "2", "stop": "4"}, "23"),
        ({"start": "0.1s"}, "1234"),
        ({"start": "0.15s", "stop": "0:00.3"}, "2"),
        ({"stop": "0.3s"}, "012"),
        ({"stride": 2}, "024"),
        ({"start": 1, "stride": 2, "limit": 1}, "1"),
        ({"fps": 5}, "024"),
        ({"fps": 100}, "01234"),
        ({"start": 1, "fps": 5}, "13"),
    ],
)
def test_frames_are_selected(tum_folder: Callable[..., Path], options: dict, frames: str) -> None:
    sequence = open_sequence(tum_folder(), **options)
    assert numbers(sequence) == list(frames)
    assert [frame.timestamp for frame in sequence] == [1000 + int(number) / 10 for number in frames]
    poses = [float(frame.T_cw_groundtruth[0, 3]) for frame in sequence if frame.T_cw_groundtruth is not None]
    assert poses == pytest.approx([-int(number) / 10 for number in frames if int(number) < 4], abs=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": 5}, "no frames left of 5"),
        ({"start": "soon"}, "--start: expected a frame, as 120, or a time, as 12.5s or 1:30, got `soon`"),
        ({"stop": "-3"}, "--stop: expected"),
        ({"start": -1}, "must be at least 0"),
        ({"stride": 0}, "stride must be positive, not 0"),
        ({"limit": 0}, "no frames left of 5"),
        ({"fps": 0.0}, "frames per second must be positive"),
        ({"resize_to": "big"}, "--resize: expected 640x480, 640 or 0.5, got `big`"),
        ({"resize_to": "0.1"}, "at least 32 pixels each way"),
        ({"resize_to": "99999x99999"}, "at most"),
    ],
)
def test_wrong_options(tum_folder: Callable[..., Path], options: dict, message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        open_sequence(tum_folder(), **options)


@pytest.mark.parametrize(
    ("text", "size"),
    [("0.75", (48, 36)), ("48", (48, 36)), ("48x40", (48, 40)), ("2", (128, 96)), ("64x48", (64, 48))],
)
def test_resize(tum_folder: Callable[..., Path], text: str, size: tuple[int, int]) -> None:
    folder = tum_folder()
    whole, sequence = open_sequence(folder), open_sequence(folder, resize_to=text)
    assert sequence.size == sequence.camera.size == size
    assert sequence[0].image.shape == (1, 1, size[1], size[0])
    assert float(sequence[0].image.mean()) == pytest.approx(float(whole[0].image.mean()), abs=0.02)
    assert sequence.pose(2).equal(whole.pose(2))


def test_scaled_camera_sees_the_same_part_of_the_image() -> None:
    """Where a point lies, as a share of the image from its left edge, is the same at every size."""
    camera = Camera.radial_tangential(60, 61, 31, 24, -0.2, 0.05, 0.001, 0.002, size=(64, 48))
    smaller = scale_camera(camera, (32, 12))
    points = torch.tensor([[0.1, -0.2, 1.0], [-0.3, 0.25, 1.5]], dtype=torch.float64)
    share = (camera.project(points)[0] + 0.5) / torch.tensor([64, 48])
    torch.testing.assert_close((smaller.project(points)[0] + 0.5) / torch.tensor([32, 12]), share)


def test_mask_for_all_frames(tum_folder: Callable[..., Path], tmp_path: Path) -> None:
    mask = np.full((48, 64), 255, np.uint8)
    mask[24:, :32] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    sequence = open_sequence(tum_folder(), mask=tmp_path / "mask.png", start=1, resize_to="32x48")
    frame = sequence[1]
    assert frame.mask.shape == frame.image.shape
    assert frame.mask.dtype == torch.bool
    expected = torch.ones(1, 1, 48, 32, dtype=torch.bool)
    expected[..., 24:, :16] = False
    assert torch.equal(frame.mask, expected)
    assert open_sequence(tum_folder())[0].mask is None


def test_a_mask_per_frame(tum_folder: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for name, row in (("1.png", 10), ("3.png.png", 30)):
        mask = np.full((48, 64), 255, np.uint8)
        mask[row] = 0
        cv2.imwrite(str(tmp_path / "masks" / name), mask)
    sequence = open_sequence(tum_folder(), mask=tmp_path / "masks", stride=3, start=1)
    assert sequence.notes == ("masks for 2 of 5 frames",)
    assert sequence[0].mask[0, 0, :, 0].logical_not().nonzero().flatten().tolist() == [10]
    assert sequence[1].mask is None
    whole = open_sequence(tum_folder(), mask=tmp_path / "masks")
    assert whole[3].mask[0, 0, :, 0].logical_not().nonzero().flatten().tolist() == [30]


def test_masks_by_order(tum_folder: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for index in range(5):
        cv2.imwrite(
            str(tmp_path / "masks" / f"m{index + 8}.png"), np.full((48, 64), 255 * (index == 2), np.uint8)
        )
    sequence = open_sequence(tum_folder(), mask=tmp_path / "masks")
    assert [bool(frame.mask.any()) for frame in sequence] == [False, False, True, False, False]


def test_invalid_masks_are_rejected(tum_folder: Callable[..., Path], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((24, 32), np.uint8))
    with pytest.raises(SequenceError, match=r"small\.png: the mask is 32x24, the images are 64x48"):
        open_sequence(tum_folder(), mask=tmp_path / "small.png")
    with pytest.raises(SequenceError, match=r"--mask: .*nothing\.png cannot be read"):
        open_sequence(tum_folder(), mask=tmp_path / "nothing.png")
    with pytest.raises(SequenceError, match="none of its 1 images is the mask of a frame"):
        open_sequence(tum_folder(), mask=tmp_path)
