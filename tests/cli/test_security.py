"""Files of somebody else: they import no code, give no credentials away, and reach no other path, terminal or page."""

from __future__ import annotations

import json
import pickle
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.cli.conftest import FAST, ROOM
from torchslam.cli.main import main
from torchslam.data import open_sequence
from torchslam.data.formats.given_poses import read_poses
from torchslam.data.opening import full_name
from torchslam.errors import ConfigError, SequenceError, TorchslamError, TrajectoryError
from torchslam.features.weights import read_weights
from torchslam.plugins import ALLOWED
from torchslam.utils.console import printable, without_credentials

ALONE = [*FAST, "--processes", "1"]
Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> Command:
    """Run a command: status, output and messages."""

    def run(*arguments: str | Path) -> tuple[int, str, str]:
        status = main([str(argument) for argument in arguments])
        said = capfd.readouterr()
        return status, said.out, said.err

    return run


def texts_below(folder: Path) -> Iterator[tuple[Path, bytes]]:
    return ((path, path.read_bytes()) for path in folder.rglob("*") if path.is_file())


# --- code ----------------------------------------------------------------------------------------------------


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package `trap` that can be imported; the file that an import makes."""
    made = tmp_path / "imported"
    (tmp_path / "code").mkdir()
    content = f"open({str(made)!r}, 'w').close()\nfrom torchslam.errors import ConfigError\n"
    content += "def make(images): raise ConfigError('the trap ran')\n"
    (tmp_path / "code" / "trap.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path / "code")
    monkeypatch.delenv(ALLOWED, raising=False)
    monkeypatch.delitem(__import__("sys").modules, "trap", raising=False)
    return made


@pytest.mark.parametrize("setting", ["features.kind", "matching.matcher"])
def test_a_configuration_file_imports_no_code(
    tmp_path: Path, trap: Path, command: Command, finished: Path, setting: str
) -> None:
    section, key = setting.split(".")
    (tmp_path / "c.toml").write_text(f'[{section}]\n{key} = "trap:make"\n')
    results = shutil.copytree(finished, tmp_path / "results")
    shutil.copy(tmp_path / "c.toml", results / "config.toml")
    file = ("--config", tmp_path / "c.toml")
    for arguments in (
        ("run", ROOM, "-o", tmp_path / "o", *file),
        ("run", ROOM, "-o", tmp_path / "o", "--map", results),
        ("refine", ROOM, "--poses", finished / "trajectory.txt", "-o", tmp_path / "o", *file),
        ("config", *file),
    ):
        status, _, err = command(*arguments)
        assert status == 2, arguments
        assert f"{setting} = 'trap:make' imports code, which a file may not do unasked" in err
        assert not trap.exists()


def test_code_is_imported_where_the_command_line_or_the_environment_says_so(
    tmp_path: Path, trap: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "c.toml").write_text('[features]\nkind = "trap:make"\n')
    file = ("--config", tmp_path / "c.toml")
    for more, package in ((("--features", "trap:make"), ""), ((), "other, trap"), ((), "trap.more")):
        monkeypatch.setenv(ALLOWED, package)
        monkeypatch.delitem(__import__("sys").modules, "trap", raising=False)
        trap.unlink(missing_ok=True)
        command("run", ROOM, "-o", tmp_path / "o", "--overwrite", *file, *more)
        assert trap.exists() is (package != "trap.more")


def test_the_list_of_a_batch_imports_no_code(tmp_path: Path, trap: Path, command: Command) -> None:
    (tmp_path / "c.toml").write_text('[features]\nkind = "trap:make"\n')
    (tmp_path / "config.csv").write_text(f"sequence,config\n{ROOM},c.toml\n")
    (tmp_path / "overrides.csv").write_text(f"sequence,overrides\n{ROOM},seed=3; features.kind = trap:make\n")
    status, _, err = command("batch", tmp_path / "config.csv", "-o", tmp_path / "one")
    assert status == 4
    assert "c.toml: features.kind = 'trap:make' imports code" in err
    status, _, err = command("batch", tmp_path / "overrides.csv", "-o", tmp_path / "two")
    assert status == 2
    assert "overrides.csv:2: overrides: features.kind = 'trap:make' imports code" in err
    assert not trap.exists()


class _Attack:
    def __reduce__(self) -> tuple[object, ...]:
        return open, (str(Path.cwd() / "attacked"), "w")


@pytest.mark.parametrize("save", [torch.save, lambda content, path: path.write_bytes(pickle.dumps(content))])
def test_weights_run_no_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, save: Callable[[object, Path], object]
) -> None:
    monkeypatch.chdir(tmp_path)
    save({"a": _Attack()}, tmp_path / "w.pt")
    with pytest.raises(ConfigError, match=r"w\.pt: cannot read the weights"):
        read_weights(tmp_path / "w.pt")
    assert not (tmp_path / "attacked").exists()


# --- credentials ---------------------------------------------------------------------------------------------

ADDRESS = "rtsp://admin:s3cret@p/w@127.0.0.1:9/live?token=s3cret&channel=1"


class _Stream:
    """Frames of the room as a stream that ends."""

    def __init__(self, address: str) -> None:
        self._room, self._next = open_sequence(ROOM), -1

    def isOpened(self) -> bool:
        return True

    def grab(self) -> bool:
        self._next += 1
        return self._next < len(self._room)

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, (self._room.image(self._next)[0, 0] * 255).byte().numpy()

    def get(self, property_id: int) -> float:
        return 0.0

    def release(self) -> None:
        pass


def test_the_credentials_of_a_stream_reach_neither_messages_nor_results(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", _Stream)
    camera = open_sequence(ROOM).camera.params.tolist()
    given = ("--camera", ",".join(map(str, camera)), "-o", tmp_path / "o", *ALONE)
    status, out, err = command("run", ADDRESS, *given)
    assert status in (0, 3)
    assert "127.0.0.1" in out
    assert "s3cret" not in out + err
    assert [path for path, content in texts_below(tmp_path) if b"s3cret" in content] == []
    source = json.loads((tmp_path / "o" / "metrics.json").read_text())["source"]
    assert source == "rtsp://127.0.0.1:9/live?token=***&channel=1"


def test_the_credentials_of_a_stream_reach_no_error(tmp_path: Path, command: Command) -> None:
    (tmp_path / "l.txt").write_text(f"{ADDRESS}\nhttp://admin:s3cret@host/film.mp4\n")
    for arguments, status in (
        (("run", ADDRESS, "-o", tmp_path / "o"), 2),
        (("info", ADDRESS), 2),
        (("info", ADDRESS, "--fps", "-1"), 2),
        (("info", "http://admin:s3cret@host/film.mp4"), 2),
        (("batch", tmp_path / "l.txt", "-o", tmp_path / "b"), 4),
    ):
        found, out, err = command(*arguments)
        assert found == status
        assert "s3cret" not in out + err
        assert "admin" not in out + err
    assert (tmp_path / "b" / "table.csv").exists()
    assert [
        path for path, text in texts_below(tmp_path / "b") if b"s3cret" in text or "s3cret" in path.name
    ] == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rtsp://u:p@h/x", "rtsp://h/x"),
        ("cannot open rtsp://u@h:554/x@2: gone", "cannot open rtsp://2: gone"),
        ("/cwd/https:/u:p@h/film.mp4", "/cwd/https:/h/film.mp4"),
        ("http://h/a?password=1&b=2", "http://h/a?password=***&b=2"),
        ("rtsp://h/user=admin&password=x&channel=1.sdp", "rtsp://h/user=admin&password=***&channel=1.sdp"),
        ("mail a@b about C:/a@b and http://h/a", "mail a@b about C:/a@b and http://h/a"),
        ("password=1", "password=1"),
    ],
)
def test_credentials_of_addresses_are_left_out(text: str, expected: str) -> None:
    assert without_credentials(text) == expected
    assert str(TorchslamError(text)) == expected


def test_the_source_of_a_run_has_no_credentials() -> None:
    assert full_name("https://u:p@h/film.mp4") == "https://h/film.mp4"


# --- names ---------------------------------------------------------------------------------------------------

NAMES = [
    *("<script>alert(1)</script>", "\x1b]0;owned\x07", "..\\..\\a", "a\nb", "\u202egnp", "%2e%2e%2fa"),
    "'\"&<img src=x>",
]


def test_names_of_images_reach_neither_terminal_nor_page_nor_other_paths(
    tmp_path: Path, command: Command
) -> None:
    folder = tmp_path / "<script>alert(2)<\x1b[31mscript>"
    folder.mkdir()
    room = open_sequence(ROOM)
    for index in range(len(room)):
        image = (room.image(index)[0, 0] * 255).byte().numpy()
        path = folder / f"{index:03d}{NAMES[index % len(NAMES)].replace('/', '-')}.png"
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (folder / f"999{NAMES[1]}.png").write_bytes(b"no image")
    camera = ",".join(map(str, room.camera.params.tolist()))
    out = tmp_path / "out"
    for arguments in (
        ("info", folder),
        ("run", folder, "-o", out, "--camera", camera, *ALONE),
        *(("export", out, "--to", kind) for kind in ("colmap", "nerfstudio", "tum")),
        ("plot", out),
    ):
        status, said, err = command(*arguments)
        assert status == 0, err
        assert all(line.isprintable() for line in (said + err).replace("\r", "\n").split("\n"))
    page = (out / "view.html").read_text()
    assert "<script>alert" not in page
    assert "\x1b" not in page
    inside = {path.name for path in (out / "export").rglob("*")}
    assert all(name.isascii() and name.replace("_", "").replace(".", "").isalnum() for name in inside), inside
    assert {path.name for path in tmp_path.iterdir()} == {folder.name, "out"}


def test_names_in_given_poses_are_one_word(tmp_path: Path) -> None:
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24)
    (tmp_path / "cameras.bin").write_bytes(camera)
    for name in (b"a\nb.png", b"\x1b[31m.png"):
        image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + name + b"\0" + struct.pack("<Q", 0)
        (tmp_path / "images.bin").write_bytes(image)
        with pytest.raises(TrajectoryError, match="the name of an image has control characters"):
            read_poses(tmp_path)


@pytest.mark.parametrize("source", ["rtsp://127.0.0.1:9/x", "http://127.0.0.1:9/x", "0"])
def test_no_source_of_a_results_folder_is_connected_to(
    tmp_path: Path, command: Command, finished: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    results = shutil.copytree(finished, tmp_path / "results")
    metrics = json.loads((results / "metrics.json").read_text()) | {"source": source}
    (results / "metrics.json").write_text(json.dumps(metrics))
    monkeypatch.setattr(cv2, "VideoCapture", pytest.fail)
    for arguments in (("export", results, "--to", "colmap"), ("densify", results)):
        status, _, err = command(*arguments)
        assert status == 2
        assert f"{source}: a live source gives each image once" in err


def test_what_is_escaped_can_be_told_apart() -> None:
    assert printable("a\x1b[31m\n\udcff\u202e é") == "a\\x1b[31m\\n\\udcff\\u202e é"
    assert str(SequenceError("a\tb")) == "a\\tb"
