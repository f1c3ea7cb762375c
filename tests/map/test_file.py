from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas, read_map, write_atlas
from torchslam.map.map import Map
from torchslam.types import FrameFeatures, PoseEstimate
from torchslam.utils.files import PART, write_whole


@pytest.fixture
def submap(slam_map: Map) -> Submap:
    """The small run's map, with a few frames between its keyframes, in two sessions."""
    made = Submap.empty(0, slam_map.T_cw)
    made.map = slam_map
    for index, session in ((1, 0), (2, 0), (1, 1)):
        view = slam_map.frame_features(0)
        view = FrameFeatures(
            **{**view.__dict__, "index": index, "timestamp": 100.0 + index, "session": session}
        )
        ids = torch.arange(4 + index)
        seen = PoseEstimate(slam_map.T_cw[0], ids, ids, 20, torch.eye(6, dtype=torch.float64), 1.0)
        made.posed_frames.add(view, seen, torch.eye(4, dtype=torch.float64), 0)
    return made


@pytest.fixture
def submaps(submap: Submap) -> list[Submap]:
    """Number 0 with something in it, number 2 without."""
    return [submap, Submap.empty(2, submap.map.T_cw)]


@pytest.fixture
def path(tmp_path: Path, submaps: list[Submap], camera: Camera) -> Path:
    write_atlas(tmp_path / "map.safetensors", submaps, camera, sessions=2)
    return tmp_path / "map.safetensors"


def tables(submap: Submap) -> list[dict[str, Tensor]]:
    posed_frames = submap.posed_frames
    kept = (submap.map.points, submap.map.keyframes, posed_frames.frames, posed_frames.observations)
    return [table.columns() for table in kept]


def test_submaps_and_camera_round_trip(path: Path, submaps: list[Submap], camera: Camera) -> None:
    saved = read_atlas(path)
    assert [submap.number for submap in saved.atlas] == [0, 2]
    assert saved.atlas.num_created == 3
    assert saved.atlas.create().number == 3
    assert saved.sessions == 2
    for before, after in zip(submaps, saved.atlas, strict=False):
        for expected, found in zip(tables(before), tables(after), strict=True):
            assert expected.keys() == found.keys()
            for name, column in expected.items():
                assert column.dtype == found[name].dtype
                assert torch.equal(column, found[name]), name
    assert saved.camera.model == camera.model
    assert saved.camera.size == camera.size
    assert torch.equal(saved.camera.params, camera.params)


def test_saving_is_deterministic_also_after_loading(
    path: Path, submaps: list[Submap], camera: Camera
) -> None:
    write_atlas(path.with_name("two"), submaps, camera, sessions=2)
    assert path.with_name("two").read_bytes() == path.read_bytes()
    saved = read_atlas(path)
    write_atlas(path.with_name("three"), saved.atlas, saved.camera, saved.sessions)
    assert path.with_name("three").read_bytes() == path.read_bytes()


def test_frames_of_later_sessions_are_left_out(path: Path, submaps: list[Submap], camera: Camera) -> None:
    write_atlas(path, submaps, camera, sessions=1)
    submap = next(iter(read_atlas(path).atlas))
    assert submap.posed_frames.frames["session"].tolist() == [0, 0]
    assert submap.posed_frames.observations["frame_row"].tolist() == [0] * 5 + [1] * 6
    write_atlas(path, submaps, camera, sessions=0)
    with pytest.raises(ResultsError, match="session from 0 to 0"):  # of keyframes: they are never left out
        read_atlas(path)


def test_an_empty_atlas_can_be_saved(tmp_path: Path, camera: Camera) -> None:
    write_atlas(tmp_path / "map.safetensors", [], camera)
    loaded, _ = read_map(tmp_path / "map.safetensors")
    assert loaded.num_keyframes == 0
    assert loaded.num_points == 0


def test_a_map_is_loaded_to_the_requested_device(path: Path, device: torch.device) -> None:
    saved = read_atlas(path, device)
    assert saved.camera.params.device.type == device.type
    for submap in saved.atlas:
        assert submap.tracking.T_cr.device.type == device.type
        assert all(rows.device.type == device.type for table in tables(submap) for rows in table.values())


# --- what is no map ------------------------------------------------------------------------------------------


def test_missing_damaged_and_unknown_files_are_named(path: Path) -> None:
    whole = path.read_bytes()
    path.unlink()
    with pytest.raises(ResultsError, match=r"map\.safetensors: no map file"):
        read_atlas(path)
    for content in (b"", b"not a map", whole[:-100], whole[:50], whole[:9]):
        path.write_bytes(content)
        with pytest.raises(ResultsError, match=r"map\.safetensors: not a readable"):
            read_atlas(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(ResultsError, match=r"map\.safetensors: not a readable"):
        read_atlas(path)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "not a torchslam map"),
        ({"author": "somebody"}, "not a torchslam map"),
        ({"torchslam": '{"format": 4}', "author": "somebody"}, "not a torchslam map"),
        ({"torchslam": "format 4"}, "not a torchslam map"),
        ({"torchslam": "[3]"}, "not a torchslam map"),
        ({"torchslam": '{"size": 3}'}, "not a torchslam map"),
        ({"torchslam": '{"format": 99}'}, "map format 99, this version reads format 2"),
        ({"torchslam": '{"format": 1}'}, "map format 1, this version reads format 2"),
    ],
)
def test_other_programs_and_formats_are_refused(
    path: Path, metadata: dict[str, str] | None, message: str
) -> None:
    save_file({"weights": torch.zeros(3)}, str(path), metadata=metadata)
    with pytest.raises(ResultsError, match=r"map\.safetensors: .*" + message):
        read_atlas(path)


Tensors = dict[str, Tensor]


def described(path: Path) -> dict[str, Any]:
    header = path.read_bytes()
    size = int.from_bytes(header[:8], "little")
    return json.loads(json.loads(header[8 : 8 + size])["__metadata__"]["torchslam"])


def without(name: str) -> Callable[[Tensors], object]:
    return lambda tensors: tensors.pop(name)


def put(name: str, row: int, value: float) -> Callable[[Tensors], object]:
    return lambda tensors: tensors[name].__setitem__(row, value)


def change(name: str, how: Callable[[Tensor], Tensor]) -> Callable[[Tensors], object]:
    return lambda tensors: tensors.__setitem__(name, how(tensors[name]).contiguous())


P, K, F, O = (f"submaps.0.{table}." for table in ("points", "keyframes", "frames", "observations"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without("camera.params"), "the camera's parameters are missing"),
        (change("camera.params", lambda rows: rows[:3]), "a pinhole camera has 4 parameters"),
        (put("camera.params", 0, float("nan")), "not finite numbers with a positive focal length"),
        (put("camera.params", 1, -100.0), "not finite numbers with a positive focal length"),
        (change("camera.params", Tensor.half), "not a row of numbers"),
        (without(P + "is_valid"), "submap 0, points: missing or unknown columns: is_valid"),
        (
            lambda tensors: tensors.__setitem__(P + "colour", torch.zeros(120)),
            "points: missing or unknown columns: colour",
        ),
        (
            lambda tensors: tensors.__setitem__("submaps.0.trees.age", torch.zeros(1)),
            "unknown tensors: submaps.0.trees.age",
        ),
        (
            lambda tensors: tensors.__setitem__("submaps.1.points.age", torch.zeros(1)),
            "unknown tensors: submaps.1",
        ),
        (lambda tensors: tensors.__setitem__("trees", torch.zeros(1)), "unknown tensors: trees"),
        (
            change(P + "positions_w", lambda rows: rows[:, :2]),
            r"positions_w: rows must have the shape \(3,\)",
        ),
        (
            change(P + "positions_w", Tensor.float),
            "positions_w: torch.float32 but the camera is torch.float64",
        ),
        (change(P + "is_valid", Tensor.long), "is_valid: must be of kind bool"),
        (change(P + "is_valid", lambda rows: rows[:-1]), "the columns have 119 to 120 rows"),
        (
            change(K + "angles", lambda rows: rows[:, 1:]),
            "angles: N is 39, elsewhere 40|N is 40, elsewhere 39",
        ),
        (change(P + "descriptors", lambda rows: rows[:, 1:]), "D is 32, elsewhere 31"),
        (change(P + "descriptors", Tensor.double), "descriptors of several types"),
        (put(P + "positions_w", 0, float("inf")), "positions_w: not finite"),
        (put(F + "T_cr", 0, float("nan")), "T_cr: not finite"),
        (put(K + "angles", 0, float("nan")), "angles: not finite"),
        (put(K + "T_cw", 0, 0.5), "T_cw: not rigid transforms"),
        (change(K + "T_cw", lambda rows: 1.01 * rows), "T_cw: not rigid transforms"),
        (
            change(F + "T_cr", lambda rows: rows.index_fill(1, torch.tensor([3]), 0)),
            "T_cr: not rigid transforms",
        ),
        (lambda tensors: tensors[K + "T_cw"][2, :3, 3].fill_(1e160), r"T_cw: beyond 1e\+12"),
        (put(P + "positions_w", 3, -1e13), r"positions_w: beyond 1e\+12"),
        (put(K + "keypoints", 3, 1e300), r"keypoints: beyond 1e\+12"),
        (put(P + "first_keyframe", 5, 6), "first_keyframe from 0 to 6, there are 0 to 5"),
        (put(P + "replaced_by", 5, 120), "replaced_by from -1 to 120, there are -1 to 119"),
        (put(P + "replaced_by", 5, 5), "replaced_by has a cycle"),
        (
            lambda tensors: tensors[P + "replaced_by"][:120].copy_(torch.arange(1, 121) % 120),
            "replaced_by has a cycle",
        ),
        (put(K + "point_ids", 0, 120), "point_ids from -1 to 120, there are -1 to 119"),
        (put(F + "session", 0, -1), "session from -1 to 1, there are 0 to 1"),
        (put(K + "frame_index", 1, 0), "two keyframes have the same session and frame index"),
        (put(K + "frame_index", 1, -1), "frame_index from -1 to 25, there are 0"),
        (put(F + "reference_keyframe", 0, 6), "reference_keyframe from 0 to 6, there are 0 to 5"),
        (put(O + "frame_row", 0, 3), "frame_row from 0 to 3, there are 0 to 2"),
        (put(O + "point_ids", 0, 120), "point_ids from 0 to 120, there are 0 to 119"),
        (put(O + "keypoint_index", 0, -2), "keypoint_index from -2"),
    ],
)
def test_inconsistent_tables_are_refused(
    path: Path, damage: Callable[[Tensors], object], message: str
) -> None:
    about, tensors = described(path), load_file(str(path))
    damage(tensors)
    save_file(tensors, str(path), metadata={"torchslam": json.dumps(about)})
    with pytest.raises(
        ResultsError, match=r"map\.safetensors: not a whole torchslam map: .*(" + message + ")"
    ):
        read_atlas(path)


def test_a_long_chain_of_replacements_is_no_cycle(path: Path) -> None:
    about, tensors = described(path), load_file(str(path))
    tensors[P + "replaced_by"][:119] = torch.arange(1, 120)
    save_file(tensors, str(path), metadata={"torchslam": json.dumps(about)})
    assert read_map(path)[0].follow_merges(torch.tensor([0])).tolist() == [119]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": {"model": "wide", "size": [160, 120]}}, "unknown camera model 'wide'"),
        ({"camera": {"model": "pinhole"}}, "'size' is missing"),
        ({"camera": {"model": "pinhole", "size": [160]}}, "not enough values"),
        ({"camera": {"model": "pinhole", "size": [160, "high"]}}, "an image of 160 x high pixels"),
        ({"camera": {"model": "pinhole", "size": [160, 2**31]}}, "an image of 160 x 2147483648 pixels"),
        ({"submaps": [0, 0]}, "numbers must differ"),
        ({"submaps": [0, 2], "num_created": 2}, "must differ and lie below"),
        ({"submaps": 3}, "must be an iterable"),
        ({"submaps": ["a"]}, "must be numbers"),
        ({"sessions": -1}, "must be numbers"),
        ({"sessions": None}, "must be numbers"),
        ({"sessions": 1}, "session from 0 to 1, there are 0 to 0"),
        ({"submaps": []}, "unknown tensors"),
    ],
)
def test_inconsistent_metadata_are_refused(path: Path, changes: dict[str, Any], message: str) -> None:
    about, tensors = described(path) | changes, load_file(str(path))
    save_file(tensors, str(path), metadata={"torchslam": json.dumps(about)})
    with pytest.raises(ResultsError, match=r"map\.safetensors: not a whole torchslam map: .*" + message):
        read_atlas(path)


# --- whole or not at all -------------------------------------------------------------------------------------


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map"
    write_whole(path, b"old")

    def fail(number: int) -> None:
        assert (tmp_path / ("map" + PART)).read_bytes() == b"new"
        raise OSError("no space left")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [found.name for found in tmp_path.iterdir()] == ["map"]


def test_leftovers_of_a_killed_process_are_overwritten(tmp_path: Path) -> None:
    (tmp_path / ("map" + PART)).write_bytes(b"a half")
    write_whole(tmp_path / "map", b"whole")
    assert [found.name for found in tmp_path.iterdir()] == ["map"]
    assert (tmp_path / "map").read_bytes() == b"whole"
