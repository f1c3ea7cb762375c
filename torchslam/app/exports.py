"""What is taken away from a result: files of its folder, exports of `torchslam export`, zips of them, and words."""

from __future__ import annotations

import itertools
import shlex
import shutil
import threading
import zipfile
from collections.abc import Sequence
from pathlib import Path

from torchslam.app.jobs import INPUT, LOCK, LOG, RECORD, tool
from torchslam.errors import ResultsError
from torchslam.io.file_names import DENSE_CLOUD, MESH, METRICS, POINT_CLOUD, TRAJECTORY

FOLDER = "taken"  # in the results folder: written on demand, and again when the results have changed
VIEW = "view.html"  # as `page.VIEW`, whose module needs torch
FREE = 1 << 30  # bytes of the disk that uploads and exports leave free
FILES = {
    "ply": ("sparse cloud (PLY)", POINT_CLOUD),
    "dense": ("dense cloud (PLY)", DENSE_CLOUD),
    "mesh": ("mesh (PLY)", MESH),
    "tum": ("path, TUM", TRAJECTORY),
    "view": ("view.html, to share", VIEW),
}
"""Files of the results folder: label and name."""
ZIPS: dict[str, tuple[str, Sequence[str]]] = {
    "colmap": ("COLMAP (zip)", ("--to", "colmap")),
    "nerfstudio": ("nerfstudio (zip)", ("--to", "nerfstudio")),
    "splat": ("3D Gaussian splatting (zip)", ("--to", "colmap", "--undistort")),
    "kitti": ("path, KITTI (zip)", ("--to", "kitti")),
    "all": ("all results (zip)", ()),
}
"""Zips: label and arguments of `torchslam export`; without any, of the results folder itself."""
_writing = threading.Lock()


def check_disk(folder: Path, size: int = 0) -> None:
    """Check that the disk has room for some bytes more. Raises ResultsError."""
    if shutil.disk_usage(folder).free < FREE + size:
        raise ResultsError("the disk of the server has not enough space")


def write_export(path: Path, kind: str) -> Path:
    """Return the file of an export of a results folder, which is written unless it is there. Raises ResultsError."""
    if kind not in FILES | ZIPS or not (path / METRICS).is_file():
        raise ResultsError("there is no such export, or the run has no results yet")
    with _writing:
        if kind in FILES:
            file = path / FILES[kind][1]
            if kind == "mesh" and not file.is_file():
                check_disk(path)
                tool(["export", str(path), "--to", "mesh", "--output", str(file), "--overwrite"], path.parent)
            if not file.is_file():
                raise ResultsError(
                    f"the run wrote no {file.name}" + (": run it with Dense" if kind == "dense" else "")
                )
            return file
        target, (_, words) = path / FOLDER / f"{kind}.zip", ZIPS[kind]
        if not target.exists() or target.stat().st_mtime < (path / METRICS).stat().st_mtime:
            check_disk(path)
            source = path / FOLDER / kind if words else path
            if words:
                tool(["export", str(path), *words, "--output", str(source), "--overwrite"], path.parent)
            zip_folder(source, target)
        return target


def zip_folder(source: Path, target: Path) -> None:
    """Write the files of a folder into a zip, whole or not at all; not what was uploaded, nor links."""
    target.parent.mkdir(exist_ok=True)
    part = target.with_suffix(".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for file in sorted(source.rglob("*")):
            inside = file.relative_to(source)
            is_own = (
                inside.parts[0] in (RECORD, LOG, LOCK, FOLDER) or inside.parts[0].partition(".")[0] == INPUT
            )
            if file.is_file() and not file.is_symlink() and not is_own:
                archive.write(file, inside)
    part.replace(target)


def links(address: str) -> str:
    """HTML of the buttons for all exports, see page.js; `address` is that of the run, quoted."""
    style = "display:block;margin:4px 12px;cursor:pointer;color:#1864ab;font-size:0.875em"
    return "".join(
        f'<a role="button" style="{style}" data-take="{label}" data-address="{address}/{kind}">{label}</a>'
        for kind, (label, _) in (ZIPS | FILES).items()
    )


def command_and_python(words: list[str], folder: Path) -> str:
    """The command line of a run, and lines of Python that do the same; paths are relative to `folder`."""
    plain = [word.replace(f"{folder}/", "") for word in words]
    given = dict(itertools.pairwise(plain))
    stride = given.get("--stride", 1)
    settings = [after for word, after in itertools.pairwise(plain) if word == "--set"]
    for flag, name in (("--marker", "marker"), ("--camera-height", "camera_height"), ("--gps", "gps")):
        settings += [f"metric.{name}={given[flag]}"] if flag in given else []
    lines = [
        "import torchslam",
        f"sequence = torchslam.open_sequence({plain[1]!r}, {given.get('--camera')!r}, stride={stride})",
        f"config = torchslam.load_config(None, {settings!r})",
        f"run = torchslam.run(sequence, config, mapping={given.get('--mapping', 'auto')!r})",
        "if run.check is not None:",
        "    print(run.check.sentence())",
        "print(run.camera.params, run.trajectory.positions_w.shape)",
        "points = run.map.positions_w[run.map.valid_points()]",
    ]
    return shlex.join(["torchslam", *plain]) + "\n\n" + "\n".join(lines)
