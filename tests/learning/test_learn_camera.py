"""The example that learns the camera of recordings, and the study's recordings through a bent lens."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from examples.learn_camera import LearnedCamera, Straightened, learn
from experiments.learning.camera.bent_lens import FOCAL, SIZE, Bent, bent_lens, ray_errors
from torchslam import ORB, Camera, open_sequence
from torchslam.data import Sequence
from torchslam.errors import ClipError
from torchslam.learning import Clips

CAMERA = Camera.pinhole(260.0, 262.0, 159.5, 119.5, size=(320, 240))
BENT = Camera(
    "radial_tangential",
    torch.tensor([300.0, 298.0, 158.0, 121.0, -0.2, 0.05, 1e-3, -2e-3, 0.0], dtype=torch.float64),
    (320, 240),
)


def rays_of(camera: Camera) -> Tensor:
    """The rays of the middles of cells of 10 pixels."""
    x, y = torch.arange(32).double() * 10 + 4.5, torch.arange(24).double() * 10 + 4.5
    return camera.unproject(torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2))


def test_it_starts_as_the_given_camera_and_everything_has_a_gradient() -> None:
    lens = LearnedCamera(CAMERA)
    points = torch.tensor([[0.2, -0.1, 2.0], [-0.5, 0.3, 3.0]], dtype=torch.float64)
    pixels, _ = lens.camera().project(points)
    torch.testing.assert_close(pixels, CAMERA.project(points)[0])
    straight = lens.straightened(pixels[None])
    torch.testing.assert_close(straight, pixels[None])
    (pixels.square().sum() + straight.square().sum()).backward()
    for each in (lens.change, lens.grid):
        assert each.grad is not None
        assert (each.grad != 0).any()
    with pytest.raises(ValueError, match="fisheye"):
        LearnedCamera(Camera.fisheye(260.0, 260.0, 159.5, 119.5, 0.0, 0.0, 0.0, 0.0, size=(320, 240)))
    with pytest.raises(ValueError, match="must be of focal, center, distortion, grid, not lens"):
        LearnedCamera(CAMERA, ("lens",))


@pytest.mark.parametrize("start", [CAMERA, BENT])
def test_each_change_moves_the_pixels_by_one_in_a_pattern_of_its_own(start: Camera) -> None:
    lens, rays = LearnedCamera(start), rays_of(start)
    step = 1e-4
    moved = []
    for row in range(len(lens.change)):
        with torch.no_grad():
            lens.change.zero_()[row] = step
            moved.append((lens.camera().project(rays)[0] - start.project(rays)[0]).flatten() / step)
    gram = torch.stack(moved) @ torch.stack(moved).T / len(rays)
    # Seen at more pixels than the patterns were made of.
    torch.testing.assert_close(gram, torch.eye(8).double(), atol=0.15, rtol=0)


@pytest.mark.parametrize(
    ("parts", "kept"),
    [(("focal",), (2, 3, 4, 5, 6, 7, 8)), (("center", "distortion"), (0, 1, 8)), (("grid",), range(9))],
)
def test_what_is_not_learned_stays(parts: tuple[str, ...], kept: tuple[int, ...]) -> None:
    lens = LearnedCamera(BENT, parts)
    with torch.no_grad():
        lens.change += 1.0
    assert torch.equal(lens.camera().params[list(kept)], BENT.params[list(kept)])
    assert lens.grid.requires_grad == ("grid" in parts)
    changed = [place for place in range(9) if place not in kept]
    assert (lens.camera().params[changed] != BENT.params[changed]).all()


def test_the_grid_moves_keypoints_near_its_nodes() -> None:
    lens = LearnedCamera(CAMERA)
    with torch.no_grad():
        lens.grid[:, 0, 0] = torch.tensor([2.0, -1.0])  # to the right and up, at the top left
    at = torch.tensor([[[0.0, 0.0], [319.0, 239.0]]], dtype=torch.float64)
    torch.testing.assert_close(lens.straightened(at) - at, torch.tensor([[[2.0, -1.0], [0.0, 0.0]]]).double())


def test_a_feature_extractor_reads_the_learned_grid(tmp_path: Path) -> None:
    lens = bent_lens(0)
    save_file(lens.weights(), tmp_path / "camera.safetensors")
    image = torch.rand(1, 1, *reversed(SIZE), generator=torch.Generator().manual_seed(0))
    plain = ORB(50)(image)
    found = Straightened(50, str(tmp_path / "camera.safetensors"))(image)
    assert torch.equal(found.keypoints, lens.straightened(plain.keypoints))
    assert not torch.equal(found.keypoints, plain.keypoints)
    assert torch.equal(Straightened(50)(image).keypoints, plain.keypoints.double())
    mask = torch.zeros_like(image, dtype=torch.bool)
    assert not Straightened(50)(image, mask).mask.any()


@pytest.fixture(scope="module")
def room() -> Sequence:
    return open_sequence("synthetic:room", resize_to="320x240", stride=3, limit=24)


@pytest.mark.parametrize(("supervised", "off"), [(True, 0.002), (False, 0.005)])
def test_a_wrong_focal_length_moves_to_the_true_one(room: Sequence, supervised: bool, off: float) -> None:
    """From 5 % off: a few steps on a clip of a rendered room."""
    clips = Clips([room], per_sequence=1)
    start = room.camera.with_params(room.camera.params * torch.tensor([1.05, 1.05, 1, 1]).double())
    losses: list[float] = []

    def log(name: str, value: float, _: int) -> None:
        if name == "loss":
            losses.append(value)

    lens = learn(clips, start, supervised, ("focal",), steps=8, log=log)
    found = lens.camera().focal.detach() / room.camera.focal - 1
    assert abs(float(found)) < off
    assert losses[-1] < losses[0]
    assert torch.equal(lens.grid, torch.zeros_like(lens.grid))


def test_clips_that_all_fail_are_an_error(room: Sequence, capsys: pytest.CaptureFixture[str]) -> None:
    still = open_sequence("synthetic:standstill", resize_to="320x240", limit=8)
    clips = Clips([room], per_sequence=1)
    clips.sequences[0] = still
    clips.chosen[0] = (0, 0, 1)
    with pytest.raises(ClipError, match="no clip can be used"):
        learn(clips, room.camera, supervised=True)
    assert "1 of 1 clips are left out: no map was initialized in 8 frames" in capsys.readouterr().out


class Ramp(Sequence):
    """An image whose gray value grows from left to right."""

    def __init__(self) -> None:
        camera = Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
        super().__init__("ramp", "a test", camera, torch.zeros(1, dtype=torch.float64))

    def image(self, index: int) -> Tensor:
        return (torch.arange(640.0) / 639).expand(1, 1, 480, 640).contiguous()

    def image_name(self, index: int) -> str:
        return "ramp"


def test_a_bent_lens_sees_along_its_rays() -> None:
    lens, ramp = bent_lens(0), Ramp()
    given = Camera.pinhole(FOCAL, FOCAL, 159.5, 119.5, size=SIZE)
    bent = Bent(ramp, lens, given)
    assert bent.camera is given
    x, y = 37, 201
    ray = lens.camera().unproject(lens.straightened(torch.tensor([[[float(x), float(y)]]]).double())[0])
    expected = ramp.camera.project(ray)[0][0, 0] / 639
    assert float(bent.image(0)[0, 0, y, x]) == pytest.approx(float(expected), abs=2e-5)
    assert bent.image(0) is bent.image(0)
    wide = LearnedCamera(given.with_params(given.params * torch.tensor([0.7, 0.7, 1, 1]).double()))
    with pytest.raises(ValueError, match="outside of the images"):
        Bent(ramp, wide, given)


def test_rays_are_compared_up_to_a_rotation() -> None:
    lens = bent_lens(1)
    assert max(ray_errors(lens, lens)) < 1e-6
    # A shift of the center is a turn of the camera, to first order.
    straight, shifted, longer = (
        LearnedCamera(Camera.pinhole(focal, focal, cx, 119.5, size=SIZE))
        for focal, cx in ((FOCAL, 159.5), (FOCAL, 160.5), (1.01 * FOCAL, 159.5))
    )
    assert ray_errors(shifted, straight)[1] < 0.4
    rms, most = ray_errors(longer, straight)
    assert 0.5 < rms < most < 2.0
