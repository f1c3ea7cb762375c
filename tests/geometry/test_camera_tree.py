"""Cameras in `torch.func`, in `default_collate`, stacked and taken apart."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap
from torch.utils._pytree import tree_flatten_with_path, tree_map
from torch.utils.data import DataLoader, default_collate

from torchslam.geometry import Camera

SIZE = (640, 480)


def pinhole(focal: float) -> Camera:
    return Camera.pinhole(focal, focal, 320.0, 240.0, size=SIZE)


def bent(k1: float) -> Camera:
    return Camera.radial_tangential(500.0, 510.0, 320.0, 240.0, k1, 0.02, 1e-3, -2e-3, size=SIZE)


POINTS = torch.tensor([[0.3, -0.2, 2.0], [-0.4, 0.1, 1.5]], dtype=torch.float64)


def test_collate_and_a_loader_give_a_batch_of_cameras():
    samples = [{"camera": pinhole(500.0 + row), "frame": row} for row in range(4)]
    batch = default_collate(samples)["camera"]
    assert isinstance(batch, Camera)
    assert batch.params.shape == (4, 4)
    assert batch.size == SIZE
    assert torch.equal(batch.fx, torch.tensor([500.0, 501, 502, 503], dtype=torch.float64))
    (loaded,) = DataLoader(samples, batch_size=4, num_workers=1)
    assert torch.equal(loaded["camera"].params, batch.params)


@pytest.mark.parametrize("other", [bent(0.1), Camera.pinhole(500.0, 500.0, 320.0, 240.0, size=(320, 240))])
def test_a_batch_has_one_model_and_one_size(other):
    with pytest.raises(ValueError, match="one model and one size"):
        default_collate([pinhole(500.0), other])


def test_stacked_and_chosen(dtype, device):
    cameras = [bent(k1).to(device, dtype) for k1 in (-0.3, -0.1, 0.05)]
    stacked = Camera.stack(cameras)
    assert stacked.params.dtype == dtype
    assert stacked.params.device.type == device.type
    for row, camera in enumerate(cameras):
        assert torch.equal(stacked[row].params, camera.params)
        torch.testing.assert_close(stacked[row].limit, camera.limit)
    rows = torch.tensor([2, 0], device=device)
    assert torch.equal(stacked[rows].params, stacked.params[rows])
    assert torch.equal(stacked[rows].limit, stacked.limit[rows])
    assert torch.equal(stacked[1:].limit, stacked.limit[1:])
    with pytest.raises(IndexError, match="one camera"):
        cameras[0][0]


def test_a_pytree_of_its_parameters():
    camera = pinhole(500.0)
    doubled = tree_map(lambda tensor: 2 * tensor, camera)
    assert isinstance(doubled, Camera)
    assert torch.equal(doubled.params, 2 * camera.params)
    assert (doubled.model, doubled.size) == (camera.model, camera.size)
    ((path, leaf),), _ = tree_flatten_with_path(camera)
    assert str(path[0]) == ".params"
    assert leaf is camera.params


@pytest.mark.parametrize("make", [pinhole, bent])
def test_torch_func_takes_cameras(make):
    """Mapped over, and differentiated with respect to."""
    cameras = [make(value) for value in ((500.0, 520.0) if make is pinhole else (-0.2, 0.05))]

    def pixels(camera: Camera) -> Tensor:
        return camera.project(POINTS)[0]

    together = vmap(pixels)(Camera.stack(cameras))
    torch.testing.assert_close(together, torch.stack([pixels(camera) for camera in cameras]))
    gradient = grad(lambda camera: pixels(camera).sum())(cameras[0])
    assert isinstance(gradient, Camera)
    params = cameras[0].params.clone().requires_grad_()
    pixels(cameras[0].with_params(params)).sum().backward()
    torch.testing.assert_close(gradient.params, params.grad)
    assert jacrev(pixels)(cameras[0]).params.shape == (2, 2, cameras[0].params.shape[-1])
