"""Frames that other processes read: the same as without them, whatever happens to these processes."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.cli.conftest import write_tum_folder
from tests.data.mp4 import write_mp4
from tests.parallel.test_pool import PATIENCE, wait_until_ready
from torchslam import Features, Frame, load_config
from torchslam.cli.main import main
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError
from torchslam.parallel.prefetch import FeaturePrefetcher
from torchslam.system.front_end import checked_extractor, image_extractor
from torchslam.utils.timing import Stopwatch

SETTINGS = ["features.kind=opencv-orb", "features.num_keypoints=300"]
CONFIG = load_config(None, SETTINGS)
SET = [part for setting in SETTINGS for part in ("--set", setting)]
SIZE = (160, 120)
FRAMES = 14
BAD, SMALL = 6, 9


@pytest.fixture
def sequence(tmp_path: Path) -> Sequence:
    """Pictures, one damaged and one too small, with a mask, as a TUM folder."""
    folder = tmp_path / "pictures"
    (folder / "rgb").mkdir(parents=True)
    for index in range(FRAMES):
        cv2.imwrite(str(folder / "rgb" / f"{index:02}.png"), picture(index))
    (folder / "rgb" / f"{BAD:02}.png").write_bytes(b"not an image")
    cv2.imwrite(str(folder / "rgb" / f"{SMALL:02}.png"), picture(0)[:50])
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, :50] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    return open_sequence(folder, "100,100,79.5,59.5", mask=tmp_path / "mask.png")


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers are forks where they can be, which need not import torch again."""
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: sys.platform == "linux")


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the processes, so that a short sequence is theirs."""
    enter = FeaturePrefetcher.__enter__

    def wait(self: FeaturePrefetcher) -> FeaturePrefetcher:
        enter(self)
        wait_until_ready(self)
        return self

    monkeypatch.setattr(FeaturePrefetcher, "__enter__", wait)


def picture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, SIZE[::-1], dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), np.empty(0), 0, 255, cv2.NORM_MINMAX)


def look(frames: FeaturePrefetcher | Sequence, index: int) -> tuple[Frame, Features] | str:
    """A frame and its features, or the error in words."""
    try:
        frame = frames[index]
    except FrameError as error:
        return str(error)
    return frame, image_extractor(CONFIG)(frame) if frame.features is None else frame.features


def check_same(frames: FeaturePrefetcher, sequence: Sequence, index: int) -> bool:
    """The frame is the one without other processes; returns whether it came from one of them."""
    found, expected = look(frames, index), look(sequence, index)
    if isinstance(found, str) or isinstance(expected, str):
        assert found == expected
        return False
    assert (found[0].index, found[0].timestamp, found[0].name) == (
        expected[0].index,
        expected[0].timestamp,
        expected[0].name,
    )
    for name in Features.__dataclass_fields__:
        mine, other = getattr(found[1], name), getattr(expected[1], name)
        if other is None:
            assert mine is None, name
            continue
        assert mine.dtype == other.dtype
        assert torch.equal(mine, other), name
    return found[0].features is not None


def ahead(sequence: Sequence, clock: Stopwatch | None = None, processes: int = 1) -> FeaturePrefetcher:
    extractor = partial(checked_extractor, CONFIG, sequence.camera)
    return FeaturePrefetcher(sequence, extractor, clock or Stopwatch(), processes)


@pytest.mark.usefixtures("patient")
def test_prefetched_features_equal_those_computed_here(sequence: Sequence) -> None:
    clock = Stopwatch()
    with ahead(sequence, clock, processes=2) as frames:
        # The first frame is read here while the others are requested; the run begins at frame 2.
        theirs = [check_same(frames, sequence, index) for index in range(2, FRAMES)]
        assert len(frames._requested) == 0
    assert theirs == [index not in (2, BAD, SMALL) for index in range(2, FRAMES)]
    assert clock.take()["features"] > 0
    assert isinstance(look(sequence, BAD), str)
    assert multiprocessing.active_children() == []


@pytest.mark.usefixtures("forked", "patient")
def test_small_pictures_come_along_where_they_are_wanted(sequence: Sequence) -> None:
    for is_wanted in (False, True):
        sequence.sends_pictures = is_wanted
        with ahead(sequence) as frames:
            assert frames[0].picture is None  # read here
            sent = frames[1].picture
        assert (sent is not None) == is_wanted
    assert sent is not None
    assert torch.equal(sent, sequence.color(1))  # it is small already


@pytest.mark.usefixtures("forked", "patient")
def test_few_frames_are_requested_ahead() -> None:
    with ahead(open_sequence("synthetic:room?frames=50&blank=1")) as frames:
        assert frames[10].features is None
        assert sorted(frames._requested) == [*range(11, 19)]
        assert frames[11].features is not None
        assert sorted(frames._requested) == [*range(12, 20)]


@pytest.mark.usefixtures("forked", "patient")
def test_the_run_continues_without_a_killed_worker(sequence: Sequence) -> None:
    with ahead(sequence) as frames:
        check_same(frames, sequence, 0)
        assert check_same(frames, sequence, 1)
        os.kill(frames._workers[0].process.pid or 0, signal.SIGKILL)
        frames._workers[0].process.join()
        with pytest.warns(UserWarning, match="died; continuing without it"):
            theirs = [check_same(frames, sequence, index) for index in range(2, FRAMES)]
    assert not all(theirs[4:])


RUN = """
import sys, threading
from multiprocessing.process import BaseProcess

start = BaseProcess.start

def start_and_print(process):
    print("started a", type(process).__name__)
    start(process)

if __name__ == "__main__":
    if sys.argv[1] == "spawn":
        threading.Thread(target=threading.Event().wait, daemon=True).start()
    BaseProcess.start = start_and_print
    from torchslam.cli.main import main
    sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forks on Linux alone")
def test_forks_and_new_interpreters_give_the_same_bytes(tmp_path: Path) -> None:
    folder = write_tum_folder(tmp_path / "room", frames=8)
    # With 3: one reads frames, one solves local adjustments, one estimates the sensor.
    expected = {2: ["Process"], 3: 3 * ["Process"]}
    arguments = ["run", str(folder), *SET, "--mapping", "online"]
    assert main([*arguments, "-o", str(tmp_path / "alone"), "--processes", "1"]) == 0
    for method, processes in (("fork", 2), ("spawn", 3)):
        output = tmp_path / f"{method}{processes}"
        more = ["-o", str(output), "--processes", str(processes)]
        command = [sys.executable, "-c", RUN, method, *arguments, *more]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
        started = [line.split()[-1] for line in done.stdout.splitlines() if line.startswith("started a")]
        # `torchslam run` has a single thread when its workers start, so that they are forks.
        assert started == [f"{method.capitalize()}{kind}" for kind in expected[processes]]
        for name in ("trajectory.txt", "online.txt", "keyframes.txt", "map.safetensors", "map.ply"):
            assert (output / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), (output, name)


def test_videos_and_archives_can_be_sent_to_workers(tmp_path: Path, sequence: Sequence) -> None:
    images = [cv2.cvtColor(picture(index), cv2.COLOR_GRAY2BGR) for index in range(5)]
    write_mp4(tmp_path / "video.mp4", images)
    (tmp_path / "pictures" / "rgb" / f"{BAD:02}.png").unlink()
    shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path / "pictures")
    for path in (tmp_path / "video.mp4", tmp_path / "packed.zip"):
        opened = open_sequence(path, "100,100,79.5,59.5", stride=2)
        first = opened.image(2)
        copy = pickle.loads(pickle.dumps(opened))
        assert torch.equal(copy.image(2), first)
        assert torch.equal(copy.image(1), opened.image(1))
        assert not torch.equal(copy.image(1), first)
        del copy
        assert torch.equal(opened.image(2), first)  # the files are still there


# --- processes that are ended ---------------------------------------------------------------------------------

ORPHAN = """
import os, signal, sys
from tests.parallel.test_pool import wait_until_ready
from tests.parallel.test_prefetch import ahead
from torchslam.data import open_sequence
from torchslam.parallel import pool

if __name__ == "__main__":
    pool.can_fork = lambda: sys.argv[1] == "fork"
    with ahead(open_sequence("synthetic:room?frames=50&blank=1"), processes=2) as frames:
        wait_until_ready(frames)
        frames[0], frames[1]
        os.kill(os.getpid(), signal.SIGKILL)
"""


def running(group: int) -> list[int]:
    """The processes of a group that have not ended."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            state, _, its_group = (process / "stat").read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # gone meanwhile
        if int(its_group) == group and state != "Z":
            found.append(int(process.name))
    return found


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")


def wait_for_end(group: int) -> None:
    until = time.monotonic() + 30
    while running(group):
        assert time.monotonic() < until
        time.sleep(0.05)


@needs_proc
@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_end_with_their_parent(method: str) -> None:
    asking = subprocess.Popen([sys.executable, "-c", ORPHAN, method], start_new_session=True)
    assert asking.wait(PATIENCE) == -signal.SIGKILL
    wait_for_end(asking.pid)


@needs_proc
@pytest.mark.parametrize(
    ("method", "number", "status", "when"),
    [
        ("fork", signal.SIGINT, 130, "initializing"),
        pytest.param("fork", signal.SIGTERM, 143, "? frames/s", marks=pytest.mark.slow),
        ("spawn", signal.SIGTERM, 143, "? frames/s"),  # before the new interpreter has started
        pytest.param("spawn", signal.SIGINT, 130, "? frames/s", marks=pytest.mark.slow),
        pytest.param("spawn", signal.SIGTERM, 143, "initializing", marks=pytest.mark.slow),
    ],
)
def test_a_signal_to_the_process_group_ends_the_run_with_results(
    tmp_path: Path, method: str, number: int, status: int, when: str
) -> None:
    line = ["run", "synthetic:room?frames=50000&blank=1", "-o", str(tmp_path / "out"), *SET]
    line += ["--processes", "2", "--set", "paper.unrefined=true"]
    command = [sys.executable, "-c", RUN, method, *line]
    with (tmp_path / "err").open("w+") as errors:
        child = subprocess.Popen(command, stderr=errors, stdout=errors, start_new_session=True)
        until = time.monotonic() + PATIENCE
        while when not in (tmp_path / "err").read_text():
            assert child.poll() is None, (tmp_path / "err").read_text()
            assert time.monotonic() < until
            time.sleep(0.1)
        os.killpg(child.pid, number)  # as a terminal does with Ctrl-C
        assert child.wait(PATIENCE) == status
    said = (tmp_path / "err").read_text()
    assert "Traceback" not in said
    assert "interrupted; the results so far were written" in said
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["interrupted"]
    wait_for_end(child.pid)
