"""Cameras as torch's own tools take them: a pytree of their parameters, for `torch.func`; and `default_collate`.

Model and size are structure: they must agree where trees are compared, and in a batch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from torch.utils import _pytree
from torch.utils.data._utils.collate import default_collate_fn_map

from torchslam.geometry.camera import Camera


def _flatten(camera: Camera) -> tuple[list[Any], tuple[str, tuple[int, int]]]:
    return [camera.params], (camera.model, camera.size)


def _flatten_with_keys(camera: Camera) -> tuple[list[tuple[_pytree.KeyEntry, Any]], Any]:
    leaves, structure = _flatten(camera)
    return [(_pytree.GetAttrKey("params"), leaf) for leaf in leaves], structure


def _unflatten(leaves: Iterable[Any], structure: tuple[str, tuple[int, int]]) -> Camera:
    """Unchecked: trees hold other things than tensors, too, such as dimensions."""
    camera = object.__new__(Camera)
    model, size = structure
    (params,) = leaves
    camera.__dict__.update(model=model, params=params, size=size)
    return camera


def _collate(cameras: Sequence[Camera], *, collate_fn_map: object = None) -> Camera:
    return Camera.stack(cameras)


def register() -> None:
    """Tell torch. Once, when the package is imported."""
    _pytree.register_pytree_node(Camera, _flatten, _unflatten, flatten_with_keys_fn=_flatten_with_keys)
    default_collate_fn_map[Camera] = _collate
