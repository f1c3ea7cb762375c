"""Pages that are made when the site is built: the settings, the command line, and what lies outside of docs/."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = ("experiments/**/*.md", "experiments/**/*.png", "CONTRIBUTING.md", "CHANGELOG.md")
"""What of the repository becomes a part of the site, where it lies."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    for name, text in (
        ("settings.md", _settings()),
        ("commands.md", _commands()),
        ("map_file.md", _map_file()),
    ):
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links of a file in the root of the repository lead into docs/; here they begin there."""
    return markdown.replace("](docs/", "](") if page.file.src_uri == "CONTRIBUTING.md" else markdown


def _settings() -> str:
    """Every setting with what it is, its default and its range, as `torchslam config` prints them."""
    from torchslam.config import Config

    parts = [
        "# Settings",
        "`torchslam config > mine.toml` prints all of these as a file that `--config mine.toml` reads; "
        "`--set section.name=value` changes one. In Python they are the fields of "
        '<autoref optional identifier="torchslam.config.Config"><code>Config</code></autoref> and of its sections. '
        "A value that is not allowed is an error that says what is.",
    ]
    parts += _sections(Config(), "")
    return "\n\n".join(parts) + "\n"


def _sections(settings: Any, prefix: str) -> Iterator[str]:
    from torchslam.config.schema import Settings

    rows, inner = [], []
    for each in fields(settings):
        value = getattr(settings, each.name)
        if isinstance(value, Settings):
            inner.append((each.name, value))
        else:
            shown = (
                f'"{value}"'
                if isinstance(value, str)
                else str(value).lower()
                if value in (True, False)
                else value
            )
            about = each.metadata.get("about", "")
            allowed = "true or false" if isinstance(value, bool) else str(each.metadata["allowed"])
            allowed = (
                "any text" if isinstance(value, str) and not each.metadata["allowed"].choices else allowed
            )
            rows.append(f"| `{each.name}` | {about} | `{shown}` | {allowed} |")
    if rows:
        title = f"## `[{prefix}]`" if prefix else "## Outside of sections"
        yield "\n".join(
            [title, "", "| setting | what it is | default | allowed |", "|---|---|---|---|", *rows]
        )
    for name, value in inner:
        yield from _sections(value, f"{prefix}.{name}" if prefix else name)


def _commands() -> str:
    """What every command says of itself under `--help`."""
    from torchslam.cli.main import COMMANDS, build_parser

    os.environ["COLUMNS"] = "100"
    parts = [
        "# Command line",
        "Exit status: 0 done, 2 an error (one line on stderr says which), 3 no map could be initialised or no frame be "
        "localised, 4 some sequences of a batch ended with an error, 130 and 143 ended by Ctrl-C and by SIGTERM. "
        "`python -m torchslam` is the same command.",
    ]
    for name, (_, summary) in COMMANDS.items():
        command = build_parser(name)._subparsers._group_actions[0].choices[name]  # type: ignore[union-attr,index]
        parts += [
            f"## torchslam {name}",
            summary[0].upper() + summary[1:] + ".",
            f"```text\n{command.format_help()}```",
        ]
    return "\n\n".join(parts) + "\n"


def _map_file() -> str:
    """The columns of `map.safetensors`."""
    from torchslam.map import schema
    from torchslam.map.file import FORMAT

    parts = [
        f"# The map file\n\n`map.safetensors` (format {FORMAT}) holds everything that a run keeps: of each world its "
        "tables, and `camera.params`. A tensor `worlds.0.points.positions_w` is a column of a table of world 0; row by "
        "row, the columns of a table belong together. Letters in a shape: N keypoints of a frame, D numbers of a "
        "descriptor. Floats are float64 as a run writes them; a descriptor is bytes or floats.",
        "`torchslam.map.file.read_atlas(path)` reads and checks it; so does `SLAM.load(path)`, to go on in it. "
        "Any safetensors reader gets at the tensors.",
    ]
    for name in ("points", "keyframes", "frames", "observations"):
        rows = []
        for column, each in getattr(schema, name.upper()).items():
            shape = ", ".join(map(str, each.shape)) + "," * (len(each.shape) == 1)
            rows.append(f"| `{column}` | ({shape}) | {each.kind} | {each.about} |")
        head = [f"## {name}", "", "| column | a row | kind | what it is |", "|---|---|---|---|"]
        parts.append("\n".join([*head, *rows]))
    return "\n\n".join(parts) + "\n"
