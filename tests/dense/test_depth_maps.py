"""Depth maps in a file: what is written is read again, in blocks and joined, and what is damaged is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from torchslam.dense import DepthMaps
from torchslam.dense.depth_maps import join, read_about, read_shape
from torchslam.errors import ResultsError
from torchslam.geometry import Camera

WIDTH, HEIGHT = 6, 4


def some_maps(count: int, first: int = 0) -> DepthMaps:
    generator = torch.Generator().manual_seed(first)
    depth = 1 + torch.rand(count, HEIGHT, WIDTH, generator=generator)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, HEIGHT, WIDTH, generator=generator), dim=1)
    confidence = torch.rand(count, HEIGHT, WIDTH, generator=generator)
    for rows in (depth, confidence):
        rows[:, 0] = 0
    normal[:, :, 0] = 0
    return DepthMaps(
        frame_index=first + 2 * torch.arange(count),
        depth=depth,
        normal=normal,
        confidence=confidence,
        T_cw=torch.eye(4, dtype=torch.float64).repeat(count, 1, 1),
        camera=Camera.pinhole(5.0, 5.0, 2.5, 1.5, (WIDTH, HEIGHT)),
    )


def assert_same(found: DepthMaps, expected: DepthMaps) -> None:
    for name in ("frame_index", "depth", "normal", "confidence", "T_cw"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert torch.equal(found.camera.params, expected.camera.params)
    assert found.camera.size == expected.camera.size


@pytest.mark.parametrize("count", [0, 1, 5])
def test_what_is_saved_is_loaded(count: int, tmp_path: Path) -> None:
    maps = some_maps(count)
    maps.save(tmp_path / "a", {"every": 3})
    assert_same(DepthMaps.load(tmp_path / "a"), maps)
    assert read_about(tmp_path / "a") == {"every": 3}
    assert read_shape(tmp_path / "a") == (count, HEIGHT, WIDTH)


def test_another_program_reads_the_tensors(tmp_path: Path) -> None:
    maps = some_maps(2)
    maps.save(tmp_path / "a")
    tensors = load_file(tmp_path / "a")
    assert torch.equal(tensors["depth"], maps.depth)
    assert torch.equal(tensors["T_cw"], maps.T_cw)


def test_joined_parts_have_the_bytes_of_a_whole(tmp_path: Path) -> None:
    whole = some_maps(5)
    rows = [slice(0, 1), slice(1, 4), slice(4, 5)]
    parts = [tmp_path / str(number) for number in range(len(rows))]
    for path, some in zip(parts, rows, strict=True):
        fields = ("frame_index", "depth", "normal", "confidence", "T_cw")
        replace(whole, **{name: getattr(whole, name)[some] for name in fields}).save(path)
    join(tmp_path / "joined", parts)
    whole.save(tmp_path / "whole")
    assert (tmp_path / "joined").read_bytes() == (tmp_path / "whole").read_bytes()
    blocks = list(DepthMaps.blocks(tmp_path / "joined", 2))
    assert [len(block) for block in blocks] == [2, 2, 1]
    assert torch.equal(torch.cat([block.depth for block in blocks]), whole.depth)


def test_parts_of_another_camera_are_not_joined(tmp_path: Path) -> None:
    maps = some_maps(1)
    maps.save(tmp_path / "a")
    replace(maps, camera=maps.camera.with_params(2 * maps.camera.params)).save(tmp_path / "b")
    with pytest.raises(ResultsError, match="b: depth maps of another camera"):
        join(tmp_path / "joined", [tmp_path / "a", tmp_path / "b"])
    assert not (tmp_path / "joined").exists()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("depth", torch.nan, "depth: not finite"),
        ("depth", -1.0, "depth: negative"),
        ("normal", 0.5, "normal: neither of unit length nor 0"),
        ("confidence", 1.5, "confidence: not between 0 and 1"),
        ("frame_index", 9, "frame_index: not ascending"),
        ("T_cw", torch.inf, "T_cw: not finite"),
        ("camera.params", -1.0, "focal lengths above zero"),
    ],
)
def test_wrong_numbers_are_refused_with_the_name_of_the_file(
    name: str, value: float, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "depths.safetensors"
    some_maps(3).save(path)
    with safe_open(str(path), framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors[name].view(-1)[0] = value
    save_file(tensors, path, metadata)
    with pytest.raises(ResultsError, match=rf"depths\.safetensors: not whole depth maps: .*{message}"):
        DepthMaps.load(path)


@pytest.mark.parametrize("name", ["depth", "normal", "T_cw"])
def test_a_missing_or_short_tensor_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "depths.safetensors"
    some_maps(3).save(path)
    with safe_open(str(path), framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    short = tensors | {name: tensors[name][:2].clone()}
    save_file(short, path, metadata)
    with pytest.raises(ResultsError, match=f"{name}: .* expected"):
        DepthMaps.load(path)
    save_file({key: rows for key, rows in tensors.items() if key != name}, path, metadata)
    with pytest.raises(ResultsError, match=f"missing or unknown tensors: {name}"):
        DepthMaps.load(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="no depth maps"):
        DepthMaps.load(tmp_path / "none")
    (tmp_path / "text").write_text("text")
    with pytest.raises(ResultsError, match="text: not whole depth maps"):
        DepthMaps.load(tmp_path / "text")
    save_file({"a": torch.zeros(1)}, tmp_path / "other")
    with pytest.raises(ResultsError, match="not depth maps of torchslam"):
        DepthMaps.load(tmp_path / "other")


@pytest.mark.parametrize("length", [0, 7, 100, 1000])
def test_a_file_that_was_cut_is_refused(length: int, tmp_path: Path) -> None:
    some_maps(3).save(tmp_path / "a")
    (tmp_path / "cut").write_bytes((tmp_path / "a").read_bytes()[:length])
    with pytest.raises(ResultsError, match="cut: "):
        DepthMaps.load(tmp_path / "cut")
