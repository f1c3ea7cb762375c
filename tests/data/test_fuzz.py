"""Whatever a file holds, a reader returns something valid or raises its own error, in bounded time and memory.

`make fuzz` tries thirty times as many inputs, each in a process with limits.
"""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.__main__ import _outcomes
from tests.fuzz.inputs import clear, numbers, outcome
from tests.fuzz.readers import Reader, readers
from torchslam.data import parse_camera, read_calibration, read_trajectory
from torchslam.data.formats.image_file import read_gray
from torchslam.data.text_file import listed_files
from torchslam.errors import CalibrationError, FrameError, SequenceError, TrajectoryError

WORDS = st.one_of(
    st.floats(width=32).map(str),
    st.integers(-3, 3).map(str),
    st.text("ab#,.-e1\t", max_size=4),
    st.just("fisheye"),
)
LINES = st.lists(WORDS, max_size=10).map(" ".join)
FILES = st.lists(LINES, max_size=5).map("\n".join)
SAME_FOLDER = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@given(FILES)
@SAME_FOLDER
def test_trajectories(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with contextlib.suppress(TrajectoryError):
        trajectory = read_trajectory(tmp_path / "t.txt")
        assert trajectory.T_wc.isfinite().all()
        assert (trajectory.timestamps.diff() > 0).all()


@given(FILES)
@SAME_FOLDER
def test_image_lists(tmp_path: Path, text: str) -> None:
    (tmp_path / "rgb.txt").write_text(text)
    with contextlib.suppress(SequenceError):
        assert list(listed_files(tmp_path / "rgb.txt", SequenceError))


@given(LINES)
def test_calibrations(text: str) -> None:
    with contextlib.suppress(CalibrationError):
        camera = parse_camera(text, (64, 48))
        assert camera.params.isfinite().all()
        assert (camera.params[:2] > 0).all()


KEYS = (
    "camera_matrix",
    "intrinsics",
    "distortion_model",
    "data",
    "Camera.fx",
    "Camera.fy",
    "image_width",
    "fl_x",
    "w",
    "D",
)
VALUES = st.one_of(LINES, LINES.map("[{}]".format), st.just("\n  data: [1, 0, 2, 0, 3, 4, 0, 0, 1]"))
YAML = st.lists(st.tuples(st.sampled_from(KEYS), VALUES).map(": ".join), max_size=6).map("\n".join)
JSON = st.dictionaries(
    st.sampled_from(KEYS), st.one_of(st.floats(), st.integers(), st.text("ab1.", max_size=4), st.none())
).map(json.dumps)
COLMAP = LINES.map("1 OPENCV 64 48 {}".format)


@given(
    st.sampled_from(["a.yaml", "a.txt"]), st.one_of(YAML, JSON, COLMAP, FILES, FILES.map("<a>{}</a>".format))
)
@SAME_FOLDER
def test_calibration_files(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with contextlib.suppress(CalibrationError):
        calibration = read_calibration(tmp_path / name)
        camera = calibration.camera(calibration.size or (64, 48))
        assert camera.params.isfinite().all()
        assert (camera.params[:2] > 0).all()


@given(st.sampled_from([b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"BM"]), st.binary(max_size=200))
@SAME_FOLDER
def test_images(tmp_path: Path, start: bytes, rest: bytes) -> None:
    (tmp_path / "image").write_bytes(start + rest)
    with contextlib.suppress(FrameError):
        assert read_gray(tmp_path / "image", "here").shape[:2] == (1, 1)


def spin(root: Path) -> None:
    while True:
        sum(range(1000))


def spin_deaf(root: Path) -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGPROF, signal.SIGALRM])
    spin(root)


def sleep(root: Path) -> None:
    time.sleep(1.0)


def wait(root: Path) -> None:
    time.sleep(60.0)


@pytest.mark.parametrize(
    ("read", "patience", "verdict", "where"),
    [(spin, 0.2, "hang", "in spin"), (sleep, 0.4, "read", ""), (wait, 0.1, "hang", "in wait")],
)
def test_the_time_limit_is_cpu_time_and_a_hang_ends(
    tmp_path: Path, read: Callable[[Path], None], patience: float, verdict: str, where: str
) -> None:
    found = outcome(Reader("mine", lambda: {"a.txt": b"a"}, read, 1), 0, tmp_path, patience)
    assert found.verdict == verdict
    assert where in found.what
    assert signal.getitimer(signal.ITIMER_PROF) == signal.getitimer(signal.ITIMER_REAL) == (0, 0)


def test_a_process_that_ignores_signals_is_killed_and_the_next_input_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tests.fuzz.__main__.LOOK", 0.05)
    verdicts = dict(_outcomes(Reader("mine", lambda: {"a.txt": b"a"}, spin_deaf, 2), [0, 1], patience=0.2))
    assert [verdicts[number].verdict for number in (0, 1)] == ["hang", "hang"]
    verdicts = dict(_outcomes(Reader("mine", lambda: {"a.txt": b"a"}, sleep, 2), [0, 1], patience=0.4))
    assert [verdicts[number].verdict for number in (0, 1)] == ["read", "read"]


@pytest.mark.parametrize("name", readers())
def test_wrong_inputs_are_read_or_refused(tmp_path: Path, name: str) -> None:
    """Every thirtieth one of `python -m tests.fuzz`; `--only NAME:NUMBER` tries a single one."""
    reader = readers()[name]
    for number in numbers(reader.inputs, 1_000):
        found = outcome(reader, number, tmp_path)
        assert found.verdict in ("read", "refused"), f"{name}:{number}: {found.verdict}: {found.what}"
    clear(tmp_path)
