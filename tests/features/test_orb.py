from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from torchslam.errors import ConfigError
from torchslam.features import ORB, SIFT, OpenCVORB, extractor, match
from torchslam.features import orb as orb_module
from torchslam.features.orb import blur, describe, pattern
from torchslam.types import Features

BINARY = pytest.mark.parametrize("kind", [ORB, OpenCVORB])
EXTRACTORS = pytest.mark.parametrize("kind", [ORB, OpenCVORB, SIFT])


def scene(height: int, width: int, seed: int = 0) -> Tensor:
    """(1, 1, H, W): overlapping rectangles and discs of random gray, slightly blurred."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 128, dtype=np.uint8)
    for _ in range(height * width // 400):
        x, y = (int(v) for v in rng.integers(0, (width, height)))
        size, gray = int(rng.integers(4, 24)), int(rng.integers(0, 256))
        if rng.random() < 0.7:
            cv2.rectangle(image, (x, y), (x + size, y + size), gray, -1)
        else:
            cv2.circle(image, (x, y), size // 2, gray, -1)
    return to_tensor(cv2.GaussianBlur(image, (0, 0), 0.8))


def to_tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image).float()[None, None] / 255


def distances(first: Tensor, second: Tensor) -> Tensor:
    """(N, 2), (M, 2) -> (N, M), without the rounding of torch.cdist's matrix product."""
    return (first[:, None] - second).norm(dim=-1)


def same(first: Features, second: Features) -> bool:
    columns = ((getattr(first, f.name), getattr(second, f.name)) for f in fields(Features))
    return all(one is other if one is None else torch.equal(one, other) for one, other in columns)


def element(features: Features, index: int) -> Features:
    """One image of a batch, as a batch of one."""
    columns = {f.name: getattr(features, f.name) for f in fields(Features)}
    return Features(**{name: None if x is None else x[index : index + 1] for name, x in columns.items()})


@BINARY
def test_fields_have_the_documented_shapes(kind: type[nn.Module], dtype: torch.dtype) -> None:
    features = kind(num_keypoints=150)(scene(200, 260).to(dtype).expand(2, 1, -1, -1))
    assert features.keypoints.shape == (2, 150, 2)
    assert features.descriptors.shape == (2, 150, 32)
    assert features.descriptors.dtype == torch.uint8
    assert features.mask.dtype == torch.bool
    for values in (features.scores, features.scales, features.angles):
        assert values.shape == (2, 150)
        assert values.dtype == dtype
        assert values.isfinite().all()
    assert features.keypoints.dtype == dtype
    found = features.mask
    assert found.sum() > 200
    assert (features.keypoints[found] >= 0).all()
    assert (features.keypoints[found] <= torch.tensor([259, 199])).all()
    assert features.angles.abs().max() <= math.pi
    level = features.scales.double().log() / math.log(1.2)
    torch.testing.assert_close(level, level.round(), atol=1e-4, rtol=0)
    assert (features.scores.diff(dim=1) <= 0).all()


@EXTRACTORS
def test_the_same_image_gives_the_same_bytes(kind: type[nn.Module]) -> None:
    image = scene(160, 210, 1)
    assert same(kind(num_keypoints=100)(image), kind(num_keypoints=100)(image))


@EXTRACTORS
def test_a_batch_equals_a_loop(kind: type[nn.Module]) -> None:
    images = torch.cat([scene(150, 170, seed) for seed in range(3)] + [torch.zeros(1, 1, 150, 170)])
    extract = kind(num_keypoints=120)
    batch = extract(images)
    for row in range(4):
        assert same(batch[row : row + 1], extract(images[row : row + 1]))
    assert not batch.mask[3].any()


@EXTRACTORS
@pytest.mark.parametrize("size", [(1, 1), (5, 40), (30, 30), (41, 39), (77, 131), (39, 300)])
def test_any_image_size_is_accepted(kind: type[nn.Module], size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    features = kind(num_keypoints=50)(torch.rand(2, 1, *size, generator=generator))
    assert features.mask.shape == (2, 50)
    assert features.keypoints.isfinite().all()


@EXTRACTORS
def test_noise_and_blank_images(kind: type[nn.Module]) -> None:
    extract = kind(num_keypoints=200)
    noise = torch.rand(1, 1, 200, 200, generator=torch.Generator().manual_seed(0))
    assert extract(noise).mask.sum() > 120
    assert not extract(torch.full((1, 1, 200, 200), 0.5)).mask.any()


@EXTRACTORS
@pytest.mark.parametrize(
    "images", [torch.rand(1, 3, 64, 64), torch.rand(64, 64), torch.zeros(1, 1, 64, 64).byte()]
)
@pytest.mark.usefixtures("without_shape_checks")
def test_unsupported_images_are_refused(kind: type[nn.Module], images: Tensor) -> None:
    with pytest.raises(ValueError, match="images must be"):
        kind()(images)


@pytest.mark.parametrize(
    ("option", "value"),
    {
        "num_keypoints": 0,
        "num_levels": 0,
        "scale_factor": 1.0,
        "threshold": 5,
        "low_threshold": 0,
        "ranking": "best",
    }.items(),
)
def test_invalid_options_are_refused(option: str, value: float | str) -> None:
    with pytest.raises(ValueError, match=r"ORB needs|ranking"):
        ORB(**{option: value})


@BINARY
@pytest.mark.parametrize("scale", [1.0, 1.44, 2.0])
def test_corners_of_a_square_are_detected_at_their_positions(kind: type[nn.Module], scale: float) -> None:
    """The square's corners, drawn with exact coverage of pixels, at every level that sees them."""
    edge = np.array([80.25, 160.75])  # in the image's pixels, so that pixels on the edge are partly covered
    cover = [
        np.clip(np.arange(240) + 0.5 - edge[0], 0, 1) - np.clip(np.arange(240) + 0.5 - edge[1], 0, 1)
    ] * 2
    image = torch.from_numpy(60 + 150 * cover[0][:, None] * cover[1]).float()[None, None] / 255
    features = kind(num_keypoints=100)(image)
    found = features.keypoints[0][features.mask[0] & (features.scales[0] - scale).abs().lt(0.1 * scale)]
    corners = torch.tensor([[x, y] for x in edge for y in edge], dtype=torch.float32)
    assert len(found) >= 4
    # FAST-9 fires inside the corner, a pixel of the level or two from its tip, alike at all four.
    apart = distances(found, corners)
    assert apart.amin(0).max() < 2.5 * scale
    center = torch.stack([found[apart[:, k].argmin()] for k in range(4)]).mean(0)
    assert (center - edge.mean()).abs().max() < (0.5 if kind is ORB else scale)


def test_subpixel_positions_follow_the_image() -> None:
    """Moving the image by parts of a pixel moves the keypoints as much."""
    big = scene(520, 520, 2)[0, 0].numpy() * 255
    big = cv2.GaussianBlur(big, (0, 0), 4)

    def shifted(by: float) -> Tensor:
        warp = np.array([[0.25, 0, by], [0, 0.25, 0]])
        return to_tensor(cv2.warpAffine(big, warp, (130, 130), flags=cv2.INTER_AREA).round().astype(np.uint8))

    extract = ORB(num_keypoints=100, num_levels=1, threshold=10)
    first, second = extract(shifted(0.0)), extract(shifted(0.5))
    matches = match(first, second)
    rows = matches.mask[0]
    i, j = matches.indices_1[0][rows], matches.indices_2[0][rows]
    moved = second.keypoints[0][j] - first.keypoints[0][i]
    assert len(moved) > 20
    torch.testing.assert_close(moved.median(0).values, torch.tensor([0.5, 0.0]), atol=0.1, rtol=0)


@EXTRACTORS
@pytest.mark.parametrize("degrees", [30.0, -75.0, 180.0])
def test_turning_the_image_turns_the_keypoints(kind: type[nn.Module], degrees: float) -> None:
    image = (scene(300, 300, 3)[0, 0].numpy() * 255).astype(np.uint8)
    turn = math.radians(degrees)
    # From x towards y, about the center.
    warp = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    warp = np.c_[warp, 149.5 - warp @ [149.5, 149.5]]
    turned = cv2.warpAffine(image, warp, (300, 300), borderMode=cv2.BORDER_REFLECT)
    extract = kind(num_keypoints=400)
    first, second = extract(to_tensor(image)), extract(to_tensor(turned))
    matches = match(first, second)
    rows = matches.mask[0]
    i, j = matches.indices_1[0][rows], matches.indices_2[0][rows]
    expected = torch.from_numpy(first.keypoints[0][i].numpy() @ warp[:, :2].T + warp[:, 2])
    right = (second.keypoints[0][j] - expected).norm(dim=-1) < 3
    assert right.sum() > 80
    assert right.double().mean() > 0.8
    change = second.angles[0][j][right] - first.angles[0][i][right] - turn
    change = torch.atan2(change.sin(), change.cos())
    assert change.abs().median() < math.radians(3)


def test_a_dim_half_has_keypoints_too() -> None:
    image = scene(240, 320, 4)
    image[..., 160:] = 0.5 + (image[..., 160:] - 0.5) * 0.12
    features = ORB(num_keypoints=300)(image)
    right = features.keypoints[0][features.mask[0]][:, 0] > 165
    assert 10 <= int(right.sum()) < 150


@pytest.mark.parametrize("ranking", ["fast", "harris"])
def test_an_image_of_weak_texture_has_the_full_number_of_keypoints(ranking: str) -> None:
    bright = scene(240, 320)
    dim = (bright - 0.5) * 0.12 + 0.5  # no corner exceeds the threshold of 20
    orb = ORB(num_keypoints=300, ranking=ranking)
    features = orb(torch.cat([bright, dim]))
    assert features.mask.sum(1).tolist() == [300, 300]
    assert same(element(features, 1), orb(dim))  # whatever else the batch holds
    assert same(element(features, 0), orb(bright))
    near = distances(features.keypoints[0], features.keypoints[1]).amin(0)
    assert float((near < 1).double().mean()) > 0.7


def test_weak_corners_are_used_where_there_are_hardly_others() -> None:
    bright = scene(240, 320)
    faint = (bright - 0.5) * 0.06 + 0.5  # fifteen gray values from black to white
    orb = ORB(num_keypoints=300)
    features = orb(torch.cat([faint, bright]))
    assert features.mask.sum(1).tolist() == [300, 300]
    assert same(element(features, 0), orb(faint))
    assert same(element(features, 1), orb(bright))
    wanted = torch.zeros_like(faint, dtype=torch.bool)
    wanted[..., :160] = True
    left = orb(faint, wanted)
    assert int(left.mask.sum()) > 100
    assert float(left.keypoints[left.mask][:, 0].max()) < 161
    nothing = (bright - 0.5) * 0.01 + 0.5
    assert not orb(nothing).mask.any()
    fainter = (bright - 0.5) * 0.05 + 0.5
    assert int(ORB(num_keypoints=300, low_threshold=3)(fainter).mask.sum()) == 300
    assert int(orb(fainter).mask.sum()) < 150


def test_weak_texture_is_less_than_half_of_the_keypoints(monkeypatch: pytest.MonkeyPatch) -> None:
    image, decided = scene(400, 500), set()
    image[..., 60:] = (image[..., 60:] - 0.5) * 0.12 + 0.5
    for count in (300, 700, 1100, 1300):
        monkeypatch.setattr(orb_module, "WEAK_TEXTURE_RATIO", 0.0)
        strict = ORB(num_keypoints=count)(image)
        monkeypatch.setattr(orb_module, "WEAK_TEXTURE_RATIO", 0.5)
        features, offered = ORB(num_keypoints=count)(image), int(strict.mask.sum())
        is_weak = offered < count / 2
        assert same(features, strict) is not is_weak
        assert (int(features.mask.sum()) > 1.3 * offered) is is_weak
        decided.add(is_weak)
    assert decided == {True, False}


def test_harris_ranking_finds_other_corners_in_the_same_places() -> None:
    image = scene(200, 260, 5)
    harris, fast = ORB(num_keypoints=100, ranking="harris")(image), ORB(num_keypoints=100)(image)
    assert harris.mask.all()
    common = (distances(harris.keypoints[0], fast.keypoints[0]) < 0.01).any(1)
    assert 20 < int(common.sum()) < 100


def test_the_batch_leaves_no_gradient_by_default() -> None:
    image = scene(120, 120).requires_grad_()
    assert not ORB(num_keypoints=50)(image).keypoints.requires_grad


@pytest.mark.parametrize("ranking", ["fast", "harris"])
def test_keypoints_and_scores_pass_gradcheck(ranking: str) -> None:
    image = scene(80, 90, 6).double()
    extract = ORB(num_keypoints=8, num_levels=2, ranking=ranking, differentiable=True)
    generator = torch.Generator().manual_seed(0)
    image = image + 1e-3 * torch.rand(image.shape, generator=generator, dtype=torch.float64)
    direction = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def along(step: Tensor) -> tuple[Tensor, Tensor]:
        features = extract(image + step * direction)
        return features.keypoints, features.scores / 1e3

    start = torch.zeros((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(along, (start,), eps=1e-7)


def test_differentiable_keypoints_are_near_the_plain_ones() -> None:
    image = scene(160, 200, 7)
    plain, soft = ORB(num_keypoints=100)(image), ORB(num_keypoints=100, differentiable=True)(image)
    assert torch.equal(plain.descriptors.sort(1).values, soft.descriptors.sort(1).values)
    apart = distances(plain.keypoints[0], soft.keypoints[0]).amin(1)
    assert apart.median() < 0.3


def test_gradients_of_a_blank_image_are_finite() -> None:
    image = torch.full((1, 1, 100, 100), 0.5, requires_grad=True)
    features = ORB(num_keypoints=20, differentiable=True)(image)
    (features.keypoints.sum() + features.scores.sum()).backward()
    assert image.grad is not None
    assert not image.grad.any()


def test_orb_runs_on_the_device(device: torch.device) -> None:
    image = scene(160, 200, 9)
    expected, found = ORB(num_keypoints=100)(image), ORB(num_keypoints=100).to(device)(image.to(device))
    assert found.keypoints.device.type == device.type
    apart = distances(expected.keypoints[0], found.keypoints[0].cpu()).amin(1)
    assert (apart < 0.01).double().mean() > 0.95


def test_the_opencv_extractor_equals_opencv() -> None:
    image = scene(200, 260, 10)
    features = OpenCVORB(num_keypoints=100)(image)
    array = (image[0, 0] * 255).round().to(torch.uint8).numpy()
    found, described = cv2.ORB.create(nfeatures=100).detectAndCompute(array, None)
    best = max(range(len(found)), key=lambda k: found[k].response)
    assert features.scores[0, 0] == pytest.approx(found[best].response)
    assert features.descriptors[0, 0].tolist() == described[best].tolist()
    scale = 1.2 ** found[best].octave
    expected = np.array(found[best].pt) + (scale - 1) / 2
    np.testing.assert_allclose(features.keypoints[0, 0].numpy(), expected, atol=1e-4)


def test_pattern_is_256_different_tests_within_its_disk() -> None:
    tests = pattern().numpy()
    assert tests.shape == (256, 4)
    assert len({frozenset([(a, b), (c, d)]) for a, b, c, d in pattern().tolist()}) == 256
    assert (np.linalg.norm(tests.reshape(-1, 2), axis=1) <= 14.5).all()


def test_descriptor_compares_the_pattern_on_the_blurred_image() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (60, 70), dtype=np.uint8)
    box = np.convolve(np.ones(4), np.ones(4))
    kernel = np.outer(box, box) / 256
    smooth = cv2.filter2D(image.astype(np.float64), -1, kernel)
    x, y = 33, 28
    described = describe(
        blur(torch.from_numpy(image).flatten(), 70), torch.tensor([y * 70 + x]), torch.zeros(1), 70
    )[0].numpy()
    bits = [smooth[y + b, x + a] < smooth[y + d, x + c] for a, b, c, d in pattern().tolist()]
    assert np.unpackbits(described, bitorder="little").astype(bool).tolist() == bits


@pytest.mark.parametrize(("name", "kind"), [("orb", ORB), ("opencv-orb", OpenCVORB), ("sift", SIFT)])
def test_an_extractor_is_created_by_name(name: str, kind: Callable) -> None:
    module = extractor(name, 77)
    assert isinstance(module, kind)
    assert module.num_keypoints == 77


def test_an_unknown_extractor_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"opencv-orb.*xfeat"):
        extractor("surf")


@pytest.mark.data
@pytest.mark.parametrize("sequence", ["redkitchen", "kitti07", "shelf_bin"])
def test_real_images_give_all_keypoints_and_many_matches(sequence: str, data_dir) -> None:
    paths = sorted((data_dir / sequence / "rgb").iterdir())[:2]
    images = [to_tensor(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    first, second = (ORB(num_keypoints=1000)(image) for image in images)
    assert first.mask.all()
    assert second.mask.all()
    assert int(match(first, second).mask.sum()) > 300
    assert int(match(first, replace(second, mask=~second.mask)).mask.sum()) == 0
