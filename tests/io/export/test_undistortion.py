from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.io.export.scene import ExportedScene, Undistorter, pinhole_within, undistorted


def border(camera: Camera) -> torch.Tensor:
    """(N, 2) the outermost pixels of an image."""
    v, u = np.mgrid[: camera.height, : camera.width]
    outer = (u == 0) | (v == 0) | (u == camera.width - 1) | (v == camera.height - 1)
    return torch.from_numpy(np.stack((u[outer], v[outer]), axis=1)).double()


def test_the_undistorted_image_is_the_largest_valid_one(lens: Camera) -> None:
    pinhole = pinhole_within(lens)
    rays = torch.nn.functional.pad(pinhole.normalize(border(pinhole)), (0, 1), value=1.0)
    pixels, valid = lens.project(rays)
    assert valid.all()
    size = torch.tensor(lens.size).double() - 1
    assert bool(((pixels > -0.01) & (pixels < size + 0.01)).all())  # the rim is sampled at its pixels
    room = torch.stack((pixels.amin(0), size - pixels.amax(0)))  # left, top; right, bottom
    assert bool((room.abs() < 1.5).all())  # the last column and row of pixels may not fit
    assert torch.equal(pinhole.params[:2], lens.params[:2])


def test_undistorted_keypoints_agree_with_opencv(scene: ExportedScene) -> None:
    flat, (K, k) = undistorted(scene), (scene.camera.K.numpy(), scene.camera.params[4:].numpy())
    undistort = cv2.fisheye.undistortPoints if scene.camera.model == "fisheye" else cv2.undistortPoints
    if scene.camera.model == "pinhole":
        k = np.zeros(5)
    pixels = scene.pixels.numpy()[:, None]
    expected = undistort(pixels, K, k, P=flat.camera.K.numpy())[:, 0]
    np.testing.assert_allclose(flat.pixels, expected, atol=1e-3)


def test_undistorted_images_agree_with_opencv(lens: Camera) -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (*reversed(lens.size), 3), dtype=np.uint8), (0, 0), 2)
    new, K = pinhole_within(lens).K.numpy(), lens.K.numpy()
    k = lens.params[4:].numpy() if lens.model != "pinhole" else np.zeros(5)
    maps = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
    x, y = maps(K, k, np.eye(3), new, pinhole_within(lens).size, cv2.CV_32FC1)
    expected = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = np.abs(Undistorter(lens)(image).astype(int) - expected)
    assert difference.max() <= 2


def test_the_size_of_an_undistorted_image_is_bounded() -> None:
    """The left and right edges are 100 degrees from the axis, where a pinhole camera sees nothing."""
    wide = pinhole_within(Camera.fisheye(90.0, 90.0, 159.5, 119.5, 0.0, 0.0, 0.0, 0.0, size=(320, 240)))
    assert wide.size[0] in (640, 641)
    assert float(wide.fx) == pytest.approx(float(wide.fy))
    assert float(wide.fx) < 1.0


def test_a_field_of_view_beyond_pinhole_is_refused() -> None:
    with pytest.raises(ResultsError, match="too wide"):
        pinhole_within(Camera.fisheye(90.0, 90.0, 600.0, 119.5, 0.0, 0.0, 0.0, 0.0, size=(320, 240)))
