"""Runs of a folder: their queue, state and names, and what a record may say; no browser, and no viewer."""

from __future__ import annotations

import ast
import json
import os
import signal
import string
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.app.conftest import wait_until
from torchslam.app import jobs
from torchslam.app.exports import command_and_python, write_export, zip_folder
from torchslam.app.jobs import DEMO, LOCK, LOG, RECORD, Record, Runs, State
from torchslam.app.options import check_arguments
from torchslam.config import load_config
from torchslam.errors import ConfigError, ResultsError
from torchslam.io.file_names import CHECKPOINT, METRICS
from torchslam.metric.distances import Distances
from torchslam.metric.options import given_options, sources_of

SLEEPS = """
import time
print('torchslam: begun', flush=True)
try:
    time.sleep(60)
except KeyboardInterrupt:
    print('torchslam: interrupted', flush=True)
"""


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runs:
    """Runs whose process is a stand-in that sleeps."""
    real = subprocess.Popen
    monkeypatch.setattr(
        jobs.subprocess, "Popen", lambda words, **options: real([sys.executable, "-c", SLEEPS], **options)
    )
    return Runs(tmp_path / "results", max_runs=4)


def test_one_run_goes_on_at_a_time_and_the_next_follows(runs: Runs) -> None:
    first, second = runs.add("first", DEMO, ()), runs.add("second", DEMO, ("--dense",))
    runs.advance()
    wait_until(lambda: "begun" in "".join(jobs.log_tail(runs.path(first))))
    assert (runs.state(first), runs.state(second), runs.running()) == (State.RUNNING, State.QUEUED, first)
    with pytest.raises(ResultsError, match="stop it first"):
        runs.delete(first)
    runs.stop(first)
    wait_until(lambda: runs.state(first) is not State.RUNNING)
    runs.advance()
    assert runs.state(first) is State.STOPPED
    assert runs.running() == second
    runs.stop(second)
    runs.resume(first)
    assert runs.state(first) is State.QUEUED
    runs.stop(first)
    assert runs.state(first) is State.STOPPED
    wait_until(lambda: runs.running() is None)
    runs.delete(first)
    assert first not in runs.names()


def test_a_run_is_queued_until_its_process_holds_the_lock(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, real, seen = runs.add("walk.mp4", DEMO), jobs.subprocess.Popen, list[State]()

    def begin(words: list[str], **options: Any) -> subprocess.Popen[bytes]:
        seen.append(runs.state(name))
        return real(words, **options)

    with monkeypatch.context() as patched:
        patched.setattr(jobs.subprocess, "Popen", begin)
        patched.setattr(jobs, "is_held", lambda path: False)  # who looks just before the lock is taken
        runs.advance()
    assert seen == [State.QUEUED]
    assert runs.state(name) is State.RUNNING
    runs.stop(name)


def test_another_server_finds_a_run_that_goes_on_and_keeps_what_has_ended(runs: Runs) -> None:
    name = runs.add("walk.mp4", DEMO, ())
    runs.advance()
    again = Runs(runs.folder)
    assert again.state(name) is State.RUNNING
    again.advance()  # starts no second one
    again.stop(name)
    wait_until(lambda: again.state(name) is not State.RUNNING)
    assert again.state(name) is State.STOPPED
    path = runs.path(name)
    (path / METRICS).write_text("{}")
    assert again.state(name) is State.DONE
    (path / CHECKPOINT).write_bytes(b"")
    assert again.state(name) is State.STOPPED  # the results so far, and a checkpoint to go on from
    runs.advance()


def test_a_run_that_crashed_is_failed(runs: Runs) -> None:
    name = runs.add("x", DEMO)
    runs.advance()
    wait_until(lambda: "begun" in "".join(jobs.log_tail(runs.path(name))))
    os.kill(int((runs.path(name) / LOCK).read_text()), signal.SIGKILL)
    wait_until(lambda: runs.running() is None)
    assert runs.state(name) is State.FAILED
    assert 0 <= runs.seconds(name) < 60
    runs.resume(name)
    assert runs.state(name) is State.QUEUED


def test_the_number_of_runs_is_limited(runs: Runs) -> None:
    for number in range(4):
        runs.add(f"{number}", DEMO, ())
    with pytest.raises(ResultsError, match="--max-runs"):
        runs.add("5", DEMO, ())


def test_a_run_whose_files_cannot_be_copied_is_not_added_and_its_upload_stays(
    runs: Runs, tmp_path: Path
) -> None:
    upload, folder = tmp_path / "input.mp4", tmp_path / "gps"
    upload.write_bytes(b"x")
    folder.mkdir()
    for wrong in (folder, tmp_path / "missing.csv"):
        with pytest.raises(OSError, match=wrong.name):
            runs.add("walk.mp4", "", (), upload, [wrong])
        assert upload.exists()
        assert not list(runs.folder.iterdir())
    assert (runs.path(runs.add("walk.mp4", "", (), upload)) / "input.mp4").exists()


def test_only_names_of_runs_are_accepted(runs: Runs, tmp_path: Path) -> None:
    (tmp_path / METRICS).write_text("{}")  # the parent folder looks like a run
    (runs.folder / "video.mp4").write_bytes(b"x")
    (runs.folder / "link").symlink_to(tmp_path)
    (runs.folder / "outside.mp4").symlink_to("/etc/passwd")
    for name in ("..", ".", "", "/", "/etc", "link", "../results", "a/b", "video.mp4", "x\0y", "\ud800"):
        with pytest.raises(ResultsError):
            runs.path(name)
    assert runs.recordings() == ["video.mp4"]


@given(st.text(max_size=300))
def test_a_stored_name_has_nothing_of_the_name_but_a_plain_suffix(name: str) -> None:
    stored = jobs.stored_name(name)
    assert set(stored) <= set(string.ascii_lowercase + string.digits + ".")
    assert stored.startswith("input")
    assert stored.count(".") <= 1
    assert len(stored) < 20
    title = jobs.shown(name)
    assert title.isprintable()
    assert len(title) <= jobs.MAX_TITLE
    assert set(jobs.slug(name)) <= set(string.ascii_lowercase + string.digits + "-")
    assert jobs.slug(name)


@pytest.mark.parametrize(
    "arguments",
    [
        ("--features", "evil:code"),
        ("--set", "features.kind=evil:code"),
        ("--set", "features.weights=../../secret"),
        ("--set", "features.num_keypoints=many"),
        ("--camera", "/etc/passwd"),
        ("--camera", "../other/calibration.txt"),
        ("--camera", "--overwrite"),
        ("--gps", ".."),
        ("--output", "elsewhere"),
        ("--stride", "1;rm"),
        ("--mapping",),
    ],
)
def test_a_record_from_elsewhere_cannot_read_outside_or_run_code(
    runs: Runs, arguments: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigError):
        check_arguments(arguments)
    name = runs.add("x", DEMO, ())
    jobs.write_record(runs.path(name), Record("x", DEMO, arguments))
    with pytest.raises(ConfigError):
        runs.advance()
    assert runs.state(name) is State.FAILED  # and the queue goes on
    runs.advance()


@pytest.mark.parametrize(
    "source", ["/etc/passwd", "../secret.mp4", "", "rtsp://host/x", "0", "link.mp4", "missing.mp4"]
)
def test_a_record_from_elsewhere_runs_nothing_outside_of_the_folder(
    runs: Runs, tmp_path: Path, source: str
) -> None:
    (tmp_path / "secret.mp4").write_bytes(b"x")
    name = runs.add("x", DEMO, ())
    (runs.folder / "link.mp4").symlink_to(tmp_path / "secret.mp4")
    jobs.write_record(runs.path(name), Record("x", source))
    with pytest.raises(ResultsError, match="not in the folder"):
        runs.command(name)


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"title": 1}', '{"title": "a", "source": "b", "arguments": 3}', "null"]
)
def test_a_damaged_record_is_named_and_ends_nothing(runs: Runs, content: str) -> None:
    name = runs.add("x", DEMO, ())
    (runs.path(name) / RECORD).write_text(content)
    assert "damaged" in runs.record(name).title
    assert runs.state(name) is State.QUEUED
    with pytest.raises(ResultsError, match="not in the folder"):
        runs.advance()
    assert runs.state(name) is State.FAILED


def test_progress_and_messages_are_read_from_the_log(tmp_path: Path) -> None:
    lines = [
        "torchslam: camera: 500 px",
        "frames",
        "12/160 |##      | 30.1 frames/s, 00:05 left, tracking, 900 points",
    ]
    (tmp_path / LOG).write_text("\n".join(["\x1b[31mred", *lines]))
    log = jobs.log_tail(tmp_path)
    assert jobs.progress_of(log) == ("12/160 · 30.1 frames/s, 00:05 left, tracking, 900 points", 12 / 160)
    assert jobs.progress_of(["adjusting |# | iteration 3 of at most 30, 00:01"])[1] == 0.1
    assert jobs.progress_of(["torchslam: warning: 3/4 | x"]) == ("", 0.0)
    assert "\x1b" not in "".join(log)


def test_the_message_of_a_reader_names_the_file_as_the_user_does(tmp_path: Path) -> None:
    path = tmp_path / "input.txt"
    path.write_text("x")
    with pytest.raises(ResultsError, match="neither a video") as refused:
        jobs.tool(["info", str(path)])
    message = str(refused.value)
    assert jobs.without_paths(message, tmp_path, "holiday.txt").startswith("holiday.txt: ")
    assert jobs.without_paths(message, tmp_path).startswith("input.txt: ")


def test_a_zip_of_all_results_has_neither_the_upload_nor_links(tmp_path: Path) -> None:
    import zipfile

    folder = tmp_path / "run"
    (folder / "plots").mkdir(parents=True)
    for name in ("input.mp4", RECORD, LOG, METRICS, "plots/scene.png"):
        (folder / name).write_text(name)
    (folder / "secret").symlink_to("/etc/passwd")
    zip_folder(folder, folder / "taken" / "all.zip")
    with zipfile.ZipFile(folder / "taken" / "all.zip") as archive:
        assert archive.namelist() == [METRICS, "plots/scene.png"]
    for kind in ("nothing", "../x", "dense"):
        with pytest.raises(ResultsError):
            write_export(folder, kind)


def test_the_lines_of_python_are_those_of_the_command(tmp_path: Path) -> None:
    words = [
        "run",
        f"{tmp_path}/a b.mp4",
        "--output",
        f"{tmp_path}/r",
        "--mapping",
        "online",
        "--stride",
        "2",
    ]
    text = command_and_python([*words, "--set", "seed=3", "--marker", "aruco-4x4:0.1"], tmp_path)
    command, _, lines = text.partition("\n\n")
    assert command.startswith("torchslam run 'a b.mp4' --output r --mapping online")
    compile(lines, "lines", "exec")
    assert "'seed=3', 'metric.marker=aruco-4x4:0.1'" in lines
    assert json.dumps(str(tmp_path))[1:-1] not in text


def test_a_length_that_was_set_is_in_the_commands_and_in_the_python(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[list[str]]()
    monkeypatch.setattr(jobs, "tool", lambda words: asked.append(list(words)))
    name = runs.add("walk.mp4", DEMO, ("--mapping", "online"))
    runs.scale(name, ["3:1.5,2", "4:100,20.5", "0.297"])
    runs.scale(name, ["3:1.5,2", "9:7,8", "2"])
    record = runs.record(name)
    text = command_and_python(runs.command(name), runs.folder, record.lengths)
    _, first, second, _, *lines = text.splitlines()
    assert first.split()[1:] == [*asked[0][:1], name, *asked[0][2:]]
    assert second == f"torchslam align {name} --distance 3:1.5,2 9:7,8 2"
    settings = next(line for line in lines if "load_config" in line).partition("None, ")[2].rstrip(")")
    config = load_config(None, ast.literal_eval(settings))
    (source,) = sources_of(given_options(config.metric))
    assert isinstance(source, Distances)
    assert [(str(each), each.meters) for each in source.distances] == [("3:1.5,2 4:100,20.5", 0.297)]
    marked = command_and_python(
        [*runs.command(name), "--marker", "aruco-4x4:0.1"], runs.folder, record.lengths
    )
    assert "metric.distance" not in marked  # the marker has determined the scale
