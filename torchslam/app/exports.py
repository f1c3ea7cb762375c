"""What is taken away from a result: files of its folder, exports of `torchslam export`, zips of them, and words."""

from __future__ import annotations

import itertools
import shlex
import shutil
import tempfile
import threading
import zipfile
from collections.abc import Sequence
from pathlib import Path

from torchslam.app.jobs import INPUT, LOCK, LOG, RECORD, tool
from torchslam.errors import ResultsError
from torchslam.io.file_names import DENSE_CLOUD, EXAMPLE_IMAGE, MESH, METRICS, POINT_CLOUD, TRAJECTORY

TAKEN = "taken"  # folder of the zips, in the results folder: written again when the results have changed
FREE = 1 << 30  # bytes of the disk that uploads and exports leave free
EXPORTS: dict[str, tuple[str, str, Sequence[str]]] = {
    "colmap": ("COLMAP (zip)", "", ("--to", "colmap")),
    "nerfstudio": ("nerfstudio (zip)", "", ("--to", "nerfstudio")),
    "splat": ("3D Gaussian splatting (zip)", "", ("--to", "colmap", "--undistort")),
    "kitti": ("path, KITTI (zip)", "", ("--to", "kitti")),
    "all": ("all results (zip)", "", ()),
    "ply": ("sparse cloud (PLY)", POINT_CLOUD, ()),
    "dense": ("dense cloud (PLY)", DENSE_CLOUD, ()),
    "mesh": ("mesh (PLY)", MESH, ("--to", "mesh")),
    "tum": ("path, TUM", TRAJECTORY, ()),
    "view": ("view.html, to share", "view.html", ()),
    "picture": ("", EXAMPLE_IMAGE, ()),
}
"""Label, none for the picture of a run in the list; file of the results folder, none for a zip; and arguments of
`torchslam export` that write it."""
_writing = threading.Lock()


def check_disk(folder: Path, size: int = 0) -> None:
    """Check that the disk has room for some bytes more. Raises ResultsError."""
    if shutil.disk_usage(folder).free < FREE + size:
        raise ResultsError("the disk of the server has not enough space")


def write_export(path: Path, kind: str) -> Path:
    """Return the file of an export of a results folder, which is written unless it is there. Raises ResultsError."""
    if kind not in EXPORTS or not (path / METRICS).is_file():
        raise ResultsError("there is no such export, or the run has no results yet")
    _, name, words = EXPORTS[kind]
    file = path / (name or f"{TAKEN}/{kind}.zip")
    with _writing:
        is_old = not name and file.exists() and file.stat().st_mtime < (path / METRICS).stat().st_mtime
        if file.is_file() and not is_old:
            return file
        check_disk(path)
        if not words and name:
            hint = ": run it with Dense" if kind == "dense" else ""
            raise ResultsError(f"the run wrote no {name}{hint}")
        with tempfile.TemporaryDirectory(dir=path, prefix=TAKEN) as written:
            target = str(file) if name else written
            if words:
                tool(["export", str(path), *words, "--output", target, "--overwrite"])
            if not name:
                zip_folder(Path(written) if words else path, file)
    return file


def zip_folder(source: Path, target: Path) -> None:
    """Write the files of a folder into a zip, whole or not at all; not what was uploaded, nor links."""
    target.parent.mkdir(exist_ok=True)
    part = target.with_suffix(".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for file in sorted(source.rglob("*")):
            top = file.relative_to(source).parts[0]
            is_own = top in (RECORD, LOG, LOCK) or top.startswith(TAKEN) or top.partition(".")[0] == INPUT
            if file.is_file() and not file.is_symlink() and not is_own:
                archive.write(file, file.relative_to(source))
    part.replace(target)


def links(address: str) -> str:
    """HTML of the buttons for all exports, see page.js; `address` is that of the run, quoted."""
    style = "display:block;margin:4px 12px;cursor:pointer;color:#1864ab;font-size:0.875em"
    return "".join(
        f'<a role="button" style="{style}" data-take="{label}" data-address="{address}/{kind}">{label}</a>'
        for kind, (label, _, _) in EXPORTS.items()
        if label
    )


def command_and_python(words: list[str], folder: Path, lengths: Sequence[str] = ()) -> str:
    """The command lines of a run, and lines of Python that do the same; paths are relative to `folder`.

    The first of the `lengths` determines the scale where nothing else does; the others are compared with it.
    """
    plain = [word.replace(f"{folder}/", "") for word in words]
    pairs = list(itertools.pairwise(plain))
    given = dict(pairs)
    settings = [after for word, after in pairs if word == "--set"]
    for name in ("marker", "camera_height", "gps"):
        flag = "--" + name.replace("_", "-")
        settings += [f"metric.{name}={given[flag]}"] if flag in given else []
    if lengths and not any(each.startswith("metric.") for each in settings):
        settings.append(f"metric.distance={lengths[0]}")
    commands = [plain, *(["align", given["--output"], "--distance", *each.split()] for each in lengths)]
    shell = "\n".join(shlex.join(["torchslam", *each]) for each in commands)
    stride, camera, mapping = given.get("--stride", 1), given.get("--camera"), given.get("--mapping", "auto")
    return f"""{shell}

import torchslam
sequence = torchslam.open_sequence({plain[1]!r}, {camera!r}, stride={stride})
config = torchslam.load_config(None, {settings!r})
run = torchslam.run(sequence, config, mapping={mapping!r})
if run.check is not None:
    print(run.check.sentence())
print(run.camera.params, run.trajectory.positions_w.shape)
points = run.map.positions_w[run.map.valid_points()]"""
