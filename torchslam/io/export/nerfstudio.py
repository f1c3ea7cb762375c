"""`transforms.json` of nerfstudio, with the point cloud that splatting starts from.

Poses and points are in the same upright frame. `applied_transform` is omitted, since versions of nerfstudio differ in
whether they apply it to the point cloud (issues 2784 and 3101).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.geometry.transforms import corner_camera, opengl
from torchslam.io.export.ply import write_ply
from torchslam.io.export.scene import ExportedScene

TRANSFORMS = "transforms.json"
POINT_CLOUD = "sparse_pc.ply"
IMAGES = "images"
# The names of the parameters in the order of ours; nerfstudio's formulas are OpenCV's.
MODELS = {
    "pinhole": ("PINHOLE", ()),
    "radial_tangential": ("OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}


def nerfstudio_camera(camera: Camera) -> dict[str, Any]:
    """The camera's entries of transforms.json."""
    model, distortion = MODELS[camera.model]
    names = ("fl_x", "fl_y", "cx", "cy", *distortion)
    params = corner_camera(camera).params.tolist()
    about = {"camera_model": model, "w": camera.width, "h": camera.height}
    return about | dict(zip(names, params, strict=True))


def write_nerfstudio(folder: Path, scene: ExportedScene, R_up: Float[Tensor, "3 3"]) -> None:
    """Write transforms.json and the point cloud into a folder that is made if need be.

    Args:
        R_up: (3, 3) from the map's world to the upright one, see `geometry.transforms.upright_rotation`
    """
    folder.mkdir(parents=True, exist_ok=True)
    upright = scene.turned(R_up)
    frames = [
        {"file_path": f"{IMAGES}/{name}", "transform_matrix": T}
        for name, T in zip(upright.image_names, opengl(upright.T_wc).tolist(), strict=True)
    ]
    content = nerfstudio_camera(scene.camera) | {
        "ply_file_path": POINT_CLOUD,
        "upright_from_map": R_up.tolist(),  # for the reader: nerfstudio does not know it
        "frames": frames,
    }
    (folder / TRANSFORMS).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    write_ply(folder / POINT_CLOUD, upright.points_w, upright.colors, centers_w=torch.zeros(0, 3))
