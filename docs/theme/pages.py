"""Generated pages of the site: the settings, the command line, the map file, and files from outside of docs/."""

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
REPOSITORY = "https://github.com/torchslam/torchslam"
OUTSIDE = ("experiments/**/*.md", "experiments/**/*.png", "CONTRIBUTING.md", "CHANGELOG.md")
"""Files of the repository that become part of the site at their own path."""


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
    """Make the links of files from outside into docs/ relative to docs/, and those to the main README absolute."""
    if (ROOT / "docs" / page.file.src_uri).exists():
        return markdown
    home = "../" * page.file.src_uri.count("/") + "README.md"  # is not part of the site
    markdown = markdown.replace(f"]({home}", f"]({REPOSITORY}")
    return markdown.replace("](docs/", "](").replace("../docs/", "../")


def _settings() -> str:
    """Return the page with every setting, its description, default and range."""
    from torchslam.config import Config

    parts = [
        "# Settings",
        "`torchslam config > mine.toml` prints all of these as a file that `--config mine.toml` reads; "
        "`--set section.name=value` changes one. In Python they are the fields of "
        '<autoref optional identifier="torchslam.config.Config"><code>Config</code></autoref> and of its sections. '
        "A value that is not allowed raises an error that lists the allowed ones.",
    ]
    parts += _sections(Config(), "")
    return "\n\n".join(parts) + "\n"


def _sections(settings: Any, prefix: str) -> Iterator[str]:
    from torchslam.config.schema import Allowed, Settings, descriptions

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
            about = descriptions(type(settings))[each.name]
            limits = each.metadata.get("allowed", Allowed())
            allowed = "true or false" if isinstance(value, bool) else str(limits)
            allowed = "any text" if isinstance(value, str) and not limits.choices else allowed
            rows.append(f"| `{each.name}` | {about} | `{shown}` | {allowed} |")
    if rows:
        title = f"## `[{prefix}]`" if prefix else "## Outside of sections"
        yield "\n".join(
            [title, "", "| setting | description | default | allowed |", "|---|---|---|---|", *rows]
        )
    for name, value in inner:
        yield from _sections(value, f"{prefix}.{name}" if prefix else name)


def _commands() -> str:
    """Return the page with the help text of every command."""
    from torchslam.cli.main import COMMANDS, build_parser

    os.environ["COLUMNS"] = "100"
    parts = [
        "# Command line",
        "Exit status: 0 done, 2 an error (one line on stderr says which), 3 no map could be initialized or no "
        "frame could be localized, 4 some sequences of a batch failed, 130 and 143 ended by Ctrl-C and by SIGTERM. "
        "`python -m torchslam` is the same command.",
    ]
    for name, summary in COMMANDS.items():
        command = build_parser(name)._subparsers._group_actions[0].choices[name]  # type: ignore[union-attr,index]
        parts += [
            f"## torchslam {name}",
            summary[0].upper() + summary[1:] + ".",
            f"```text\n{command.format_help()}```",
        ]
    return "\n\n".join(parts) + "\n"


def _map_file() -> str:
    """Return the page with the columns of `map.safetensors`."""
    from torchslam.map.file import FORMAT, TABLES

    parts = [
        f"# The map file\n\n`map.safetensors` (format {FORMAT}) holds the atlas: the tables of each submap, and "
        "`camera.params`. A tensor `submaps.0.points.positions_w` is a column of the table of points of submap 0; all "
        "columns of a table have the same rows. The metadata entry `torchslam` is JSON with the keys `format`, "
        "`camera`, `submaps` (their numbers), `num_created` and `sessions`. Letters in a shape: N keypoints of a "
        "frame, D numbers of a descriptor. Floats are float64 as a run writes them; a descriptor is bytes or floats.",
        "`torchslam.map.file.read_atlas(path)` reads and checks it; so does `SLAM.load(path)`, to continue in it. "
        "Any safetensors reader can read the tensors.",
    ]
    for name, schema in TABLES.items():
        rows = []
        for column, each in schema.items():
            shape = ", ".join(map(str, each.shape)) + "," * (len(each.shape) == 1)
            rows.append(f"| `{column}` | ({shape}) | {each.kind} | {each.about} |")
        head = [f"## {name}", "", "| column | shape of a row | kind | description |", "|---|---|---|---|"]
        parts.append("\n".join([*head, *rows]))
    return "\n\n".join(parts) + "\n"
