"""Following by patches: a camera moves before a textured wall."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torchslam.config import load_config
from torchslam.geometry import Camera, se3_exp, se3_inverse, transform
from torchslam.tracking.scout import Scout
from torchslam.types import Anchor, Followed, Frame

CAMERA = Camera.pinhole(200.0, 200.0, 159.5, 119.5, (320, 240))
DEPTH = 2.0


def wall(size: int = 900) -> np.ndarray:
    noise = np.random.default_rng(3).standard_normal((size, size)).astype(np.float32)
    smooth = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (2.0, 4.0, 10.0))
    assert isinstance(smooth, np.ndarray)
    return cv2.normalize(smooth, np.empty(0), 0.0, 1.0, cv2.NORM_MINMAX)


WALL = wall()
PER_UNIT = 150.0  # pixels of the picture on the wall


def pose(step: float) -> Tensor:
    """(4, 4) the camera after a time, world to camera: sideways, forward and turning a little."""
    return se3_exp(torch.tensor([-0.03, 0.01, -0.02, 0.004, 0.006, 0.01], dtype=torch.float64) * step)


def picture(T_cw: Tensor) -> Tensor:
    """(1, 1, H, W) what the camera sees of the wall z = DEPTH."""
    R, t = T_cw[:3, :3].numpy(), T_cw[:3, 3].numpy()
    wall_to_world = np.array([[1 / PER_UNIT, 0, -3.0], [0, 1 / PER_UNIT, -3.0], [0, 0, DEPTH]])
    to_camera = CAMERA.K.numpy() @ (R @ wall_to_world + np.outer(t, [0, 0, 1]))
    image = cv2.warpPerspective(WALL, to_camera, CAMERA.size, flags=cv2.INTER_LINEAR)
    return torch.from_numpy(image)[None, None]


def frame(index: int, image: Tensor | None = None) -> Frame:
    return Frame(index, float(index), picture(pose(index)) if image is None else image)


def anchor(index: int, keyframes: Tensor | None = None, overlap: float = 1.0) -> Anchor:
    T_aw = pose(index)
    y, x = torch.meshgrid(torch.linspace(25, 215, 9), torch.linspace(25, 295, 12), indexing="ij")
    pixels = torch.stack([x.flatten(), y.flatten()], dim=-1).double()
    rays_w = CAMERA.unproject(pixels) @ T_aw[:3, :3]
    centre_w = se3_inverse(T_aw)[:3, 3]
    points_w = centre_w + rays_w * ((DEPTH - centre_w[2]) / rays_w[:, 2])[:, None]
    return Anchor(
        index=index,
        points_a=transform(T_aw, points_w),
        pixels=pixels,
        scales=torch.ones(len(pixels), dtype=torch.float64),
        senior=torch.ones(len(pixels), dtype=torch.bool),
        T_ka=torch.eye(4, dtype=torch.float64)[None] if keyframes is None else keyframes,
        velocity=pose(index) @ se3_inverse(pose(index - 1)),
        overlap=overlap,
    )


def scout(*settings: str) -> Scout:
    return Scout(
        CAMERA,
        load_config(
            None, ["patches.delay=0", "patches.min_agreeing=40", "keyframes.max_translation=10", *settings]
        ),
    )


def follow_from(found: Scout, first: Anchor, frames: int) -> list[Followed]:
    found.follow(frame(first.index))
    found.learn(first.index, first)
    return [found.follow(frame(first.index + step)) for step in range(1, frames + 1)]


def check_pose(followed: Followed, index: int, first: int = 0) -> None:
    assert followed.T_ca is not None
    error = followed.T_ca @ pose(first) @ se3_inverse(pose(index))
    assert float(error[:3, 3].norm()) < 2e-3
    cosine = ((error[:3, :3].diagonal().sum() - 1) / 2).clamp(-1, 1)
    assert math.degrees(float(cosine.acos())) < 0.05


def test_the_camera_is_followed() -> None:
    for index, followed in enumerate(follow_from(scout(), anchor(0), 5), start=1):
        assert followed.why_not == ""
        assert followed.anchor == 0
        check_pose(followed, index)
        assert len(followed.rows) > 60
        expected, _ = CAMERA.project(transform(followed.T_ca, anchor(0).points_a))  # type: ignore[arg-type]
        assert (followed.pixels - expected[followed.rows]).norm(dim=-1).median() < 0.1
        assert followed.expected >= len(followed.rows)
        assert bool((torch.linalg.eigvalsh(followed.covariance) > 0).all())


def test_in_large_images_as_in_reduced_ones() -> None:
    assert scout().reduction == 1.0
    small = scout("features.image_pixels=19200")  # a quarter: half as wide and high
    assert small.reduction == 2.0
    for index, followed in enumerate(follow_from(small, anchor(0), 3), start=1):
        check_pose(followed, index)


def test_without_an_anchor_features_are_wanted() -> None:
    found = scout()
    assert found.follow(frame(0)).why_not == "nothing to follow it from"
    found.learn(0, anchor(0))
    assert found.follow(frame(1)).why_not == ""
    found.learn(1, None)
    assert found.follow(frame(2)).anchor == -1
    found.learn(2, anchor(2))
    assert found.follow(frame(3)).anchor == 2
    found.forget()
    assert found.follow(frame(4)).anchor == -1


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_news_are_taken_after_a_fixed_number_of_frames(delay: int) -> None:
    found = scout(f"patches.delay={delay}", "patches.max_frames=30")
    found.follow(frame(0))
    found.learn(0, anchor(0))
    anchors = []
    for index in range(1, 9):
        anchors.append(found.follow(frame(index)).anchor)
        if index == 3:
            found.learn(3, anchor(3))
    assert anchors == [-1] * delay + [0] * 3 + [3] * (5 - delay)


def test_what_was_followed_goes_on_from_the_next_anchor() -> None:
    found = scout("patches.delay=2")
    found.follow(frame(0))
    found.learn(0, anchor(0))
    for index in range(1, 3):
        found.follow(frame(index))
    for index in range(3, 9):
        followed = found.follow(frame(index))
        check_pose(followed, index, first=followed.anchor)
        found.learn(index, anchor(index))
    assert followed.anchor == 5


def test_a_jump_is_lost_and_a_small_one_is_found_in_the_second_attempt() -> None:
    found = scout()
    found.follow(frame(0))
    found.learn(0, anchor(0))
    lost = found.follow(frame(1, picture(pose(60.0))))
    assert "were found again" in lost.why_not
    assert lost.T_ca is None
    back = found.follow(frame(2))
    assert back.T_ca is not None
    check_pose(back, 2)


def test_another_picture_is_not_taken_for_the_scene() -> None:
    found = scout()
    found.follow(frame(0))
    found.learn(0, anchor(0))
    other = torch.from_numpy(np.ascontiguousarray(WALL[300:540, 500:820][::-1]))[None, None]
    assert found.follow(frame(1, other)).T_ca is None


def test_far_from_all_keyframes_features_are_wanted() -> None:
    near, far = torch.eye(4, dtype=torch.float64), se3_exp(torch.tensor([5.0, 0, 0, 0, 0, 0]).double())
    for keyframes, words in ((far[None], "no keyframe is near it"), (torch.stack([far, near]), "")):
        found = scout("keyframes.max_translation=0.2")
        (followed,) = follow_from(found, anchor(0, keyframes), 1)
        assert followed.why_not == words
        check_pose(followed, 1)


def test_one_that_features_are_wanted_of_may_become_a_keyframe() -> None:
    found = scout("patches.delay=2", "keyframes.max_translation=0.04")
    found.follow(frame(0))
    found.learn(0, anchor(0))
    found.follow(frame(1))
    found.follow(frame(2))
    words = [found.follow(frame(index)).why_not for index in range(3, 7)]
    assert words == [
        "no keyframe is near it",
        "",
        "",
        "no keyframe is near it",
    ]  # a step is 0.019 of the depth


def test_only_so_many_frames_in_a_row() -> None:
    words = [followed.why_not for followed in follow_from(scout("patches.max_frames=2"), anchor(0), 5)]
    wanted = "2 frames were followed without features"
    assert words == ["", "", wanted, "", ""]


def test_when_little_is_left_of_the_reference_keyframe() -> None:
    settings = ("keyframes.min_overlap=0.8", "patches.overlap_share=0.9")
    (followed,) = follow_from(scout(*settings), anchor(0, overlap=0.7), 1)
    assert "of the points of its reference keyframe" in followed.why_not
    (followed,) = follow_from(scout(*settings), anchor(0, overlap=1.0), 1)
    assert followed.why_not == ""


def test_points_of_age_have_the_say() -> None:
    first = anchor(0)
    young = torch.arange(len(first.pixels)) % 3 == 0
    wrong = torch.where(
        young[:, None], first.points_a * 1.4, first.points_a
    )  # along their rays: at 0 nobody can tell
    told = {"points_a": wrong, "senior": ~young}
    found = scout("patches.max_frames=9")
    followed = follow_from(found, Anchor(**{**vars(first), **told}), 6)[-1]
    check_pose(followed, 6)
    assert not young[followed.rows].any()


def test_a_thin_map_needs_every_frame() -> None:
    found, covered = scout("patches.min_agreeing=100"), picture(pose(1))
    covered[..., :100] = 0.5
    found.follow(frame(0))
    found.learn(0, anchor(0))
    followed = found.follow(frame(1, covered))
    assert followed.why_not == f"only {len(followed.rows)} patches agree with the pose"
    check_pose(followed, 1)
    (followed,) = follow_from(scout("patches.min_agreeing=109"), anchor(0), 1)
    assert followed.why_not == "there is too little to follow it by"
    assert followed.T_ca is None
