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
        about, self._gui, self._files = descriptions(MetricConfig), gui, dict[str, Path]()
        hint = "unknown: that of the recording, if it states one, else estimated from the images"
        self._camera = gui.add_dropdown("Camera", (UNKNOWN, FILE, *PRESETS.split(", ")), hint=hint)
        self._stride = gui.add_number("Every N-th frame", 1, min=1, max=1000, step=1)
        hint = "auto: frame by frame, as a whole where that fails; online: frame by frame; global: always as a whole"
        self._mapping = gui.add_dropdown("Mapping", MAPPINGS, hint=hint)
        self._dense = gui.add_checkbox("Dense", False, hint="compute a dense cloud after the run")
        self._meters = gui.add_dropdown("Meters", (NO_METERS, MARKER, HEIGHT, GPS, CLICKS))
        self._marker = gui.add_text("Marker", "aruco-4x4:0.10", hint=about["marker"])
        self._height = gui.add_number("Height, m", 1.5, min=0.01, max=1000, hint=about["camera_height"])
        self._uploads = {kind: gui.add_html("") for kind in FILE_KINDS}
        for each in (self._camera, self._meters):
            each.on_update(lambda _: self._show())
        self._settings = dict[str, tuple[Any, Any]]()  # widget and default by full name
        with gui.add_folder("Settings", expand_by_default=False):
            self._add_settings(Config())
        self._show()

    def take(self, kind: str, path: Path) -> None:
        """Use an uploaded file for an option."""
        self._files[kind] = path
        (self._camera if kind == "camera" else self._meters).value = FILE_KINDS[kind]
        self._show()

    def arguments(self) -> tuple[list[str], list[Path]]:
        """The arguments of the run, and the uploaded files that they name. Raises ConfigError if a file is missing."""
        camera, meters = self._camera.value, self._meters.value
        used = [kind for kind, choice in FILE_KINDS.items() if choice in (camera, meters)]
        if missing := [kind for kind in used if kind not in self._files]:
            raise ConfigError(f"choose the {missing[0]} file first")
        given = {
            "--mapping": self._mapping.value,
            "--stride": f"{self._stride.value:.0f}",
            "--camera": self._files["camera"].name
            if camera == FILE
            else camera
            if camera != UNKNOWN
            else None,
            "--marker": self._marker.value if meters == MARKER else None,
            "--camera-height": f"{self._height.value:g}" if meters == HEIGHT else None,
            "--gps": self._files["gps"].name if meters == GPS else None,
        }
        words = [word for flag, value in given.items() if value is not None for word in (flag, value)]
        for name, (widget, default) in self._settings.items():
            value = str(widget.value).lower() if isinstance(default, bool) else widget.value
            words += ["--set", f"{name}={value}"] if widget.value != default else []
        return [*words, *(["--dense"] if self._dense.value else [])], [self._files[kind] for kind in used]

    def _show(self) -> None:
        """Show the details of what is chosen."""
        chosen = self._camera.value, self._meters.value
        self._marker.visible, self._height.visible = MARKER in chosen, HEIGHT in chosen
        for kind, button in self._uploads.items():
            button.visible = FILE_KINDS[kind] in chosen
            verb = "Replace" if kind in self._files else "Choose"
            button.content = file_button(f"{verb} the {kind} file", kind)

    def _add_settings(self, section: Settings, prefix: str = "") -> None:
        """Add a widget for each setting, with its description; not for free text, which could name files or code."""
        gui, about = self._gui, descriptions(type(section))
        for declared in fields(section):
            value, label = getattr(section, declared.name), declared.name.replace("_", " ")
            allowed: Allowed = declared.metadata.get("allowed", Allowed())
            options: dict[str, Any] = {"hint": about.get(declared.name)}
            if isinstance(value, Settings):
                if declared.name not in HIDDEN:
                    with gui.add_folder(label, expand_by_default=False):
                        self._add_settings(value, f"{declared.name}.")
                continue
            if isinstance(value, bool):
                widget: Any = gui.add_checkbox(label, value, **options)
            elif isinstance(value, int | float):
                low = allowed.low if allowed.also is None else min(allowed.also, allowed.low)
                limits = [each if abs(each) < MAX_SHOWN else None for each in (low, allowed.high)]
                options |= {"min": limits[0], "max": limits[1], "step": 1 if isinstance(value, int) else 1e-6}
                widget = gui.add_number(label, value, **options)
            elif allowed.choices:
                widget = gui.add_dropdown(label, allowed.choices, initial_value=value, **options)
            else:
                continue
            self._settings[prefix + declared.name] = widget, value


def file_button(label: str, kind: str, color: str = "#e7f0fa;color:#1864ab") -> str:
    """HTML of a button that chooses a file to upload, see page.js; `label` and `kind` are words of this program."""
    several = " multiple" if kind == "recording" else ""
    style = f"display:block;margin:4px 12px;padding:6px;text-align:center;cursor:pointer;background:{color}"
    inner = f'<input type="file" data-kind="{kind}"{several} style="display:none">'
    return f'<label style="{style};border-radius:4px;font-size:0.875em">{label}{inner}</label>'
