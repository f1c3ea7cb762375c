"""Corners in images: exact and without bias, bent sides included."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torchslam.geometry import Camera
from torchslam.metric.markers.detection import (
    detector_of,
    dictionary,
    fit_corners,
    parse_target,
    side_bends,
    sides,
)

SIZE = (320, 240)
PINHOLE = Camera.pinhole(300.0, 300.0, 159.5, 119.5, size=SIZE)
BENT = Camera.radial_tangential(300.0, 300.0, 159.5, 119.5, -0.3, 0.1, 0.0, 0.0, size=SIZE)
OVER = 4  # samples of a pixel to each side


def drawn(texture: np.ndarray, corners_c: np.ndarray, camera: Camera, blur: float = 0.7) -> np.ndarray:
    """The image of a texture between four corners (4, 3) in the camera, in OpenCV's order."""
    steps = (np.arange(OVER) + 0.5) / OVER - 0.5
    x = (np.arange(SIZE[0])[:, None] + steps).ravel()
    y = (np.arange(SIZE[1])[:, None] + steps).ravel()
    pixels = torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    rays = camera.unproject(pixels).numpy()
    u, v = corners_c[1] - corners_c[0], corners_c[3] - corners_c[0]
    places = rays @ np.linalg.inv(np.stack((u, v, corners_c[0])))
    a, b = ((places[:, i] / places[:, 2]).reshape(len(y), len(x)) for i in (0, 1))
    rows, columns = texture.shape
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 230}
    image = cv2.remap(
        texture,
        (a * columns - 0.5).astype(np.float32),
        (b * rows - 0.5).astype(np.float32),
        cv2.INTER_NEAREST,
        **border,
    )
    image = image.reshape(SIZE[1], OVER, SIZE[0], OVER).mean(axis=(1, 3)).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 2, image.shape)
    return (cv2.GaussianBlur(image, (0, 0), blur) + noise).round().clip(0, 255).astype(np.uint8)


def marker_image(family: str, identity: int) -> np.ndarray:
    known = dictionary(family, family)
    return np.where(
        cv2.aruco.generateImageMarker(known, identity, 50 * (known.markerSize + 2)) > 127, 230, 25
    ).astype(np.uint8)


CORNERS_C = np.array(((-0.13, -0.10, 1.0), (0.05, -0.12, 1.1), (0.06, 0.07, 1.05), (-0.12, 0.08, 0.95)))
"""Nearly a parallelogram; the fourth is set below."""
CORNERS_C[2] = CORNERS_C[1] + CORNERS_C[3] - CORNERS_C[0]


@pytest.mark.parametrize(
    ("family", "identity", "camera"),
    [("apriltag-25h9", 3, BENT), ("apriltag-36h11", 5, PINHOLE), ("aruco-4x4", 7, BENT)],
    ids=["apriltag-25h9", "apriltag-36h11", "aruco-4x4"],
)
def test_a_marker_is_found_to_a_tenth_of_a_pixel(family: str, identity: int, camera: Camera) -> None:
    image = drawn(marker_image(family, identity), CORNERS_C, camera)
    (found,) = detector_of(parse_target(f"{family}:0.1"), camera).detect(image)
    true = camera.project(torch.from_numpy(CORNERS_C))[0].numpy()
    assert found.identity == identity
    assert np.abs(found.pixels - true).max() < 0.12
    spread, true_spread = (
        np.linalg.norm(each - each.mean(axis=0), axis=1).mean() for each in (found.pixels, true)
    )
    assert abs(spread / true_spread - 1) < 0.0015  # a threshold alone: -1 %


def test_the_bend_of_a_side_is_that_of_its_middle() -> None:
    corners = torch.from_numpy(CORNERS_C + np.array((0.3, 0.2, 0.0)))
    quads = BENT.project(corners)[0].numpy()[None]
    bends = side_bends(quads, BENT)
    assert bends is not None
    middles = BENT.project((corners / corners[:, 2:] + (corners / corners[:, 2:]).roll(-1, dims=0)) / 2)[
        0
    ].numpy()
    along, normal = sides(quads)
    expected = ((middles - quads[0] - along[0] / 2) * normal[0]).sum(axis=-1)
    assert np.abs(bends[0]).max() > 0.15
    assert np.allclose(bends[0], expected, atol=0.05)
    assert side_bends(quads, PINHOLE) is None


def test_a_square_without_edges_is_no_marker() -> None:
    image = np.full((240, 320), 128, np.uint8)
    quads = np.array([[[50.0, 50], [90, 50], [90, 90], [50, 90]], [[-3.0, 5], [30, 5], [30, 40], [-3, 40]]])
    _, found = fit_corners(image, quads, 7)
    assert not found.any()
    assert fit_corners(image, quads[:0], 7)[0].shape == (0, 4, 2)


def test_a_chessboard_and_a_charuco_board_are_found() -> None:
    squares = np.indices((100, 140)) // 20
    board = np.where(squares.sum(axis=0) % 2, 230, 25).astype(np.uint8)
    charuco = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary("aruco-5x5", ""))
    images = {"chessboard-7x5:0.04": board, "charuco-7x5:0.04:0.03": charuco.generateImage((560, 400))}
    corners = np.array(
        ((-0.45, -0.33, 1.0), (0.45, -0.33, 1.05), (0.45, 0.3129, 1.07), (-0.45, 0.3129, 1.02))
    )
    for text, texture in images.items():
        padded = cv2.copyMakeBorder(texture, *[texture.shape[0] // 10] * 4, cv2.BORDER_CONSTANT, value=230)
        target = parse_target(text)
        (found,) = detector_of(target, PINHOLE).detect(drawn(padded, corners, PINHOLE))
        margin = texture.shape[0] / 10
        places = (target.corners(0)[found.rows] / 0.04 + 1) * texture.shape[0] / 5 + margin
        u, v = corners[1] - corners[0], corners[3] - corners[0]
        points_c = corners[0] + places[:, :1] / padded.shape[1] * u + places[:, 1:] / padded.shape[0] * v
        true = PINHOLE.project(torch.from_numpy(points_c))[0].numpy()
        if np.abs(found.pixels - true).max() > 1:  # a chessboard may be counted from its other end
            true = true[::-1]
        assert len(found.rows) == 24
        assert np.abs(found.pixels - true).max() < 0.3


def test_nothing_is_found_where_nothing_is() -> None:
    image = np.full((240, 320), 128, np.uint8)
    for text in ("aruco-4x4:0.1", "chessboard-7x5:0.04", "charuco-7x5:0.04:0.03"):
        assert detector_of(parse_target(text), PINHOLE).detect(image) == []
