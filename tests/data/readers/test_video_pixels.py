"""Videos with interlaced frames, and with pixels that are not square."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from tests.data.interlaced import set_interlaced, set_wide, write_mpeg2
from tests.data.mp4 import write_mp4
from torchslam.data import Calibrated, Sequence, open_sequence
from torchslam.data.formats.calibration_files import parse_calibration
from torchslam.data.readers.live import LIVE
from torchslam.data.readers.video import pixel_aspect
from torchslam.errors import FrameError, SequenceError

COUNT = 6
CONVERTED = (
    "interlaced, which this OpenCV does not decode; convert it: "
    'ffmpeg -i "{}" -vf bwdif=send_frame -crf 16 "{}-progressive.mp4"'
)


def value(index: int) -> int:
    return 30 * index + 10


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Whole frames, each of its own brightness, and square pixels."""
    path = tmp_path / "clip.mkv"
    write_mpeg2(path, [np.full((48, 64, 3), value(index), np.uint8) for index in range(COUNT)])
    return path


def images_of(sequence: Sequence) -> list[torch.Tensor]:
    return [sequence.image(index) for index in range(len(sequence))]


def is_right(image: torch.Tensor, index: int) -> bool:
    return bool((255 * image - value(index)).abs().max() < 4)


def refusal(is_decoded: Callable[[], bool]) -> str:
    """The error of an OpenCV that does not decode interlaced frames; empty where what was decoded is right."""
    try:
        assert is_decoded()
    except (SequenceError, FrameError) as error:
        return str(error)
    return ""


def test_interlaced_frames_are_decoded_or_refused(clip: Path) -> None:
    """The frame that was converted last lies where the next one is converted to."""
    set_interlaced(
        clip, [False, False, True, True, False, False]
    )  # in the stream, frame 3 comes before 1 and 2
    sequence = open_sequence(clip)
    assert len(sequence) == COUNT
    order = (*range(COUNT), 3, 0, 2, 5)
    said = [refusal(lambda index=index: is_right(sequence.image(index), index)) for index in order]
    refused = [index for index, message in zip(order, said, strict=True) if message]
    assert refused in ([], [1, 2, 2])  # as this OpenCV is
    assert all(f"clip.mkv#{index}: interlaced" in said[index] for index in refused)


@pytest.mark.parametrize("suffix", ["mkv", "ts", "mpg", "avi"])
def test_a_video_of_interlaced_frames_is_decoded_or_refused(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"clip.{suffix}"
    write_mpeg2(path, [np.full((48, 64, 3), value(index), np.uint8) for index in range(COUNT)])
    images_of(open_sequence(path))  # pictures in memory that is freed
    set_interlaced(path, [True] * COUNT)
    capfd.readouterr()
    said = refusal(
        lambda: all(is_right(image, index) for index, image in enumerate(images_of(open_sequence(path))))
    )
    assert said in ("", f"{path}: {CONVERTED.format(path, 'clip')}")
    assert "swscaler" not in capfd.readouterr().err


def test_interlaced_h264() -> None:
    """Six frames of x264, `tff=1:interlaced=1`, as camcorders record it."""
    path = Path(__file__).parents[1] / "interlaced.mp4"
    means = [0.475, 0.480, 0.486, 0.489, 0.492, 0.493]
    said = refusal(
        lambda: (
            pytest.approx(means, abs=0.004)
            == [float(image.mean()) for image in images_of(open_sequence(path))]
        )
    )
    assert said in ("", f"{path}: {CONVERTED.format(path, 'interlaced')}")


def test_frames_that_repeat_are_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "still.mp4"
    write_mp4(path, [np.full((48, 64, 3), value(index // 3), np.uint8) for index in range(6)])
    sequence = open_sequence(path)
    assert all(abs(255 * float(sequence.image(i).mean()) - value(i // 3)) < 4 for i in range(6))
    assert capfd.readouterr().err == ""


def test_a_stream_of_interlaced_frames_is_decoded_or_refused(clip: Path) -> None:
    set_interlaced(clip, [True] * COUNT)
    said = refusal(lambda: is_right(LIVE.open(str(clip), None, None).image(0), 0))
    assert said == "" or "interlaced" in said


@pytest.mark.parametrize("variable", ["OPENCV_FFMPEG_DEBUG=1", "OPENCV_FFMPEG_LOGLEVEL=-8"])
def test_a_silenced_log_hides_nothing(variable: str) -> None:
    path = Path(__file__).parents[1] / "interlaced.mp4"
    code = (
        "import os; from torchslam.data import open_sequence; from torchslam.errors import SequenceError\n"
        f"try: said = str(float(open_sequence({str(path)!r}).image(0).mean()))\n"
        "except SequenceError as error: said = str(error)\n"
        "print(os.environ['{}'], said)".format(variable.partition("=")[0])
    )
    name, _, value = variable.partition("=")
    command = [sys.executable, "-c", code]
    said = subprocess.run(
        command, capture_output=True, check=True, env=os.environ | {name: value}
    ).stdout.decode()
    assert said.startswith(value)
    assert "interlaced" in said or float(said.split()[1]) == pytest.approx(0.475, abs=0.004)


def test_videos_are_read_where_the_error_stream_is_closed(clip: Path) -> None:
    set_interlaced(clip, [False] * (COUNT - 1) + [True])
    code = (
        "import os; os.close(2)\nfrom torchslam.data import open_sequence\n"
        f"print(float(open_sequence({str(clip)!r}).image(1).mean()))"
    )
    said = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True).stdout
    assert abs(255 * float(said) - value(1)) < 4


def test_pixels_that_are_not_square(clip: Path) -> None:
    """A picture of 64 x 48 pixels that is shown 16:9: each is a third wider than high."""
    assert open_sequence(clip).pixel_aspect == 1.0
    set_wide(clip)
    unknown = open_sequence(clip)
    assert unknown.pixel_aspect == pytest.approx(4 / 3)
    assert unknown.describe()["size"] == "64x48, pixels of 4:3, wide to high"
    assert unknown.with_guess().camera.params.tolist() == pytest.approx([54.4, 54.4 * 4 / 3, 31.5, 23.5])
    guessed = open_sequence(clip, "fov=90")
    assert guessed.calibrated is Calibrated.GUESSED
    assert guessed.camera.params.tolist() == pytest.approx([32, 32 * 4 / 3, 31.5, 23.5])
    smaller = open_sequence(clip, "fov=90", resize_to="64x36")
    assert smaller.pixel_aspect == pytest.approx(1.0)
    assert smaller.camera.params.tolist() == pytest.approx([32, 32, 31.5, 17.5])


def test_turned_pixels_that_are_not_square() -> None:
    properties = {cv2.CAP_PROP_SAR_NUM: 4.0, cv2.CAP_PROP_SAR_DEN: 3.0}
    capture = SimpleNamespace(get=lambda which: properties.get(which, 0.0))
    assert pixel_aspect(capture, "v.mp4") == pytest.approx(4 / 3)
    properties[cv2.CAP_PROP_ORIENTATION_META] = 90.0
    assert pixel_aspect(capture, "v.mp4") == pytest.approx(3 / 4)
    properties[cv2.CAP_PROP_SAR_NUM] = 1000.0
    with pytest.raises(SequenceError, match=r"v\.mp4: damaged: its pixels are 1000:3, wide to high"):
        pixel_aspect(capture, "v.mp4")


def test_a_stream_of_pixels_that_are_not_square(clip: Path) -> None:
    set_wide(clip)
    stream = LIVE.open(str(clip), parse_calibration("fov=90"), None)
    assert stream.camera.params.tolist() == pytest.approx([32, 32 * 4 / 3, 31.5, 23.5])
    assert stream.describe()["size"] == "64x48, pixels of 4:3, wide to high"


def test_a_given_camera_that_contradicts_the_pixels_is_kept_and_named(clip: Path) -> None:
    set_wide(clip)
    assert open_sequence(clip, "60,80,31.5,23.5").notes == ()
    contradicting = open_sequence(clip, "60,60,31.5,23.5")
    assert contradicting.camera.params.tolist() == [60, 60, 31.5, 23.5]
    (note,) = contradicting.notes
    assert note == (
        "the file declares pixels of 4:3, width to height, so fy should be 1.333 fx; the given camera has 1"
    )


def test_resizing_to_another_shape_makes_pixels_that_are_not_square(clip: Path) -> None:
    squeezed = open_sequence(clip, resize_to="32x48")
    assert squeezed.pixel_aspect == 2.0
    assert squeezed.with_guess().camera.params.tolist() == pytest.approx([27.2, 54.4, 15.5, 23.5])
    assert open_sequence(clip, resize_to="0.75").pixel_aspect == 1.0
    assert open_sequence(clip, stride=2).pixel_aspect == 1.0


def test_a_name_with_a_colon(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """FFmpeg would take what stands before the colon for a protocol."""
    named = clip.with_name("2024-05-01T12:30:05.mkv")
    clip.rename(named)
    monkeypatch.chdir(named.parent)
    for path in (named.name, f"./{named.name}", named):
        sequence = open_sequence(path)
        assert (sequence.name, len(sequence)) == ("2024-05-01T12:30:05", COUNT)
        assert is_right(sequence.image(2), 2)


def test_a_name_that_is_not_utf8(clip: Path) -> None:
    """OpenCV would crash."""
    named = clip.with_name(os.fsdecode(b"clip\xff.mkv"))
    clip.rename(named)
    with pytest.raises(SequenceError, match="its name is not UTF-8, which OpenCV cannot open; rename it"):
        open_sequence(named)
