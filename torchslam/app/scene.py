"""What is drawn: a map that grows, or a result; and what is measured in it by clicks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import viser
from jaxtyping import Float, Int
from viser.transforms import SO3

# Red, green, blue.
PATH, UNCERTAIN, TRUTH, OTHER = (87, 150, 65), (190, 130, 225), (60, 60, 60), (230, 140, 40)
FRUSTUM, MARK = (70, 110, 190), (230, 60, 50)  # red, green, blue
UNCERTAIN_STATE = 2  # number of `types.State.UNCERTAIN`, whose module needs torch
MAX_FRUSTA, MAX_THUMBNAILS = 400, 48
"""Keyframes that are drawn as frusta, and those of them with an image. Tried at these values only."""
REACH_PX, BESIDE_PX = 14.0, 3.0
"""Pixels from a click to what it means, and by which what is nearer to the eye may be farther away, as in view.html."""
PLANE_POINTS = 40
"""Neighbors of a click that determine a plane. Tried at this value only."""
PIXEL_STEPS = 65535  # of an image point, over the image; as `page.STEPS`, whose module needs torch
MIN_SIZE = 1e-6  # of what is drawn, in map units: so that nothing divides by zero


class Scene:
    """The scene of the page, the same for all who look at it.

    Attributes:
        data: the result that is shown, as of `reading.result`; None during a run.
        submap: its main submap; None without one.
        points: (P, 3) of the sparse map that is shown.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self.clear()

    def clear(self) -> None:
        """Draw nothing."""
        self._scene.reset()
        self.data: dict[str, Any] | None = None
        self.submap: dict[str, Any] | None = None
        self.points, self._colors = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        self._dense: tuple[np.ndarray, np.ndarray] | None = None
        self.frames, self._keyframes = np.zeros(0, int), np.zeros((0, 3, 4), np.float32)
        self._is_aimed, self._size = False, 1.0

    def show_live(self, found: dict[str, Any]) -> None:
        """Draw a map that grows, as of `reading.live`. Its world is that of the first camera: y points down."""
        poses, points, (_, fy, _, _, width, height) = found["poses"], found["points"], found["camera"]
        if not len(points):
            return
        low, high = np.percentile(points, (5, 95), axis=0)
        self._size = max(float(np.linalg.norm(high - low)), MIN_SIZE)
        with self._server.atomic():
            self._cloud("points", points, found["colors"], 0.004)
            self._path(poses, found["uncertain"], found["breaks"])
            if len(poses):
                self._frustum("camera", poses[-1], (fy, width, height), 0.08, found["image"])
        if not self._is_aimed:
            self._is_aimed = True
            self._scene.set_up_direction("-y")
            self.aim((low + high) / 2, (0.5, -0.7, -1.0), 1.3 * self._size)

    def show_result(self, data: dict[str, Any]) -> None:
        """Draw the main submap of a result."""
        self.clear()
        self.data = data
        self._scene.set_up_direction("+z")
        if not data["submaps"]:
            return
        self.submap = submap = data["submaps"][0]
        self._size = max(2.0 * submap["radius"], MIN_SIZE)
        self.points, colors = submap["points"].reshape(-1, 3), submap["colors"].reshape(-1, 3)
        self._colors = colors if len(colors) else np.full(self.points.shape, 130, np.uint8)
        if (dense := submap["dense"]) is not None:
            steps = dense["points"].reshape(-1, 3) * np.asarray(dense["step"], np.float32)
            self._dense = np.asarray(dense["low"], np.float32) + steps, dense["colors"].reshape(-1, 3)
        self._keyframes = submap["keyframe_poses"].reshape(-1, 3, 4)
        rows = spread(len(self._keyframes), MAX_FRUSTA)
        self._keyframes, self.frames = (
            self._keyframes[rows],
            data["frames"]["index"][submap["keyframe"]][rows],
        )
        with self._server.atomic():
            self.crop(None)
            states = data["frames"]["state"][submap["frame"]]
            self._path(submap["poses"].reshape(-1, 3, 4), states == UNCERTAIN_STATE, submap["breaks"])
            self._segments("truth", strip(submap["truth"].reshape(-1, 3)), TRUTH)
            corners = np.asarray(data["corners"]) * submap["frustum"]
            self._segments("frusta", outlines(self._keyframes, corners), FRUSTUM, 1.0)
        self.aim(np.zeros(3), (0.6, -1.0, 0.7), 1.5 * submap["radius"])

    def thumbnail_frames(self) -> list[int]:
        """The keyframes whose images are to be shown."""
        return [int(each) for each in self.frames[spread(len(self.frames), MAX_THUMBNAILS)]]

    def show_thumbnails(self, images: dict[int, np.ndarray]) -> None:
        """Add the images of keyframes to their frusta, as of `reading.thumbnails`."""
        if self.data is None or self.submap is None:
            return
        camera, size = (self.data["camera"][1], *self.data["size"]), self.submap["frustum"] / self._size
        for frame, image in images.items():
            pose = self._keyframes[self.frames.tolist().index(frame)]
            self._frustum(f"images/{frame}", pose, camera, size, image)

    def crop(self, limits: Float[np.ndarray, "2 3"] | None, is_dense: bool = True) -> None:
        """Draw the points within two corners, the dense ones if there are any and they are wanted."""
        is_dense = is_dense and self._dense is not None
        points, colors = self._dense if is_dense and self._dense is not None else (self.points, self._colors)
        if limits is not None:
            inside = ((points >= limits[0]) & (points <= limits[1])).all(axis=1)
            points, colors = points[inside], colors[inside]
        self._cloud("points", points, colors, 0.0016 if is_dense else 0.003)

    def show_other(self, positions: Float[np.ndarray, "N 3"]) -> None:
        """Draw another path, which is aligned with this one."""
        self._segments("other", strip(positions), OTHER)

    def show_marks(self, rows: list[int]) -> None:
        """Mark points, and the line between two."""
        red = np.broadcast_to(np.array(MARK, np.uint8), (len(rows), 3))
        self._cloud("marks", self.points[rows], red, 0.015)
        self._segments("between", strip(self.points[rows]), MARK)

    def turn_up(self, row: int, eye: Float[np.ndarray, "3"]) -> None:
        """Make the normal of the plane around a point the direction that is up."""
        self._scene.set_up_direction(tuple(map(float, plane_normal(self.points, row, eye))))

    def fly(self, row: int) -> None:
        """Put the eyes of all who look into a pose of the path."""
        if self.submap is None or not len(self.submap["poses"]):
            return
        poses = self.submap["poses"].reshape(-1, 3, 4).astype(float)
        pose = poses[min(row, len(poses) - 1)]
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.wxyz, client.camera.position = SO3.from_matrix(pose[:, :3]).wxyz, pose[:, 3]

    def aim(self, center: np.ndarray, direction: tuple[float, float, float], distance: float) -> None:
        """Put the eyes of all who look, and of those who come, at a distance of a center."""
        position = center + distance * np.asarray(direction) / np.linalg.norm(direction)
        for camera in (
            self._server.initial_camera,
            *(each.camera for each in self._server.get_clients().values()),
        ):
            camera.near, camera.far = distance / 1000, distance * 100
            camera.position, camera.look_at = position, np.asarray(center)

    def clicked(self, event: Any, is_keyframe: bool) -> int:
        """The frame of the keyframe, or the row of the point, that is seen where a click was; -1 without one."""
        pixel = event.client.camera.fov / max(1, event.client.camera.image_height)
        points = self._keyframes[:, :, 3] if is_keyframe else self.points
        row = nearest_to_ray(points, np.asarray(event.ray_origin), np.asarray(event.ray_direction), pixel)
        return int(self.frames[row]) if is_keyframe and row >= 0 else row

    def _cloud(self, name: str, points: np.ndarray, colors: np.ndarray, size: float) -> None:
        options: dict[str, Any] = {"precision": "float32", "point_shape": "circle", "point_shading": "flat"}
        self._scene.add_point_cloud(name, points, colors, point_size=size * self._size, **options)

    def _path(self, poses: np.ndarray, uncertain: np.ndarray, breaks: Any) -> None:
        """Draw a path; steps to uncertain poses in another color, and none across a break."""
        segments = strip(poses[:, :, 3])
        is_kept = np.ones(len(segments), bool)
        is_kept[[int(row) - 1 for row in breaks]] = False
        colors = np.where(
            np.asarray(uncertain, bool)[1:, None, None],
            np.array(UNCERTAIN, np.uint8),
            np.array(PATH, np.uint8),
        )
        self._segments("path", segments[is_kept], np.repeat(colors, 2, axis=1)[is_kept], 3.0)

    def _segments(self, name: str, segments: np.ndarray, color: Any, pixels: float = 2.0) -> None:
        if len(segments):
            self._scene.add_line_segments(name, segments, color, thickness=pixels, thickness_units="screen")
        elif self._scene.get_handle_by_name(name):
            self._scene.remove_by_name(name)

    def _frustum(
        self, name: str, pose: np.ndarray, camera: tuple[float, ...], size: float, image: np.ndarray
    ) -> None:
        """Draw a frustum with its image; camera: fy, width, height."""
        fy, width, height = camera
        placed: dict[str, Any] = {
            "wxyz": SO3.from_matrix(pose[:, :3].astype(float)).wxyz,
            "position": pose[:, 3],
        }
        style: dict[str, Any] = {
            "color": FRUSTUM,
            "thickness": 1.0,
            "thickness_units": "screen",
            "cast_shadow": False,
        }
        # The viewer scales a frustum to the volume of a cube; this makes its depth the wanted one.
        scale = size * self._size * (width * height / (12 * fy**2)) ** (1 / 3)
        fov = 2 * math.atan(height / (2 * fy))
        self._scene.add_camera_frustum(name, fov, width / height, scale=scale, image=image, **placed, **style)


def spread(count: int, limit: int) -> Int[np.ndarray, " R"]:
    """Indices of at most `limit` of `count` rows, evenly spread."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).round().astype(int)


def strip(positions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 2 3"]:
    """The segments between successive positions."""
    return np.stack((positions[:-1], positions[1:]), axis=1)


def outlines(
    poses: Float[np.ndarray, "K 3 4"], corners: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "M 2 3"]:
    """The edges of frusta: from each center to the corners, and around them."""
    ends = poses[:, None, :, 3] + np.einsum("kij,cj->kci", poses[:, :, :3], corners)
    sides = np.stack((np.broadcast_to(poses[:, None, :, 3], ends.shape), ends), axis=2)
    around = np.stack((ends, np.roll(ends, -1, axis=1)), axis=2)
    return np.concatenate((sides, around), axis=1).reshape(-1, 2, 3)


def nearest_to_ray(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    pixel: float,
) -> int:
    """Row of the point along a ray, as the ruler of view.html chooses it; -1 without one. pixel: its angle, rad."""
    if not len(points):
        return -1
    depth = (points - eye) @ (direction / np.linalg.norm(direction))
    beside = np.sqrt(np.maximum(((points - eye) ** 2).sum(axis=1) - depth**2, 0.0))
    pixels = np.arctan2(beside, depth) / pixel
    cost = np.where((depth > 0) & (pixels <= REACH_PX), (pixels + BESIDE_PX) * depth, np.inf)
    best = int(cost.argmin())
    return best if np.isfinite(cost[best]) else -1


def length_between(submap: dict[str, Any], rows: list[int]) -> tuple[float, float]:
    """Distance of two points and its standard error, NaN where it is unknown, by the errors of both and of the unit."""
    between = np.diff(submap["points"].reshape(-1, 3)[rows].astype(float), axis=0)[0]
    length = float(np.linalg.norm(between))
    # The standard errors: of the float32 of a step the upper 16 bits, and lower triangles in these steps.
    steps = (submap["error_step"][rows].astype(np.uint32) << 16).view(np.float32).astype(float)
    L = np.zeros((2, 3, 3))
    L[:, *np.tril_indices(3)] = submap["error_factor"].reshape(-1, 6)[rows]
    along = np.swapaxes(L, 1, 2) @ (between / max(length, MIN_SIZE))
    variances = np.where(steps > 0, steps**2 * (along**2).sum(axis=1), np.nan)
    return length, float(np.sqrt(variances.sum() + (length * submap["unit_std"]) ** 2))


def length_words(length: float, std: float, unit: str) -> str:
    """A length in words, to two digits of its standard error."""
    if not std > 0:
        return f"{length:.4g} {unit or 'map units'}"
    digits = max(0, min(9, 1 - math.floor(math.log10(std))))
    return f"{length:.{digits}f} ± {std:.{digits}f} {unit or 'map units'}"


def click_of(submap: dict[str, Any], size: tuple[int, int], row: int) -> str | None:
    """FRAME:X,Y of a point, as `--distance` takes it; None if no frame of the run shows it."""
    x, y = (submap["seen_pixel"].reshape(-1, 2)[row] * (np.asarray(size) - 1) / PIXEL_STEPS).round(1)
    return f"{submap['seen_frame'][row]}:{x:g},{y:g}" if submap["seen_frame"][row] >= 0 else None


def plane_normal(
    points: Float[np.ndarray, "N 3"], row: int, eye: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The normal of the plane through a point and its neighbors, of unit length, to the side of the eye."""
    near = points[np.argsort(np.linalg.norm(points - points[row], axis=1))[:PLANE_POINTS]].astype(float)
    normal = np.linalg.svd(near - np.median(near, axis=0))[2][2]
    return normal if normal @ (eye - points[row]) >= 0 else -normal
