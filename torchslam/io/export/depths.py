"""Depth maps for other programs: 16-bit images, and COLMAP's workspace of a dense reconstruction.

COLMAP's files: https://colmap.github.io/format.html#dense-reconstruction. A map is a line `width&height&channels&` and
then float32 numbers, of which those along a row of the image are neighbors, and channels come last.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.transforms import scale_camera
from torchslam.dense.cloud import PointCloud
from torchslam.dense.depth_maps import DepthMaps
from torchslam.geometry import Camera
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.ply import write_cloud
from torchslam.io.export.scene import ExportedScene, Images, write_images

UNIT = 1e-3  # of the numbers of a 16-bit image, in map units; the default of nerfstudio
FARTHEST = 65535  # of these units: what is farther counts as unknown
MAX_POINTS = 500_000
"""Of the clouds that a program draws, or starts a splat from."""
NEIGHBORS = 20  # COLMAP's default: images that it compares a depth map with


def depth_png(depth: Float[Tensor, "H W"]) -> bytes:
    """Encode depth as a 16-bit PNG image in UNIT; 0 where it is unknown."""
    units = (depth.double() / UNIT).round()
    units = torch.where(units <= FARTHEST, units, 0.0)
    return cv2.imencode(".png", units.cpu().numpy().astype(np.uint16))[1].tobytes()


def enlarged(pinhole: Camera, camera: Camera) -> Camera:
    """The camera of a depth map, for images as large as those of the camera that it was made from."""
    factor = max(1.0, float(camera.params[0] / pinhole.params[0]))
    size = (round(factor * pinhole.width), round(factor * pinhole.height))
    return scale_camera(pinhole, size)


def write_workspace(
    folder: Path, scene: ExportedScene, path: Path, cloud: PointCloud | None, images: Images | None
) -> None:
    """Write COLMAP's workspace of a dense reconstruction, as after `patch_match_stereo` and `stereo_fusion`.

    Args:
        folder: the workspace, created if missing.
        scene: the frames of the depth maps, for their camera.
        path: the file of the depth maps.
        cloud: the fused cloud in the map's world, if there is one.
        images: of the size of the depth maps; None: no images.
    """
    stereo, names = folder / "stereo", dict(zip(scene.frame_ids.tolist(), scene.image_names, strict=True))
    for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
        (stereo / kind).mkdir(parents=True, exist_ok=True)
        for old in (stereo / kind).glob("[0-9]" * 6 + ".png.*"):
            old.unlink()
    for maps in DepthMaps.blocks(path, 1):
        name = f"{names[int(maps.frame_index)]}.geometric.bin"
        (stereo / "depth_maps" / name).write_bytes(colmap_map(maps.depth))
        (stereo / "normal_maps" / name).write_bytes(colmap_map(maps.normal[0]))
    lines = scene.image_names
    (stereo / "fusion.cfg").write_text("".join(f"{name}\n" for name in lines), encoding="utf-8")
    neighbors = "".join(f"{name}\n__auto__, {NEIGHBORS}\n" for name in lines)
    (stereo / "patch-match.cfg").write_text(neighbors, encoding="utf-8")
    write_colmap(folder / "sparse", scene)
    if images is not None:
        write_images(folder / "images", scene, images)
    if cloud is not None:
        write_cloud(folder / "fused.ply", cloud)


def colmap_map(values: Float[Tensor, "C H W"]) -> bytes:
    """Encode a map as COLMAP does: the numbers of a row are neighbors, then rows, then channels."""
    channels, height, width = values.shape
    return f"{width}&{height}&{channels}&".encode() + values.cpu().numpy().astype("<f4").tobytes()
