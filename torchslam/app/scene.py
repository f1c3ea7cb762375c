"""What is drawn: a map that grows, or a result; and what is measured in it by clicks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import viser
from jaxtyping import Bool, Float, Int
from viser.transforms import SO3

PATH, UNCERTAIN, TRUTH, OTHER = (87, 150, 65), (190, 130, 225), (60, 60, 60), (230, 140, 40)
"""Red, green, blue."""
MARK = (230, 60, 50)
"""As `PATH`. Frusta are black: without lights, a mesh has no color."""
BEADS = 4000
"""Points that a path is drawn by. They touch up to a path of ten times the scene. Without a GPU a point takes 1 µs of a
frame, a line segment of the viewer 100 µs."""
REACH_PX, BESIDE_PX = 14.0, 3.0
"""Pixels from a click to what it means, and by which what is nearer to the eye may be farther away, as in view.html."""
PLANE_POINTS = 40
"""Neighbors of a click that determine a plane. Tried at this value only."""
PIXEL_STEPS = 65535  # of an image point, over the image; as `page.STEPS`, whose module needs torch
MIN_SIZE = 1e-6  # of what is drawn, in map units: so that nothing divides by zero
SIDES = ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1))  # triangles of a frustum: its center, and corners


class Scene:
    """The scene of the page, the same for all who look at it; `submap`: the result, as of `reading.result`."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self._scene.configure_default_lights(False)  # nothing drawn reflects light, and shadows take time
        self._scene.configure_environment_map(None)
        self.clear()

    def clear(self) -> None:
        """Draw nothing."""
        self._scene.reset()
        self.submap = dict[str, Any]()
        self._is_aimed, self._size, self._random = False, 1.0, np.random.default_rng(0)

    def show_live(self, found: dict[str, Any]) -> None:
        """Draw a map that grows, as of `reading.live`. Its world is that of the first camera: y points down."""
        poses, points = found["poses"], found["points"]
        if not len(points) or not len(poses):
            return
        low, high = np.percentile(points, (5, 95), axis=0)
        self._size = max(float(np.linalg.norm(high - low)), MIN_SIZE)
        with self._server.atomic():
            self._cloud("points", points, found["colors"], 0.004)
            self._path("path", poses[:, :, 3], found["uncertain"], found["breaks"])
            corners = 0.08 * self._size * found["corners"]
            self._frusta(poses[-1:], corners)
            self._images({0: found["image"]} if found["image"].size else {}, poses[-1:], corners)
        if not self._is_aimed:
            self._is_aimed = True
            self._scene.set_up_direction("-y")
            self._aim((low + high) / 2, (0.5, -0.7, -1.0), 1.3 * self._size)

    def show_result(self, submap: dict[str, Any]) -> None:
        """Draw a submap; nothing for an empty one."""
        self.clear()
        self.submap = submap
        self._scene.set_up_direction("+z")
        if submap:
            self._size = max(2.0 * submap["radius"], MIN_SIZE)
            with self._server.atomic():
                self.crop(None)
                self._path("path", submap["poses"][:, :, 3], submap["uncertain"], submap["breaks"])
                self._path("truth", submap["truth"], color=TRUTH)
                self._frusta(submap["keyframe_poses"], submap["corners"])
                self._images(submap["images"], submap["keyframe_poses"], submap["corners"])
            self._aim(np.zeros(3), (0.6, -1.0, 0.7), 1.5 * submap["radius"])

    def crop(self, limits: Float[np.ndarray, "2 3"] | None, is_dense: bool = True) -> None:
        """Draw the points within two corners, the dense ones if there are any and they are wanted."""
        dense, points, colors = (self.submap[name] for name in ("dense", "points", "colors"))
        if is_dense := is_dense and dense is not None:
            low, step = (np.asarray(dense[name], np.float32) for name in ("low", "step"))
            points, colors = low + dense["points"] * step, dense["colors"]
        if limits is not None:
            inside = ((points >= limits[0]) & (points <= limits[1])).all(axis=1)
            points, colors = points[inside], colors[inside]
        self._cloud("points", points, colors, 0.0016 if is_dense else 0.003)

    def show_other(self, positions: Float[np.ndarray, "N 3"]) -> None:
        """Draw another path, which is aligned with this one."""
        self._path("other", positions, color=OTHER)

    def show_marks(self, rows: list[int]) -> None:
        """Mark points, and the line between two."""
        marked = self.submap["points"][rows]
        self._cloud("marks", marked, np.full((len(rows), 3), MARK, np.uint8), 0.015)
        self._path("between", marked, color=MARK)

    def turn_up(self, row: int, eye: Float[np.ndarray, "3"]) -> None:
        """Make the normal of the plane around a point the direction that is up."""
        up = plane_normal(self.submap["points"], row, eye)
        self._scene.set_up_direction((float(up[0]), float(up[1]), float(up[2])))

    def fly(self, row: int, client: viser.ClientHandle) -> None:
        """Move the view of one client to a pose of the path; the views of others stay."""
        for pose in self.submap["poses"][: row + 1][-1:].astype(float) if self.submap else ():
            with client.atomic():
                client.camera.wxyz = SO3.from_matrix(pose[:, :3]).wxyz
                client.camera.position = pose[:, 3]

    def clicked(self, event: Any, is_keyframe: bool) -> int:
        """Return the frame of the keyframe or the row of the point at a click; -1 without one."""
        ray = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
        pixel = event.client.camera.fov / max(1, event.client.camera.image_height)
        if not is_keyframe:
            return nearest_to_ray(self.submap["points"], *ray, pixel)
        poses = self.submap["keyframe_poses"]
        row = frustum_on_ray(poses, self.submap["corners"], *ray)
        row = nearest_to_ray(poses[:, :, 3], *ray, pixel) if row < 0 else row
        return int(self.submap["frames"][row]) if row >= 0 else -1

    def _aim(self, center: np.ndarray, direction: tuple[float, float, float], distance: float) -> None:
        """Put the eyes of all who look, and of those who come, at a distance of a center."""
        position = center + distance * np.asarray(direction) / np.linalg.norm(direction)
        clients = self._server.get_clients().values()
        for camera in (self._server.initial_camera, *(each.camera for each in clients)):
            camera.near, camera.far = distance / 1000, distance * 100
            camera.position, camera.look_at = position, np.asarray(center)

    def _cloud(self, name: str, points: np.ndarray, colors: np.ndarray, size: float) -> None:
        """Draw points in random order, as detail.js wants them; their size is relative to that of the scene."""
        if len(points):
            order = self._random.permutation(len(points))
            style: dict[str, Any] = {"precision": "float32", "point_shape": "square", "point_shading": "flat"}
            style["point_size"] = size * self._size
            self._scene.add_point_cloud(name, points[order], colors[order], **style)
        elif self._scene.get_handle_by_name(name):
            self._scene.remove_by_name(name)

    def _path(
        self,
        name: str,
        positions: np.ndarray,
        uncertain: Any = (),
        breaks: Any = (),
        color: tuple[int, int, int] = PATH,
    ) -> None:
        """Draw a path; steps to uncertain poses in another color, and none across a break."""
        is_kept = np.ones(max(0, len(positions) - 1), bool)
        is_kept[[int(row) - 1 for row in breaks]] = False
        points, ends = beads(positions.astype(float), is_kept)
        is_uncertain = np.isin(ends, np.flatnonzero(uncertain))[:, None]
        colors = np.where(is_uncertain, np.array(UNCERTAIN, np.uint8), np.array(color, np.uint8))
        self._cloud(name, points.astype(np.float32), colors, 0.0025)

    def _frusta(self, poses: np.ndarray, corners: Float[np.ndarray, "4 3"]) -> None:
        """Draw the edges of frusta, all at once, and in random order like points."""
        order = self._random.permutation(len(poses))
        faces = (np.array(SIDES) + 5 * order[:, None, None]).reshape(-1, 3)
        tips = np.concatenate((np.zeros((1, 3)), corners))
        vertices = poses[:, None, :, 3] + np.einsum("kij,cj->kci", poses[:, :, :3], tips)
        style: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        if len(poses):
            self._scene.add_mesh_simple("frusta", vertices.reshape(-1, 3), faces, wireframe=True, **style)

    def _images(
        self, images: dict[int, np.ndarray], poses: np.ndarray, corners: Float[np.ndarray, "4 3"]
    ) -> None:
        """Draw images at the ends of the frusta of some poses, by row."""
        center, (width, height, _) = corners.mean(axis=0), corners[2] - corners[0]
        plain: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        for row, image in images.items():
            R, t = poses[row, :, :3].astype(float), poses[row, :, 3]
            placed = {"wxyz": SO3.from_matrix(R).wxyz, "position": t + R @ center}
            self._scene.add_image(f"images/{row}", image, width, height, **placed, **plain)


def beads(
    positions: Float[np.ndarray, "N 3"], is_kept: Bool[np.ndarray, " N-1"]
) -> tuple[Float[np.ndarray, "B 3"], Int[np.ndarray, " B"]]:
    """Evenly spread points along the kept steps of a path, and the rows in which their steps end."""
    if len(positions) < 2:
        return positions, np.zeros(len(positions), int)
    steps = np.where(is_kept, np.linalg.norm(np.diff(positions, axis=0), axis=1), 0.0)
    walked = np.concatenate(((0.0,), np.cumsum(steps)))
    at = np.linspace(0.0, walked[-1], BEADS)
    points = np.stack([np.interp(at, walked, axis) for axis in positions.T], axis=1)
    return points, np.searchsorted(walked, at)


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


def frustum_on_ray(
    poses: Float[np.ndarray, "K 3 4"],
    corners: Float[np.ndarray, "4 3"],
    eye: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
) -> int:
    """Row of the first frustum whose image a ray passes through; -1 without one."""
    R_cw = poses[:, :, :3].transpose(0, 2, 1)
    starts, steps = np.einsum("kij,kj->ki", R_cw, eye - poses[:, :, 3]), R_cw @ direction
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # a ray along the image plane does not pass through it
        along = (corners[0, 2] - starts[:, 2]) / steps[:, 2]
        hits = (starts + along[:, None] * steps)[:, :2]
        inside = ((hits >= corners[:, :2].min(axis=0)) & (hits <= corners[:, :2].max(axis=0))).all(axis=1)
    distances = np.where(inside & (along > 0), along, np.inf)
    best = int(distances.argmin()) if len(poses) else -1
    return best if best >= 0 and np.isfinite(distances[best]) else -1


def length_between(submap: dict[str, Any], rows: list[int]) -> tuple[float, float]:
    """Distance of two points and its standard error, NaN where it is unknown, by the errors of both and of the unit."""
    between = np.diff(submap["points"][rows].astype(float), axis=0)[0]
    length = float(np.linalg.norm(between))
    # The standard errors: of the float32 of a step the upper 16 bits, and lower triangles in these steps.
    steps = (submap["error_step"][rows].astype(np.uint32) << 16).view(np.float32).astype(float)
    L = np.zeros((2, 3, 3))
    L[:, *np.tril_indices(3)] = submap["error_factor"][rows]
    along = np.swapaxes(L, 1, 2) @ (between / max(length, MIN_SIZE))
    variances = np.where(steps > 0, steps**2 * (along**2).sum(axis=1), np.nan)
    return length, float(np.sqrt(variances.sum() + (length * submap["unit_std"]) ** 2))


def length_words(length: float, std: float, unit: str) -> str:
    """A length in words, to two digits of its standard error."""
    if not std > 0:
        return f"{length:.4g} {unit or 'map units'}"
    digits = max(0, min(9, 1 - math.floor(math.log10(std))))
    return f"{length:.{digits}f} ± {std:.{digits}f} {unit or 'map units'}"


def click_of(submap: dict[str, Any], row: int) -> str | None:
    """FRAME:X,Y of a point, as `--distance` takes it; None if no frame of the run shows it."""
    x, y = (submap["seen_pixel"][row] * (np.asarray(submap["size"]) - 1) / PIXEL_STEPS).round(1)
    return f"{submap['seen_frame'][row]}:{x:g},{y:g}" if submap["seen_frame"][row] >= 0 else None


def plane_normal(
    points: Float[np.ndarray, "N 3"], row: int, eye: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The normal of the plane through a point and its neighbors, of unit length, to the side of the eye."""
    near = points[np.argsort(np.linalg.norm(points - points[row], axis=1))[:PLANE_POINTS]].astype(float)
    normal = np.linalg.svd(near - np.median(near, axis=0))[2][2]
    return normal if normal @ (eye - points[row]) >= 0 else -normal
