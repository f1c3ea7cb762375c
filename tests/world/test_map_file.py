from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.world.map import Map
from torchslam.world.map_file import read_map, write_map


def test_map_and_camera_come_back_as_they_were(tmp_path: Path, slam_map: Map, camera: Camera) -> None:
    write_map(tmp_path / "map.safetensors", slam_map, camera)
    loaded, loaded_camera = read_map(tmp_path / "map.safetensors")
    for table, loaded_table in ((slam_map.points, loaded.points), (slam_map.keyframes, loaded.keyframes)):
        assert table.columns().keys() == loaded_table.columns().keys()
        for name, column in table.columns().items():
            assert column.dtype == loaded_table[name].dtype
            assert torch.equal(column, loaded_table[name]), name
    assert loaded_camera.model == camera.model
    assert loaded_camera.size == camera.size
    assert torch.equal(loaded_camera.params, camera.params)


def test_a_loaded_map_can_grow(tmp_path: Path, slam_map: Map, camera: Camera) -> None:
    write_map(tmp_path / "map.safetensors", slam_map, camera)
    loaded, _ = read_map(tmp_path / "map.safetensors")
    before = loaded.num_points
    loaded.add_points(
        torch.zeros(2, 3, dtype=torch.float64), torch.zeros(2, 32, dtype=torch.uint8), keyframe=0
    )
    assert loaded.num_points == before + 2


def test_same_map_gives_same_bytes(tmp_path: Path, slam_map: Map, camera: Camera) -> None:
    for name in ("one", "two"):
        write_map(tmp_path / name, slam_map, camera)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_an_empty_map_is_a_file_too(tmp_path: Path, camera: Camera) -> None:
    write_map(tmp_path / "map.safetensors", Map(), camera)
    loaded, _ = read_map(tmp_path / "map.safetensors")
    assert loaded.num_keyframes == 0
    assert loaded.num_points == 0


def test_missing_damaged_and_foreign_files_are_named(tmp_path: Path, slam_map: Map, camera: Camera) -> None:
    path = tmp_path / "map.safetensors"
    with pytest.raises(ResultsError, match=r"map\.safetensors: no map file"):
        read_map(path)
    path.write_bytes(b"not a map")
    with pytest.raises(ResultsError, match=r"map\.safetensors: not a readable"):
        read_map(path)
    write_map(path, slam_map, camera)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ResultsError, match="not a readable"):
        read_map(path)
    save_file({"weights": torch.zeros(3)}, str(path))
    with pytest.raises(ResultsError, match="not a torchslam map"):
        read_map(path)
    save_file({"weights": torch.zeros(3)}, str(path), metadata={"torchslam": '{"format": 99}'})
    with pytest.raises(ResultsError, match="map format 99"):
        read_map(path)
    save_file({"weights": torch.zeros(3)}, str(path), metadata={"torchslam": '{"format": 1}'})
    with pytest.raises(ResultsError, match="map format 1, this version reads format 2"):
        read_map(path)
