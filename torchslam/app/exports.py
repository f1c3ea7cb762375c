"""What is taken away from a result: files of its folder, exports of `torchslam export`, zips of them, and words."""

from __future__ import annotations

import itertools
import shlex
import shutil
import threading
import zipfile
from pathlib import Path
from typing import NamedTuple

from torchslam.app.jobs import INPUT, LOCK, LOG, RECORD, Record, message_of, tool
from torchslam.errors import ResultsError
from torchslam.io.file_names import DENSE_CLOUD, MESH, METRICS, POINT_CLOUD, TRAJECTORY

FOLDER = "taken"  # in the results folder: written on demand, and again when the results have changed
VIEW = "view.html"  # as `page.VIEW`, whose module imports torch
FREE = 1 << 30  # bytes of the disk that exports leave free


class Export(NamedTuple):
    """Something to take away.

    Attributes:
        label: on the page.
        file: of the results folder; empty for an export.
        words: of `torchslam export`, and the name of what it writes.
    """

    label: str
    file: str = ""
    words: tuple[str, ...] = ()


EXPORTS = {
    "colmap": Export("COLMAP (zip)", words=("--to", "colmap")),
    "nerfstudio": Export("nerfstudio (zip)", words=("--to", "nerfstudio")),
    "splat": Export("3D Gaussian splatting (zip)", words=("--to", "colmap", "--undistort")),
    "ply": Export("sparse cloud (PLY)", POINT_CLOUD),
    "dense": Export("dense cloud (PLY)", DENSE_CLOUD),
    "mesh": Export("mesh (PLY)", MESH),
    "tum": Export("path, TUM", TRAJECTORY),
    "kitti": Export("path, KITTI (zip)", words=("--to", "kitti")),
    "view": Export("view.html, to share", VIEW),
    "all": Export("all results (zip)"),
}
_writing = threading.Lock()


def write_export(path: Path, kind: str, name: str) -> tuple[Path, str]:
    """Write an export of a results folder unless it is there; return the file, and the name to save it under.

    Raises ResultsError if it is none, or cannot be written.
    """
    if kind not in EXPORTS:
        raise ResultsError("no such export")
    export = EXPORTS[kind]
    if not (path / METRICS).is_file():
        raise ResultsError("the run has no results yet")
    if export.file:
        if not (path / export.file).is_file():
            hint = {"dense": "run it with Dense", "mesh": "run it with Dense"}.get(kind, "the run wrote none")
            if kind == "mesh" and (path / DENSE_CLOUD).is_file():
                return _made_mesh(path), f"{name}-{MESH}"
            raise ResultsError(f"no {export.file}: {hint}")
        return path / export.file, f"{name}-{export.file}"
    with _writing:
        target = path / FOLDER / f"{kind}.zip"
        if not target.exists() or target.stat().st_mtime < (path / METRICS).stat().st_mtime:
            _check_disk(path)
            source = path
            if export.words:
                source = path / FOLDER / kind
                _export(path, [*export.words, "--output", str(source), "--overwrite"])
            zip_folder(source, target)
        return target, f"{name}-{kind}.zip"


def links(name: str, address: str) -> str:
    """HTML of the buttons for all exports, see page.js; `address` is that of the run, quoted."""
    style = "display:block;margin:4px 12px;cursor:pointer;color:#1864ab;font-size:0.875em"
    return "".join(
        f'<a role="button" style="{style}" data-take="{label}" data-address="{address}/{kind}">{label}</a>'
        for kind, (label, *_) in EXPORTS.items()
    )


def command_and_python(record: Record, words: list[str], folder: Path) -> str:
    """The command line that does the same, and lines of Python; paths are below `folder`, which is left out."""
    plain = [word.replace(f"{folder}/", "") for word in words]
    source, arguments = plain[1], dict(zip(plain, [*plain[1:], ""], strict=True))
    opened = [repr(source)]
    opened += [f"camera={arguments['--camera']!r}"] if "--camera" in arguments else []
    opened += [f"stride={arguments['--stride']}"] if "--stride" in arguments else []
    settings = [after for word, after in itertools.pairwise(plain) if word == "--set"]
    settings += [
        f"metric.{flag[2:].replace('-', '_')}={arguments[flag]}"
        for flag in ("--marker", "--camera-height", "--gps")
        if flag in arguments
    ]
    lines = [
        "import torchslam",
        "",
        f"sequence = torchslam.open_sequence({', '.join(opened)})",
        f"config = torchslam.load_config(None, {settings!r})",
        f"run = torchslam.run(sequence, config, mapping={arguments.get('--mapping', 'auto')!r})",
        "if run.check is not None:",
        "    print(run.check.sentence())",
        "print(run.camera.params, run.trajectory.positions_w.shape)",
        "points = run.map.positions_w[run.map.valid_points()]",
    ]
    return shlex.join(["torchslam", *plain]) + "\n\n" + "\n".join(lines)


def zip_folder(source: Path, target: Path) -> None:
    """Write the files of a folder into a zip, whole or not at all; not what was uploaded, nor links."""
    target.parent.mkdir(exist_ok=True)
    part = target.with_suffix(".part")
    left_out = {RECORD, LOG, LOCK, FOLDER}
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for file in sorted(source.rglob("*")):
            inside = file.relative_to(source)
            is_kept = inside.parts[0] not in left_out and not inside.parts[0].startswith(f"{INPUT}.")
            if file.is_file() and not file.is_symlink() and is_kept and inside.parts[0] != INPUT:
                archive.write(file, inside)
    part.replace(target)


def _made_mesh(path: Path) -> Path:
    with _writing:
        _check_disk(path)
        _export(path, ["--to", "mesh", "--output", str(path / MESH), "--overwrite"])
    return path / MESH


def _export(path: Path, words: list[str]) -> None:
    done = tool(["export", str(path), *words])
    if done.returncode:
        raise ResultsError(message_of(done, path.parent))


def _check_disk(path: Path) -> None:
    if shutil.disk_usage(path).free < FREE:
        raise ResultsError("the disk of the server has not enough space")
