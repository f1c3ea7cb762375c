"""Rendered sequences: geometry against closed forms, determinism, options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import open_sequence
from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import MIP_LEVELS, QUARTER_TURN, Rectangle, corridors, rooms, wall
from torchslam.data.synthetic.sequence import OUTWARD, SCENES, RenderOptions, SyntheticSequence
from torchslam.errors import FrameError, SequenceError

Build = Callable[[int], list[Rectangle]]
SIZE = (160, 120)
K = np.array(((125.0, 0, 79.5), (0, 125.0, 59.5), (0, 0, 1)))


def _plain(origin: tuple[float, float, float], size: tuple[float, float], gray: int) -> Rectangle:
    """A rectangle of one gray level that faces the z axis."""
    side = 2 ** (MIP_LEVELS - 1)
    texture = np.full((side, side), gray, np.uint8)
    return Rectangle(np.array(origin), np.array((1.0, 0, 0)), np.array((0, 1.0, 0)), size, texture)


def test_rendered_edges_agree_with_the_projection() -> None:
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


def test_surfaces_behind_the_camera_or_edge_on_are_invisible() -> None:
    renderer = Renderer([_plain((-1, -1, 2.0), (2, 2), 200)], K, SIZE)
    turned = np.diag((-1.0, 1.0, -1.0, 1.0))
    assert renderer.render(turned).max() == 0
    edge_on = np.array(((0, 0, 1.0, -2), (0, 1, 0, 0), (-1, 0, 0, 3), (0, 0, 0, 1)))
    assert renderer.render(edge_on).max() == 0


def test_rows_with_poses_of_their_own_are_those_of_whole_images() -> None:
    renderer = Renderer(wall(seed=3), K, SIZE)
    poses = np.tile(np.eye(4), (SIZE[1], 1, 1))
    poses[:, 0, 3] = np.linspace(-0.1, 0.1, SIZE[1])
    image = renderer.render(poses)
    for row in (0, 17, 60, 119):
        assert np.array_equal(image[row], renderer.render(poses[row])[row])
    assert np.array_equal(renderer.render(np.tile(np.eye(4), (SIZE[1], 1, 1))), renderer.render(np.eye(4)))


def test_the_middle_row_of_a_rolling_shutter_has_the_pose_of_the_frame() -> None:
    """At twice the pace and with a readout of a frame interval, the first row has the pose of a slow frame."""
    rolling, still = (open_sequence(f"synthetic:room?frames=8&noise=0&readout={ms}") for ms in (50, 0))
    assert rolling.groundtruth is not None
    assert still.groundtruth is not None
    assert torch.equal(rolling.groundtruth.T_wc, still.groundtruth.T_wc)
    off = (rolling.image(4) - still.image(4)).abs()[0, 0]
    assert float(off[239:241].mean()) < 0.05 * float(off[:2].mean())
    fast = open_sequence("synthetic:room?frames=8&noise=0&pace=2&readout=50")
    assert torch.equal(fast.pose(3), still.pose(6))
    first = open_sequence("synthetic:room?frames=8&noise=0&blur=0&pace=2&readout=50").image(3)[0, 0, 0]
    slow = open_sequence("synthetic:room?frames=8&noise=0&blur=0").image(5)[0, 0, 0]
    assert float((first - slow).abs().mean()) < 0.01


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


def test_a_scene_gives_the_same_bytes_in_any_order(rendered_images: dict[object, np.ndarray]) -> None:
    first, second = open_sequence("synthetic:room"), open_sequence("synthetic:room")
    image = first.image(1)
    assert torch.equal(first.image(1), image)
    rendered_images.clear()
    second.image(5)
    assert torch.equal(second.image(1), image)
    pairs = zip(_built(corridors), corridors(0), strict=True)
    assert all(np.array_equal(one.texture, same.texture) for one, same in pairs)
    assert not torch.equal(first.image(1), open_sequence("synthetic:room?noise=5").image(1))


def test_long_sequences_revisit_places_but_never_exactly() -> None:
    sequence = open_sequence("synthetic:room?frames=400&blank=1")
    assert sequence.groundtruth is not None
    assert len(sequence) == 400
    distance = (sequence.groundtruth.positions_w[160:320] - sequence.groundtruth.positions_w[:160]).norm(
        dim=-1
    )
    assert float(distance.min()) > 0
    assert float(distance.max()) < 0.1
    assert float(sequence[399].image.std()) == 0


def test_rotating_and_static_cameras_have_no_parallax() -> None:
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


@lru_cache(maxsize=3)
def _built(build: Build) -> list[Rectangle]:
    """Of seed 0; made once, for it takes seconds."""
    return build(0)


def _path(name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (N, 3) and orientations (N, 3, 3) of the camera in the world."""
    groundtruth = open_sequence(f"synthetic:{name}").groundtruth
    assert groundtruth is not None
    return groundtruth.positions_w, groundtruth.T_wc[:, :3, :3]


def _degrees_between(R_1: torch.Tensor, R_2: torch.Tensor) -> torch.Tensor:
    cosine = ((R_1.mT @ R_2).diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def test_every_scene_has_its_own_length() -> None:
    scenes = ("room", "planar", "loop", "corridors")
    assert [len(open_sequence(f"synthetic:{name}")) for name in scenes] == [160, 160, 720, 560]
    assert len(open_sequence("synthetic:loop?frames=30")) == 30


def test_the_loop_is_smooth_without_rotations_in_place() -> None:
    positions, R_wc = _path("loop")
    moves = positions.diff(dim=0)
    steps, turns = moves.norm(dim=-1), _degrees_between(R_wc[:-1], R_wc[1:])
    assert 0.02 < float(steps.min()) < float(steps.max()) < 0.035
    assert 0.5 < float(turns.mean()) < float(turns.max()) < 1.5
    # The camera looks to the left of where it goes, by as much all the way but for the sway.
    ahead, view = moves / steps[:, None], R_wc[:-1, :, 2]
    to_the_left = torch.atan2(ahead[:, 0] * view[:, 2] - ahead[:, 2] * view[:, 0], (ahead * view).sum(dim=-1))
    assert float((to_the_left - OUTWARD).abs().max()) < 0.25
    assert float((to_the_left - OUTWARD).mean().abs()) < 0.01


def test_the_loop_returns_to_its_start() -> None:
    positions, R_wc = _path("loop")
    assert float((positions[670:] - positions[:50]).norm(dim=-1).max()) < 0.15
    assert float(_degrees_between(R_wc[670:], R_wc[:50]).max()) < 5
    assert float((positions[:50] - positions[335:385]).norm(dim=-1).min()) > 5.0  # the far side in between


@pytest.mark.parametrize(("name", "build"), [("loop", rooms), ("corridors?frames=720", corridors)])
def test_the_walk_avoids_walls_and_furniture(name: str, build: Build) -> None:
    positions = _path(name)[0].numpy()
    clearance = [_distance(positions, rectangle).min() for rectangle in _built(build)]
    assert 0.4 < min(clearance) < 1.0


def _distance(points: np.ndarray, rectangle: Rectangle) -> np.ndarray:
    """(N,) from each point (N, 3) to the nearest place of a rectangle."""
    axes = np.stack((rectangle.axis_u, rectangle.axis_v))
    inside = ((points - rectangle.origin) @ axes.T).clip(0, rectangle.size)
    return np.linalg.norm(points - rectangle.origin - inside @ axes, axis=-1)


def test_the_corridors_are_never_revisited() -> None:
    positions, _ = _path("corridors")
    apart = (torch.arange(len(positions))[:, None] - torch.arange(len(positions))).abs() >= 150
    assert float(torch.cdist(positions, positions)[apart].min()) > 2.5
    # The first room painted white, the others black.
    white, black = (np.full((32, 32), gray, np.uint8) for gray in (255, 0))
    built = _built(corridors)
    painted = [
        Rectangle(one.origin, one.axis_u, one.axis_v, one.size, white if row < len(built) / 4 else black)
        for row, one in enumerate(built)
    ]
    renderer, sequence = Renderer(painted, K, SIZE), open_sequence("synthetic:corridors?frames=720")
    seen = [renderer.render(sequence.pose(index).numpy()).mean() / 255 for index in (0, 440, 500, 559, 670)]
    assert seen[0] > 0.95
    assert seen[1:4] == [0, 0, 0]
    assert seen[4] > 0.95


def test_corridors_look_alike_where_rooms_do_not() -> None:
    T_wc = open_sequence("synthetic:loop").groundtruth.T_wc[40].numpy()
    quarter = np.eye(4)
    quarter[:3, :3] = QUARTER_TURN
    alike, different = (Renderer(_built(build), K, SIZE) for build in (corridors, rooms))
    for turns in (1, 2, 3):
        T_wc_there = np.linalg.matrix_power(quarter, turns) @ T_wc
        here, there = (np.linalg.inv(pose) for pose in (T_wc, T_wc_there))
        assert np.abs(alike.render(here) - alike.render(there)).mean() < 0.1
        assert np.abs(different.render(here) - different.render(there)).mean() > 20


def test_the_walk_meets_corresponding_places_of_the_corridors() -> None:
    positions, R_wc = (values.numpy() for values in _path("corridors"))
    quarter = 670 / 4
    for turns in (1, 2, 3):
        index = round(40 + turns * quarter)
        back = np.linalg.matrix_power(QUARTER_TURN.T, turns)
        assert np.linalg.norm(back @ positions[index] - positions[40]) < 0.15
        assert np.linalg.norm(back @ R_wc[index] - R_wc[40]) < 0.1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "synthetic:kitchen",
            "unknown scene `kitchen`; there are room, planar, rotation, standstill, loop, corridors",
        ),
        ("synthetic:room?frmes=3", "unknown option `frmes`; there are frames, seed"),
        ("synthetic:room?frames=many", "`frames` must be a number, got `many`"),
        ("synthetic:room?frames=0", "`frames` is out of range: 0"),
        ("synthetic:room?noise=nan", "`noise` is out of range: nan"),
    ],
)
def test_bad_names(name: str, message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        open_sequence(name)


def test_rendered_images_are_kept_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rendered_images: dict[object, np.ndarray]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def image(name: str) -> torch.Tensor:
        rendered_images.clear()  # of the tests
        return open_sequence(f"synthetic:planar?{name}").image(1)

    first = image("noise=1&cache=1")
    assert torch.equal(first, image("noise=1"))
    (file,) = (tmp_path / "torchslam" / "rendered").rglob("*.png")
    monkeypatch.setattr(SyntheticSequence, "_rendered", None)
    assert torch.equal(image("frames=9&noise=1&cache=1"), first)
    with pytest.raises(TypeError):
        image("noise=2&cache=1")
    file.write_bytes(b"")
    with pytest.raises(FrameError, match="planar#1"):
        image("noise=1&cache=1")


def test_all_scenes_and_options_are_documented() -> None:
    page = (Path(__file__).parents[2] / "docs" / "tutorials" / "research.md").read_text(encoding="utf-8")
    own = [name for name, scene in SCENES.items() if scene.build.__module__.startswith("torchslam")]
    for name in (*own, *(column.name for column in fields(RenderOptions))):
        assert f"| `{name}` |" in page, name
