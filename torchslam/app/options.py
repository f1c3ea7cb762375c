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
NO_METERS, MARKER, HEIGHT, GPS, CLICKS = (
    "none",
    "marker",
    "camera height",
    "GPS file",
    "clicked length, after the run",
)
MAPPINGS = ("auto", "online", "global")  # as of `global_mapping.recording.Mapping`, which needs torch
FILE_KINDS = {"camera": FILE, "gps": GPS}  # kinds of uploads that belong to an option
HIDDEN = frozenset({"metric", "paper", "simulated"})
"""Sections that are not shown: the options above have the first, the others are for studies."""
MAX_SHOWN = (
    10**9
)  # limits of numbers beyond this one are not shown: a browser has no larger integers in steps of 1

# The arguments that a run of the page may have, with the words that follow. No value names a folder, so that a record
# in a folder of results from elsewhere reads nothing outside of it.
_WORD = r"[^/\\\0]{1,200}"
_ARGUMENTS = {
    "--camera": (_WORD,),
    "--stride": (r"\d{1,6}",),
    "--mapping": ("|".join(MAPPINGS),),
    "--dense": (),
    "--marker": (_WORD,),
    "--camera-height": (_WORD,),
    "--gps": (_WORD,),
    "--set": (r"[a-z_]+(\.[a-z_]+)?=[\w.+-]{1,60}",),
}


def check_arguments(arguments: Iterable[str]) -> None:
    """Check the arguments of a run, which may be those of a record from elsewhere.

    Raises ConfigError for one that the page does not give, or that imports code.
    """
    words = list(arguments)
    while words:
        flag = words.pop(0)
        if flag not in _ARGUMENTS:
            raise ConfigError(f"{flag!r}: no option of the page")
        for pattern in _ARGUMENTS[flag]:
            value = words.pop(0) if words else ""
            if not re.fullmatch(pattern, value) or value.startswith("-") or value in (".", ".."):
                raise ConfigError(f"{flag} {value!r}: not a value that the page accepts")
            if flag == "--set":
                check_override_in_file(Config, value, flag)
                merge_settings(Config(), None, [value])


class Options:
    """The options in the panel.

    Attributes:
        files: uploaded files that belong to an option, by kind.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        about = descriptions(MetricConfig)
        self.files = dict[str, Path]()
        presets = PRESETS.split(", ")
        self._camera = gui.add_dropdown(
            "Camera",
            (UNKNOWN, FILE, *presets),
            hint="unknown: that of the recording, if it states one, else estimated from the images",
        )
        self._stride = gui.add_number(
            "Every N-th frame", 1, min=1, max=1000, step=1, hint="1: all frames are used"
        )
        self._mapping = gui.add_dropdown(
            "Mapping",
            MAPPINGS,
            hint="auto: frame by frame, and then as a whole where frames were lost or the check fails; "
            "online: frame by frame alone; global: always as a whole as well",
        )
        self._dense = gui.add_checkbox("Dense", False, hint="compute a dense cloud after the run")
        self._meters = gui.add_dropdown(
            "Meters", (NO_METERS, MARKER, HEIGHT, GPS, CLICKS), hint="what determines the metric scale"
        )
        self._marker = gui.add_text("Marker", "aruco-4x4:0.10", visible=False, hint=about["marker"])
        self._height = gui.add_number(
            "Meters above ground", 1.5, min=0.01, max=1000, visible=False, hint=about["camera_height"]
        )
        self._uploads = {kind: gui.add_html("", visible=False) for kind in FILE_KINDS}
        self._camera.on_update(lambda _: self._show())
        self._meters.on_update(lambda _: self._show())
        self._settings = dict[str, tuple[Any, Any]]()  # widget and default by full name
        with gui.add_folder("Settings", expand_by_default=False):
            self._add_settings(gui, Config())
        self._show()

    def take(self, kind: str, path: Path, title: str) -> None:
        """Use an uploaded file for an option."""
        self.files[kind] = path
        self._camera.value, self._meters.value = (
            (FILE, self._meters.value) if kind == "camera" else (self._camera.value, GPS)
        )
        self._show()

    def arguments(self) -> tuple[tuple[str, ...], dict[str, Path]]:
        """The arguments of the run, and the uploaded files that they name.

        Raises ConfigError for a value that is not allowed, or a file that is missing.
        """
        used = [
            kind for kind, choice in FILE_KINDS.items() if choice in (self._camera.value, self._meters.value)
        ]
        missing = [kind for kind in used if kind not in self.files]
        if missing:
            raise ConfigError(f"choose the file of the {missing[0]} first")
        words = ["--mapping", self._mapping.value]
        if self._stride.value > 1:
            words += ["--stride", str(int(self._stride.value))]
        if self._camera.value != UNKNOWN:
            is_file = self._camera.value == FILE
            words += ["--camera", self.files["camera"].name if is_file else self._camera.value]
        words += ["--dense"] if self._dense.value else []
        meters = {
            MARKER: ("--marker", self._marker.value),
            HEIGHT: ("--camera-height", f"{self._height.value:g}"),
        }
        words += meters.get(self._meters.value, ())
        if self._meters.value == GPS:
            words += ["--gps", self.files["gps"].name]
        for name, (widget, default) in self._settings.items():
            if widget.value != default:
                value = str(widget.value).lower() if isinstance(default, bool) else str(widget.value)
                words += ["--set", f"{name}={value}"]
        check_arguments(words)
        return tuple(words), {kind: self.files[kind] for kind in used}

    def _show(self) -> None:
        """Show the details of what is chosen."""
        self._marker.visible = self._meters.value == MARKER
        self._height.visible = self._meters.value == HEIGHT
        for kind, html in self._uploads.items():
            html.visible = FILE_KINDS[kind] in (self._camera.value, self._meters.value)
            html.content = file_button(
                f"{'Choose' if kind not in self.files else 'Replace'} the {kind} file", kind
            )

    def _add_settings(self, gui: viser.GuiApi, section: Settings, prefix: str = "") -> None:
        """Add a widget for each setting, with its description; those that are free text could name files or code."""
        about = descriptions(type(section))
        for declared in fields(section):
            name, value = prefix + declared.name, getattr(section, declared.name)
            if isinstance(value, Settings):
                if declared.name not in HIDDEN:
                    with gui.add_folder(declared.name.replace("_", " "), expand_by_default=False):
                        self._add_settings(gui, value, f"{declared.name}.")
                continue
            allowed: Allowed = declared.metadata.get("allowed", Allowed())
            label, hint = declared.name.replace("_", " "), about.get(declared.name)
            widget: Any
            if isinstance(value, bool):
                widget = gui.add_checkbox(label, value, hint=hint)
            elif isinstance(value, int | float):
                limits = {
                    key: each
                    for key, each in (("min", allowed.low), ("max", allowed.high))
                    if abs(each) < MAX_SHOWN
                }
                if allowed.also is not None:
                    limits["min"] = min(allowed.also, limits.get("min", allowed.also))
                widget = gui.add_number(
                    label, value, hint=hint, step=1 if isinstance(value, int) else 1e-6, **limits
                )
            elif allowed.choices:
                widget = gui.add_dropdown(label, allowed.choices, initial_value=value, hint=hint)
            else:
                continue
            self._settings[name] = widget, value


def file_button(label: str, kind: str, is_main: bool = False) -> str:
    """HTML of a button that chooses a file to upload, see page.js; `label` and `kind` are words of this program."""
    color = "#228be6;color:#fff" if is_main else "#e7f0fa;color:#1864ab"
    several = " multiple" if kind == "recording" else ""
    return (
        f'<label style="display:block;margin:4px 12px;padding:6px;border-radius:4px;text-align:center;cursor:pointer;'
        f'font-size:0.875em;font-weight:500;background:{color}">{label}'
        f'<input type="file" data-kind="{kind}"{several} style="display:none"></label>'
    )
