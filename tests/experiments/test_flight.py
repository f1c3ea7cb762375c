"""A flight through a dense cloud: what is drawn of points whose place is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from experiments.report.animation import save_animation
from experiments.report.flight import GROUND, SIZE, draw_flight, splat
from tests.box_room import box_cloud, box_depths
from torchslam.geometry import Camera
from torchslam.types import Trajectory

CAMERA = Camera.pinhole(40.0, 40.0, 31.5, 23.5, size=(64, 48))
RED, BLUE = torch.tensor([[200, 0, 0]], dtype=torch.uint8), torch.tensor([[0, 0, 200]], dtype=torch.uint8)
EYE = torch.eye(4, dtype=torch.float64)


def test_the_nearest_point_is_in_front_and_the_larger_one_the_nearer_one() -> None:
    points_w = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0], [0.0, 0.0, -1.0], [0.5, 0.0, 4.0]])
    colors = torch.cat((BLUE, RED, BLUE, BLUE))
    image = splat(points_w, colors, 0.2, EYE, CAMERA, near=0.1)
    is_red, is_blue = (np.all(image == color.numpy(), axis=-1) for color in (RED, BLUE))
    assert is_red.sum() == 25  # 2 pixels to each side: 0.2 * 40 / 2 / 2
    assert is_blue.sum() == 9  # of the last one alone: the first is behind, the third behind the eye
    assert np.all(image[~is_red & ~is_blue] == GROUND)
    assert np.argwhere(is_blue).mean(axis=0).round().tolist() == [24, 36]  # of pixel (36.5, 23.5)


def test_a_flight_through_a_room_shows_its_walls_and_the_path(tmp_path: Path) -> None:
    x = torch.linspace(-0.5, 0.5, 12, dtype=torch.float64)
    T_wc = EYE.repeat(12, 1, 1)
    T_wc[:, 0, 3] = x
    cloud = box_cloud(box_depths(EYE[None], torch.tensor([0]), CAMERA))
    pictures = draw_flight(cloud, Trajectory(x, T_wc), 3)
    assert [each.size for each in pictures] == [SIZE] * 3
    middle = np.asarray(pictures[0])[150:250, 250:390].astype(int)
    assert np.abs(middle - GROUND).sum(axis=-1).min() > 50  # no hole in the wall
    save_animation(pictures, tmp_path / "flight.webp", 12.0)
    with Image.open(tmp_path / "flight.webp") as made:
        assert made.n_frames == 3  # type: ignore[attr-defined]
