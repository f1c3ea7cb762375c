"""`torchslam densify` on a run over a few rendered frames: as a user has it."""

from __future__ import annotations

import errno
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from safetensors.torch import load_file

from examples.train_depth import of_run
from tests.cli.conftest import FAST
from torchslam.cli.densify import map_size
from torchslam.cli.main import main
from torchslam.data import open_sequence
from torchslam.dense import DepthMaps
from torchslam.dense.cost_volume import matching_cost
from torchslam.densify import Views, passes
from torchslam.errors import ConfigError, FrameError
from torchslam.geometry import Camera, se3_inverse
from torchslam.io.export.scene import Images
from torchslam.io.results import DENSE_CLOUD, DEPTHS, MESH

ROOM = "synthetic:room?frames=18"
SMALL = ["--resolution", "96"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("torchslam.io.write_run.draw", lambda results, output: [])
        assert main(["run", ROOM, "--output", str(directory), *FAST, "--dense", *SMALL, "--every", "3"]) == 0
    return directory


@pytest.fixture
def results(run: Path, tmp_path: Path) -> Path:
    """The run without dense depth."""
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("dense", "dense.ply", "plots"))
    return tmp_path / "run"


def densify(results: Path, *more: str, processes: int = 1) -> int:
    return main(["densify", str(results), *SMALL, "--every", "3", "--processes", str(processes), *more])


def test_a_run_with_dense_depth_has_all_its_results(run: Path) -> None:
    maps = DepthMaps.load(run / "dense" / "depths.safetensors")
    figures = json.loads((run / "metrics.json").read_text())["dense"]
    assert maps.camera.size == (96, 72)
    names = {"frame_index", "depth", "normal", "confidence", "T_cw", "camera.params"}
    assert load_file(run / "dense" / "depths.safetensors").keys() == names
    assert (maps.frame_index % 3 == 0).all()
    assert figures["depth_maps"] == len(maps) == len(list((run / "dense" / "pictures").iterdir()))
    assert figures["kept_ratio"] == pytest.approx(float((maps.depth > 0).double().mean()))
    assert figures["kept_ratio"] > 0.5
    assert b"element vertex %d\n" % figures["points"] in (run / "dense.ply").read_bytes()[:300]
    assert not (run / "dense" / "parts").exists()
    picture = cv2.imread(str(run / "dense" / "pictures" / f"{int(maps.frame_index[0]):06d}.png"))
    assert picture.shape == (72, 3 * 96, 3)


def test_depth_matches_the_images_at_the_true_poses(run: Path) -> None:
    maps, sequence = DepthMaps.load(run / "dense" / "depths.safetensors"), open_sequence(ROOM)
    frames = maps.frame_index.tolist()
    true = torch.stack([sequence.pose(index) for index in frames])
    found, expected = se3_inverse(maps.T_cw)[:, :3, 3], se3_inverse(true)[:, :3, 3]
    depth = maps.depth[0].double() * torch.pdist(expected).sum() / torch.pdist(found).sum()
    grays = torch.cat([sequence.image(index) for index in frames])
    grays = torch.nn.functional.interpolate(grays, size=(72, 96), mode="area")[:, 0].double()
    inverse = 1 / depth.clamp(min=1e-3)
    hypotheses = torch.stack((inverse, 1.2 * inverse, inverse / 1.2))
    T_sr = true[1:] @ se3_inverse(true[0])
    right, *wrong = matching_cost(grays[0], grays[1:], maps.camera, T_sr, hypotheses, 3, 1)[:, depth > 0]
    assert all(float(right.median()) < 0.5 * float(each.median()) for each in wrong)


def test_the_same_bytes_again_and_after_an_interruption(
    run: Path, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[Path] = []
    write = passes._write_alone

    def write_three(job: passes.DenseJob, view: int) -> None:
        if len(computed) == 3:
            raise KeyboardInterrupt
        computed.append(job.path(passes.Pass.ALONE, view))
        write(job, view)

    with monkeypatch.context() as patch:
        patch.setattr(passes, "_write_alone", write_three)
        assert densify(results) == 130
    assert not (results / "dense" / "depths.safetensors").exists()
    times = {path: path.stat().st_mtime_ns for path in computed}
    assert len(times) == 3
    kept = []

    def noted(job: passes.DenseJob, view: int) -> None:
        kept.append(job.path(passes.Pass.ALONE, view))
        write(job, view)

    monkeypatch.setattr(passes, "_write_alone", noted)
    assert densify(results) == 0
    assert not set(kept) & set(computed)
    for name in (DEPTHS, DENSE_CLOUD):
        assert (results / name).read_bytes() == (run / name).read_bytes()


@pytest.mark.slow
def test_the_same_bytes_with_any_number_of_processes(run: Path, results: Path) -> None:
    assert densify(results, processes=3) == 0
    for name in (DEPTHS, DENSE_CLOUD):
        assert (results / name).read_bytes() == (run / name).read_bytes()


def test_learned_aggregation_by_option_and_by_the_configuration(run: Path, results: Path) -> None:
    assert densify(results, "--aggregation", "learned") == 0
    by_option = (results / DEPTHS).read_bytes()
    assert json.loads((results / "metrics.json").read_text())["dense"]["aggregation"] == "learned"
    assert by_option != (run / DEPTHS).read_bytes()
    config = (results / "config.toml").read_text()
    assert 'aggregation = "classical"' in config
    (results / "config.toml").write_text(config.replace('"classical"', '"learned"'))
    assert densify(results) == 0
    assert (results / DEPTHS).read_bytes() == by_option
    assert densify(results, "--aggregation", "classical") == 0
    assert (results / DEPTHS).read_bytes() == (run / DEPTHS).read_bytes()


@pytest.mark.parametrize(
    "other", [["--resolution", "80x64"], pytest.param(["--aggregation", "learned"], marks=pytest.mark.slow)]
)
def test_parts_of_other_settings_are_not_used(
    other: list[str], results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*arguments: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(passes, "_write_merged", stop)
        assert densify(results) == 130
    assert list((results / "dense" / "parts").glob("*.alone.safetensors"))
    written: list[Path] = []
    write = passes._write_alone
    monkeypatch.setattr(
        passes, "_write_alone", lambda path, *rest: (written.append(path), write(path, *rest))
    )
    assert densify(results, *other) == 0
    assert len(written) == len(DepthMaps.load(results / DEPTHS))


def test_the_network_is_trained_on_what_the_keyframes_of_a_run_agree_on(run: Path) -> None:
    views = of_run(run, "96")
    assert len(views) >= 3
    for view in views:
        assert 0.2 < float(view.is_right.double().mean()) < 1
        assert view.is_rated[view.is_right].all()
        assert not view.is_right[view.is_rated].all()


def test_a_full_disk_is_one_line_and_loses_nothing(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "dense/depths.safetensors")

    with monkeypatch.context() as patch:
        patch.setattr(passes, "join", full)
        assert densify(results) == 2
    assert "No space left on device" in capsys.readouterr().err.splitlines()[-1]
    parts = list((results / "dense" / "parts").glob("*.merged.safetensors"))
    assert parts
    assert densify(results) == 0


def test_a_damaged_part_is_named(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write = passes._write_alone

    def damage(job: passes.DenseJob, view: int) -> None:
        write(job, view)
        path = job.path(passes.Pass.ALONE, view)
        path.write_bytes(path.read_bytes()[:100])

    monkeypatch.setattr(passes, "_write_alone", damage)
    assert densify(results) == 2
    assert "not a readable part of depth maps" in capsys.readouterr().err


def test_missing_images_are_reported(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = results / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"source": str(tmp_path / "moved.mp4")}))
    assert densify(results) == 2
    assert "moved.mp4: does not exist; use --images for its new location" in capsys.readouterr().err
    assert densify(results, "--images", ROOM) == 0
    path.write_text(json.dumps(json.loads(path.read_text()) | {"source": None}))
    assert densify(results) == 2
    assert "metrics.json: the location of the images is unknown; use --images" in capsys.readouterr().err


def test_an_image_that_cannot_be_read_is_skipped_and_counted(
    run: Path, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = int(DepthMaps.load(run / DEPTHS).frame_index[3])
    read = Images.bgr

    def damaged(images: Images, frame_id: int) -> Any:
        if frame_id == broken:
            raise FrameError("b.png is not an image, or a damaged one")
        return read(images, frame_id)

    monkeypatch.setattr(Images, "bgr", damaged)
    assert densify(results) == 0
    error = capsys.readouterr().err
    assert error.count("torchslam: warning: skipped a view: b.png is not an image, or a damaged one\n") == 1
    maps = DepthMaps.load(results / DEPTHS)
    figures = json.loads((results / "metrics.json").read_text())["dense"]
    assert broken not in maps.frame_index
    assert figures["skipped"] == 1
    assert figures["depth_maps"] == len(maps) == len(DepthMaps.load(run / DEPTHS)) - 1


def test_without_any_readable_image_there_is_no_depth(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def damaged(images: Images, frame_id: int) -> Any:
        raise FrameError(f"{frame_id}.png is not an image, or a damaged one")

    monkeypatch.setattr(Images, "bgr", damaged)
    assert densify(results) == 2
    assert "images cannot be read, the first one: 0.png is not an image" in capsys.readouterr().err
    assert not (results / DEPTHS).exists()


def test_a_view_without_neighbors_goes_with_them() -> None:
    neighbors = ((1, 2), (0, 2), (0, 1, 3), (2, 4), (3, 2))
    T_cw = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    T_cw[:, 0, 3] = torch.arange(5)
    ones = torch.ones(5)
    views = Views(
        10 * torch.arange(5), T_cw, Camera.pinhole(9.0, 9.0, 4.5, 3.5, (10, 8)), ones, 2 * ones, neighbors
    )
    assert views.without(()).neighbors == neighbors
    left = views.without({4})  # 3 has one neighbor without it
    assert left.frame_index.tolist() == [0, 10, 20]
    assert left.neighbors == ((1, 2), (0, 2), (0, 1))
    assert left.T_sr(0)[:, 0, 3].tolist() == [1.0, 2.0]
    assert len(views.without({2})) == 0


def test_a_mesh_needs_its_extra_before_anything_is_computed(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert densify(results, "--mesh") == 2
    assert main(["run", ROOM, "--output", str(tmp_path / "new"), "--dense", "--mesh"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all("Open3D is required for a mesh: pip install 'torchslam[mesh]'" in line for line in lines)
    assert not (results / "dense").exists()
    assert not (tmp_path / "new").exists()


def test_a_mesh_is_that_of_the_depth_maps(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("open3d", reason="Open3D is not installed: pip install 'torchslam[mesh]'")
    assert densify(results, "--mesh") == 0
    assert "triangles" in capsys.readouterr().out
    assert main(["export", str(results), "--to", "mesh"]) == 0
    assert (results / MESH).read_bytes() == (results / "export" / "mesh.ply").read_bytes()
    assert densify(results) == 0
    assert not (results / MESH).exists()


@pytest.mark.parametrize("option", [["--every", "5"], ["--resolution", "96"], ["--mesh"]])
def test_options_of_dense_depth_require_it(
    option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", ROOM, "--output", str(tmp_path / "new"), *option]) == 2
    assert "--resolution, --every and --mesh require --dense" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--every", "12"], "dense depth needs 3 views or more, and there are 2 frames"),
        (["--resolution", "999999999x80"], "at most the image's"),
        (["--resolution", "big"], "expected 640x480 or 640, got `big`"),
        (["--resolution", "2000x1000"], "at most the image's"),
        (["--resolution", "40"], "at least 64 each way"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    options: list[str], message: str, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["densify", str(results), *SMALL, *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert densify(results / "none") == 2
    assert "none: no such results folder" in capsys.readouterr().err


def test_sizes_are_even_and_no_larger_than_the_image() -> None:
    assert map_size("320", (640, 481)) == (320, 240)
    assert map_size("320", (481, 641)) == (240, 320)
    assert map_size("1000", (641, 481)) == (640, 480)
    assert map_size("100x80", (640, 480)) == (100, 80)
    with pytest.raises(ConfigError):
        map_size("", (640, 480))
