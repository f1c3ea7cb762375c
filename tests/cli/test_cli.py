"""The command line end to end, on a few rendered frames and on everything that users get wrong."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

import torchslam
from tests.cli.conftest import FAST, ROOM, write_tum_folder
from torchslam.cli.main import COMMANDS, load_command, main
from torchslam.config import load_config
from torchslam.data import read_trajectory
from torchslam.map.file import read_map
from torchslam.utils.timing import cpu_seconds, peak_memory_mb


def run_and_read(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    status = main(arguments)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_run_writes_all_results(finished: Path) -> None:
    names = {path.relative_to(finished).as_posix() for path in finished.rglob("*") if path.is_file()}
    pictures = {f"plots/{name}.png" for name in ("scene", "top_view", "errors", "features", "tracking")}
    files = {f"{name}.txt" for name in ("trajectory", "online", "keyframes", "groundtruth", "calibration")}
    files |= {
        "map.safetensors",
        "graph.safetensors",
        "loops.safetensors",
        "map.ply",
        "config.toml",
        "view.html",
        "metrics.json",
        "frames.csv",
    }
    assert names == files | {"example.png"} | pictures
    figures = json.loads((finished / "metrics.json").read_text())
    assert figures["frames"] == 16
    assert len(read_trajectory(finished / "trajectory.txt")) == figures["posed"]
    assert len(read_trajectory(finished / "online.txt")) == figures["frames"] - figures["initialized_at"]
    assert figures["online_ate_m"] < 0.05 * figures["path_length_m"]
    assert len(read_trajectory(finished / "keyframes.txt")) == figures["keyframes"]
    assert read_map(finished / "map.safetensors")[0].num_points == figures["points"]
    assert figures["ate_m"] < 0.05 * figures["path_length_m"]
    if sys.platform != "win32":
        assert 0.1 < figures["cpu_s"] < cpu_seconds()
        assert 50 < figures["peak_memory_mb"] <= peak_memory_mb()


def test_resolved_configuration_reads_back(finished: Path) -> None:
    config = load_config(finished / "config.toml")
    assert config.seed == 7
    assert config.features.kind == "opencv-orb"


@pytest.mark.usefixtures("without_pictures")
def test_same_input_and_seed_give_same_bytes(finished: Path, tmp_path: Path) -> None:
    assert main(["run", ROOM, "--output", str(tmp_path), *FAST, "--seed", "7"]) == 0
    for name in ("trajectory.txt", "keyframes.txt", "map.safetensors", "map.ply"):
        assert (tmp_path / name).read_bytes() == (finished / name).read_bytes(), name


def test_plot_draws_again_from_the_files_alone(
    finished: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run_and_read(capsys, "plot", str(copy))
    assert status == 0
    drawn = {Path(line).name for line in out.splitlines()}
    assert drawn == {path.name for path in (finished / "plots").iterdir()} | {"view.html"}
    assert (copy / "view.html").read_bytes() == (finished / "view.html").read_bytes()
    for name in ("scene.png", "top_view.png", "features.png"):
        assert (copy / "plots" / name).read_bytes() == (finished / "plots" / name).read_bytes()


def test_evaluate_prints_a_table_or_json(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(finished / "trajectory.txt"), str(finished / "groundtruth.txt")]
    status, out, _ = run_and_read(capsys, "eval", *files)
    assert status == 0
    assert "ATE" in out
    status, out, _ = run_and_read(capsys, "eval", *files, "--json")
    figures = json.loads((finished / "metrics.json").read_text())
    assert json.loads(out)["ate_m"] == pytest.approx(figures["ate_m"], abs=1e-6)
    assert run_and_read(capsys, "eval", str(finished), files[1], "--json")[:2] == (0, out)


def test_info_describes_the_sequence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run_and_read(capsys, "info", str(write_tum_folder(tmp_path / "tum")))
    assert status == 0
    for part in ("6", "640x480", "20.00 Hz", "pinhole 500 500 319.5 239.5", "none"):
        assert part in out


def test_demo_writes_the_results_of_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchslam.cli.commands.DEMO_SEQUENCE", ROOM)
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "metrics.json").write_text("of an earlier time: the demo writes over it")
    status, out, err = run_and_read(capsys, "demo", "--output", str(tmp_path / "demo"), *FAST)
    assert status == 0
    assert "ATE" in out
    assert "16/16" in err
    assert "tracking" in err
    assert (tmp_path / "demo" / "plots" / "scene.png").exists()


def test_a_static_camera_gives_no_map_and_a_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, _, err = run_and_read(
        capsys, "run", "synthetic:standstill?frames=8", "--output", str(tmp_path), *FAST
    )
    assert status == 3
    assert "no map was initialized in 8 frames" in err
    assert json.loads((tmp_path / "metrics.json").read_text())["initialized_at"] is None
    assert (tmp_path / "trajectory.txt").exists()
    assert main(["plot", str(tmp_path)]) == 0


def test_bad_frames_are_skipped_counted_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum_folder(tmp_path / "tum")
    (folder / "rgb" / "2.png").write_bytes(b"not an image")
    (folder / "rgb" / "3.png").unlink()
    cv2.imwrite(str(folder / "rgb" / "4.png"), np.zeros((10, 10), np.uint8))
    status, out, err = run_and_read(capsys, "run", str(folder), "--output", str(tmp_path / "out"), *FAST)
    assert status in (0, 3)  # too few frames to promise a map
    assert "3 of them unreadable" in out
    for place in ("rgb.txt:3", "rgb.txt:4", "rgb.txt:5"):
        assert place in err
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["frames"] == 6
    assert len(figures["skipped"]) == 3


def test_download_fetches_what_run_can_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum_folder(tmp_path / "made" / "desk_1", frames=4)
    (tmp_path / "served").mkdir()
    shutil.make_archive(str(tmp_path / "served" / "desk_1_mono"), "zip", folder.parent)
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "served"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        status, out, _ = run_and_read(capsys, "download", "eth3d/desk_1", "--to", str(tmp_path), "--url", url)
        missing, _, err = run_and_read(
            capsys, "download", "eth3d/desk_2", "--to", str(tmp_path), "--url", url
        )
        server.shutdown()
    assert (status, missing) == (0, 2)
    assert "desk_2_mono.zip: 404" in err
    status, out, _ = run_and_read(capsys, "info", out.strip())
    assert "640x480" in out


BAD_ARGUMENTS = [
    (["run", "nowhere"], "nowhere"),
    (["run", ROOM, "--set", "features.num_keypionts=10"], "features.num_keypoints"),
    (["run", ROOM, "--set", "nonsense"], "section.key=value"),
    (["run", ROOM, "--config", "missing.toml"], "missing.toml"),
    (["run", ROOM, "--camera", "500,500,320"], "--camera"),
    (["run", ROOM, "--camera", "nan,500,320,240"], "nan"),
    (["run", ROOM, "--camera", "500,-500,320,240"], "positive"),
    (["run", "synthetic:palace"], "palace"),
    (["info", "nowhere"], "nowhere"),
    (["plot", "nowhere"], "nowhere"),
    (["export", "nowhere", "--to", "ply"], "nowhere"),
    (["eval", "nowhere.txt", "nowhere.txt"], "nowhere.txt"),
    (["download", "kitti/00"], "eth3d/NAME"),
]


@pytest.mark.parametrize(
    ("arguments", "expected"), BAD_ARGUMENTS, ids=[" ".join(a) for a, _ in BAD_ARGUMENTS]
)
def test_errors_are_one_line_with_status_2(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    output = ["--output", "out"] if arguments[0] == "run" else []
    status, out, err = run_and_read(capsys, *arguments, *output)
    assert status == 2
    assert out == ""
    assert err.startswith("torchslam: error: ")
    assert err.count("\n") == 1
    assert expected in err


def test_results_that_cannot_be_written_stop_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    status, _, err = run_and_read(capsys, "run", ROOM, "--output", str(tmp_path / "file" / "out"))
    assert status == 2
    assert str(tmp_path / "file") in err


def test_a_folder_that_cannot_be_written_to_stops_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, content: bytes) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("torchslam.io.results.write_whole", refuse)
    monkeypatch.setattr("torchslam.cli.run.SLAM", None)  # nothing is begun
    status, _, err = run_and_read(capsys, "run", ROOM, "--output", str(tmp_path))
    assert status == 2
    assert "Permission denied" in err
    assert str(tmp_path) in err


def test_plot_of_an_incomplete_folder_names_what_is_missing(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.safetensors").write_bytes((finished / "map.safetensors").read_bytes())
    status, _, err = run_and_read(capsys, "plot", str(tmp_path))
    assert status == 2
    assert "metrics.json" in err
    (tmp_path / "metrics.json").write_bytes((finished / "metrics.json").read_bytes())
    status, _, err = run_and_read(capsys, "plot", str(tmp_path))
    assert status == 2
    assert "trajectory.txt" in err


@pytest.mark.parametrize(
    "command", ["run", "app", "batch", "demo", "eval", "plot", "export", "info", "config", "download"]
)
def test_help_of_every_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    assert f"usage: torchslam {command}" in capsys.readouterr().out


def test_the_command_list_shows_each_commands_summary() -> None:
    for name, summary in COMMANDS.items():
        first = load_command(name)[0].split("\n")[0].rstrip(".")
        assert summary == first[0].lower() + first[1:]


def test_public_names_are_imported_lazily() -> None:
    for name in torchslam.__all__:
        assert getattr(torchslam, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'teleport'"):
        torchslam.teleport  # noqa: B018


def test_usage_errors_have_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ["run", ROOM, "-o", "x", "--checkpoint", "-1"],
        ["run", ROOM, "-o", "x", "--resume", "--overwrite"],
        ["run", ROOM],
        ["run", ROOM, "-o", "x", "--processes", "0"],
        ["export", "x"],
        ["export", "x", "--to", "obj"],
        ["fly"],
        [],
    ):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)


@pytest.mark.parametrize("command", [["info"], ["run", "-o", "results"]])
def test_a_pattern_that_the_shell_expanded(
    tmp_path: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / f"{index}.png" for index in range(3)]
    for path in files:
        path.write_bytes(b"")
    with pytest.raises(SystemExit) as stopped:
        main([*command, *map(str, files)])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert f"3 files instead of one path, the first {files[0]}: a shell expands patterns" in error
    assert f"in quotes: '{tmp_path / '*.png'}'" in error
    with pytest.raises(SystemExit):
        main([*command, str(files[0]), "nonsense"])
    assert "unrecognized arguments: nonsense" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of another kind")
@pytest.mark.parametrize(
    ("arguments", "unbuffered"),
    [
        *product([["config"], ["--help"]], ["", "1"]),
        (["info", "/nowhere"], ""),
        pytest.param(["info", "/nowhere"], "1", marks=pytest.mark.slow),
    ],
)
def test_a_reader_that_is_gone_is_no_error(arguments: list[str], unbuffered: str) -> None:
    """As in `torchslam ... | head`, with and without the messages in the pipe."""
    command = [sys.executable, "-m", "torchslam", *arguments]
    for messages in (subprocess.PIPE, subprocess.STDOUT):
        reader, writer = os.pipe()
        os.close(reader)
        environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
        done = subprocess.run(
            command, stdout=writer, stderr=messages, env=environment, check=False, text=True
        )
        os.close(writer)
        assert done.returncode == 141
        assert "roken pipe" not in (done.stderr or "")
