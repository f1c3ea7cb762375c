"""The options of a run on the page, and the arguments of `torchslam run` that they are."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchslam.cli.arguments import PRESETS
from torchslam.config import Config, MetricConfig, merge_settings
from torchslam.config.schema import Allowed, Settings, check_override_in_file, descriptions
from torchslam.errors import ConfigError

if TYPE_CHECKING:
    import viser

UNKNOWN, FILE = "unknown", "file"  # cameras beside the presets
MARKER, HEIGHT, GPS = "marker", "camera height", "GPS file"  # sources of meters, and without one:
NO_METERS, CLICKS = "none", "clicked length, after the run"
MAPPINGS = ("auto", "online", "global")  # as of `global_mapping.recording.Mapping`, which needs torch
FILE_KINDS = {"camera": FILE, "gps": GPS}  # kinds of uploads, and the option that they belong to
# Sections: the options above have the first, the others are for studies.
HIDDEN = ("metric", "paper", "simulated")
MAX_SHOWN = 10**9  # limits of numbers that are shown: a browser has no larger ones in steps of 1

# The arguments that a run of the page may have, and their values. None names a folder or a plugin, so that a record in
# results from elsewhere reads nothing outside of its own folder, and runs no code.
_WORD = r"(?!-|\.\.?$)[^/\\\0]{1,200}"
_ARGUMENTS = dict.fromkeys(("--camera", "--marker", "--camera-height", "--gps"), _WORD)
_ARGUMENTS |= {
    "--stride": r"\d{1,6}",
    "--mapping": "|".join(MAPPINGS),
    "--set": r"[a-z_]+(\.[a-z_]+)?=[\w.+-]{1,60}",
}


def check_arguments(arguments: Iterable[str]) -> None:
    """Check the arguments of a run. Raises ConfigError for one that the page does not give, or that imports code."""
    words = iter(arguments)
    for flag in words:
        if flag == "--dense":
            continue
        value = next(words, "")
        if flag not in _ARGUMENTS or not re.fullmatch(_ARGUMENTS[flag], value):
            raise ConfigError(f"{flag} {value}: the page accepts no such option")
        if flag == "--set":
            check_override_in_file(Config, value, flag)
            merge_settings(Config(), None, [value])


class Options:
    """The options in the panel."""

    def __init__(self, gui: viser.GuiApi) -> None:
        about = descriptions(MetricConfig)
        self._files = dict[str, Path]()
        cameras = (UNKNOWN, FILE, *PRESETS.split(", "))
        hint = "unknown: that of the recording, if it states one, else estimated from the images"
        self._camera = gui.add_dropdown("Camera", cameras, hint=hint)
        self._stride = gui.add_number("Every N-th frame", 1, min=1, max=1000, step=1)
        hint = "auto: frame by frame, as a whole where that fails; online: frame by frame; global: always as a whole"
        self._mapping = gui.add_dropdown("Mapping", MAPPINGS, hint=hint)
        self._dense = gui.add_checkbox("Dense", False, hint="compute a dense cloud after the run")
        self._meters = gui.add_dropdown("Meters", (NO_METERS, MARKER, HEIGHT, GPS, CLICKS))
        self._marker = gui.add_text("Marker", "aruco-4x4:0.10", hint=about["marker"])
        self._height = gui.add_number("Height, m", 1.5, min=0.01, max=1000, hint=about["camera_height"])
        self._uploads = {kind: gui.add_html("") for kind in FILE_KINDS}
        self._camera.on_update(lambda _: self._show())
        self._meters.on_update(lambda _: self._show())
        self._settings = dict[str, tuple[Any, Any]]()  # widget and default by full name
        with gui.add_folder("Settings", expand_by_default=False):
            self._add_settings(gui, Config())
        self._show()

    def take(self, kind: str, path: Path) -> None:
        """Use an uploaded file for an option."""
        self._files[kind] = path
        if kind == "camera":
            self._camera.value = FILE
        else:
            self._meters.value = GPS
        self._show()

    def arguments(self) -> tuple[list[str], list[Path]]:
        """The arguments of the run, and the uploaded files that they name. Raises ConfigError if a file is missing."""
        used = [
            kind for kind, choice in FILE_KINDS.items() if choice in (self._camera.value, self._meters.value)
        ]
        if missing := [kind for kind in used if kind not in self._files]:
            raise ConfigError(f"choose the {missing[0]} file first")
        words = ["--mapping", self._mapping.value, "--stride", f"{self._stride.value:.0f}"]
        camera, meters = self._camera.value, self._meters.value
        if camera != UNKNOWN:
            words += ["--camera", self._files["camera"].name if camera == FILE else camera]
        words += ["--dense"] if self._dense.value else []
        words += ["--marker", self._marker.value] if meters == MARKER else []
        words += ["--camera-height", f"{self._height.value:g}"] if meters == HEIGHT else []
        words += ["--gps", self._files["gps"].name] if meters == GPS else []
        for name, (widget, default) in self._settings.items():
            if widget.value != default:
                words += [
                    "--set",
                    f"{name}={str(widget.value).lower() if isinstance(default, bool) else widget.value}",
                ]
        return words, [self._files[kind] for kind in used]

    def _show(self) -> None:
        """Show the details of what is chosen."""
        self._marker.visible, self._height.visible = (
            self._meters.value == MARKER,
            self._meters.value == HEIGHT,
        )
        for kind, html in self._uploads.items():
            html.visible = FILE_KINDS[kind] in (self._camera.value, self._meters.value)
            html.content = file_button(
                f"{'Replace' if kind in self._files else 'Choose'} the {kind} file", kind
            )

    def _add_settings(self, gui: viser.GuiApi, section: Settings, prefix: str = "") -> None:
        """Add a widget for each setting, with its description; not for free text, which could name files or code."""
        about = descriptions(type(section))
        for declared in fields(section):
            value, label, widget = getattr(section, declared.name), declared.name.replace("_", " "), None
            allowed: Allowed = declared.metadata.get("allowed", Allowed())
            hint = about.get(declared.name)
            if isinstance(value, Settings):
                if declared.name not in HIDDEN:
                    with gui.add_folder(label, expand_by_default=False):
                        self._add_settings(gui, value, f"{declared.name}.")
            elif isinstance(value, bool):
                widget = gui.add_checkbox(label, value, hint=hint)
            elif isinstance(value, int | float):
                low = allowed.low if allowed.also is None else min(allowed.also, allowed.low)
                shown = [each if abs(each) < MAX_SHOWN else None for each in (low, allowed.high)]
                step = 1 if isinstance(value, int) else 1e-6
                widget = gui.add_number(label, value, min=shown[0], max=shown[1], step=step, hint=hint)
            elif allowed.choices:
                widget = gui.add_dropdown(label, allowed.choices, initial_value=value, hint=hint)
            if widget is not None:
                self._settings[prefix + declared.name] = widget, value


def file_button(label: str, kind: str, color: str = "#e7f0fa;color:#1864ab") -> str:
    """HTML of a button that chooses a file to upload, see page.js; `label` and `kind` are words of this program."""
    several = " multiple" if kind == "recording" else ""
    style = f"display:block;margin:4px 12px;padding:6px;text-align:center;cursor:pointer;background:{color}"
    inner = f'<input type="file" data-kind="{kind}"{several} style="display:none">'
    return f'<label style="{style};border-radius:4px;font-size:0.875em">{label}{inner}</label>'
