"""Compute dense depth of a run from its map and images: depth maps, a colored cloud and pictures.

Each keyframe, or every N-th frame with --every, gets a depth map with normals and confidence. What is textureless,
reflecting or moving stays unknown. dense.ply is the cloud; the folder dense has depths.safetensors and pictures.
--mesh also writes mesh.ply (extra `mesh`). Images that cannot be read are skipped. An interrupted computation goes on
where it ended when it is started again with the same options.

Exit status: 0 done, 2 an error; 130 ended by Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import re
import warnings
from pathlib import Path

from tqdm import tqdm

from torchslam.cli import arguments
from torchslam.cli.progress import shown_warnings
from torchslam.config import CHOICES, load_config
from torchslam.densify import densify
from torchslam.densify.views import views_of
from torchslam.errors import ConfigError, ResultsError
from torchslam.io.export.mesh import import_open3d, write_mesh
from torchslam.io.export.ply import upright_from_map, write_cloud
from torchslam.io.export.scene import pinhole_within
from torchslam.io.results import CONFIG, DENSE_CLOUD, DEPTHS, MAP, MESH, open_run, write_metrics
from torchslam.io.viewer.page import VIEW
from torchslam.io.write_run import redraw
from torchslam.parallel.workers import processors
from torchslam.utils.console import table, tqdm_options

LONG_SIDE = 320
"""Default resolution: about a second per keyframe."""
MAX_PROCESSES = 4
"""Unless asked for: each takes up to 1.4 GB of memory at 640 x 480."""
SMALLEST = 64
"""Width and height of a depth map, pixels: windows at half size must be a small part of it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam densify`."""
    arguments.add_directory(parser)
    add_options(parser)
    arguments.add_images(parser)
    parser.add_argument(
        "--processes",
        type=arguments.at_least(1),
        metavar="N",
        help="number of processes on the CPU; results are identical (default: one per processor, at most "
        f"{MAX_PROCESSES})",
    )
    parser.add_argument(
        "--aggregation",
        choices=CHOICES["dense.aggregation"],
        help="aggregation of matching costs (dense.aggregation; default: as the run was configured)",
    )
    arguments.add_device(parser)


def add_options(parser: argparse._ActionsContainer) -> None:
    """Add the arguments of dense depth that `torchslam run` has as well; it has no others."""
    parser.set_defaults(images=None, aggregation=None)
    parser.add_argument(
        "--resolution",
        default=str(LONG_SIDE),
        metavar="WxH|LONG",
        help="size of the depth maps: 640x480, or the longer side (default: %(default)s)",
    )
    parser.add_argument(
        "--every",
        type=arguments.at_least(1),
        metavar="N",
        help="depth for every N-th posed frame (default: for the keyframes)",
    )
    parser.add_argument(
        "--mesh", action="store_true", help="also write the surfaces as triangles (extra `mesh`)"
    )


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam densify`; returns the exit status."""
    print(table(densify_results(options.directory, options)))
    return 0


def densify_results(directory: Path, options: argparse.Namespace) -> dict[str, str]:
    """Compute dense depth of a results folder and add it to the folder; return rows for `table`.

    Args:
        directory: the results folder.
        options: those of `torchslam densify`, or of `torchslam run --dense`, which has some of them.
    """
    device, every, rows = options.device, options.every, dict[str, str]()
    if options.mesh:
        import_open3d()
    started = sum(os.times()[:4])  # of this process and of those that it has waited for
    run = open_run(directory)
    config = load_config(directory / CONFIG if (directory / CONFIG).is_file() else None)
    aggregation = options.aggregation or config.dense.aggregation
    if run.main is None:
        raise ResultsError(f"{directory / MAP}: no map to get depth for")
    scene = run.scene(run.main, every is None)
    size = map_size(options.resolution, pinhole_within(scene.camera).size)
    views = views_of(scene, size, every)
    images = run.images(scene, views.camera, options.images, "use --images for its new location")
    layout = "depth {n_fmt}/{total_fmt} |{bar:24}| {remaining} left"
    with tqdm(total=2 * len(views), **tqdm_options(), bar_format=layout) as bar, shown_warnings():

        def on_progress(done: int, total: int) -> None:
            bar.total = total  # less where images are skipped
            bar.update(done - bar.n)

        count = options.processes or min(processors(), MAX_PROCESSES)
        if (options.processes or 1) > 1 and device.type != "cpu":
            warnings.warn("--processes is for the CPU: a GPU computes in one process", stacklevel=2)
        folder = directory / DEPTHS.parent
        found = densify(views, images, folder, device, on_progress, count, aggregation == "learned")
    R_up = upright_from_map(run.main.map, run.main.metric)
    write_cloud(directory / DENSE_CLOUD, found.cloud, R_up)
    figures = {
        "depth_maps": found.views,
        "skipped": len(found.skipped),
        "size": list(size),
        "aggregation": aggregation,
        "kept_ratio": found.kept,
        "confidence": found.confidence,
        "points": len(found.cloud),
        "voxel": found.voxel,
        "cpu_s": sum(os.times()[:4]) - started,
    }
    write_metrics(directory, run.metrics | {"dense": figures})
    if (directory / VIEW).exists():
        redraw(directory, plots=False)
    (directory / MESH).unlink(missing_ok=True)
    if options.mesh:
        made = write_mesh(directory / MESH, directory / DEPTHS, R_up, images)
        rows["mesh"] = f"{directory / MESH}, {made.triangles} triangles, voxels of {made.voxel:.4g} map units"
    return {
        "depth maps": f"{found.views} of {size[0]} x {size[1]} pixels",
        "kept": f"{found.kept:.0%} of the pixels, mean confidence {found.confidence:.2f}",
        "points": f"{len(found.cloud)}, voxels of {found.voxel:.4g} map units",
        "dense": f"{directory / DENSE_CLOUD}, {folder}",
        **rows,
    }


def map_size(text: str, image: tuple[int, int]) -> tuple[int, int]:
    """Size of depth maps: even, no larger than the image. Raises ConfigError."""
    if both := re.fullmatch(r"(\d{1,9})x(\d{1,9})", text):
        width, height = int(both[1]), int(both[2])
    elif re.fullmatch(r"\d{1,9}", text):
        scale = min(int(text) / max(image), 1.0)
        width, height = round(image[0] * scale), round(image[1] * scale)
    else:
        raise ConfigError(f"--resolution: expected 640x480 or 640, got `{text}`")
    width, height = width // 2 * 2, height // 2 * 2
    if min(width, height) < SMALLEST or width > image[0] or height > image[1]:
        raise ConfigError(
            f"--resolution {text}: depth maps of {width} x {height} pixels; at least {SMALLEST} each way and at most "
            f"the image's {image[0]} x {image[1]} are possible"
        )
    return width, height
