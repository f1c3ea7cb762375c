"""Frames a second of the page of `torchslam app` with a large result: python -m experiments.benchmarks.page

With a recording: what a run takes by itself, on the page without a tab, and while a tab shows it and its view is moved.

Needs Chromium, playwright and the extra `app`. Headless Chromium draws in software, without a GPU.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
import viser
from playwright.sync_api import sync_playwright

from torchslam.app.jobs import Runs
from torchslam.app.scene import Scene
from torchslam.app.web import Uploads, application

KEYFRAMES, DENSE, FRAMES, THUMBNAILS = (
    2000,
    500_000,
    18_000,
    24,
)  # as of 2 million points, of which as many are sent
ARGUMENTS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
SECONDS = 20.0  # of dragging, after those in which the number of points settles
# Counts the points of the largest cloud in each frame that is drawn; installed before the page's own script.
COUNT = """(() => {
  const {prototype: gl} = WebGL2RenderingContext, draw = gl.drawArrays;
  window.drawn = [];
  let most = 0;
  gl.drawArrays = function (mode, first, count) {
    if (mode === gl.POINTS) most = Math.max(most, count);
    draw.call(this, mode, first, count);
  };
  requestAnimationFrame(function look(now) {
    if (most) window.drawn.push([now, most]);
    most = 0;
    requestAnimationFrame(look);
  });
})()"""


def large_result() -> dict[str, Any]:
    """A walk of several rounds in a hall, in the form of `reading.result`."""
    random = np.random.default_rng(0)
    turns = np.linspace(0, 8 * np.pi, FRAMES)
    poses = np.tile(np.eye(3, 4, dtype=np.float32), (FRAMES, 1, 1))
    poses[:, :, 3] = np.stack((np.cos(turns), np.sin(turns), 0.02 * turns), axis=1)
    points = random.integers(0, 65536, (DENSE, 3)).astype(np.uint16)
    points[np.arange(DENSE), random.integers(0, 3, DENSE)] = 0  # three walls
    colors = random.integers(0, 256, (DENSE, 3)).astype(np.uint8)
    rows = np.linspace(0, FRAMES - 1, KEYFRAMES).astype(int)
    corners = np.array([[-0.6, -0.4, 1], [0.6, -0.4, 1], [0.6, 0.4, 1], [-0.6, 0.4, 1]])
    return {
        "radius": 2.0,
        "poses": poses,
        "uncertain": np.zeros(FRAMES, bool),
        "breaks": [],
        "truth": np.zeros((0, 3)),
        "keyframe_poses": poses[rows],
        "corners": 0.07 * corners,
        "images": {
            row: colors[: 72 * 96].reshape(72, 96, 3) for row in range(0, KEYFRAMES, KEYFRAMES // THUMBNAILS)
        },
        "points": np.zeros((0, 3), np.float32),
        "colors": np.zeros((0, 3), np.uint8),
        "dense": {
            "low": [-2, -2, -1],
            "step": [4 / 65535] * 2 + [2 / 65535],
            "points": points,
            "colors": colors,
        },
    }


def processor_time() -> float:
    """Seconds that the processes of the browser have computed (Linux)."""
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            name, _, values = stat.read_text().rpartition(")")
            ticks += sum(map(int, values.split()[11:13])) if "chrom" in name else 0
    return ticks / os.sysconf("SC_CLK_TCK")


def watched(recording: Path, rounds: int) -> None:
    """Run a recording in three ways in turn, and print the processor time and the duration of each run."""
    command = [sys.executable, "-m", "torchslam"]
    with (
        tempfile.TemporaryDirectory() as name,
        sync_playwright() as playwright,
        contextlib.ExitStack() as at_end,
    ):
        folder = Path(name)
        copy: Callable[..., Any] = shutil.copytree if recording.is_dir() else shutil.copy
        walk = copy(recording, folder / f"walk{recording.suffix}")
        words = [*command, "app", name, "--no-browser", "--port", "0"]
        server = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        at_end.callback(server.wait)
        at_end.callback(server.send_signal, signal.SIGINT)
        assert server.stdout is not None
        address = server.stdout.readline().split()[-1]
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        at_end.callback(browser.close)
        runs = Runs(folder)
        for number in range(rounds):
            alone, begin = folder / f"alone{number}", time.monotonic()
            words = [*command, "run", str(walk), "--output", str(alone)]
            subprocess.run(words, check=True, capture_output=True)
            report("by itself", alone, time.monotonic() - begin)
            for is_open in (False, True):
                before, page = set(runs.names()), browser.new_page(viewport={"width": 1280, "height": 800})
                page.goto(address)
                page.get_by_role("combobox", name="In the folder").click()
                page.get_by_role("option", name=walk.name, exact=True).click()
                page.get_by_role("button", name="Start").click()
                while not (added := set(runs.names()) - before) or runs.running() not in added:
                    page.wait_for_timeout(100)
                (run,) = added
                if is_open:
                    drag_while(page, partial(goes_on, runs, run))
                page.close()
                while goes_on(runs, run):
                    time.sleep(0.2)
                report("with a tab" if is_open else "without a tab", folder / run, runs.seconds(run))


def goes_on(runs: Runs, run: str) -> bool:
    """Whether a run goes on."""
    return runs.running() == run


def is_before(end: float) -> bool:
    """Whether a time of the monotonic clock is still to come."""
    return time.monotonic() < end


def drag_while(page: Any, goes_on: Callable[[], bool]) -> None:
    """Drag the view."""
    page.mouse.move(400, 400)
    page.mouse.down()
    step = 0
    while goes_on():
        step += 1
        page.mouse.move(400 + (7 * step) % 300, 400 + (3 * step) % 100)
        page.wait_for_timeout(15)


def report(how: str, results: Path, seconds: float) -> None:
    """Print a row of the table."""
    metrics = json.loads((results / "metrics.json").read_text())
    print(
        f"{how}: {metrics['cpu_s']:.1f} s of processor time, {seconds:.1f} s; load {os.getloadavg()[0]:.1f}",
        flush=True,
    )


def main() -> None:
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "recording", type=Path, nargs="?", help="measure runs of it rather than frames a second"
    )
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    if options.recording is None:
        frames_a_second()
    else:
        watched(options.recording, options.rounds)


def frames_a_second() -> None:
    """Serve the result, drag the view, and print a row of the table."""
    viewer = viser.ViserServer("127.0.0.1", 0, verbose=False)
    listening = socket.create_server(("127.0.0.1", 0))
    nobody: Any = None
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page_of_viewer: Any = application(viewer, Runs(Path(folder)), Uploads(Path(folder), 1), nobody)
        options: dict[str, Any] = {"log_level": "warning", "ws": "websockets-sansio"}
        server = uvicorn.Server(uvicorn.Config(page_of_viewer, **options))
        threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True).start()
        Scene(viewer).show_result(large_result())
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(COUNT)
        page.goto(f"http://localhost:{listening.getsockname()[1]}/")
        while not page.evaluate("window.drawn.some(([, count]) => count > 5000)"):
            page.wait_for_timeout(100)
        for name, seconds in (("settling", SECONDS), ("moving", SECONDS)):
            page.evaluate("window.drawn.length = 0")
            spent, end = processor_time(), time.monotonic() + seconds
            drag_while(page, partial(is_before, end))
            drawn, spent = np.array(page.evaluate("window.drawn")), processor_time() - spent
            rate, each = (len(drawn) - 1) / seconds, 1000 * spent / len(drawn)
            points = np.median(drawn[:, 1])
            print(
                f"{name}: {rate:.1f} frames/s, {points:.0f} points, {each:.0f} ms of processor time a frame",
                flush=True,
            )
        page.mouse.up()
        page.evaluate("window.drawn.length = 0")
        page.wait_for_timeout(6000)
        drawn = np.array(page.evaluate("window.drawn"))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        load = os.getloadavg()[0]
        print(
            f"at rest: {drawn[:, 1].max():.0f} points; memory of the server {memory:.0f} MB; load {load:.1f}"
        )
        browser.close()
        server.should_exit = True
    viewer.stop()


if __name__ == "__main__":
    main()
