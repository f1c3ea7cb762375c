"""A server of the page with a folder of its own, and a video of the rendered room."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.data.trajectories import write_trajectory
from torchslam.types import Trajectory

VIDEO_FRAMES = 40


@dataclass
class Server:
    """A server that runs."""

    process: subprocess.Popen[bytes]
    folder: Path
    address: str
    token: str

    @property
    def port(self) -> int:
        return int(self.address.rstrip("/").rpartition(":")[2])


def start_server(folder: Path, *options: str) -> Server:
    command = [sys.executable, "-m", "torchslam", "app", str(folder), "--no-browser", "--port", "0", *options]
    output = folder.with_suffix(".log")  # a pipe that nobody reads fills, and then the server hangs
    with output.open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    pattern = r"torchslam app: (http://\S+:\d+/)(?:\?token=(\S+))?"
    wait_until(lambda: process.poll() is not None or re.search(pattern, output.read_text()))
    found = re.search(pattern, output.read_text())
    assert found is not None, output.read_text()
    return Server(process, folder, found[1], found[2] or "")


def stop_server(server: Server) -> None:
    server.process.send_signal(signal.SIGINT)
    server.process.wait(30)


@pytest.fixture(scope="module")  # what one module chose for the next run is not for another one
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    for module in ("viser", "starlette", "uvicorn"):
        pytest.importorskip(module, reason=f"the page needs {module}: pip install 'torchslam[app]'")
    running = start_server(tmp_path_factory.mktemp("app") / "results")
    yield running
    stop_server(running)


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the demo as a video, and their true path beside it.

    The video has a name that a careless page would execute, but not in pictures.
    """
    name = "room.mp4" if "TORCHSLAM_PICTURES" in os.environ else "<img src=x onerror=alert(1)> {alert(2)}.mp4"
    path = tmp_path_factory.mktemp("video") / name
    sequence = open_sequence("synthetic:room", resize_to="320x240", limit=VIDEO_FRAMES)
    plain = path.with_name("plain.mp4")
    film = cv2.VideoWriter(str(plain), cv2.VideoWriter.fourcc(*"mp4v"), 15.0, (320, 240))
    for index in range(len(sequence)):
        film.write(cv2.cvtColor(sequence.color(index).numpy(), cv2.COLOR_RGB2BGR))
    film.release()
    assert sequence.groundtruth is not None
    times = torch.arange(VIDEO_FRAMES, dtype=torch.float64) / 15.0
    truth = Trajectory(times, sequence.groundtruth.T_wc[:VIDEO_FRAMES])
    write_trajectory(path.with_name("truth.txt"), truth)
    return plain.rename(path)


def wait_until(is_so: object, seconds: float = 120.0) -> None:
    """Wait until a function returns a true value."""
    assert callable(is_so)
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.2)


os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the servers and of their runs
