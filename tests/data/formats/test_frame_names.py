"""Frames by their names: cameras that share a folder, and numbers that only count."""

from __future__ import annotations

import fnmatch
from pathlib import Path

import pytest

from torchslam.data.formats.frame_names import find_frames
from torchslam.errors import SequenceError


def _touch(folder: Path, pattern: str, *numbers: range) -> None:
    for first in numbers[0]:
        for second in numbers[1]:
            (folder / pattern.format(first, second)).touch()


@pytest.mark.parametrize(
    ("pattern", "numbers"),
    [
        ("cam{}_{:04d}.png", (range(2), range(5))),
        ("{1:06d}_cam{0}.jpg", (range(2), range(5))),
        ("image_0{}_{:010d}.png", (range(4), range(3))),
        ("{}-{:05d}.png", (range(2), range(300))),
        ("{1:06d}_{0}.png", (range(10, 12), range(300))),
    ],
)
def test_images_of_several_cameras_are_not_one_recording(
    tmp_path: Path, pattern: str, numbers: tuple[range, range]
) -> None:
    _touch(tmp_path, pattern, *numbers)
    with pytest.raises(SequenceError, match="count alike; which one") as error:
        find_frames(tmp_path)
    globs = str(error.value).split("'")[1::2]
    assert len(globs) == len(numbers[0])
    parts = [find_frames(tmp_path, Path(glob).name).frames for glob in globs]
    assert [len(part) for part in parts] == [len(numbers[1])] * len(globs)
    assert all(
        fnmatch.fnmatch(str(file), glob) for glob, part in zip(globs, parts, strict=True) for file in part
    )


def test_cameras_with_clocks_of_their_own_are_not_one_recording(tmp_path: Path) -> None:
    for camera in range(2):
        _touch(tmp_path, f"cam{camera}_{{}}{{}}.png", range(1, 4), range(camera, 9, 2))
    with pytest.raises(SequenceError, match=r"cam0_\*\.png' or '.*cam1_\*\.png'"):
        find_frames(tmp_path)


@pytest.mark.parametrize(
    ("pattern", "numbers"),
    [
        ("{}_{:02d}.png", (range(5), range(30))),  # second and frame
        ("frame_{}_{}.png", (range(3), range(60))),  # minute and second
        ("cam0_{}{}.png", (range(1, 3), range(5))),  # one camera
    ],
)
def test_numbers_that_only_count_are_one_recording(
    tmp_path: Path, pattern: str, numbers: tuple[range, range]
) -> None:
    _touch(tmp_path, pattern, *numbers)
    assert len(find_frames(tmp_path).frames) == len(numbers[0]) * len(numbers[1])


def test_parts_that_follow_each_other_are_one_recording(tmp_path: Path) -> None:
    _touch(tmp_path, "cam{}_{}.png", range(1), range(5))
    _touch(tmp_path, "cam{}_{}.png", range(1, 2), range(5, 10))
    assert len(find_frames(tmp_path).frames) == 10
