"""Downloads from a server on this machine: whole, broken off and resumed, damaged and hostile archives."""

from __future__ import annotations

import hashlib
import io
import re
import stat
import threading
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from torchslam.data import download as downloads
from torchslam.data import open_sequence
from torchslam.data.download import download, unpack
from torchslam.errors import DownloadError, SequenceError


@dataclass
class Server:
    """What the server offers, how it misbehaves and which requests it received.

    cut: bytes after which a transfer breaks off; the number of transfers it does so for
    length: what it says instead of the length; None: nothing; pause: seconds after every byte
    """

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    cut: int | None = None
    cuts_left: int = 0
    ranges: bool = True
    length: str | None = "true"
    pause: float = 0.0
    requests: list[str | None] = field(default_factory=list)


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.requests.append(self.headers.get("Range"))
            body = state.files.get(self.path)
            if body is None:
                self.send_error(404)
                return
            start = 0
            if state.ranges and (asked := re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))):
                start = int(asked[1])
            if start >= len(body):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(body)}")
                self.end_headers()
                return
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
            if state.length is not None:
                true = str(len(body) - start)
                self.send_header("Content-Length", true if state.length == "true" else state.length)
            self.end_headers()
            end = len(body)
            if state.cut is not None and state.cuts_left > 0:
                state.cuts_left -= 1
                end = min(end, start + state.cut)
            if not state.pause:
                self.wfile.write(body[start:end])
            for byte in body[start:end] if state.pause else ():
                self.wfile.write(bytes((byte,)))
                time.sleep(state.pause)

        def log_message(self, *args: object) -> None:
            """Keep the test's output clean."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as httpd:
        thread = threading.Thread(target=httpd.serve_forever, args=(0.01,))
        thread.start()
        state.url = f"http://127.0.0.1:{httpd.server_port}"
        yield state
        httpd.shutdown()
        thread.join()


@pytest.fixture
def archive(tmp_path: Path, write_picture) -> bytes:
    """A zip in the layout of ETH3D's monocular archives."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        listing = poses = ""
        for index in range(3):
            write_picture(tmp_path / "picture.png", index)
            file.writestr(f"plant_1/rgb/{index}.png", (tmp_path / "picture.png").read_bytes())
            listing += f"{index / 27:.6f} rgb/{index}.png\n"
            poses += f"{index / 27:.6f} 0 0 {index} 0 0 0 1\n"
        file.writestr("plant_1/rgb.txt", listing)
        file.writestr("plant_1/groundtruth.txt", poses)
        file.writestr("plant_1/calibration.txt", "60 60 31.5 23.5\n")
    return buffer.getvalue()


def _entries(**entries: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, content in entries.items():
            file.writestr(name, content)
    return buffer.getvalue()


def test_download_unpack_open(server: Server, archive: bytes, tmp_path: Path) -> None:
    server.files["/plant_1_mono.zip"] = archive
    folder = download("eth3d/plant_1", tmp_path / "data", server.url)
    assert folder == tmp_path / "data" / "plant_1"
    sequence = open_sequence(folder)
    assert (len(sequence), sequence.size) == (3, (64, 48))
    assert sequence[2].T_cw_groundtruth is not None
    assert [path.name for path in folder.parent.iterdir()] == ["plant_1"]  # nothing left over
    assert download("eth3d/plant_1", tmp_path / "data", server.url) == folder
    assert server.requests == [None]  # not fetched again


def test_a_broken_transfer_resumes_in_the_same_call(server: Server, archive: bytes, tmp_path: Path) -> None:
    server.files["/plant_1_mono.zip"] = archive
    server.cut, server.cuts_left = 1000, 2
    folder = download("eth3d/plant_1", tmp_path, server.url)
    assert server.requests == [None, "bytes=1000-", "bytes=2000-"]
    assert len(open_sequence(folder)) == 3


def test_a_broken_transfer_resumes_in_the_next_call(server: Server, archive: bytes, tmp_path: Path) -> None:
    server.files["/plant_1_mono.zip"] = archive
    server.cut, server.cuts_left = 500, 5
    with pytest.raises(DownloadError, match=rf"broke off after 2500 of {len(archive)} bytes; run the same"):
        download("eth3d/plant_1", tmp_path, server.url)
    assert (tmp_path / "plant_1_mono.zip.part").stat().st_size == 2500
    assert not (tmp_path / "plant_1").exists()
    assert len(open_sequence(download("eth3d/plant_1", tmp_path, server.url))) == 3
    assert server.requests[-1] == "bytes=2500-"


@pytest.mark.parametrize("left", ["a part, of a server without ranges", "all of it", "more than the file"])
def test_leftovers_are_resumed_used_or_discarded(
    server: Server, archive: bytes, tmp_path: Path, left: str
) -> None:
    server.files["/plant_1_mono.zip"] = archive
    server.ranges = not left.startswith("a part")
    part = {"a": archive[:700], "all": archive, "more": archive + b"more"}[left.split()[0]]
    (tmp_path / "plant_1_mono.zip.part").write_bytes(part)
    assert len(open_sequence(download("eth3d/plant_1", tmp_path, server.url))) == 3


def test_checksum(server: Server, archive: bytes, tmp_path: Path) -> None:
    server.files["/plant_1_mono.zip"] = archive
    digest = hashlib.sha256(archive).hexdigest()
    for wrong, message in (
        ("0" * 64, f"has the SHA-256 {digest}, not 0{{64}}; it was deleted"),
        ("12", "64 hexa"),
    ):
        with pytest.raises(DownloadError, match=message):
            download("eth3d/plant_1", tmp_path / "data", server.url, sha256=wrong)
        assert list((tmp_path / "data").iterdir()) == []
    assert download("eth3d/plant_1", tmp_path / "data", server.url, sha256=digest.upper()).is_dir()


def test_the_size_of_a_download_is_bounded(
    server: Server, archive: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.files["/plant_1_mono.zip"] = archive
    monkeypatch.setattr(downloads, "MAX_BYTES", len(archive) - 1)
    for length in (None, "-3", "many", "9" * 5000):  # as the server says it: wrongly, or not at all
        server.length = length
        with pytest.raises(
            DownloadError, match=f"more than {len(archive) - 1} bytes, the most that is fetched"
        ):
            download("eth3d/plant_1", tmp_path / "data", server.url)
        assert not (tmp_path / "data" / "plant_1").exists()


def test_a_slow_body_times_out(
    server: Server, archive: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.files["/plant_1_mono.zip"] = archive
    server.length, server.pause = None, 0.02
    monkeypatch.setattr(downloads, "TIMEOUT", 0.1)
    monkeypatch.setattr(downloads, "ATTEMPTS", 1)
    with pytest.raises(DownloadError, match="slower than 4096 bytes a second; run the same command again"):
        download("eth3d/plant_1", tmp_path / "data", server.url)


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_decompression_bomb_is_refused(
    tmp_path: Path, method: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downloads, "SMALL", 1 << 20)
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", method) as file:
        file.writestr("0.png", bytes(4 << 20))
    with pytest.raises(
        DownloadError, match=r"bomb\.zip: \d+ bytes that unpack to 4194304: more than 100 times"
    ):
        unpack(tmp_path / "bomb.zip", tmp_path / "target")
    assert [path.name for path in tmp_path.iterdir()] == ["bomb.zip"]
    with pytest.raises(SequenceError, match="more than 100 times"):
        open_sequence(tmp_path / "bomb.zip")


def test_a_full_disk_is_reported_as_such(
    server: Server, archive: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.files["/plant_1_mono.zip"] = archive
    monkeypatch.setattr(downloads, "MARGIN", 1 << 62)
    with pytest.raises(DownloadError, match="do not fit into"):
        download("eth3d/plant_1", tmp_path / "data", server.url)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["plant_1_mono.zip"]


def test_archive_entries_without_a_name_are_refused(tmp_path: Path) -> None:
    content = _entries(**{"good.txt": b"good", "N": b"nameless"})
    # The length of the name, in the entry and in the directory, becomes 0, and its byte a part of the extra field.
    for mark, at in ((b"PK\3\4", 26), (b"PK\1\2", 28)):
        start = content.rindex(mark) + at
        content = content[:start] + b"\0\0" + content[start + 2 :]
    (tmp_path / "hostile.zip").write_bytes(content)
    with pytest.raises(DownloadError, match=r"hostile\.zip"):
        unpack(tmp_path / "hostile.zip", tmp_path / "target")
    assert [path.name for path in tmp_path.iterdir()] == ["hostile.zip"]


def test_unknown_names(server: Server, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match="404"):
        download("eth3d/nothing", tmp_path, server.url)
    with pytest.raises(DownloadError, match="run the same command again"):
        download("eth3d/plant_1", tmp_path, "http://127.0.0.1:9")  # no server
    for name in ("plant_1", "tum/desk", "eth3d/../up", "eth3d/"):
        with pytest.raises(DownloadError, match="unknown name"):
            download(name, tmp_path, server.url)


def test_damaged_archive_leaves_nothing(server: Server, archive: bytes, tmp_path: Path) -> None:
    damaged = bytearray(archive)
    damaged[200] ^= 0xFF
    for content in (bytes(damaged), b"<html>sorry</html>"):
        server.files["/plant_1_mono.zip"] = content
        with pytest.raises(DownloadError, match=r"plant_1_mono\.zip: not a zip archive.* it was deleted"):
            download("eth3d/plant_1", tmp_path / "data", server.url)
        assert list((tmp_path / "data").iterdir()) == []
    server.files["/plant_1_mono.zip"] = archive  # nothing is in the way of a whole one
    assert len(open_sequence(download("eth3d/plant_1", tmp_path / "data", server.url))) == 3


@pytest.mark.parametrize(
    "name",
    ["../evil.txt", "a/../../evil.txt", "/etc/evil.txt", "..\\evil.txt", "C:\\evil.txt", "C:/evil.txt"],
)
def test_paths_outside_the_target_are_refused(tmp_path: Path, name: str) -> None:
    archive = tmp_path / "hostile.zip"
    archive.write_bytes(_entries(**{"good.txt": b"good", name: b"evil"}))
    with pytest.raises(DownloadError, match=r"hostile\.zip: entry `.*evil\.txt` climbs out"):
        unpack(archive, tmp_path / "target")
    assert [path.name for path in tmp_path.iterdir()] == ["hostile.zip"]


def test_links_in_archives_are_refused(tmp_path: Path) -> None:
    entry = zipfile.ZipInfo("link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "hostile.zip", "w") as file:
        file.writestr(entry, "/etc/passwd")
    with pytest.raises(DownloadError, match="entry `link` is a link"):
        unpack(tmp_path / "hostile.zip", tmp_path / "target")
    assert not (tmp_path / "target").exists()


def test_files_at_the_top_of_an_archive(tmp_path: Path) -> None:
    (tmp_path / "flat.zip").write_bytes(_entries(**{"rgb.txt": b"0 a", "rgb/a.png": b"x"}))
    unpack(tmp_path / "flat.zip", tmp_path / "target")
    assert (tmp_path / "target" / "rgb" / "a.png").read_bytes() == b"x"
