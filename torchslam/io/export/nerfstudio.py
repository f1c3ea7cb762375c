"""`transforms.json` of nerfstudio, with the point cloud that splatting starts from.

Poses and points are in the same upright frame. `applied_transform` is omitted, since versions of nerfstudio differ in
whether they apply it to the point cloud (issues 2784 and 3101).

Depth images have 16 bits and the unit that nerfstudio expects, a thousandth of a map unit. Its data parser takes them
for all frames or for none, enlarges them to the size of the images, and has the unit as an option
(`--depth-unit-scale-factor`), not in the file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.cloud import PointCloud
from torchslam.dense.depth_maps import DepthMaps
from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.geometry.distortion import MODELS
from torchslam.geometry.transforms import corner_camera, opengl
from torchslam.io.export.ply import MAX_DRAWN, write_cloud, write_ply
from torchslam.io.export.scene import ExportedScene

POINT_CLOUD = "sparse_pc.ply"
DENSE_CLOUD = "dense_pc.ply"
IMAGES = "images"
DEPTHS = "depths"
UNIT = 1e-3  # of the numbers of a depth image, in map units
NAMES = {"pinhole": "PINHOLE", "radial_tangential": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""Names of camera models; the formulas and names of their coefficients are OpenCV's."""


def nerfstudio_camera(camera: Camera) -> dict[str, Any]:
    """The camera's entries of transforms.json. Raises ResultsError for a model that it cannot hold."""
    if camera.model not in NAMES:
        raise ResultsError(
            f"nerfstudio has no {camera.model} camera: export to colmap, whose FULL_OPENCV holds it, or with "
            "--undistort"
        )
    names = ("fl_x", "fl_y", "cx", "cy", *MODELS[camera.model].coefficients)
    params = corner_camera(camera).params.tolist()
    about = {"camera_model": NAMES[camera.model], "w": camera.width, "h": camera.height}
    return about | dict(zip(names, params, strict=True))


def depth_png(depth: Float[Tensor, "H W"]) -> bytes:
    """Encode depth as a 16-bit PNG image in UNIT; 0 where it is unknown."""
    units = (depth.double() / UNIT).round()
    units = torch.where(units <= 65535, units, 0.0)  # what is farther counts as unknown
    return cv2.imencode(".png", units.cpu().numpy().astype(np.uint16))[1].tobytes()


def write_nerfstudio(
    folder: Path,
    scene: ExportedScene,
    R_up: Float[Tensor, "3 3"],
    cloud: PointCloud | None = None,
    depths: Path | None = None,
) -> None:
    """Write transforms.json, the point cloud and depth images into a folder that is made if need be.

    Args:
        R_up: (3, 3) from the map's world to the upright one, see `geometry.transforms.upright_rotation`
        cloud: a dense cloud in the map's world, to start from instead of the points
        depths: the file of the depth maps of all frames, whose camera is that of the scene up to its size
    """
    folder.mkdir(parents=True, exist_ok=True)
    upright = scene.turned(R_up)
    frames = [
        {"file_path": f"{IMAGES}/{name}", "transform_matrix": T}
        for name, T in zip(upright.image_names, opengl(upright.T_wc).tolist(), strict=True)
    ]
    if depths is not None:
        (folder / DEPTHS).mkdir(exist_ok=True)
        names = dict(zip(scene.frame_ids.tolist(), scene.image_names, strict=True))
        for frame, name in zip(frames, names.values(), strict=True):
            frame["depth_file_path"] = f"{DEPTHS}/{name}"
        for maps in DepthMaps.blocks(depths, 1):
            (folder / DEPTHS / names[int(maps.frame_index)]).write_bytes(depth_png(maps.depth[0]))
    content = nerfstudio_camera(scene.camera) | {
        "ply_file_path": POINT_CLOUD if cloud is None else DENSE_CLOUD,
        "upright_from_map": R_up.tolist(),  # for the reader: nerfstudio does not know it
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    write_ply(folder / POINT_CLOUD, upright.points_w, upright.colors, centers_w=upright.points_w[:0])
    if cloud is not None:
        write_cloud(folder / DENSE_CLOUD, cloud.thinned(MAX_DRAWN), R_up)
