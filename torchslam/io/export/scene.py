"""Content of an export: posed frames of one run in one submap, their points, observations and images.

Images and keypoints are undistorted on request.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchslam.data import open_sequence
from torchslam.data.calibration import Calibration
from torchslam.data.formats.given_poses import rows_by_name
from torchslam.data.formats.image_file import write_image
from torchslam.data.readers.live import is_live
from torchslam.data.sequence import Sequence
from torchslam.data.transforms import resize, scale_camera
from torchslam.errors import FrameError, ResultsError, SequenceError
from torchslam.geometry import Camera, SensorModel, se3_inverse, squared_reprojection_errors, transform
from torchslam.geometry.rolling_shutter import Readout
from torchslam.geometry.zoom import Zoom
from torchslam.map.atlas import Submap

MAX_GROWTH = 2.0  # of width and height; a pinhole image diverges at 90 degrees from the axis
SAME_PICTURE = 0.9
"""Correlation from which on an image is that of the run, by another decoder or in other colors: less than that of two
frames between which anything moves."""
NOISE = 4 / 255
"""Difference that a codec may make in an image without contrast."""
WITHOUT = "use --sequence for its new location, or --no-images"


@dataclass(frozen=True)
class ExportedScene:
    """Posed frames in order of time, points and observations, ordered by frame; on the CPU.

    Attributes:
        frame_ids: indices of the frames in the sequence.
        timestamps: seconds.
        points_w: points, each observed by two frames or more.
        colors: red, green, blue.
        frame_index, point_index: rows of the frame and the point of each observation.
        pixels: observed keypoints.
    """

    camera: Camera
    frame_ids: Int[Tensor, " K"]
    timestamps: Float[Tensor, " K"]
    is_keyframe: Bool[Tensor, " K"]
    T_cw: Float[Tensor, "K 4 4"]
    points_w: Float[Tensor, "N 3"]
    colors: UInt8[Tensor, "N 3"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    pixels: Float[Tensor, "O 2"]

    @property
    def T_wc(self) -> Float[Tensor, "K 4 4"]:
        """Camera to world."""
        return se3_inverse(self.T_cw)

    @property
    def image_names(self) -> list[str]:
        """Image file names of an export, in the order of the frames."""
        return [f"{index:06d}.png" for index in self.frame_ids.tolist()]

    def turned(self, R: Float[Tensor, "3 3"]) -> ExportedScene:
        """Return the scene rotated by R: points p become R p."""
        T_cw = self.T_cw.clone()
        T_cw[:, :3, :3] = T_cw[:, :3, :3] @ R.mT
        return replace(self, T_cw=T_cw, points_w=self.points_w @ R.mT)

    def of_frames(self, frame_ids: Int[Tensor, " R"]) -> ExportedScene:
        """Return the scene of some of the frames. Raises ResultsError if one of them is not in the scene."""
        missing = frame_ids[~torch.isin(frame_ids, self.frame_ids)].tolist()
        if missing:
            raise ResultsError(f"frame {missing[0]} has no pose in this map")
        rows = torch.nonzero(torch.isin(self.frame_ids, frame_ids))[:, 0]
        return self._part(rows, torch.ones_like(self.frame_index, dtype=torch.bool))

    def _part(self, rows: Int[Tensor, " R"], is_seen: Bool[Tensor, " O"]) -> ExportedScene:
        """The scene of rows of frames, in their order, and of points in two or more of the observations that count."""
        slot = torch.full((len(self.T_cw),), -1, device="cpu")
        slot[rows] = torch.arange(len(rows), device="cpu")
        is_seen = is_seen & (slot[self.frame_index] >= 0)
        tracks = torch.bincount(self.point_index[is_seen], minlength=len(self.points_w))
        seen = torch.nonzero(is_seen & (tracks[self.point_index] >= 2))[:, 0]
        seen = seen[torch.argsort(slot[self.frame_index[seen]], stable=True)]
        points, point_index = torch.unique(self.point_index[seen], return_inverse=True)
        return replace(
            self,
            frame_ids=self.frame_ids[rows],
            timestamps=self.timestamps[rows],
            is_keyframe=self.is_keyframe[rows],
            T_cw=self.T_cw[rows],
            points_w=self.points_w[points],
            colors=self.colors[points],
            frame_index=slot[self.frame_index[seen]],
            point_index=point_index,
            pixels=self.pixels[seen],
        )

    def errors(self) -> Float[Tensor, " O"]:
        """Return the reprojection errors, in pixels."""
        points_c = transform(self.T_cw[self.frame_index], self.points_w[self.point_index][:, None])
        return squared_reprojection_errors(points_c[:, 0], self.pixels, self.camera).sqrt()

    def point_errors(self) -> Float[Tensor, " N"]:
        """Return the mean error of each point; their mean is the reprojection error of COLMAP."""
        total = torch.zeros(len(self.points_w), dtype=self.pixels.dtype, device="cpu")
        count = torch.bincount(self.point_index, minlength=len(total))
        return total.index_add(0, self.point_index, self.errors()) / count


def scene_of(
    submap: Submap, camera: Camera, session: int, keyframes_alone: bool, readout: Readout | None = None
) -> ExportedScene:
    """Build the scene of one session in a saved submap, from all frames or only from keyframes.

    With the readout of a rolling shutter, keypoints are where a global shutter would have seen them. Points outside of
    the domain of the camera model and points with fewer than two observations are omitted. Raises ResultsError if there
    are no frames.
    """
    if submap.map.num_keyframes == 0:
        raise ResultsError(f"submap {submap.number} is empty")
    sensor = SensorModel(camera, readout)
    graph = submap.posed_frames.graph(submap.map, sensor, submap.number).global_shutter()
    wanted = (graph.sessions == session) & (graph.is_keyframe | (not keyframes_alone))
    rows = torch.nonzero(wanted)[:, 0]
    if len(rows) == 0:
        raise ResultsError(
            f"submap {submap.number} holds no frames of this run: it was only localized, or all of it is elsewhere"
        )
    rows = rows[torch.argsort(graph.timestamps[rows], stable=True)]
    points_c = transform(graph.T_cw[graph.frame_index], graph.points_w[graph.point_index][:, None])
    scene = ExportedScene(
        camera=camera.to(torch.float64),
        frame_ids=graph.frame_ids,
        timestamps=graph.timestamps,
        is_keyframe=graph.is_keyframe,
        T_cw=graph.T_cw.double(),
        points_w=graph.points_w.double(),
        colors=submap.map.points["colors"][graph.point_ids],
        frame_index=graph.frame_index,
        point_index=graph.point_index,
        pixels=graph.pixels.double(),
    )
    return scene._part(rows, camera.project(points_c[:, 0])[1])


def pinhole_within(camera: Camera) -> Camera:
    """Return the pinhole camera with the largest field of view that lies within the view of the camera.

    It has the focal lengths of the camera, reduced only if the image would be more than MAX_GROWTH times as wide or
    high. Raises ResultsError if the field of view is too wide.
    """
    if camera.model == "pinhole":
        return camera
    x, y = (torch.arange(size, dtype=camera.params.dtype, device="cpu") for size in camera.size)

    def edge(u: Tensor, v: Tensor, axis: int) -> Tensor:
        return camera.normalize(torch.stack(torch.broadcast_tensors(u, v), dim=-1))[:, axis]

    low = torch.stack((edge(x[0], y, 0).max(), edge(x, y[0], 1).max()))
    high = torch.stack((edge(x[-1], y, 0).min(), edge(x, y[-1], 1).min()))
    focal = camera.params[:2]
    extent, size = (high - low) * focal, torch.tensor(camera.size, device="cpu")
    if not bool((extent >= 1).all()):
        raise ResultsError("the field of view of the camera is too wide for an undistorted image")
    scale = (MAX_GROWTH * size / extent).min().clamp(max=1.0)
    width, height = (int(side) + 1 for side in scale * extent)
    params = torch.cat((scale * focal, -scale * focal * low))
    return Camera("pinhole", params, (width, height))


def enlarged(pinhole: Camera, camera: Camera) -> Camera:
    """The camera of a depth map, for images as large as those of the camera that it was made from."""
    factor = max(1.0, float(camera.params[0] / pinhole.params[0]))
    size = (round(factor * pinhole.width), round(factor * pinhole.height))
    return scale_camera(pinhole, size)


def undistorted(scene: ExportedScene, pinhole: Camera | None = None) -> ExportedScene:
    """Return the scene for a pinhole camera, by default `pinhole_within`; keypoints may lie outside of the images."""
    pinhole = pinhole_within(scene.camera) if pinhole is None else pinhole
    if _is_same(scene.camera, pinhole):
        return scene
    return replace(scene, camera=pinhole, pixels=undistorted_pixels(scene.pixels, scene.camera, pinhole))


def undistorted_pixels(pixels: Float[Tensor, "N 2"], camera: Camera, pinhole: Camera) -> Float[Tensor, "N 2"]:
    """Convert pixels of a camera to a pinhole camera."""
    return camera.normalize(pixels) * pinhole.params[:2] + pinhole.params[2:]


class Undistorter:
    """Converts images of a camera to a pinhole camera, by default `pinhole_within`.

    Smaller images are means over the pixels of the larger ones.
    """

    def __init__(self, camera: Camera, pinhole: Camera | None = None) -> None:
        pinhole = pinhole_within(camera) if pinhole is None else pinhole
        self._size = pinhole.size
        factor = max(1, int(camera.params[0] / pinhole.params[0] + 1e-6))
        sides = (torch.arange(factor * side, device="cpu").double() for side in pinhole.size)
        u, v = ((side + 0.5) / factor - 0.5 for side in sides)
        grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
        slopes = pinhole.to(torch.float64).normalize(grid.flatten(0, 1))
        rays = torch.nn.functional.pad(slopes, (0, 1), value=1.0)
        pixels = camera.project(rays)[0].reshape(grid.shape)
        self._x, self._y = (pixels[..., axis].float().numpy() for axis in (0, 1))

    def __call__(self, image: UInt8[np.ndarray, "H W *channels"]) -> UInt8[np.ndarray, "h w *channels"]:
        """Undistort an image; the result has the size of the pinhole camera."""
        # Border pixels may fall outside by a rounding error, so the border is replicated.
        large = cv2.remap(image, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        is_small = large.shape[1::-1] == self._size
        return large if is_small else cv2.resize(large, self._size, interpolation=cv2.INTER_AREA)


def _is_same(camera: Camera, other: Camera) -> bool:
    """Whether two cameras have the same images, to within a hundredth of a pixel."""
    is_alike = camera.model == other.model and camera.size == other.size
    return is_alike and bool(((camera.params - other.params).abs() < 0.01).all())


class Images:
    """Color images by frame, optionally undistorted.

    Args:
        rows: index in the sequence of each frame of the run
        camera: that of the sequence
        pinhole: camera of the undistorted images; None: the images as they are
    """

    def __init__(
        self, sequence: Sequence, rows: Mapping[int, int], camera: Camera, pinhole: Camera | None = None
    ) -> None:
        self._sequence = sequence
        self._rows = rows
        is_same = pinhole is None or _is_same(camera, pinhole)
        self._undistort = None if is_same else Undistorter(camera, pinhole)

    @property
    def brings_features(self) -> bool:
        """Images are there, whatever features a run used."""
        return False

    def image(self, frame_id: int) -> Float[Tensor, "1 1 H W"]:
        """Return a gray image in [0, 1], as it is. Raises FrameError if it cannot be read."""
        return self._sequence.image(self._rows[frame_id])

    def file_name(self, frame_id: int) -> str:
        """Return the file of a frame below the folder of all; empty if frames are no files."""
        return self._sequence.file_name(self._rows[frame_id])

    def bgr(self, frame_id: int) -> UInt8[np.ndarray, "H W 3"]:
        """Return an image as OpenCV writes it: blue, green, red. Raises FrameError if it cannot be read."""
        rgb = self._sequence.color(self._rows[frame_id]).contiguous().numpy()
        image = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        return image if self._undistort is None else self._undistort(image)


class ExampleFrame(NamedTuple):
    """A frame of a run whose image, gray in [0, 1], is kept with the results."""

    frame_id: int
    timestamp: float
    image: Float[Tensor, "1 1 H W"]


@dataclass(frozen=True)
class ImageSource:
    """Where the images of a run are, and by what they are found.

    Attributes:
        path: of the sequence.
        fps: frame rate with which the run read images without timestamps.
        files: file of each frame, if frames are files; a file is a frame's own, a time that was counted is not.
        example: frame by whose image the sequence is recognized; None if there is none.
        as_stored: whether the run ignored the EXIF orientation of images.
        zoom: of the run, which is undone in the images; None: one focal length.
    """

    path: str
    fps: float | None = None
    files: Mapping[int, str] = field(default_factory=dict)
    example: ExampleFrame | None = None
    as_stored: bool = False
    zoom: Zoom | None = None


def open_images(
    source: ImageSource, scene: ExportedScene, pinhole: Camera | None = None, otherwise: str = WITHOUT
) -> Images:
    """Open the images of a scene, in the size of the run.

    Images are found by their file names, and frames of videos and recordings by their times, since the run may have
    read a part of the sequence. Raises ResultsError if the sequence or an image is missing, or another one.

    Args:
        source: where the images are.
        scene: the exported frames.
        pinhole: camera of the undistorted images; None: the images as they are.
        otherwise: what to do without them, for the error.
    """
    times = dict(zip(scene.frame_ids.tolist(), scene.timestamps.tolist(), strict=True))
    if is_live(source.path):  # nor is it opened because of a results folder
        raise ResultsError(f"{source.path}: a live source gives each image once; {otherwise}")
    try:
        camera = None
        if source.as_stored:  # the numbers are not used: the images may have another size
            numbers = (1.0, 1.0, 0.0, 0.0)
            camera = Calibration("pinhole", numbers, source.path, guessed=True, as_stored=True)
        sequence = open_sequence(source.path, camera)
        if source.fps is not None and not set(times.values()) <= set(sequence.timestamps.tolist()):
            sequence = open_sequence(source.path, camera, fps=source.fps)
        if sequence.size != scene.camera.size:
            sequence = resize(sequence, "{}x{}".format(*scene.camera.size))
    except SequenceError as error:
        raise ResultsError(f"the sequence of this run cannot be read: {error}; {otherwise}") from None
    rows, example = _image_rows(sequence, source, times, otherwise), source.example
    if source.zoom is not None:
        sequence = sequence.with_camera(scene.camera).unzoomed(_of_rows(source.zoom, rows))
    if example is not None and example.frame_id in rows:
        try:
            found = sequence.image(rows[example.frame_id])
        except FrameError:  # reported when it is needed
            found = example.image
        if found.shape != example.image.shape or not _is_same_picture(found, example.image):
            raise ResultsError(
                f"{source.path}: not the sequence of this run: frame {example.frame_id} shows something else than it "
                f"did; {otherwise}"
            )
    return Images(sequence, rows, scene.camera, pinhole)


def _of_rows(zoom: Zoom, rows: Mapping[int, int]) -> Zoom:
    """The zoom of a run by the rows of the sequence that its frames are; rows: index in the sequence of each frame."""
    ids = sorted(rows, key=rows.__getitem__)
    frames = torch.tensor(ids, dtype=torch.int64, device="cpu")
    return Zoom(torch.tensor([rows[each] for each in ids], dtype=torch.int64, device="cpu"), zoom.at(frames))


def _image_rows(
    sequence: Sequence, source: ImageSource, times: Mapping[int, float], otherwise: str
) -> dict[int, int]:
    """The index in a sequence of each frame, and of the example if it is there. Raises ResultsError otherwise."""
    wanted, example = dict(times), source.example
    if example is not None:
        wanted.setdefault(example.frame_id, example.timestamp)
    present = [sequence.file_name(index) for index in range(len(sequence))]
    is_of_files, start = any(present), f"{source.path}: not the sequence of this run"
    if is_of_files and not source.files:
        raise ResultsError(
            f"{source.path}: the results do not state the image of each frame: run again, or --no-images"
        )
    if source.files and not is_of_files:
        name = next(iter(source.files.values()))
        raise ResultsError(f"{start}, whose frames are files such as {name}; {otherwise}")
    if is_of_files:
        ids = [frame_id for frame_id in wanted if frame_id in source.files]
        found = rows_by_name([source.files[frame_id] for frame_id in ids], present).tolist()
        rows = {ids[row]: index for index, row in enumerate(found) if row >= 0}
    else:
        row_at = {time: row for row, time in enumerate(sequence.timestamps.tolist())}
        rows = {frame_id: row_at[time] for frame_id, time in wanted.items() if time in row_at}
    missing = [frame_id for frame_id in times if frame_id not in rows]
    if missing and not is_of_files:
        raise ResultsError(f"{start}, whose frames have other times; {otherwise}")
    if missing:
        name = source.files.get(missing[0], "no file")
        raise ResultsError(
            f"{source.path}: {len(missing)} of {len(times)} images of this run are missing, the first is that of frame "
            f"{missing[0]}, {name}; {otherwise}"
        )
    return rows


def _is_same_picture(image: Float[Tensor, "1 1 H W"], other: Float[Tensor, "1 1 H W"]) -> bool:
    """Whether two images are the same, up to noise, brightness and contrast."""
    centered, other = (values.double() - values.double().mean() for values in (image, other))
    energy, other_energy = (float(values.square().mean()) for values in (centered, other))
    covariance = float((centered * other).mean())
    if covariance > 0 and covariance**2 > SAME_PICTURE**2 * energy * other_energy:
        return True
    return max(energy, other_energy) < NOISE**2


def write_images(folder: Path, scene: ExportedScene, images: Images) -> None:
    """Write the image of every frame as PNG; images of an earlier export are deleted."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("[0-9]" * 6 + ".png"):
        old.unlink()
    for frame_id, name in zip(scene.frame_ids.tolist(), scene.image_names, strict=True):
        write_image(folder / name, images.bgr(frame_id))
