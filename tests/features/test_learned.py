from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.features.test_orb import scene
from torchslam.errors import ConfigError
from torchslam.features import ALIKED, XFeat, extractor, match
from torchslam.features.weights import read_weights

WEIGHTS_DIR = Path(os.environ.get("TORCHSLAM_WEIGHTS", Path(__file__).parents[3] / "shared" / "weights"))
NETWORKS = pytest.mark.parametrize(
    ("name", "file", "width"), [("xfeat", "xfeat.safetensors", 64), ("aliked", "aliked-t16.safetensors", 64)]
)


def weights(file: str) -> Path:
    path = WEIGHTS_DIR / file
    if not path.is_file():
        pytest.skip(f"no weights at {path}; set TORCHSLAM_WEIGHTS to the folder that has them")
    return path


@NETWORKS
def test_fields_have_the_documented_shapes(name: str, file: str, width: int) -> None:
    network = extractor(name, 100, weights(file))
    with torch.no_grad():
        features = network(torch.cat([scene(150, 200), torch.zeros(1, 1, 150, 200)]))
    assert features.keypoints.shape == (2, 100, 2)
    assert features.descriptors.shape == (2, 100, width)
    found = features.mask[0]
    assert found.sum() > 50
    assert (features.keypoints[0][found] >= -0.5).all()
    assert (features.keypoints[0][found] <= torch.tensor([199.5, 149.5])).all()
    torch.testing.assert_close(features.descriptors[0][found].norm(dim=-1), torch.ones(int(found.sum())))
    assert (features.scales == 2).all()
    assert not features.angles.any()
    assert all(values.isfinite().all() for values in vars(features).values())


@NETWORKS
def test_shifted_images_match(name: str, file: str, width: int) -> None:
    network = extractor(name, 200, weights(file))
    image = scene(192, 256, 1)
    with torch.no_grad():
        first, second = network(image[..., :224]), network(image[..., 32:])
    matches = match(first, second, ratio=None, max_distance=0.3)
    rows = matches.mask[0]
    moved = second.keypoints[0][matches.indices_2[0][rows]] - first.keypoints[0][matches.indices_1[0][rows]]
    assert len(moved) > 50
    torch.testing.assert_close(moved.median(0).values, torch.tensor([-32.0, 0.0]), atol=0.1, rtol=0)


@NETWORKS
def test_gradients_reach_the_weights(name: str, file: str, width: int) -> None:
    network = extractor(name, 20, weights(file))
    features = network(scene(96, 128, 2))
    (features.keypoints.sum() + features.descriptors.square().sum()).backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert gradients
    assert all(g.isfinite().all() for g in gradients)
    assert any(g.any() for g in gradients)


def test_the_weights_of_a_matcher_in_the_same_file_are_left_out(tmp_path: Path) -> None:
    path, both = weights("aliked-t16.safetensors"), tmp_path / "both.safetensors"
    parts = {f"extractor.{name}": tensor for name, tensor in read_weights(path).items()}
    save_file(parts | {"matcher.input_proj.weight": torch.zeros(2, 2)}, both)
    with torch.no_grad():
        one, other = (extractor("aliked", 50, file)(scene(96, 128)) for file in (path, both))
    assert torch.equal(one.descriptors, other.descriptors)


@pytest.mark.parametrize("kind", [XFeat, ALIKED])
def test_unusable_weights_are_rejected_by_name(kind: type, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="absent"):
        kind(tmp_path / "absent.safetensors")
    (tmp_path / "broken.safetensors").write_bytes(b"no tensors here")
    with pytest.raises(ConfigError, match="broken"):
        kind(tmp_path / "broken.safetensors")
    save_file({"block1.conv1.weight": torch.zeros(2, 2)}, tmp_path / "other.safetensors")
    with pytest.raises(ConfigError, match="other"):
        kind(tmp_path / "other.safetensors")
    names = ("block1.conv1.weight", "desc_head.agg_weights", "net.norm.weight")
    save_file({name: torch.tensor(1.0) for name in names}, tmp_path / "numbers.safetensors")
    with pytest.raises(ConfigError, match="numbers"):
        kind(tmp_path / "numbers.safetensors")


@NETWORKS
def test_keypoints_read_again_are_the_same_and_stay_in_their_rows(name: str, file: str, width: int) -> None:
    """After a step of a training a detection has other keypoints in most rows; read at fixed places none moves far."""
    network, image = extractor(name, 150, weights(file)), scene(150, 230, 1)
    with torch.no_grad():
        found = network(image)
        same = network.read(image, found.keypoints, found.mask)
        for column in ("keypoints", "scores", "descriptors", "mask"):
            torch.testing.assert_close(getattr(same, column), getattr(found, column), rtol=1e-5, atol=1e-5)
    optimizer = torch.optim.Adam(network.parameters(), 1e-4)
    same = network.read(image, found.keypoints, found.mask)
    (same.keypoints.square().mean() + same.scores.mean()).backward()
    optimizer.step()
    with torch.no_grad():
        detected, again = network(image), network.read(image, found.keypoints, found.mask)
    rows = found.mask[0]
    detected_moved, moved = (
        (other.keypoints - found.keypoints)[0, rows].norm(dim=-1) for other in (detected, again)
    )
    assert (detected_moved > 8).float().mean() > 0.1
    assert 0 < moved.max() < 4
    assert torch.equal(again.mask, found.mask)


def test_autocast_does_not_move_the_keypoints_of_xfeat() -> None:
    network, image = extractor("xfeat", 150, weights("xfeat.safetensors")), scene(250, 380, 1)
    with torch.no_grad():
        exact = network(image)
        with torch.autocast("cpu", torch.bfloat16):
            found = network.read(image, exact.keypoints, exact.mask)
            detected = network(image)
    assert torch.equal(found.keypoints, exact.keypoints)
    assert detected.keypoints.dtype == torch.float32
    distances = torch.cdist(detected.keypoints[0], exact.keypoints[0])
    assert (
        distances.amin(1) == 0
    ).float().mean() > 0.9  # ranks are by the reliability, which the backbone rounds
