"""Draw a flight through the dense cloud of a run as an animation: behind the camera, along its smoothed path.

torchslam run ../shared/data/fr2_desk_20 -o results/fr2_desk_20
torchslam densify results/fr2_desk_20 --every 2 --resolution 480
python -m experiments.report.flight results/fr2_desk_20 docs/images/flight.webp --pictures 48
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor

from experiments.common import parser_of
from experiments.report.animation import save_animation
from torchslam.dense import PointCloud
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, rigid, se3_inverse, transform
from torchslam.io.plots.charts import ACCENT, thin
from torchslam.io.results import DENSE_CLOUD, read_results
from torchslam.types import Trajectory

SIZE = (640, 400)
SAMPLES = 2  # pixels to a side that are drawn for each pixel: edges are smooth
FIELD_OF_VIEW_DEG = 60.0  # from left to right
GROUND = (246, 245, 241)
SMOOTHING = 0.06  # width of the window over the path, in lengths of the path
BACK = 0.25  # the eye is behind the camera by this, in median distances of the cloud from the path
NEAR = 0.03  # and nothing nearer to the eye than this is drawn
COVER = 1.6  # widths of a point, in distances between neighbors: surfaces are closed
MAX_POINT_PX = 12
PATH_PX = 3


def draw_flight(cloud: PointCloud, trajectory: Trajectory, pictures: int) -> list[Image.Image]:
    """Pictures of a dense cloud from behind the camera, and the path ahead of it.

    Args:
        cloud: points in the world of the trajectory.
        trajectory: camera to world.
        pictures: their number, evenly over the trajectory, also between its poses.
    """
    T_wc = smoothed(trajectory.T_wc, max(1, round(SMOOTHING * len(trajectory))))
    reach = float(_distances(cloud, trajectory).median())
    eye = torch.eye(4, dtype=T_wc.dtype)
    eye[2, 3] = -BACK * reach
    width, height = (SAMPLES * side for side in SIZE)
    focal = width / 2 / float(np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)))
    camera = Camera.pinhole(focal, focal, (width - 1) / 2, (height - 1) / 2, size=(width, height))
    width_of_points = COVER * cloud.spacing()
    made = []
    for place in torch.linspace(0, len(T_wc) - 1, pictures, dtype=T_wc.dtype).tolist():
        T_wc_now = between(T_wc, place)
        path_w = torch.cat((T_wc_now[None], T_wc[int(place) + 1 :]))[:, :3, 3]
        made.append(_picture(cloud, width_of_points, path_w, se3_inverse(T_wc_now @ eye), camera, reach))
    return made


def smoothed(T_wc: Float[Tensor, "K 4 4"], window: int) -> Float[Tensor, "K 4 4"]:
    """The mean pose of the `window` poses before and after each one."""
    means = torch.stack(
        [T_wc[max(0, row - window) : row + window + 1].mean(dim=0) for row in range(len(T_wc))]
    )
    return _nearest_pose(means)


def between(T_wc: Float[Tensor, "K 4 4"], place: float) -> Float[Tensor, "4 4"]:
    """The pose at a place in a path: 1.5 is in the middle between the second pose and the third."""
    before = int(place)
    after = min(before + 1, len(T_wc) - 1)
    return _nearest_pose(torch.lerp(T_wc[before], T_wc[after], place - before))


def _nearest_pose(means: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Means of poses, whose rotations are none, with the nearest rotations."""
    U, _, Vh = torch.linalg.svd(means[..., :3, :3])
    return rigid(U @ Vh, means[..., :3, 3])


def splat(
    points_w: Float[Tensor, "N 3"],
    colors: UInt8[Tensor, "N 3"],
    width: float,
    T_cw: Float[Tensor, "4 4"],
    camera: Camera,
    near: float,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw points as squares that face the eye, the nearest one in front.

    Args:
        points_w, colors: the points.
        width: of the squares, map units.
        T_cw: pose of the eye; camera: its camera.
        near: nothing nearer is drawn.
    """
    points_c = transform(T_cw, points_w.to(T_cw))
    front = points_c[:, 2] > near
    pixels = camera.to(T_cw.dtype).project(points_c)[0].round()
    seen = front & camera.in_image(pixels, border=-SAMPLES * MAX_POINT_PX)
    pixels, colors, depth = pixels[seen].long(), colors[seen], points_c[seen, 2]
    half = (width / depth * float(camera.params[0]) / 2).round().clamp(0, SAMPLES * MAX_POINT_PX // 2).long()
    image = torch.tensor(GROUND, dtype=torch.uint8).expand(camera.height * camera.width, 3).clone()
    nearest = torch.full((len(image),), torch.inf, dtype=depth.dtype)
    for size in torch.unique(half).tolist():
        drawn = half == size
        offsets = torch.arange(-size, size + 1)
        for dy in offsets.tolist():
            for dx in offsets.tolist():
                _put(
                    image,
                    nearest,
                    pixels[drawn] + torch.tensor((dx, dy)),
                    depth[drawn],
                    colors[drawn],
                    camera,
                )
    return image.reshape(camera.height, camera.width, 3).numpy()


def _put(
    image: UInt8[Tensor, "S 3"],
    nearest: Float[Tensor, " S"],
    pixels: Int[Tensor, "N 2"],
    depth: Float[Tensor, " N"],
    colors: UInt8[Tensor, "N 3"],
    camera: Camera,
) -> None:
    """Set single pixels where a point is the nearest so far."""
    inside = camera.in_image(pixels.to(camera.params.dtype))
    where = (pixels[:, 1] * camera.width + pixels[:, 0])[inside]
    depth, colors = depth[inside], colors[inside]
    nearest.scatter_reduce_(0, where, depth, "amin")
    first = nearest[where] == depth
    image[where[first]] = colors[first]


def _picture(
    cloud: PointCloud,
    width: float,
    path_w: Float[Tensor, "K 3"],
    T_cw: Float[Tensor, "4 4"],
    camera: Camera,
    reach: float,
) -> Image.Image:
    image = splat(cloud.points_w, cloud.colors, width, T_cw, camera, NEAR * reach)
    _draw_path(image, path_w, T_cw, camera, NEAR * reach)
    return Image.fromarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA))


def _draw_path(
    image: UInt8[np.ndarray, "H W 3"],
    path_w: Float[Tensor, "K 3"],
    T_cw: Float[Tensor, "4 4"],
    camera: Camera,
    near: float,
) -> None:
    """The path ahead and the camera, over the points."""
    path_c = transform(T_cw, path_w)
    pixels = camera.to(T_cw.dtype).project(path_c)[0].round().int().numpy()
    color = tuple(int(ACCENT[at : at + 2], 16) for at in (1, 3, 5))
    seen = path_c[:, 2] > near
    end = int(seen.int().argmin()) if not bool(seen.all()) else len(seen)
    cv2.polylines(image, [pixels[:end]], False, color, SAMPLES * PATH_PX // 2, cv2.LINE_AA)
    if end:
        cv2.circle(image, tuple(pixels[0].tolist()), SAMPLES * PATH_PX, color, -1, cv2.LINE_AA)


def _distances(cloud: PointCloud, trajectory: Trajectory) -> Float[Tensor, " R"]:
    """Distances of some points from the nearest position of the camera."""
    points_w = cloud.points_w[torch.from_numpy(thin(len(cloud), 1000))].to(trajectory.positions_w)
    return torch.cdist(points_w, trajectory.positions_w).amin(dim=1)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("results", type=Path, help="results folder of a run with a dense cloud")
    parser.add_argument("output", type=Path, help="a .webp or .gif file")
    parser.add_argument("--pictures", type=int, default=60)
    parser.add_argument("--rate", type=float, default=12.0, help="pictures per second")
    arguments = parser.parse_args()
    results = read_results(arguments.results)
    if results.cloud is None:
        raise ResultsError(f"{arguments.results / DENSE_CLOUD}: no dense cloud")
    pictures = draw_flight(results.cloud, results.trajectory, arguments.pictures)
    save_animation(pictures, arguments.output, arguments.rate)


if __name__ == "__main__":
    main()
