"""view.html: map, path, cameras and errors of a run in a page that needs nothing but a browser."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from pathlib import Path

from torchslam.io.results import Results
from torchslam.io.viewer.data import page_data

VIEW = "view.html"
SCRIPTS = ("draw.js", "orbit.js", "scene.js", "view.js")  # in this order, all in one script


def write_view(results: Results, directory: Path) -> Path:
    """Write the page into a folder of results; returns its file. Same results, same bytes."""
    path = directory / VIEW
    path.write_text(page(results), encoding="utf-8")
    return path


def page(results: Results) -> str:
    """The whole page: its own style and script, and all data."""
    data = page_data(results)
    parts = {
        "title": html.escape(data["title"]),
        "css": _asset("view.css"),
        # Nothing in the data may end the script that it stands in.
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        "script": "".join(map(_asset, SCRIPTS)),
    }
    text = _asset("view.html")
    before, *rest = text.split("{{")
    pieces = [before]
    for part in rest:
        name, after = part.split("}}", 1)
        pieces += [parts[name], after]
    return "".join(pieces)


def _asset(name: str) -> str:
    return (files("torchslam.io.viewer") / name).read_text(encoding="utf-8")
