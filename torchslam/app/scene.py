"""What is drawn: a map that grows, or a result; and what is measured in it by clicks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import viser
import viser.transforms
from jaxtyping import Float, Int

PATH, UNCERTAIN, TRUTH, OTHER = (
    (87, 150, 65),
    (190, 130, 225),
    (60, 60, 60),
    (230, 140, 40),
)  # red, green, blue
FRUSTUM, MARK = (70, 110, 190), (230, 60, 50)  # red, green, blue
STATES = ("initializing", "tracking", "uncertain", "lost")  # as `types.State`, whose module imports torch
MAX_FRUSTA, MAX_THUMBNAILS = 400, 48
"""Keyframes that are drawn as frusta, and those of them with an image: a browser draws few images but many lines fast.
Measured with 2,000 keyframes, see docs/tutorials/app.md."""
REACH_PX = 14.0  # from a click to the point or frustum that it means, as in view.html
BESIDE_PX = 3.0  # that a point nearer to the eye may be farther from the click, as in view.html
PLANE_POINTS = (
    40  # neighbors of a click that determine a plane; 20 to 80 give the floor of the demo within 2 degrees
)
PIXEL_STEPS = 65535  # of an image point, over the image; as `page.STEPS`, whose module imports torch
MIN_SIZE = 1e-6  # of what is drawn, in map units: so that nothing divides by zero


class Scene:
    """The scene of the page, the same for all who look at it.

    Attributes:
        data: the result that is shown, as of `reading.result`; None during a run.
        points, colors: (P, 3) of the sparse map that is shown.
        frames: frames of the keyframes that are drawn.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self.clear()

    def clear(self) -> None:
        """Draw nothing."""
        self._scene.reset()
        self._scene.world_axes.visible = False
        self.data: dict[str, Any] | None = None
        self.points = np.zeros((0, 3), np.float32)
        self.colors = np.zeros((0, 3), np.uint8)
        self.dense: tuple[np.ndarray, np.ndarray] | None = None
        self.frames, self._centers_w = np.zeros(0, int), np.zeros((0, 3), np.float32)
        self._is_aimed, self._size = False, 1.0

    def show_live(self, found: dict[str, Any]) -> None:
        """Draw a map that grows, as of `reading.live`. Its world is that of the first camera: y points down."""
        if not self._is_aimed:
            self._scene.set_up_direction("-y")
        poses, points = found["poses"], found["points"]
        if not len(points):
            return
        low, high = np.percentile(points, (5, 95), axis=0)
        self._size = max(float(np.linalg.norm(high - low)), MIN_SIZE)
        with self._server.atomic():
            self._cloud("live/points", points, found["colors"], 0.004)
            self._path("live/path", poses, found["uncertain"], found["breaks"])
            if len(poses):
                _, fy, _, _, width, height = found["camera"]
                self._frustum("live/camera", poses[-1], (fy, width, height), 0.08, found["image"])
        if not self._is_aimed:
            self._is_aimed = True
            self.aim((low + high) / 2, (0.5, -0.7, -1.0), 1.3 * self._size)

    def show_result(self, data: dict[str, Any]) -> None:
        """Draw the main submap of a result."""
        self.clear()
        self.data = data
        self._scene.set_up_direction("+z")
        if not data["submaps"]:
            return
        submap = data["submaps"][0]
        self._size = max(2.0 * submap["radius"], MIN_SIZE)
        self.points = submap["points"].reshape(-1, 3)
        colors = submap["colors"].reshape(-1, 3)
        self.colors = colors if len(colors) else np.full(self.points.shape, 130, np.uint8)
        if submap["dense"] is not None:
            dense = submap["dense"]
            steps = dense["points"].reshape(-1, 3).astype(np.float32)
            points = np.asarray(dense["low"], np.float32) + steps * np.asarray(dense["step"], np.float32)
            self.dense = points, dense["colors"].reshape(-1, 3)
        poses = submap["poses"].reshape(-1, 3, 4)
        states = data["frames"]["state"][submap["frame"]]
        keyframes = submap["keyframe_poses"].reshape(-1, 3, 4)
        rows = spread(len(keyframes), MAX_FRUSTA)
        self.frames = data["frames"]["index"][submap["keyframe"]][rows]
        self._centers_w = keyframes[rows, :, 3]
        with self._server.atomic():
            self.crop(None)
            self._path("result/path", poses, states == STATES.index("uncertain"), submap["breaks"])
            self._segments("result/truth", strip(submap["truth"].reshape(-1, 3)), TRUTH)
            corners = np.asarray(data["corners"]) * 2 * submap["frustum"]
            self._segments("result/frusta", outlines(keyframes[rows], corners), FRUSTUM, 1.0)
        self.aim(np.zeros(3), (0.6, -1.0, 0.7), 1.5 * submap["radius"])

    def show_thumbnails(self, images: dict[int, np.ndarray]) -> None:
        """Add the images of keyframes to their frusta, as of `reading.thumbnails`."""
        assert self.data is not None
        submap, (_, fy, _, _), size = self.data["submaps"][0], self.data["camera"], self.data["size"]
        row_of = {
            int(frame): row for row, frame in enumerate(self.data["frames"]["index"][submap["keyframe"]])
        }
        for frame, image in images.items():
            pose = submap["keyframe_poses"].reshape(-1, 3, 4)[row_of[frame]]
            self._frustum(
                f"result/images/{frame}", pose, (fy, *size), 2 * submap["frustum"] / self._size, image
            )

    def thumbnail_frames(self) -> list[int]:
        """The keyframes whose images are shown."""
        return [int(each) for each in self.frames[spread(len(self.frames), MAX_THUMBNAILS)]]

    def crop(self, limits: Float[np.ndarray, "2 3"] | None, is_dense: bool = True) -> int:
        """Draw the points within two corners, the dense ones if wanted and there are any; return their number."""
        clouds = {"sparse": (self.points, self.colors)} | (
            {"dense": self.dense} if self.dense is not None else {}
        )
        shown = "dense" if is_dense and self.dense is not None else "sparse"
        for name in clouds:
            if name != shown and self._scene.get_handle_by_name(f"result/{name}"):
                self._scene.remove_by_name(f"result/{name}")
        points, colors = self.within(limits, is_dense)
        self._cloud(f"result/{shown}", points, colors, 0.0016 if shown == "dense" else 0.003)
        return len(points)

    def within(
        self, limits: Float[np.ndarray, "2 3"] | None, is_dense: bool = True
    ) -> tuple[Float[np.ndarray, "N 3"], np.ndarray]:
        """The points within two corners, with colors."""
        points, colors = self.dense if is_dense and self.dense is not None else (self.points, self.colors)
        if limits is None:
            return points, colors
        inside = ((points >= limits[0]) & (points <= limits[1])).all(axis=1)
        return points[inside], colors[inside]

    def show_other(self, positions: Float[np.ndarray, "N 3"]) -> None:
        """Draw the path of another result, which is aligned with this one."""
        self._segments("result/other", strip(positions), OTHER)

    def show_marks(self, positions: Float[np.ndarray, "N 3"]) -> None:
        """Mark points that were clicked, and the line between two."""
        self._cloud("result/marks", positions, np.tile(np.uint8(MARK), (len(positions), 1)), 0.015)
        self._segments("result/between", strip(positions), MARK)

    def turn_up(self, normal: Float[np.ndarray, "3"]) -> None:
        """Make a direction point up on the page, whatever the result calls up."""
        self._scene.set_up_direction(tuple(map(float, normal)))

    def fly(self, row: int) -> None:
        """Put the eyes of all who look into a pose of the path."""
        assert self.data is not None
        submap = self.data["submaps"][0]
        pose = submap["poses"].reshape(-1, 3, 4)[row].astype(float)
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.wxyz = viser.transforms.SO3.from_matrix(pose[:, :3]).wxyz
                client.camera.position = pose[:, 3]

    def aim(self, center: np.ndarray, direction: tuple[float, float, float], distance: float) -> None:
        """Put the eyes of all who look, and of those who come, at a distance of a center."""
        position = center + distance * np.asarray(direction) / np.linalg.norm(direction)
        near, far = distance / 1000, distance * 100
        cameras = [each.camera for each in self._server.get_clients().values()]
        for camera in (self._server.initial_camera, *cameras):
            camera.near, camera.far, camera.position, camera.look_at = near, far, position, np.asarray(center)

    def point_at(self, origin: Any, direction: Any, pixel_angle: float) -> int:
        """Row of the point that is seen along a ray, -1 if none is within reach; `pixel_angle`: of a pixel, rad."""
        return nearest_to_ray(self.points, np.asarray(origin), np.asarray(direction), pixel_angle)

    def keyframe_at(self, origin: Any, direction: Any, pixel_angle: float) -> int | None:
        """Frame of the keyframe that is seen along a ray; None if none is within reach."""
        row = nearest_to_ray(self._centers_w, np.asarray(origin), np.asarray(direction), pixel_angle)
        return None if row < 0 else int(self.frames[row])

    def _cloud(self, name: str, points: np.ndarray, colors: np.ndarray, size: float) -> None:
        self._scene.add_point_cloud(
            name, points, colors, point_size=size * self._size, precision="float32", point_shape="circle"
        )

    def _path(self, name: str, poses: np.ndarray, uncertain: np.ndarray, breaks: Any) -> None:
        """Draw a path; steps to uncertain poses in another color, and none across a break."""
        segments = strip(poses[:, :, 3])
        is_kept = np.ones(len(segments), bool)
        is_kept[[int(row) - 1 for row in breaks]] = False
        colors = np.where(np.asarray(uncertain, bool)[1:, None], np.uint8(UNCERTAIN), np.uint8(PATH))
        colors = np.repeat(colors[is_kept][:, None], 2, axis=1) if len(segments) else PATH
        self._segments(name, segments[is_kept], colors, 3.0)

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
        self._scene.add_camera_frustum(
            name,
            2 * math.atan(height / (2 * fy)),
            width / height,
            scale=size * self._size,
            thickness=1.5,
            thickness_units="screen",
            color=FRUSTUM,
            image=image,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=viser.transforms.SO3.from_matrix(pose[:, :3].astype(float)).wxyz,
            position=pose[:, 3].astype(float),
        )


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
    centers = poses[:, None, :, 3]
    ends = centers + np.einsum("kij,cj->kci", poses[:, :, :3], corners)
    sides = np.stack((np.broadcast_to(centers, ends.shape), ends), axis=2)
    around = np.stack((ends, np.roll(ends, -1, axis=1)), axis=2)
    return np.concatenate((sides, around), axis=1).reshape(-1, 2, 3)


def nearest_to_ray(
    points: Float[np.ndarray, "N 3"],
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    pixel_angle: float,
) -> int:
    """Row of the point along a ray: within `REACH_PX` of it, and near to the eye, as the ruler of view.html chooses it.

    Returns:
        -1 if there is none.
    """
    if not len(points):
        return -1
    from_eye = points - origin
    depth = from_eye @ (direction / np.linalg.norm(direction))
    beside = np.sqrt(np.maximum((from_eye**2).sum(axis=1) - depth**2, 0.0))
    pixels = np.arctan2(beside, depth) / pixel_angle
    cost = np.where((depth > 0) & (pixels <= REACH_PX), (pixels + BESIDE_PX) * depth, np.inf)
    best = int(cost.argmin())
    return best if np.isfinite(cost[best]) else -1


def length_between(submap: dict[str, Any], first: int, second: int) -> tuple[float, float]:
    """Distance of two points and its standard error, NaN where it is unknown, by the errors of both and of the unit."""
    points = submap["points"].reshape(-1, 3)[[first, second]].astype(float)
    between = points[1] - points[0]
    length = float(np.linalg.norm(between))
    direction = between / max(length, MIN_SIZE)
    steps = (submap["error_step"][[first, second]].astype(np.uint32) << 16).view(np.float32).astype(float)
    factors = submap["error_factor"].reshape(-1, 6)[[first, second]].astype(float)
    L = np.zeros((2, 3, 3))
    L[:, *np.tril_indices(3)] = factors
    variances = np.where(steps > 0, steps**2 * ((np.swapaxes(L, 1, 2) @ direction) ** 2).sum(axis=-1), np.nan)
    return length, float(np.sqrt(variances.sum() + (length * submap["unit_std"]) ** 2))


def length_words(length: float, std: float, unit: str) -> str:
    """A length in words, to two digits of its standard error."""
    unit = unit or "map units"
    if not std > 0:
        return f"{length:.4g} {unit}"
    digits = max(0, min(9, 1 - math.floor(math.log10(std))))
    return f"{length:.{digits}f} ± {std:.{digits}f} {unit}"


def click_of(data: dict[str, Any], row: int) -> str | None:
    """FRAME:X,Y of a point, as `--distance` takes it; None if no frame of the run shows it."""
    submap = data["submaps"][0]
    frame = int(submap["seen_frame"][row])
    if frame < 0:
        return None
    steps = submap["seen_pixel"].reshape(-1, 2)[row]
    x, y = (steps * (np.asarray(data["size"]) - 1) / PIXEL_STEPS).round(1).tolist()
    return f"{frame}:{x:g},{y:g}"


def plane_normal(
    points: Float[np.ndarray, "N 3"], row: int, eye: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The normal of the plane through a point and its neighbors, of unit length, to the side of the eye."""
    distances = np.linalg.norm(points - points[row], axis=1)
    near = points[np.argsort(distances)[:PLANE_POINTS]].astype(float)
    normal = np.linalg.svd(near - np.median(near, axis=0))[2][2]
    return normal if normal @ (eye - points[row]) >= 0 else -normal
