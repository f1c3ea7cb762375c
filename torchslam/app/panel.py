"""The panel of the page: a new run, the run that goes on, its result, and the list of all runs."""

from __future__ import annotations

import html
import threading
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import viser

from torchslam.app import exports, reading
from torchslam.app.jobs import DEMO, INTERRUPTED, Runs, State, log_tail, progress_of, tool, without_paths
from torchslam.app.options import FILE_KINDS, Options, file_button
from torchslam.app.scene import Scene, click_of, length_between, length_words
from torchslam.errors import ResultsError, TorchslamError
from torchslam.io.file_names import METRICS, TRAJECTORY
from torchslam.utils.console import printable

TICK_S = 1.0
"""Seconds between two looks at the runs. Tried at 1 only: the log has a line a second."""
CHECK_S = 120.0  # seconds in which a reader is to open an upload; tried at this value only
PLAY_FPS, PLAY_STEPS = 15, 600  # poses a second while the path is played, and in all
SHOWN_MESSAGES = 6  # last messages of a run
PLAY, PAUSE = "Play the path", "Pause"
GOING_ON = (State.RUNNING, State.QUEUED)
NONE = "—"  # of the lists
IMAGE, RULER, UP = "show image", "measure", "set up"
WORDS = {
    IMAGE: "Click a frustum to see its image.",
    RULER: "Click two points.",
    UP: "Click a floor or a table.",
}
LINE = "margin:4px 12px;font-size:0.875em;overflow-wrap:anywhere"
PRE = "margin:8px 12px;padding:8px;background:#f4f4f4;font-size:0.75em;white-space:pre-wrap;overflow-wrap:anywhere"
ROW = "display:flex;gap:8px;margin:4px 12px;font-size:0.8em;overflow-wrap:anywhere"
PICTURE = "width:64px;height:48px;object-fit:cover;background:#ddd"
EMPTY = np.zeros((1, 1, 3), np.uint8)  # an image before there is one


class Panel:
    """The panel, the same for all who look at the page; what they do takes effect one after the other."""

    def __init__(self, viewer: viser.ViserServer, runs: Runs, reader: reading.ReadingProcess) -> None:
        self._gui, self._runs, self._reader = viewer.gui, runs, reader
        self._scene, self._lock, self._ended = Scene(viewer), threading.RLock(), threading.Event()
        self._shown, self._is_live, self._frame = "", False, -1  # the run that is shown, and its frame
        self._upload: tuple[Path, str] | None = None
        self._rows = list[int]()  # points that were measured
        self._told = ""  # the last error that no user caused
        self._viewer, self._flight = viewer, threading.Event()  # set: the path is not played
        self._flight.set()
        viewer.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        viewer.gui.main_panel.dock_right()
        self._status = self._gui.add_html("")
        self._bar = self._gui.add_progress_bar(0.0, visible=False, animated=True)
        self._image = self._gui.add_image(EMPTY, visible=False)
        self._stop = self._button("Stop", lambda _: self._runs.stop(self._shown), color="red")
        self._resume = self._button("Resume", lambda _: self._runs.resume(self._shown))
        tabs = self._gui.add_tab_group()
        added = {"New": self._add_new, "Result": self._add_result, "Measure": self._add_measures}
        for label, add in (added | {"Take away": self._add_exports, "Runs": self._add_runs}).items():
            with tabs.add_tab(label):
                add()
        viewer.scene.on_click()(self._guarded(self._clicked))
        threading.Thread(target=self._watch, daemon=True).start()

    def close(self) -> None:
        """Stop watching the runs, which go on."""
        self._ended.set()

    def received(self, kind: str, path: Path, called: str) -> None:
        """Take an upload. Raises ResultsError with the reader's message if it cannot be read."""
        try:
            self._take(kind, path, called)
        except TorchslamError as error:
            raise ResultsError(without_paths(str(error), self._runs.folder, called)) from None

    def _take(self, kind: str, path: Path, called: str) -> None:
        if kind == "recording":
            lines = tool(["info", str(path)], CHECK_S).splitlines()
            about = dict(line.split(maxsplit=1) for line in lines if len(line.split(maxsplit=1)) == 2)
            self._upload, self._recording.value = (path, called), NONE
            words = f"{called}: {about.get('frames', '?')} frames, {about.get('size', '')}. Start it below."
            self._source.content = line_of(words, "#2b8a3e")
        elif kind in FILE_KINDS:
            if path.is_dir():
                raise ResultsError(f"one {FILE_KINDS[kind]} is needed, not several files")
            self._options.take(kind, path.rename(path.with_name(f"{kind}{path.suffix}")))
        elif kind == "truth":
            self._compare(path, called, is_truth=True)
        else:
            raise ResultsError("no such kind of upload")

    # --- tabs

    def _add_new(self) -> None:
        self._source = self._gui.add_html(line_of("Drop a video, a zip of images or several photos, or:"))
        self._gui.add_html(file_button("Choose a video or photos", "recording", "#228be6;color:#fff"))
        self._recording = self._gui.add_dropdown("In the folder", (NONE, *self._runs.recordings()))
        demo = self._button("Demo: a rendered room", lambda _: self.begin(self._runs.add("demo room", DEMO)))
        demo.color = "gray"
        self._options = Options(self._gui)
        self._button("Start", lambda _: self._start())

    def _add_result(self) -> None:
        self._summary = self._gui.add_html("")
        self._timeline = self._gui.add_image(EMPTY, visible=False)
        self._row = self._gui.add_slider("Path", 0, 1, 1, 0, hint="fly along the path")
        self._row.on_update(self._slide)
        self._play = self._button(PLAY, lambda event: self._toggle_play(event.client), color="gray")
        self._keyframe = self._gui.add_image(EMPTY, visible=False)
        self._other = self._gui.add_dropdown("Compare with", (NONE,))
        self._button("Compare", lambda _: self._compare_run(str(self._other.value)), color="gray")
        self._gui.add_html(file_button("Compare with a true path (TUM)", "truth"))
        self._comparison = self._gui.add_html("")

    def _add_measures(self) -> None:
        self._mode = self._gui.add_dropdown("A click will", (IMAGE, RULER, UP))
        self._mode.on_update(self._guarded(lambda _: self._show_mode()))
        self._length = self._gui.add_html(line_of(WORDS[IMAGE]))
        self._meters = self._gui.add_number("True length, m", 1.0, min=1e-3, max=1e5, step=1e-3)
        self._button("Set the length", lambda _: self._set_length())
        whole: dict[str, Any] = {"min": 0, "max": 100, "step": 1, "initial_value": (0, 100)}
        self._crop = [self._gui.add_multi_slider(f"Crop {axis}", **whole) for axis in "xyz"]
        self._is_dense = self._gui.add_checkbox("Dense cloud", True)
        for each in (*self._crop, self._is_dense):
            each.on_update(self._guarded(lambda _: self._crop_scene()))

    def _add_exports(self) -> None:
        self._links, self._commands = self._gui.add_html(""), self._gui.add_html("")

    def _add_runs(self) -> None:
        self._list = self._gui.add_html("")
        self._chosen = self._gui.add_dropdown("Run", (NONE,))
        self._button("Open", lambda _: self._open(str(self._chosen.value)))
        self._button("Delete", lambda event: self._ask_delete(event.client), color="red")

    # --- actions

    def _start(self) -> None:
        (words, files), chosen = self._options.arguments(), str(self._recording.value)
        if chosen in self._runs.recordings():
            name = self._runs.add(chosen, chosen, words, None, files)
        elif self._upload is not None:
            name, self._upload = self._runs.add(self._upload[1], "", words, self._upload[0], files), None
        else:
            raise ResultsError("choose a recording first")
        self._source.content = line_of("Drop the next recording on the page, or:")
        self.begin(name)

    def begin(self, name: str) -> None:
        """Show a run that was just added, unless one that goes on is shown, for which it waits."""
        if not self._shown or self._runs.state(self._shown) is not State.RUNNING:
            self._open(name)

    def _open(self, name: str) -> None:
        """Show a run: its map so far, or its result; nothing for an empty name."""
        state = self._runs.state(name) if name else None
        self._flight.set()
        self._shown, self._frame, self._rows = name, -1, []
        self._is_live, self._mode.value = state in GOING_ON, IMAGE
        for image in (self._keyframe, self._image, self._timeline):
            image.visible = False
        for text in (self._summary, self._comparison, self._commands):
            text.content = ""
        self._links.content = line_of("There is no result yet.")
        self._scene.clear()
        if name and not self._is_live and (self._runs.path(name) / METRICS).exists():
            self._show_result(name)

    def _show_result(self, name: str) -> None:
        data = self._reader.call(reading.result, self._runs.path(name))
        self._scene.show_result(data["submap"])
        self._summary.content = line_of(data["failure"], "#c92a2a") + table(data["summary"])
        self._timeline.image, self._timeline.visible = data["timeline"], True
        self._links.content = exports.links(f"/runs/{quote(name, safe='')}")
        if self._runs.record(name).source:
            lengths = self._runs.record(name).lengths
            words = exports.command_and_python(self._runs.command(name), self._runs.folder, lengths)
            self._commands.content = f'<pre style="{PRE}">{html.escape(words)}</pre>'
        self._row.max = max(1, len(data["submap"].get("poses", ())) - 1)

    def _slide(self, event: Any) -> None:
        if event.client is not None:  # else it is played
            self._scene.fly(int(self._row.value), event.client)

    def _toggle_play(self, client: viser.ClientHandle) -> None:
        """Fly one client along the path until its end, another press of the button, or the client leaves."""

        def play(flight: threading.Event) -> None:
            last = int(self._row.max)
            row = 0 if self._row.value >= last else int(self._row.value)
            while (
                row <= last
                and client.client_id in self._viewer.get_clients()
                and not flight.wait(1 / PLAY_FPS)
            ):
                self._row.value = row
                self._scene.fly(row, client)
                row += max(1, last // PLAY_STEPS)
            flight.set()
            if flight is self._flight:
                self._play.label = PLAY

        is_start = self._flight.is_set() and bool(self._scene.submap)
        self._flight.set()
        if is_start:
            self._flight, self._play.label = threading.Event(), PAUSE
            threading.Thread(target=play, args=(self._flight,), daemon=True).start()

    def _compare_run(self, name: str) -> None:
        self._compare(self._runs.path(name) / TRAJECTORY, self._runs.record(name).title, is_truth=False)

    def _compare(self, path: Path, title: str, is_truth: bool) -> None:
        if not self._scene.submap:
            raise ResultsError("open a result first")
        shown, S = self._runs.path(self._shown), self._scene.submap["S_shown_map"]
        positions, words = self._reader.call(reading.compared, shown, path, is_truth, S)
        self._scene.show_other(positions)
        self._comparison.content = line_of(f"{title} (orange): {words}")

    def _show_mode(self) -> None:
        self._rows, self._length.content = [], line_of(WORDS[self._mode.value])

    def _clicked(self, event: Any) -> None:
        if not self._scene.submap:
            return
        mode = self._mode.value
        row, words = self._scene.clicked(event, is_keyframe=mode == IMAGE), WORDS[mode]
        if row < 0:
            words = "There is nothing within 14 pixels."
        elif mode == IMAGE:
            found = self._reader.call(reading.residuals, self._runs.path(self._shown), row)
            (self._keyframe.image, self._keyframe.label), self._keyframe.visible = found, True
            words = "The image is shown in Result."
        elif mode == UP:
            self._scene.turn_up(row, np.asarray(event.ray_origin))
        else:
            self._rows = [*self._rows, row] if len(self._rows) == 1 and self._rows != [row] else [row]
            self._scene.show_marks(self._rows)
            words = "Click the second point."
            if len(self._rows) == 2:
                length = length_between(self._scene.submap, self._rows)
                words = f"Length: {length_words(*length, self._scene.submap['unit'])}"
        self._length.content = line_of(words)

    def _set_length(self) -> None:
        """Bring the map into meters, as `torchslam align` does, by the length that was measured."""
        if len(self._rows) != 2:
            raise ResultsError("measure a length first")
        clicks = [click for row in self._rows if (click := click_of(self._scene.submap, row))]
        if len(clicks) != 2:
            raise ResultsError("no frame of the run shows both points: click other ones")
        self._runs.scale(self._shown, [*clicks, f"{self._meters.value:g}"])
        self._open(self._shown)

    def _crop_scene(self) -> None:
        if self._scene.submap:
            low, high = np.asarray(self._scene.submap["box"])
            share = np.array([slider.value for slider in self._crop], float).T / 100
            limits = low + (2.0 * share - 0.5) * (high - low)  # the box leaves out what is far
            limits[share == 0.0], limits[share == 1.0] = -np.inf, np.inf
            self._scene.crop(limits, bool(self._is_dense.value))

    def _ask_delete(self, client: viser.ClientHandle) -> None:
        name = self._runs.path(str(self._chosen.value)).name

        def delete(_: Any) -> None:
            modal.close()
            self._runs.delete(name)
            if self._shown == name:
                self._open("")

        with client.gui.add_modal("Delete the run?") as modal:
            title = self._runs.record(name).title
            client.gui.add_html(line_of(f"{title} ({name}), with its upload and all of its results."))
            client.gui.add_button("Delete it", color="red").on_click(self._guarded(delete))
            client.gui.add_button("Keep it").on_click(lambda _: modal.close())

    # --- what goes on

    def _watch(self) -> None:
        self._guarded(lambda _: self._open(self._runs.running() or next(iter(self._runs.names()), "")))(None)
        look = self._guarded(lambda _: self._follow() if self._is_live else None)
        while not self._ended.wait(TICK_S):
            look(None)

    def _follow(self) -> None:
        """Show the map so far of the run that is shown; its result once it has ended."""
        if self._runs.state(self._shown) not in GOING_ON:
            self._open(self._shown)
            return
        found = reading.live(self._runs.path(self._shown))
        if found is not None and int(found["frame"]) != self._frame:
            self._frame = int(found["frame"])
            self._scene.show_live(found)
            self._image.visible = found["image"].size > 0
            self._image.image = found["image"] if self._image.visible else EMPTY

    def _refresh(self) -> None:
        """Start what waits, and update the status and the lists."""
        self._runs.advance()
        names, rows, others = self._runs.names(), list[str](), list[str]()
        for name in names:
            state, took = self._runs.state(name), self._runs.seconds(name)
            if name != self._shown and state in GOING_ON:
                others.append(f"{self._runs.record(name).title}: {state.value}")
            image = f'<img src="/runs/{quote(name, safe="")}/picture" alt="" style="{PICTURE}">'
            words = f"<b>{html.escape(self._runs.record(name).title)}</b><br>{html.escape(name)}<br>"
            words += state.value + (f", {took:.0f} s" if took else "")
            rows.append(f'<div style="{ROW}">{image if state is State.DONE else ""}<div>{words}</div></div>')
        self._list.content = "".join(rows) or line_of("No runs yet.")
        comparable = [name for name in names if name != self._shown]
        lists = ((self._chosen, names), (self._other, comparable), (self._recording, self._runs.recordings()))
        for each, values in lists:
            if each.options != (NONE, *values):
                each.options = (NONE, *values)
        self._shown = self._shown if self._shown in names else ""
        self._refresh_status(others)

    def _refresh_status(self, others: list[str]) -> None:
        """Update what is above the tabs: state, progress and messages of the run that is shown; and other runs."""
        state = self._runs.state(self._shown) if self._shown else None
        log = log_tail(self._runs.path(self._shown)) if self._shown else []
        words, share = progress_of(log) if state is State.RUNNING else ("", 0.0)
        messages = [line.removeprefix("torchslam: ") for line in log if line.startswith("torchslam: ")]
        has_ended = state in (State.STOPPED, State.FAILED)
        if has_ended and not (log and log[-1].startswith(("torchslam: error: ", INTERRUPTED))):
            messages.append(f"the run ended unexpectedly: {log[-1] if log else 'no message'}")
        lines = [words, *(messages[-SHOWN_MESSAGES:] if state is not State.DONE else []), *others]
        content = "torchslam: from a video to a map"
        if state is not None:
            content = f"<b>{html.escape(self._runs.record(self._shown).title)}</b>: {state.value}"
        content += "".join(f"<br>{html.escape(each)}" for each in lines if each)
        self._status.content = f'<div style="{LINE}">{content}</div>'
        self._bar.value = 100.0 * share
        self._bar.visible = self._stop.visible = state in GOING_ON
        self._resume.visible = has_ended
        if state in GOING_ON and not self._is_live:  # it was resumed
            self._open(self._shown)

    def _button(self, label: str, action: Callable[[Any], None], **options: Any) -> viser.GuiButtonHandle:
        button = self._gui.add_button(label, **options)
        button.on_click(self._guarded(action))
        return button

    def _guarded(self, action: Callable[[Any], None]) -> Callable[[Any], None]:
        """An action whose errors are shown to the user who caused it, or to all; one goes on at a time."""

        def guarded(event: Any) -> None:
            try:
                with self._lock:
                    try:
                        action(event)
                    finally:
                        self._refresh()  # the status never stays that of before
            except Exception as error:  # the page goes on, whatever it is
                if not isinstance(error, TorchslamError | OSError):
                    traceback.print_exc()
                words = printable(without_paths(str(error) or type(error).__name__, self._runs.folder))
                is_users = event is not None and event.client is not None
                if not is_users and words == self._told:
                    return  # the same every second
                self._told = self._told if is_users else words
                for client in [event.client] if is_users else self._viewer.get_clients().values():
                    client.add_notification("That did not work", words, color="red")

        return guarded


def line_of(words: str, color: str = "inherit") -> str:
    """HTML of a line; the words are shown as they are, whatever they contain."""
    return f'<div style="{LINE};color:{color}">{html.escape(printable(words))}</div>' if words else ""


def table(rows: Mapping[str, str]) -> str:
    """HTML of a table of two columns; the words are shown as they are."""
    cells = "".join(
        f'<tr><td style="vertical-align:top;padding-right:8px;color:#666">{html.escape(key)}</td>'
        f"<td>{html.escape(printable(value))}</td></tr>"
        for key, value in rows.items()
    )
    return f'<table style="margin:4px 12px;font-size:0.8em">{cells}</table>'
