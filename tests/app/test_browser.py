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
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
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


def wait_for_state(page: Any, title: str, state: str) -> None:
    words = re.compile(re.escape(title) + rf": {state}")
    page.get_by_text(words).first.wait_for(timeout=SLOW_MS)


def wait_for_end(page: Any, server: Server, title: str) -> None:
    """Wait with the page closed, which does not end the run; then it shows the result."""
    page.goto("about:blank")
    wait_until(lambda: state_of(server, title) in (State.DONE, State.FAILED, State.STOPPED), SLOW_MS / 1000)
    page.goto(server.address)
    wait_for_state(page, title, "done")


def state_of(server: Server, title: str) -> State:
    runs = Runs(server.folder)
    return next(runs.state(name) for name in runs.names() if runs.record(name).title == title)


def test_from_a_video_to_a_colmap_model_and_a_length(
    page: Any, server: Server, video: Path, tmp_path: Path
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    page.locator('input[data-kind="recording"]').set_input_files(video)
    page.get_by_text(f"{VIDEO_FRAMES} frames").wait_for(timeout=SLOW_MS)
    assert video.name in page.inner_text("body")  # as text, and nothing of it was executed
    page.get_by_role("button", name="Start").click()
    wait_for_state(page, video.name, "running")
    wait_for_end(page, server, video.name)

    open_tab(page, "Measure")
    page.get_by_role("button", name="measure", exact=True).click()
    page.get_by_text("Click two points.").wait_for()
    click_until(page, -1, "Click the second point.")
    click_until(page, 1, "Length:")
    assert re.search(r"Length: [\d.]+ ± [\d.]+ map units", page.get_by_text("Length:").inner_text())
    draw(page, "app-measure")
    page.get_by_role("button", name="Set the length").click()
    open_tab(page, "Result")
    page.get_by_text("1 known length").first.wait_for(timeout=SLOW_MS)
    assert page.get_by_text("held-out image pairs").count()
    draw(page, "app-result")

    open_tab(page, "Take away")
    with page.expect_download(timeout=SLOW_MS) as download:
        page.get_by_text("COLMAP (zip)").click()
    with zipfile.ZipFile(download.value.path()) as archive:
        archive.extractall(tmp_path)
    model = pycolmap.Reconstruction(next(tmp_path.rglob("cameras.bin")).parent)
    assert model.num_reg_images() > 2
    assert model.num_points3D() > 50
    assert not [
        each for each in server.folder.parent.rglob("*") if "<img" in each.name
    ]  # names are never paths


def click_until(page: Any, side: int, words: str) -> None:
    """Click at places of one half of the scene, from its middle outwards, until the panel has some words."""
    offsets = [(side * 20.0 * x, 20.0 * y) for x in range(4, 14) for y in range(-6, 7)]
    for x, y in sorted(offsets, key=lambda each: abs(each[1])):
        page.mouse.click(445 + x, 400 + y)  # beside the panel, which is 390 wide
        page.wait_for_timeout(300)
        if page.get_by_text(words).count():
            return
    raise AssertionError(f"no point for: {words}")


@pytest.mark.slow  # a minute: the whole demo
def test_a_run_that_is_stopped_is_resumed_and_a_second_tab_shows_it(
    page: Any, browser: Any, server: Server
) -> None:
    page.get_by_text("Demo: a rendered room").click()
    page.get_by_text(re.compile(r"[1-9]\d{2,} points")).wait_for(timeout=SLOW_MS)
    if PICTURES:
        page.get_by_text(re.compile(r"1\d{3} points")).wait_for(timeout=SLOW_MS)
        page.wait_for_timeout(8000)  # for the map to be drawn
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
