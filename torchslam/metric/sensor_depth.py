"""Depth images of a sensor beside the camera as a source of meters: its depths of the points of the map.

The depths of a point in a frame, by the sensor and by the map, have the ratio of their units. The sensor is assumed at
the place of the camera, with its axes; what it is aside, some centimeters, is part of the stated error.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.data.formats.calibration_files import parse_calibration
from torchslam.data.formats.depth_images import DepthImages, find_depth_images, parse_depth_folder, read_depth
from torchslam.data.trajectories import nearest
from torchslam.data.transforms import scale_camera
from torchslam.errors import FrameError, MeasurementError
from torchslam.geometry import Camera, transform
from torchslam.geometry.robust import weighted_median
from torchslam.metric.options import Given
from torchslam.metric.slow_noise import scale_of_series
from torchslam.metric.source import MetricSource, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured

IMAGES = 60
"""Depth images that are read at most, evenly over the recording; with 20 and with 100 redkitchen's scale is the same to
.1 %."""
LEAST_IMAGES, LEAST_POINTS = 3, 10
"""Fewest images whose scatter is estimated, and points of an image that give a scale."""
PATCH = 5
"""Pixels of the side of the patch around a point, of which all must have depth, and one depth."""
NOISE = 1.5e-3
"""Standard deviation of depth, meters at one meter; it grows with the square of the depth (Khoshelham and Elberink,
"Accuracy and resolution of Kinect depth data", 2012, figure 10). Rendered depth has none, which only weighs it
otherwise."""
EDGE = 0.03
"""Relative range of the depths of a patch beyond which, and beyond its noise, it has an edge, where a pixel aside is
another surface. With .01 to .2 redkitchen's scale changes by .1 to .6 %."""
POINT_STD = 0.02
"""Relative standard deviation of the depth of a map point; on redkitchen single points scatter by 1.6 to 3 %."""
SENSOR_STD = 0.015
"""Relative error that all images share: of the sensor's own calibration (TUM corrected its three Kinects by 3.5, 3.1
and 0 %), of its place and of its axis."""


def from_options(given: Given) -> list[MetricSource]:
    """The sources of `--depth FOLDER[:SCALE]`, with `--depth-camera` for all.

    Raises MeasurementError if there are no depth images, or a list is wrong, CalibrationError for a wrong camera.
    """
    cameras = [words[0] for words in given.get("depth_camera", ())]
    if len(cameras) > 1:
        raise MeasurementError("--depth-camera is given twice: it is that of all depth images")
    for text in cameras:
        parse_calibration(text, "--depth-camera")
    found = [find_depth_images(*parse_depth_folder(words[0])) for words in given["depth"]]
    return [SensorDepth(images, *cameras) for images in found]


@dataclass(frozen=True)
class SensorDepth:
    """Depth images that were taken with the images.

    Attributes:
        images: the files.
        camera: of the depth images, as `--camera` is written; empty: they are registered to the color images, each of
            their pixels shows what the same place of the color image does.
    """

    images: DepthImages
    camera: str = ""

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """The unit of a submap by the depths of its points.

        Raises MeasurementError if a file has no depth, or in another unit.
        """
        pairs = self._pairs(view)
        if isinstance(pairs, str):
            return Unmeasured(ScaleSource.DEPTH, pairs)
        places = np.linspace(0, len(pairs) - 1, min(IMAGES, len(pairs))).tolist()
        chosen = sorted(set(map(round, places)))
        rows, logs, unreadable = list[int](), list[float](), list[str]()
        for row, path in (pairs[place] for place in chosen):
            try:
                depth = read_depth(path, self.images.units_per_meter)
            except FrameError as error:
                unreadable.append(str(error))
                continue
            found = frame_ratio(view, row, depth, self._camera(view.camera, depth))
            if found is not None:
                rows.append(row)
                logs.append(found)
        notes = []
        if not self.images.said:
            notes.append(
                f"{self.images.source}: assuming {self.images.units_per_meter:g} units per meter; "
                "--depth FOLDER:SCALE states another number"
            )
        if unreadable:
            notes.append(f"{len(unreadable)} depth images cannot be read, the first one: {unreadable[0]}")
        if len(rows) < LEAST_IMAGES:
            why = f"points of the map have depth in {len(rows)} of {len(chosen)} depth images"
            return Unmeasured(ScaleSource.DEPTH, "; ".join([why, *notes]))
        times = view.timestamps[rows].cpu().double()
        values = torch.tensor(logs, dtype=torch.float64, device="cpu")
        return scale_of_series(
            ScaleSource.DEPTH,
            times,
            values,
            torch.ones_like(values),
            "depth images",
            lambda row: f"that of frame {int(view.frame_index[rows[row]])}",
            disagreement="depth images differ by {} from each other",
            shared_std=SENSOR_STD,
            notes=tuple(notes),
        )

    def _camera(self, camera: Camera, depth: Float[np.ndarray, "H W"]) -> Camera:
        """The camera of a depth image."""
        size = (depth.shape[1], depth.shape[0])
        if self.camera:
            return parse_calibration(self.camera, "--depth-camera").camera(size).to(torch.float64)
        return scale_camera(camera.to("cpu").to(torch.float64), size)

    def _pairs(self, view: SubmapView) -> list[tuple[int, Path]] | str:
        """The frames that have a depth image, by their row in the view, and its file; or why there are none."""
        images, times = self.images, view.timestamps.cpu().double()
        near = None if images.timestamps is None else nearest_times(times, images.timestamps)
        if near is not None and bool((near >= 0).any()):
            return [(row, images.paths[place]) for row, place in enumerate(near.tolist()) if place >= 0]
        by_name = {_numbers(path.name): path for path in images.paths}
        file_name = None if view.sequence is None else view.sequence.file_name
        names = [_numbers(file_name(index)) for index in view.frame_index.tolist()] if file_name else []
        named = [(row, by_name[key]) for row, key in enumerate(names) if key and key in by_name]
        if named:
            return named
        if images.timestamps is None or not len(times):
            return f"{images.source}: its names, as {images.paths[0].name}, are neither times nor those of the images"
        own = images.timestamps
        return (
            f"{images.source}: no depth image is within half a frame of an image: they are from {float(own[0]):.3f} to "
            f"{float(own[-1]):.3f} s, images from {float(times[0]):.3f} to {float(times[-1]):.3f} s"
        )


def nearest_times(times: Float[Tensor, " N"], others: Float[Tensor, " M"]) -> Int[Tensor, " N"]:
    """The index of the nearest one of other times, both ascending; -1 where it is half an interval or more away.

    The shorter one of both median intervals counts: in between, another image would have been nearer.
    """
    rows, distances = nearest(times, others)
    intervals = [each.diff().median() for each in (times, others) if len(each) > 1]
    limit = min(map(float, intervals), default=0.0) / 2
    return torch.where(distances <= limit, rows, -1)


def _numbers(name: str) -> tuple[int, ...]:
    """The numbers in the name of a file, which those of an image and of its depth share: `frame-000010.depth.png`."""
    return tuple(map(int, re.findall(r"\d{1,18}", Path(name).stem)))


def frame_ratio(view: SubmapView, row: int, depth: Float[np.ndarray, "H W"], camera: Camera) -> float | None:
    """The logarithm of meters per unit by the points that a frame observes; None for too few.

    Args:
        view: the submap.
        row: of the frame, as in `view.timestamps`.
        depth: of a sensor, meters, 0 where it is not known.
        camera: of the depth image, at the place of the camera and with its axes.
    """
    frames, slam_map = view.submap.posed_frames, view.submap.map
    own = torch.nonzero(frames.observations["frame_row"] == view.rows[row])[:, 0]
    points = slam_map.follow_merges(frames.observations["point_ids"][own])
    z = transform(view.T_cw[row], slam_map.positions_w[points])[:, 2].detach().cpu().double()
    pixels = frames.observations["pixels"][own].detach().cpu().double()
    rays = view.camera.to("cpu").to(torch.float64).unproject(pixels)
    seen, valid = camera.project(rays / rays[:, 2:])
    patch, border = np.ones((PATCH, PATCH), np.uint8), PATCH // 2
    near, far, mean = cv2.erode(depth, patch), cv2.dilate(depth, patch), cv2.blur(depth, patch.shape)
    place = seen.round().long()
    height, width = depth.shape
    inside = valid & (z > 0) & (place >= border).all(dim=-1)
    inside &= (place[:, 0] < width - border) & (place[:, 1] < height - border)
    x, y = place[inside].T.numpy()
    low, high, middle = (torch.from_numpy(each[y, x]).double() for each in (near, far, mean))
    is_one = (low > 0) & (high <= low * (1 + EDGE + 3 * NOISE * low))
    if int(is_one.sum()) < LEAST_POINTS:
        return None
    z, middle = z[inside][is_one], middle[is_one]
    weights = 1 / (POINT_STD**2 + (NOISE * middle).square())
    return weighted_median((middle / z).log(), weights)
