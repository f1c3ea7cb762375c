"""The panel of the page: a new run, the run that goes on, its result, and the list of all runs."""

from __future__ import annotations

import html
import threading
import time
import traceback
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import viser

from torchslam.app import exports, reading
from torchslam.app.jobs import (
    DEMO,
    Runs,
    State,
    log_tail,
    message_of,
    messages_of,
    progress_of,
    read_record,
    tool,
)
from torchslam.app.options import FILE_KINDS, Options, file_button
from torchslam.app.scene import STATES, Scene, click_of, length_between, length_words, plane_normal
from torchslam.errors import ResultsError, TorchslamError
from torchslam.io.file_names import EXAMPLE_IMAGE, TRAJECTORY
from torchslam.utils.console import printable

TICK_S = 1.0
"""Seconds between two looks at the runs. Tried at 1 only: the log has a line a second."""
CHECK_S = 120.0  # seconds in which a reader is to open an upload; a video of an hour takes 60
PLAY_FPS = 15  # poses of the path a second while it is played
SHOWN_MESSAGES = 6  # last messages of a run
NONE = "—"  # of the lists
IMAGE, RULER, UP = "show image", "measure", "set up"
COLORS = {  # red, green, blue of the states in the timeline
    "initializing": "#c9b458",
    "tracking": "#57be41",
    "uncertain": "#be82e1",
    "lost": "#c85a3d",
}


class Panel:
    """The panel, the same for all who look at the page; what they do takes effect one after the other.

    Args:
        viewer: the server of the page.
        runs: the runs of the folder.
        reader: the process that reads images and results.
    """

    def __init__(self, viewer: viser.ViserServer, runs: Runs, reader: reading.ReadingProcess) -> None:
        self._viewer, self._gui, self._runs, self._reader = viewer, viewer.gui, runs, reader
        self.scene = Scene(viewer)
        self._lock = threading.RLock()
        self._shown, self._is_live, self._frame = "", False, -1  # the run that is shown, and its frame
        self._upload: tuple[Path, str] | None = None
        self._rows = list[int]()  # of the points that were measured
        self._is_playing, self._ended = False, threading.Event()
        viewer.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self._status = self._gui.add_html("")
        self._bar = self._gui.add_progress_bar(0.0, visible=False, animated=True)
        self._image = self._gui.add_image(np.zeros((1, 1, 3), np.uint8), visible=False)
        self._stop = self._button("Stop", lambda _: self._runs.stop(self._shown), color="red", visible=False)
        self._resume = self._button("Resume", lambda _: self._runs.resume(self._shown), visible=False)
        tabs = self._gui.add_tab_group()
        for label, add in (
            ("New", self._add_new),
            ("Result", self._add_result),
            ("Measure", self._add_measures),
            ("Take away", self._add_exports),
            ("Runs", self._add_runs),
        ):
            with tabs.add_tab(label):
                add()
        viewer.scene.on_click()(self._guarded(self._clicked))
        names = runs.names()
        if names:
            self._open(runs.running() or names[0])
        threading.Thread(target=self._watch, daemon=True).start()

    def close(self) -> None:
        """Stop watching the runs, which go on."""
        self._ended.set()

    # --- what the HTTP part calls

    def received(self, kind: str, path: Path, called: str) -> None:
        """Take an upload. Raises ResultsError with the reader's message if it cannot be read."""
        if kind == "recording":
            done = tool(["info", str(path)], CHECK_S)
            if done.returncode:
                raise ResultsError(message_of(done, self._runs.folder, called))
            about = {
                line.split()[0]: line.split(maxsplit=1)[1]
                for line in done.stdout.splitlines()
                if len(line.split()) > 1
            }
            with self._lock:
                self._upload = path, called
                self._recording.value = NONE
            words = ", ".join(
                f"{about[key]}{unit}" for key, unit in (("frames", " frames"), ("size", "")) if key in about
            )
            self._source.content = _line(f"{called}: {words}. Start it below.", "#2b8a3e")
        elif kind in FILE_KINDS:
            named = path.rename(path.with_name(f"{kind}{path.suffix}"))
            self._options.take(kind, named, called)
        elif kind == "truth":
            self._compare_with(path, called, is_truth=True)
        else:
            raise ResultsError("no such kind of upload")

    def taken(self, name: str, kind: str) -> tuple[Path, str]:
        """Write an export of a run, see `exports.write_export`."""
        return exports.write_export(self._runs.path(name), kind, name)

    def picture(self, name: str) -> Path | None:
        """The picture of a run in the list."""
        path = self._runs.path(name) / EXAMPLE_IMAGE
        return path if path.is_file() else None

    # --- tabs

    def _add_new(self) -> None:
        self._source = self._gui.add_html(
            _line("Drop a video, a zip of images or several photos on the page, or:")
        )
        self._gui.add_html(file_button("Choose a video or photos", "recording", is_main=True))
        self._recording = self._gui.add_dropdown("In the folder", (NONE, *self._runs.recordings()))
        self._button("Demo: a rendered room", lambda _: self._start_demo(), color="gray")
        self._options = Options(self._gui)
        self._button("Start", lambda _: self._start())

    def _add_result(self) -> None:
        self._summary = self._gui.add_html("")
        self._timeline: Any = None
        self._timeline_folder = self._gui.add_folder("Timeline", visible=False)
        self._row = self._gui.add_slider("Path", 0, 1, 1, 0, hint="fly along the path")
        self._row.on_update(self._guarded(lambda event: self._fly(int(self._row.value))))
        self._play = self._button("Play the path", lambda _: self._toggle_play(), color="gray")
        self._keyframe = self._gui.add_image(np.zeros((1, 1, 3), np.uint8), visible=False)
        self._other = self._gui.add_dropdown("Compare with", (NONE,))
        self._button("Compare", lambda _: self._compare(), color="gray")
        self._gui.add_html(file_button("Compare with a true path (TUM)", "truth"))
        self._comparison = self._gui.add_html("")

    def _add_measures(self) -> None:
        self._mode = IMAGE
        group = self._gui.add_button_group(
            "A click will",
            (IMAGE, RULER, UP),
            hint="show the image of a keyframe, measure between points, set what is up",
        )
        group.on_click(self._guarded(lambda event: self._set_mode(str(event.target.value))))
        self._length = self._gui.add_html(_line("Click a frustum to see its image."))
        self._meters = self._gui.add_number("True length, m", 1.0, min=1e-3, max=1e5, step=1e-3)
        self._button("Set the length", lambda _: self._set_length())
        self._crop = [
            self._gui.add_multi_slider(f"Crop {axis}", min=0, max=100, step=1, initial_value=(0, 100))
            for axis in "xyz"
        ]
        for slider in self._crop:
            slider.on_update(self._guarded(lambda _: self._crop_scene()))
        self._is_dense = self._gui.add_checkbox("Dense cloud", True)
        self._is_dense.on_update(self._guarded(lambda _: self._crop_scene()))

    def _add_exports(self) -> None:
        self._links = self._gui.add_html(_line("No result is open."))
        self._commands = self._gui.add_html("")

    def _add_runs(self) -> None:
        self._list = self._gui.add_html("")
        self._chosen = self._gui.add_dropdown("Run", (NONE,))
        self._button("Open", lambda _: self._open(self._chosen_name()))
        self._button("Delete", lambda event: self._ask_delete(event.client), color="red")

    # --- actions

    def _start_demo(self) -> None:
        self._open(self._runs.add("demo room", DEMO, ()))

    def _start(self) -> None:
        words, files = self._options.arguments()
        if self._upload is None and self._recording.value == NONE:
            raise ResultsError("choose a recording first")
        if self._upload is not None:
            path, called = self._upload
            name = self._runs.add(called, "", words, path, files)
            self._upload = None
        elif self._recording.value in self._runs.recordings():
            name = self._runs.add(self._recording.value, self._recording.value, words, None, files)
        else:
            raise ResultsError("the recording is not in the folder anymore")
        self._source.content = _line("Drop the next recording on the page, or:")
        self._open(name)

    def _open(self, name: str) -> None:
        """Show a run: its map so far, or its result."""
        with self._lock:
            self._is_playing = False
            self._shown, self._frame, self._rows = name, -1, []
            self._is_live = self._runs.state(name) in (State.RUNNING, State.QUEUED)
            self._keyframe.visible = self._image.visible = self._timeline_folder.visible = False
            self._summary.content = self._comparison.content = self._commands.content = ""
            self._links.content = _line("The run has no result yet.")
            self.scene.clear()
            if self._runs.state(name) is State.DONE or (self._runs.path(name) / TRAJECTORY).exists():
                self._show_result()
            self._refresh()

    def _show_result(self) -> None:
        name, path = self._shown, self._runs.path(self._shown)
        data = self._reader.call(reading.result, path)
        self.scene.show_result(data)
        rows = data["summary"] | {"breaks": "; ".join(data["breaks"])} if data["breaks"] else data["summary"]
        words = _line(data["failure"], "#c92a2a") if data["failure"] else ""
        self._summary.content = words + _table(rows)
        self._links.content = exports.links(name, f"/runs/{quote(name, safe='')}")
        self._other.options = (NONE, *(each for each in self._runs.names() if each != name))
        record = read_record(path)
        if record.source:
            text = exports.command_and_python(record, self._runs.command(name), self._runs.folder)
            self._commands.content = f'<pre style="{_PRE}">{html.escape(text)}</pre>'
        if not data["submaps"]:
            return
        self._row.max = max(1, len(data["submaps"][0]["frame"]) - 1)
        self._draw_timeline(data)
        frames = self.scene.thumbnail_frames()

        def add_thumbnails() -> None:
            try:
                images = self._reader.call(reading.thumbnails, path, frames)
            except TorchslamError as error:
                self._comparison.content = _line(f"without images: {error}")
                return
            with self._lock:
                if self._shown == name and self.scene.data is data:
                    self.scene.show_thumbnails(images)

        threading.Thread(target=add_thumbnails, daemon=True).start()

    def _draw_timeline(self, data: dict[str, Any]) -> None:
        """The inliers of each frame in the color of its state, over time."""
        frames = data["frames"]
        seconds, inliers, state = (np.asarray(frames[key], float) for key in ("seconds", "inliers", "state"))
        columns = [
            np.where(state == number, np.maximum(inliers, 0.0), np.nan) for number in range(len(STATES))
        ]
        series = [{"label": "s"}] + [
            {
                "label": name,
                "stroke": COLORS[name],
                "width": 0,
                "points": {"show": True, "size": 3, "fill": COLORS[name]},
            }
            for name in STATES
        ]
        if self._timeline is not None:
            self._timeline.remove()
        with self._timeline_folder:
            self._timeline = self._gui.add_uplot((seconds, *columns), tuple(series), height=140)
        self._timeline_folder.visible = True

    def _fly(self, row: int) -> None:
        if self.scene.data is not None and self.scene.data["submaps"]:
            self.scene.fly(min(row, len(self.scene.data["submaps"][0]["frame"]) - 1))

    def _toggle_play(self) -> None:
        self._is_playing = not self._is_playing
        if not self._is_playing or self.scene.data is None:
            return
        last = int(self._row.max)

        def play() -> None:
            row = 0 if self._row.value >= last else int(self._row.value)
            while self._is_playing and row <= last and not self._ended.is_set():
                self._row.value = row  # which flies there
                row += max(1, last // 600)
                time.sleep(1 / PLAY_FPS)
            self._is_playing = False

        threading.Thread(target=play, daemon=True).start()

    def _compare(self) -> None:
        if self._other.value == NONE:
            raise ResultsError("choose another result first")
        other = self._other.value
        self._compare_with(
            self._runs.path(other) / TRAJECTORY, self._runs.record(other).title, is_truth=False
        )

    def _compare_with(self, path: Path, title: str, is_truth: bool) -> None:
        if self.scene.data is None:
            raise ResultsError("open a result first")
        positions, words = self._reader.call(reading.compared, self._runs.path(self._shown), path, is_truth)
        self.scene.show_other(positions)
        self._comparison.content = _line(f"{title} (orange): {words}")

    def _set_mode(self, mode: str) -> None:
        self._mode, self._rows = mode, []
        words = {
            IMAGE: "Click a frustum to see its image.",
            RULER: "Click two points.",
            UP: "Click a floor or a table.",
        }
        self._length.content = _line(words.get(mode, ""))

    def _clicked(self, event: Any) -> None:
        if self.scene.data is None or not self.scene.data["submaps"]:
            return
        camera = event.client.camera
        angle = camera.fov / max(1, camera.image_height)
        ray = event.ray_origin, event.ray_direction, angle
        if self._mode == IMAGE:
            frame = self.scene.keyframe_at(*ray)
            if frame is not None:
                image, words = self._reader.call(reading.residuals, self._runs.path(self._shown), frame)
                self._keyframe.image, self._keyframe.label, self._keyframe.visible = image, words, True
            return
        row = self.scene.point_at(*ray)
        if row < 0:
            self._length.content = _line("There is no point.")
        elif self._mode == UP:
            self.scene.turn_up(plane_normal(self.scene.points, row, np.asarray(event.ray_origin)))
        else:
            self._rows = [row] if len(self._rows) != 1 or self._rows == [row] else [*self._rows, row]
            self._show_length()

    def _show_length(self) -> None:
        assert self.scene.data is not None
        submap = self.scene.data["submaps"][0]
        self.scene.show_marks(self.scene.points[self._rows])
        if len(self._rows) == 2:
            words = length_words(*length_between(submap, *self._rows), submap["unit"])
            self._length.content = _line(f"Length: {words}")
        else:
            self._length.content = _line("Click the second point.")

    def _set_length(self) -> None:
        """Bring the map into meters, as `torchslam align` does, by the length that was measured."""
        if self.scene.data is None or len(self._rows) != 2:
            raise ResultsError("measure a length first")
        clicks = [click_of(self.scene.data, row) for row in self._rows]
        if None in clicks:
            raise ResultsError("no frame of the run shows both points: click other ones")
        path = self._runs.path(self._shown)
        done = tool(["align", str(path), "--distance", *map(str, clicks), f"{self._meters.value:g}"])
        if done.returncode:
            raise ResultsError(message_of(done, self._runs.folder))
        self._open(self._shown)

    def _crop_scene(self) -> None:
        if self.scene.data is None or not self.scene.data["submaps"]:
            return
        low, high = np.asarray(self.scene.data["submaps"][0]["box"])
        margin = 0.5 * (high - low)  # the box leaves out what is far
        share = np.array([slider.value for slider in self._crop], float).T / 100
        limits = low - margin + share * (high - low + 2 * margin)
        is_whole = all(tuple(slider.value) == (0, 100) for slider in self._crop)
        self.scene.crop(None if is_whole else limits, bool(self._is_dense.value))

    def _chosen_name(self) -> str:
        if self._chosen.value not in self._runs.names():
            raise ResultsError("choose a run first")
        return str(self._chosen.value)

    def _ask_delete(self, client: viser.ClientHandle) -> None:
        name = self._chosen_name()
        record = self._runs.record(name)
        with client.gui.add_modal("Delete the run?") as modal:
            client.gui.add_html(_line(f"{record.title} with its upload and all of its results."))
            yes, no = client.gui.add_button("Delete it", color="red"), client.gui.add_button("Keep it")

        def delete(_: Any) -> None:
            modal.close()
            self._runs.delete(name)
            if self._shown == name:
                self._shown = ""
                self.scene.clear()
            self._refresh()

        yes.on_click(self._guarded(delete))
        no.on_click(lambda _: modal.close())

    # --- what goes on

    def _watch(self) -> None:
        while not self._ended.wait(TICK_S):
            try:
                with self._lock:
                    self._runs.advance()
                    self._refresh()
                    if self._is_live:
                        self._follow()
            except Exception as error:  # the page goes on, and shows it
                self._status.content = _line(f"{reading.what_failed(error)}", "#c92a2a")

    def _follow(self) -> None:
        """Show the map so far of the run that is shown; its result once it has ended."""
        state, path = self._runs.state(self._shown), self._runs.path(self._shown)
        if state in (State.RUNNING, State.QUEUED):
            words = tuple(self._runs.command(self._shown)[1:])
            found = self._reader.call(reading.live, path, words, self._frame)
            if found is not None:
                self._frame = int(found["frame"])
                self.scene.show_live(found)
                self._image.image, self._image.visible = found["image"], True
            return
        self._open(self._shown)

    def _refresh(self) -> None:
        """Update the status and the lists."""
        names = self._runs.names()
        rows, options = list[str](), [NONE]
        for name in names:
            record, state = self._runs.record(name), self._runs.state(name)
            until = time.time() if state is State.RUNNING else record.ended
            took = f", {max(0.0, until - record.started):.0f} s" if record.started and until else ""
            picture = f"/runs/{quote(name, safe='')}/picture"
            rows.append(
                f'<div style="display:flex;gap:8px;margin:4px 12px;font-size:0.8em"><img src="{picture}" alt="" '
                f'style="width:64px;height:48px;object-fit:cover;background:#ddd"><div><b>{html.escape(record.title)}</b>'
                f"<br>{html.escape(name)}<br>{state.value}{took}</div></div>"
            )
            options.append(name)
        _set(self._list, "content", "".join(rows) or _line("No runs yet."))
        _set(self._chosen, "options", tuple(options))
        _set(self._recording, "options", (NONE, *self._runs.recordings()))
        if self._shown not in names:
            self._shown, self._is_live = "", False
        self._refresh_status()

    def _refresh_status(self) -> None:
        if not self._shown:
            _set(self._status, "content", _line("torchslam: from a video to a map"))
            for each in (self._bar, self._stop, self._resume, self._image):
                _set(each, "visible", False)
            return
        name, path = self._shown, self._runs.path(self._shown)
        state, log = self._runs.state(name), log_tail(path)
        words, share = progress_of(log) if state is State.RUNNING else ("", None)
        record = self._runs.record(name)
        messages = messages_of(log)[-SHOWN_MESSAGES:]
        if state is State.FAILED:
            messages = [messages[-1] if messages else f"the run ended with status {record.status}"]
        content = f"<b>{html.escape(record.title)}</b>: {state.value}"
        content += f"<br>{html.escape(words)}" if words else ""
        is_over = state is State.DONE
        content += "" if is_over else "".join(f"<br><small>{html.escape(each)}</small>" for each in messages)
        _set(self._status, "content", f'<div style="{_LINE}">{content}</div>')
        _set(self._bar, "visible", state is State.RUNNING)
        _set(self._bar, "value", 100.0 * (share or 0.0))
        _set(self._stop, "visible", state in (State.RUNNING, State.QUEUED))
        _set(self._resume, "visible", state in (State.STOPPED, State.FAILED))
        if state in (State.RUNNING, State.QUEUED) and not self._is_live:  # it was resumed
            self._is_live, self._frame = True, -1
            self.scene.clear()

    # --- help

    def _button(self, label: str, action: Callable[[Any], None], **options: Any) -> viser.GuiButtonHandle:
        button = self._gui.add_button(label, **options)
        button.on_click(self._guarded(action))
        return button

    def _guarded(self, action: Callable[[Any], None]) -> Callable[[Any], None]:
        """An action whose errors are shown to the user who caused it; one goes on at a time."""

        @wraps(action)
        def guarded(event: Any) -> None:
            try:
                with self._lock:
                    action(event)
                    self._runs.advance()
                    self._refresh()
            except Exception as error:
                if not isinstance(error, TorchslamError | OSError):
                    traceback.print_exc()
                if event.client is not None:
                    event.client.add_notification(
                        "That did not work", reading.what_failed(error), color="red"
                    )

        return guarded


_LINE = "margin:4px 12px;font-size:0.875em;overflow-wrap:anywhere"
_PRE = "margin:8px 12px;padding:8px;background:#f4f4f4;font-size:0.75em;white-space:pre-wrap;overflow-wrap:anywhere"


def _line(words: str, color: str = "inherit") -> str:
    """HTML of a line; the words are shown as they are."""
    return f'<div style="{_LINE};color:{color}">{html.escape(printable(words))}</div>' if words else ""


def _table(rows: dict[str, str]) -> str:
    """HTML of a table of two columns."""
    cells = "".join(
        f'<tr><td style="vertical-align:top;padding-right:8px;color:#666">{html.escape(key)}</td>'
        f"<td>{html.escape(printable(value))}</td></tr>"
        for key, value in rows.items()
    )
    return f'<table style="margin:4px 12px;font-size:0.8em">{cells}</table>'


def _set(handle: Any, name: str, value: Any) -> None:
    """Change a property where it differs, so that nothing is sent otherwise."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
