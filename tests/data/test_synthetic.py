"""Rendered sequences: geometry against closed forms, determinism, options."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import MIP_LEVELS, Rectangle, wall
from torchslam.errors import SequenceError

SIZE = (160, 120)
K = np.array(((125.0, 0, 79.5), (0, 125.0, 59.5), (0, 0, 1)))


def _plain(origin: tuple[float, float, float], size: tuple[float, float], grey: int) -> Rectangle:
    """A rectangle of one grey level that faces the z axis."""
    side = 2 ** (MIP_LEVELS - 1)
    texture = np.full((side, side), grey, np.uint8)
    return Rectangle(np.array(origin), np.array((1.0, 0, 0)), np.array((0, 1.0, 0)), size, texture)


def test_edges_lie_where_the_projection_says() -> None:
    # From x = -0.4 to 0.8 m and y = -0.2 to 0.3 m at 2 m: pixels 54.5 to 129.5 and 47 to 78.25.
    image = Renderer([_plain((-0.4, -0.2, 2.0), (1.2, 0.5), 200)], K, SIZE).render(np.eye(4))
    expected = np.zeros((120, 160), np.float32)
    expected[47:79, 55:130] = 200
    assert np.array_equal(image, expected)


def test_the_nearer_one_hides_the_farther_one() -> None:
    near, far = _plain((-0.1, -0.1, 1.0), (0.2, 0.2), 50), _plain((-2, -2, 3.0), (4, 4), 150)
    for rectangles in ([near, far], [far, near]):
        image = Renderer(rectangles, K, SIZE).render(np.eye(4))
        assert image[60, 80] == 50
        assert image[5, 5] == 150


def test_nothing_is_seen_behind_the_camera_or_edge_on() -> None:
    renderer = Renderer([_plain((-1, -1, 2.0), (2, 2), 200)], K, SIZE)
    turned = np.diag((-1.0, 1.0, -1.0, 1.0))
    assert renderer.render(turned).max() == 0
    edge_on = np.array(((0, 0, 1.0, -2), (0, 1, 0, 0), (-1, 0, 0, 3), (0, 0, 0, 1)))
    assert renderer.render(edge_on).max() == 0


def test_views_of_a_plane_differ_by_its_homography() -> None:
    renderer = Renderer(wall(seed=3), K, SIZE)
    T_21 = np.eye(4)
    T_21[:3, :3] = cv2.Rodrigues(np.array((0.05, 0.2, 0.1)))[0]
    T_21[:3, 3] = (0.3, -0.1, 0.2)
    first, second = renderer.render(np.eye(4)), renderer.render(T_21)
    # The wall is the plane z = 2.5 of the first camera.
    H = K @ (T_21[:3, :3] + np.outer(T_21[:3, 3], (0, 0, 1)) / 2.5) @ np.linalg.inv(K)
    warped = cv2.warpPerspective(first, H, SIZE, flags=cv2.INTER_CUBIC, borderValue=-1)
    seen = (cv2.erode(warped, np.ones((5, 5))) >= 0) & (second > 0)
    assert seen.mean() > 0.5
    shifts = [
        _shift(warped, second, x, y) for x in range(24, 136, 16) for y in range(24, 100, 16) if seen[y, x]
    ]
    # Per patch, noise of resampling; on the whole, no shift.
    assert np.abs(np.mean(shifts, axis=0)).max() < 0.02
    assert np.median(np.abs(shifts)) < 0.1


def _shift(a: np.ndarray, b: np.ndarray, x: int, y: int) -> tuple[float, float]:
    window = np.s_[y - 12 : y + 12, x - 12 : x + 12]
    hann = cv2.createHanningWindow((24, 24), cv2.CV_32F)
    (dx, dy), _ = cv2.phaseCorrelate(a[window].astype(np.float32), b[window].astype(np.float32), hann)
    return dx, dy


def test_room_has_corners_at_every_scale_and_moves_smoothly() -> None:
    sequence = open_sequence("synthetic:room")
    assert len(sequence) >= 120
    assert sequence.size == (640, 480)
    assert sequence.groundtruth is not None
    for index in (0, 100):
        image = (sequence[index].image[0, 0] * 255).byte().numpy()
        octaves = [keypoint.octave for keypoint in cv2.ORB_create(1000).detect(image)]
        assert np.bincount(octaves, minlength=8).min() >= 40
    steps = sequence.groundtruth.positions_w.diff(dim=0).norm(dim=-1)
    assert float(steps.min()) > 0.01
    assert float(steps.max()) < 0.1


def test_same_name_same_bytes_in_any_order() -> None:
    first, second = open_sequence("synthetic:room"), open_sequence("synthetic:room")
    second.image(5)
    assert torch.equal(first.image(1), second.image(1))
    assert not torch.equal(first.image(1), open_sequence("synthetic:room?noise=5").image(1))


def test_longer_runs_come_round_again_but_never_exactly() -> None:
    sequence = open_sequence("synthetic:room?frames=400&blank=1")
    assert sequence.groundtruth is not None
    assert len(sequence) == 400
    distance = (sequence.groundtruth.positions_w[160:320] - sequence.groundtruth.positions_w[:160]).norm(
        dim=-1
    )
    assert float(distance.min()) > 0
    assert float(distance.max()) < 0.1
    assert float(sequence[399].image.std()) == 0


def test_rotation_and_standstill_have_no_parallax() -> None:
    for scene, turns in (("rotation", True), ("standstill", False)):
        sequence = open_sequence(f"synthetic:{scene}?blank=1")
        assert sequence.groundtruth is not None
        assert float(sequence.groundtruth.positions_w.abs().max()) == 0
        rotations = sequence.groundtruth.T_wc[:, :3, :3]
        assert bool((rotations - rotations[0]).abs().max() > 0.1) == turns


def test_exposure_and_noise() -> None:
    steady = open_sequence("synthetic:standstill?frames=20&noise=0")
    changing = open_sequence("synthetic:standstill?frames=20&noise=0&exposure=0.2")
    assert torch.equal(steady.image(3), steady.image(9))
    assert float(changing.image(15).mean()) > 1.1 * float(steady.image(15).mean())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("synthetic:kitchen", "unknown scene `kitchen`; there are room, planar, rotation, standstill"),
        ("synthetic:room?frmes=3", "unknown option `frmes`; there are frames, seed"),
        ("synthetic:room?frames=many", "`frames` must be a number, got `many`"),
        ("synthetic:room?frames=0", "`frames` is out of range: 0"),
        ("synthetic:room?noise=nan", "`noise` is out of range: nan"),
    ],
)
def test_bad_names(name: str, message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        open_sequence(name)
