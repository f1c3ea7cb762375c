"""Depth maps of all views of a run, one view at a time and resumable, and the cloud fused from them.

Two passes: first the depth of every view alone, then every view is compared with its neighbors. Each writes a file per
view into a folder of parts, so that memory is bounded and an interrupted computation goes on where it ended.
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from torchslam.data.formats.image_file import write_image
from torchslam.dense.cloud import CloudFusion, PointCloud
from torchslam.dense.consistency import confidence_alone, confidence_together, depth_normals, kept, merge
from torchslam.dense.depth_maps import DepthMaps, join, read_about
from torchslam.dense.estimate import estimate_depth
from torchslam.dense.learned import learned_confidence
from torchslam.densify.views import CACHED, SWEPT, ViewImages, Views, readable
from torchslam.errors import ResultsError
from torchslam.io.export.scene import Images
from torchslam.io.results import DEPTHS, PICTURE_NAMES, PICTURES
from torchslam.parallel.pool import SharedTasks
from torchslam.utils.files import parse_json, read_text, write_whole
from torchslam.utils.tensor_file import write_tensors

PARTS = "parts"
JOB = "job.json"
FORMAT = 1
"""Of the parts: those of another version are computed again."""


@dataclass(frozen=True)
class DenseSummary:
    """What a dense reconstruction has.

    Attributes:
        views: number of depth maps.
        kept: ratio of pixels with depth.
        confidence: mean of the kept pixels.
        voxel: edge of the voxels of the cloud, map units.
        cloud: the cloud.
        skipped: messages about the images that could not be read.
    """

    views: int
    kept: float
    confidence: float
    voxel: float
    cloud: PointCloud
    skipped: list[str]


def densify(
    views: Views,
    images: Images,
    folder: Path,
    device: torch.device,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    processes: int = 1,
    is_learned: bool = False,
) -> DenseSummary:
    """Compute depth maps and cloud; depth maps and pictures are written.

    A view whose image cannot be read is left out with a warning.

    Args:
        views: of the run.
        images: of their frames, with the camera of the views.
        folder: for the results; its folder of parts is used again if it is of the same views, and deleted at the end.
        device: to compute on.
        on_progress: called after each view of both passes with the numbers done and in all.
        processes: that compute views, this one included; the results are the same. On a GPU one is used.
        is_learned: let the network of the package rate the depth of each view (`dense.learned`).

    Raises:
        ResultsError: too few images can be read.
        OSError: a file cannot be written; the parts stay.
    """
    views, skipped = readable(views, images)
    for message in skipped:
        warnings.warn(f"skipped a view: {message}", stacklevel=2)
    parts = folder / PARTS
    _prepare(parts, views, is_learned)
    opened = ViewImages(views, images)
    job = DenseJob(views, opened, parts, device, is_learned)
    with SharedTasks(_do, (job,), processes if device.type == "cpu" else 1) as shared:
        done = 0
        for each in Pass:
            missing = [view for view in range(len(views)) if not job.path(each, view).exists()]
            done += len(views) - len(missing)
            on_progress(done, len(Pass) * len(views))
            for _ in shared.run([(each, view) for view in missing]):
                done += 1
                on_progress(done, len(Pass) * len(views))
    paths = [job.path(Pass.MERGED, view) for view in range(len(views))]
    join(folder / DEPTHS.name, paths)
    _draw(folder, views, opened)
    spreads = torch.tensor([read_about(path)["spread"] for path in paths], dtype=torch.float32, device="cpu")
    summary = _fuse(folder / DEPTHS.name, opened, spreads, skipped)
    shutil.rmtree(parts)
    return summary


def _prepare(parts: Path, views: Views, is_learned: bool) -> None:
    """Create the folder of parts; delete those of other views, of the other aggregation or of another version."""
    job = {"format": FORMAT, "views": views.fingerprint(), "learned": is_learned}
    try:
        is_same = parse_json(read_text(parts / JOB, 1 << 16, "a description of depth maps")) == job
    except (OSError, ValueError):
        is_same = False
    if not is_same:
        shutil.rmtree(parts, ignore_errors=True)
    parts.mkdir(parents=True, exist_ok=True)
    write_whole(parts / JOB, json.dumps(job).encode())


class Pass(Enum):
    """What is computed of each view, in this order; the second needs the first one of the neighbors."""

    ALONE = "alone"
    MERGED = "merged"


class DenseJob:
    """What the passes compute with, in each of the processes; `parts` is the folder of the results of views."""

    def __init__(
        self, views: Views, images: ViewImages, parts: Path, device: torch.device, is_learned: bool
    ) -> None:
        self.views, self.images, self.parts = views, images, parts
        self.device, self.is_learned = device, is_learned
        self.alone = lru_cache(maxsize=CACHED)(lambda view: _read_alone(self.path(Pass.ALONE, view)))

    def __reduce__(self) -> tuple[type[DenseJob], tuple[object, ...]]:
        return DenseJob, (self.views, self.images, self.parts, self.device, self.is_learned)

    def path(self, result: Pass, view: int) -> Path:
        """The file of a view's result."""
        return self.parts / f"{int(self.views.frame_index[view]):06d}.{result.value}.safetensors"


def _do(job: DenseJob, result: Pass, view: int) -> None:
    """Compute one view in one pass and write it."""
    (_write_alone if result is Pass.ALONE else _write_merged)(job, view)


def _write_alone(job: DenseJob, view: int) -> None:
    """First pass: inverse depth of a view and its confidence."""
    views, device = job.views, job.device
    sources = torch.stack([job.images.gray(other) for other in views.neighbors[view][:SWEPT]])
    gray = job.images.gray(view)[None].to(device)
    limits = views.near[view, None].to(device), views.far[view, None].to(device)
    poses = views.T_sr(view)[None, :SWEPT].to(device)
    found = estimate_depth(gray, sources[None].to(device), views.camera.to(device), poses, *limits)
    confidence = learned_confidence(found, gray, *limits) if job.is_learned else confidence_alone(found)
    tensors = {"inverse_depth": found.inverse_depth[0], "confidence": confidence[0]}
    write_tensors(job.path(Pass.ALONE, view), tensors, {})


def _read_alone(path: Path) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Inverse depth and confidence. Raises ResultsError."""
    try:
        tensors = load_file(path)
        return tensors["inverse_depth"], tensors["confidence"]
    except (OSError, KeyError, SafetensorError) as error:
        raise ResultsError(f"{path}: not a readable part of depth maps: {error}; delete it") from None


def _write_merged(job: DenseJob, view: int) -> None:
    """Second pass: the depth map of a view after the comparison with its neighbors."""
    views, device = job.views, job.device
    neighbors = [job.alone(other) for other in views.neighbors[view]]
    others, other_confidences = (torch.stack([rows[i] for rows in neighbors]).to(device) for i in (0, 1))
    inverse_depth, confidence = (rows.to(device) for rows in job.alone(view))
    camera, T_sr = views.camera.to(device), views.T_sr(view).to(device)
    merged = merge(inverse_depth, confidence, others, other_confidences, camera, T_sr)
    probability = confidence_together(merged, confidence)
    is_kept = kept(probability)
    depth = torch.where(is_kept, 1 / torch.where(is_kept, merged.inverse_depth, 1.0), 0.0)
    maps = DepthMaps(
        frame_index=views.frame_index[view, None],
        depth=depth[None],
        normal=depth_normals(depth[None], camera),
        confidence=torch.where(is_kept, probability, 0.0)[None],
        T_cw=views.T_cw[view, None],
        camera=views.camera,
    )
    spread = float(merged.spread[is_kept].median()) if bool(is_kept.any()) else 0.0
    maps.save(job.path(Pass.MERGED, view), {"spread": spread})


def _draw(folder: Path, views: Views, images: ViewImages) -> None:
    """Draw a picture of each view; those of an earlier reconstruction are deleted."""
    pictures = folder / PICTURES.name
    pictures.mkdir(exist_ok=True)
    for old in pictures.glob(PICTURE_NAMES):
        old.unlink()
    for view, maps in enumerate(DepthMaps.blocks(folder / DEPTHS.name, 1)):
        name = f"{int(views.frame_index[view]):06d}.png"
        write_picture(pictures / name, maps.depth[0], maps.normal[0], images.color(view))


def _fuse(path: Path, images: ViewImages, spreads: Float[Tensor, " K"], skipped: list[str]) -> DenseSummary:
    """Fuse the maps of a file."""
    known, pixels, confidence, sizes = 0, 0, 0.0, []
    for view, maps in enumerate(DepthMaps.blocks(path, 1)):
        depth = maps.depth[maps.depth > 0]
        known, pixels = known + depth.numel(), pixels + maps.depth.numel()
        confidence += float(maps.confidence.sum(dtype=torch.float64))
        if depth.numel():
            # A point is as uncertain as its depth, and no smaller than a pixel.
            sizes.append(depth.median() * max(float(spreads[view]), 1 / float(maps.camera.focal)))
    voxel = float(torch.stack(sizes).median()) if sizes else 1.0
    fusion = CloudFusion(voxel)
    for view, maps in enumerate(DepthMaps.blocks(path, 1)):
        fusion.add(maps, images.color(view)[None])
    return DenseSummary(
        len(spreads), known / pixels, confidence / max(known, 1), voxel, fusion.cloud(), skipped
    )


def depth_colors(depth: Float[Tensor, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colors of depth, blue, green, red, from far (blue) to near (red); black where unknown."""
    is_known = depth > 0
    if not bool(is_known.any()):
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = torch.where(is_known, 1 / torch.where(is_known, depth, 1.0), 0.0)
    limits = torch.tensor((0.02, 0.98), dtype=inverse.dtype, device="cpu")
    far, near = inverse[is_known].quantile(limits).tolist()
    scaled = ((inverse - far) / max(near - far, 1e-12)).clamp(0, 1)
    colors = cv2.applyColorMap((scaled * 255).round().to(torch.uint8).numpy(), cv2.COLORMAP_TURBO)
    colors[~is_known.numpy()] = 0
    return colors


def normal_colors(normal: Float[Tensor, "3 H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colors of normals, blue, green, red: x right is red, y up is green, towards the camera is blue."""
    is_known = (normal != 0).any(0)
    shown = normal * normal.new_tensor((1.0, -1.0, -1.0))[:, None, None]
    colors = ((shown + 1) * 127.5).round().to(torch.uint8)
    return torch.where(is_known, colors, torch.zeros_like(colors)).flip(0).movedim(0, -1).contiguous().numpy()


def write_picture(
    path: Path,
    depth: Float[Tensor, "H W"],
    normal: Float[Tensor, "3 H W"],
    color: UInt8[Tensor, "H W 3"],
) -> None:
    """Write image, depth and normals side by side. Raises ResultsError."""
    parts = (cv2.cvtColor(color.numpy(), cv2.COLOR_RGB2BGR), depth_colors(depth), normal_colors(normal))
    write_image(path, np.concatenate(parts, axis=1))
