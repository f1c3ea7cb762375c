"""The page in a real browser: from a video to a COLMAP model, stop and resume, two tabs, hostile names."""

from __future__ import annotations

import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.app.conftest import VIDEO_FRAMES, Server, wait_until
from torchslam.app.jobs import Runs, State

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
PICTURES = os.environ.get("TORCHSLAM_PICTURES")
"""Folder into which the pictures of README and tutorial are drawn."""
SLOW_MS = 600_000.0  # a run on a busy machine, milliseconds

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="the page is tested through playwright: pip install playwright"
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=BROWSER, args=ARGUMENTS)
        yield found
        found.close()


@pytest.fixture
def page(browser: Any, server: Server) -> Iterator[Any]:
    """A tab; it fails if anything of a file name was executed, or the page asked another computer."""
    opened = browser.new_page(viewport={"width": 1280, "height": 800})
    dialogs, asked = list[str](), list[str]()

    def dismiss(dialog: Any) -> None:
        dialogs.append(dialog.message)
        dialog.dismiss()

    opened.on("dialog", dismiss)
    opened.on("request", lambda request: asked.append(request.url))
    opened.goto(server.address)
    opened.get_by_text("Demo: a rendered room").wait_for(timeout=SLOW_MS)
    yield opened
    opened.close()
    assert not dialogs
    assert all(url.startswith((server.address, "data:", "blob:")) for url in asked), asked


def draw(page: Any, name: str) -> None:
    """Draw a picture of the documentation, if that is asked for."""
    if PICTURES:
        notice = page.get_by_role("alert").get_by_role("button")
        if notice.count():
            notice.first.click()
        page.wait_for_timeout(1500)
        page.screenshot(path=Path(PICTURES) / f"{name}.png")


def open_tab(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name).click()


def choose(page: Any, label: str, choice: str) -> None:
    page.get_by_role("combobox", name=label).click()
    page.get_by_role("option", name=choice).click()


def wait_for_state(page: Any, title: str, state: str) -> None:
    """Wait until the page shows a state, a regular expression; an error has what it shows instead."""
    words = re.compile(re.escape(title) + rf": ({state})")
    try:
        page.get_by_text(words).first.wait_for(timeout=SLOW_MS)
    except sync_api.TimeoutError:
        raise AssertionError(f"no {state!r} in: {page.inner_text('body')}") from None


def wait_for_end(page: Any, server: Server, title: str) -> None:
    """Wait with the page closed, which does not end the run; then it shows the result."""
    page.goto("about:blank")
    wait_until(lambda: state_of(server, title) in (State.DONE, State.FAILED, State.STOPPED), SLOW_MS / 1000)
    page.goto(server.address)
    wait_for_state(page, title, "done")


def state_of(server: Server, title: str) -> State:
    runs = Runs(server.folder)
    return next(runs.state(name) for name in runs.names() if runs.record(name).title == title)


@pytest.fixture(scope="module")
def mapped(browser: Any, server: Server, video: Path) -> Path:
    """The run of the video, which was started on the page."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(server.address)
    page.locator('input[data-kind="recording"]').set_input_files(video)
    page.get_by_text(f"{VIDEO_FRAMES} frames").wait_for(timeout=SLOW_MS)
    assert video.name in page.inner_text("body")  # as text, and nothing of it was executed
    page.get_by_role("button", name="Start").click()
    wait_for_state(page, video.name, "running|done")  # it may end before a busy browser draws
    wait_for_end(page, server, video.name)
    page.close()
    runs = Runs(server.folder)
    return next(runs.path(name) for name in runs.names() if runs.record(name).title == video.name)


# The pixels at which every `step`-th vertex of a node of the scene is seen, without those behind the camera. What has
# just come takes its place in the next frames.
PLACES = """async ([name, step]) => {
  const {nodeRefFromName, camera, canvas, requestRender} = window.__viserMutable, found = [];
  const box = canvas.getBoundingClientRect();
  requestRender();
  for (let frames = 0; frames < 3; frames++) await new Promise(requestAnimationFrame);
  nodeRefFromName["/" + name]?.traverse((node) => {
    const array = node.geometry?.attributes.position?.array ?? [];
    for (let at = 0; at < array.length; at += 3 * step) {
      const seen = node.localToWorld(camera.position.clone().set(...array.slice(at, at + 3)));
      if (seen.clone().applyMatrix4(camera.matrixWorldInverse).z > 0) continue;
      seen.project(camera);
      found.push([box.left + box.width * (1 + seen.x) / 2, box.top + box.height * (1 - seen.y) / 2]);
    }
  });
  return found;
}"""


COUNT = """(name) => {
  let count = 0;
  window.__viserMutable?.nodeRefFromName?.["/" + name]?.traverse((node) => {
    count += node.geometry?.attributes.position?.count ?? 0;
  });
  return count;
}"""


def places(page: Any, name: str, step: int = 1) -> list[tuple[float, float]]:
    """Where the vertices of a node that rests are seen beside the panel, 390 wide; those in the middle first."""
    before: list[Any] = []
    while before != (found := page.evaluate(PLACES, [name, step])):
        before = found
        page.wait_for_timeout(200)
    inside = [(x, y) for x, y in found if 20 < x < 850 and 20 < y < 780]
    return sorted(inside, key=lambda at: abs(at[0] - 440) + abs(at[1] - 400))


def count(page: Any, name: str) -> int:
    return int(page.evaluate(COUNT, name))


def test_a_length_is_measured_and_a_colmap_model_is_taken_away(
    page: Any, server: Server, mapped: Path, tmp_path: Path
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    open_tab(page, "Measure")
    choose(page, "A click will", "measure")
    page.get_by_text("Click two points.").wait_for()
    wait_until(lambda: count(page, "points") > 50)
    seen = places(page, "points")
    page.mouse.click(*seen[0])
    page.get_by_text("Click the second point.").wait_for()
    page.mouse.click(*max(seen[:100], key=lambda at: abs(at[0] - seen[0][0]) + abs(at[1] - seen[0][1])))
    page.get_by_text("Length:").wait_for()
    assert re.search(r"Length: [\d.]+ ± [\d.]+ map units", page.get_by_text("Length:").inner_text())
    draw(page, "app-measure")
    page.get_by_role("button", name="Set the length").click()
    open_tab(page, "Result")
    page.get_by_text("1 known length").first.wait_for(timeout=SLOW_MS)
    assert page.get_by_text("held-out image pairs").count()
    draw(page, "app-result")

    open_tab(page, "Take away")
    page.get_by_text(re.compile(r"torchslam align \S+ --distance \d+:\S+ \d+:\S+ 1")).wait_for()
    with page.expect_download(timeout=SLOW_MS) as download:
        page.get_by_text("COLMAP (zip)").click()
    with zipfile.ZipFile(download.value.path()) as archive:
        archive.extractall(tmp_path)
    model = pycolmap.Reconstruction(next(tmp_path.rglob("cameras.bin")).parent)
    assert model.num_reg_images() > 2
    assert model.num_points3D() > 50
    # Names are never paths.
    assert not [each for each in server.folder.parent.rglob("*") if "<img" in each.name]


EYE = "window.__viserMutable.camera.position.toArray()"
TURN = """(({nodeRefFromName, camera}) =>
  nodeRefFromName["/points"].getWorldQuaternion(camera.quaternion.clone()).toArray())(window.__viserMutable)"""


@pytest.mark.slow  # minutes in software rendering
def test_a_result_is_cropped_played_set_up_and_compared(page: Any, mapped: Path, video: Path) -> None:
    wait_until(lambda: count(page, "points") > 50)
    open_tab(page, "Result")
    page.locator('input[data-kind="truth"]').set_input_files(video.with_name("truth.txt"))
    page.get_by_text(re.compile(r"ATE 0\.0\d* m RMSE")).wait_for(timeout=SLOW_MS)
    assert count(page, "other") > 1000

    before = page.evaluate(EYE)
    page.get_by_role("button", name="Play the path").click()
    wait_until(lambda: page.evaluate(EYE) != before, 30)
    page.reload()  # while it plays: the new client begins where all is seen, and stays there
    wait_until(lambda: count(page, "frusta") > 0)
    open_tab(page, "Result")
    page.get_by_role("button", name="Play the path").wait_for()  # who was flown has left
    assert page.evaluate(EYE) == pytest.approx(before)
    page.mouse.click(*places(page, "frusta", 5)[0])
    page.get_by_text(re.compile(r"frame \d+: \d+ points, median residual")).wait_for(timeout=SLOW_MS)

    open_tab(page, "Measure")
    choose(page, "A click will", "set up")
    page.get_by_text("Click a floor or a table.").wait_for()
    before = page.evaluate(TURN)
    page.mouse.click(*places(page, "points")[0])
    wait_until(lambda: page.evaluate(TURN) != before, 30)

    whole = count(page, "points")
    box = page.locator(".multi-slider-track-container").first.bounding_box()
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 1, y)
    page.mouse.down()

    def is_cropped() -> bool:
        page.mouse.move(box["x"] + 0.45 * box["width"], y, steps=3)
        return 0 < count(page, "points") < whole

    wait_until(is_cropped, 30)
    page.mouse.up()


@pytest.mark.slow  # a minute: the whole demo
def test_a_run_that_is_stopped_is_resumed_and_a_second_tab_shows_it(
    page: Any, browser: Any, server: Server
) -> None:
    page.get_by_text("Demo: a rendered room").click()
    page.get_by_text(re.compile(r"[1-9]\d{2,} points")).wait_for(timeout=SLOW_MS)
    if PICTURES:
        page.get_by_text(re.compile(r"1\d{3} points")).wait_for(timeout=SLOW_MS)
        page.wait_for_timeout(2000)  # for the map to be drawn
    draw(page, "app-running")
    other = browser.new_page(viewport={"width": 700, "height": 400})
    other.goto(server.address)
    wait_for_state(other, "demo room", "running")
    page.get_by_role("button", name="Stop").click()
    for tab in (page, other):
        wait_for_state(tab, "demo room", "stopped")
    other.get_by_role("button", name="Resume").click()
    wait_for_state(page, "demo room", "running")
    other.close()
    wait_for_end(page, server, "demo room")
    assert "resuming at frame" in (next(server.folder.glob("*demo-room")) / "run.log").read_text()


def test_what_no_reader_knows_is_refused_with_the_message_of_the_reader(page: Any, tmp_path: Path) -> None:
    wrong = tmp_path / "notes.txt"
    wrong.write_text("no video")
    page.locator('input[data-kind="recording"]').set_input_files(wrong)
    bar = page.locator("#upload-progress")
    bar.get_by_text("neither a video nor a recording").wait_for(timeout=SLOW_MS)
    assert "notes.txt" in bar.inner_text()
    assert ".uploads" not in bar.inner_text()
    bar.click()
    assert not bar.is_visible()
