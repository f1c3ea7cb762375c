"""The example that learns the camera of recordings."""

from __future__ import annotations

import pytest
import torch

from examples.learn_camera import PARTS, LearnedCamera, learn
from torchslam import Camera, open_sequence
from torchslam.learning import Clips

CAMERA = Camera.pinhole(260.0, 262.0, 159.5, 119.5, size=(320, 240))


def test_it_starts_as_the_given_camera_and_every_part_has_a_gradient() -> None:
    lens = LearnedCamera(CAMERA)
    points = torch.tensor([[0.2, -0.1, 2.0], [-0.5, 0.3, 3.0]], dtype=torch.float64)
    pixels, _ = lens.camera().project(points)
    torch.testing.assert_close(pixels, CAMERA.project(points)[0])
    straight = lens.straightened(pixels[None])
    torch.testing.assert_close(straight, pixels[None])
    (pixels.square().sum() + straight.square().sum()).backward()
    assert all((getattr(lens, part).grad != 0).any() for part in PARTS)
    with pytest.raises(ValueError, match="fisheye"):
        LearnedCamera(Camera.fisheye(260.0, 260.0, 159.5, 119.5, 0.0, 0.0, 0.0, 0.0, size=(320, 240)))


def test_the_grid_moves_keypoints_near_its_nodes() -> None:
    lens = LearnedCamera(CAMERA)
    with torch.no_grad():
        lens.grid[:, 0, 0] = torch.tensor(
            [0.02, -0.01]
        )  # two pixels to the right and one up, at the top left
    at = torch.tensor([[[0.0, 0.0], [319.0, 239.0]]], dtype=torch.float64)
    torch.testing.assert_close(lens.straightened(at) - at, torch.tensor([[[2.0, -1.0], [0.0, 0.0]]]).double())


def test_a_wrong_focal_length_moves_towards_the_true_one() -> None:
    """Without true poses, from 5 % off: a few steps on one clip of a rendered room."""
    sequence = open_sequence("synthetic:room", resize_to="320x240", stride=3, limit=24)
    clips = Clips([sequence], per_sequence=2)
    start = sequence.camera.with_params(sequence.camera.params * torch.tensor([1.05, 1.05, 1, 1]).double())
    losses: list[float] = []

    def log(name: str, value: float, _: int) -> None:
        if name == "loss":
            losses.append(value)

    lens = learn(clips, start, 6, supervised=False, parts=("focal",), batch=2, log=log)
    off = lens.camera().focal / sequence.camera.focal - 1
    assert 0 < off < 0.045
    assert losses[-1] < losses[0]
