"""What the page must refuse: other origins and names, wrong tokens, hostile names, archives, uploads and tabs."""

from __future__ import annotations

import asyncio
import http.client
import io
import json
import os
import re
import socket
import stat
import zipfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from tests.app.conftest import Server, start_server, stop_server, wait_until

viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'torchslam[app]'")
websockets = pytest.importorskip("websockets")
PROTOCOL = f"viser-v{viser.__version__}"
HOSTILE_NAMES = [
    *(
        "../../x.mp4",
        "/etc/passwd",
        "..\\..\\x.zip",
        "C:\\Windows\\x.mp4",
        "a\0b.mp4",
        "\r\nSet-Cookie: x",
        ".htaccess",
    ),
    *(
        "<script>alert(1)</script>.mp4",
        "{constructor.constructor('alert(1)')()}",
        "%2e%2e%2fx",
        "~root",
        "-rf",
        "|id",
    ),
    *(
        "$(id).mp4",
        "`id`.mp4",
        ";id.mp4",
        "a" * 4000,
        "\u202egnp.exe",
        "\ud7ff\ufffe.mp4",
        " ",
        ".",
        "..",
        "con.mp4",
    ),
    *(
        "x.mp4/../../y",
        "rtsp://host/stream",
        "synthetic:room",
        "0",
        "x.%d.png",
        "*.png",
        "input.mp4\n",
        "👻.zip",
    ),
]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server for other computers, with a token, and with small limits."""
    options = ("--host", "0.0.0.0", "--max-upload", "1M", "--max-runs", "2")
    running = start_server(tmp_path_factory.mktemp("guarded") / "results", *options)
    yield running
    stop_server(running)


def ask(
    server: Server, method: str, path: str, body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Send a request with exactly these headers, beside those of the body; return status, headers and content."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in ({"host": f"localhost:{server.port}"} | headers).items():
            connection.putheader(name.replace("_", "-"), value)
        if body is not None:
            connection.putheader("content-length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, {key.lower(): value for key, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def announce(server: Server, *files: tuple[str, int]) -> str:
    status, _, content = ask(server, "POST", "/uploads", json.dumps(files).encode())
    assert status == 200, content
    return str(json.loads(content)["id"])


def send(server: Server, upload: str, content: bytes, kind: str = "recording") -> tuple[int, str]:
    status, _, answer = ask(server, "PUT", f"/uploads/{upload}?kind={kind}", content)
    return status, answer.decode()


def works(server: Server) -> bool:
    status, _, content = ask(server, "GET", "/page.js")
    return status == 200 and b"upload" in content


async def websocket(server: Server, **headers: str) -> bool:
    """Whether a connection to the viewer is accepted and gets something."""
    try:
        async with websockets.connect(
            f"ws://127.0.0.1:{server.port}/",
            subprotocols=[PROTOCOL],
            additional_headers=[(name, value) for name, value in headers.items() if name != "host"],
            proxy=None,
            max_size=None,
        ) as connection:
            return bool(await asyncio.wait_for(connection.recv(), 20))
    except (websockets.exceptions.WebSocketException, TimeoutError, OSError):
        return False


def test_requests_of_other_origins_and_by_other_names_are_refused(server: Server) -> None:
    paths = [
        ("GET", "/"),
        ("GET", "/page.js"),
        ("POST", "/uploads"),
        ("POST", "/runs/x/colmap"),
    ]
    port, tried = server.port, 0
    origins = [
        "http://evil.example",
        "null",
        "http://localhost:1",
        f"http://localhost.evil.example:{port}",
        "file://",
        "",
    ]
    hosts = [
        "evil.example",
        f"evil.example:{port}",
        "localhost.evil.example",
        "127.0.0.1.nip.io",
        "",
        "169.254.169.254",
    ]
    for method, path in paths:
        for headers in [{"origin": each} for each in origins] + [{"host": each} for each in hosts]:
            assert ask(server, method, path, b"", **headers)[0] == 403, (path, headers)
            tried += 1
        for site in ("cross-site", "same-site"):
            assert ask(server, method, path, b"", sec_fetch_site=site)[0] == 403
            tried += 1
    for origin in origins:
        assert not asyncio.run(websocket(server, origin=origin)), origin
        tried += 1
    assert tried == 62
    assert asyncio.run(websocket(server, origin=f"http://127.0.0.1:{port}"))
    status, headers, _ = ask(
        server, "GET", "/", sec_fetch_site="cross-site", sec_fetch_mode="navigate"
    )  # a link
    assert status == 200
    assert headers["x-frame-options"] == "DENY"
    assert "unsafe-eval'" not in headers["content-security-policy"].replace("wasm-unsafe-eval'", "")


def test_without_the_token_nothing_is_answered(guarded: Server) -> None:
    wrong = [
        "",
        "x",
        guarded.token[:-1],
        guarded.token + "x",
        guarded.token.swapcase(),
        "\xe9",
        "a" * 5000,
        "%00",
    ]
    for token in wrong:
        assert ask(guarded, "GET", f"/?token={quote(token)}")[0] == 401
        cookie = f"torchslam-token={token}".encode("latin-1").decode("latin-1")
        for method, path in (("GET", "/"), ("POST", "/uploads"), ("GET", "/runs/x/colmap")):
            assert ask(guarded, method, path, b"", cookie=cookie)[0] == 401, (token, path)
    assert not asyncio.run(websocket(guarded))
    assert ask(guarded, "POST", f"/uploads?token={guarded.token}", b"")[0] == 401  # only the page itself
    status, headers, _ = ask(guarded, "GET", f"/?token={guarded.token}", host="any.name")
    assert status == 303
    assert headers["location"] == "/"
    assert "HttpOnly" in headers["set-cookie"]
    cookie = headers["set-cookie"].partition(";")[0]
    assert ask(guarded, "GET", "/", cookie=cookie, host="any.name")[0] == 200
    assert ask(guarded, "POST", "/uploads", b'[["a.mp4", 2000000]]', cookie=cookie)[0] == 422  # --max-upload
    assert ask(guarded, "GET", "/", cookie=cookie, origin="http://evil.example")[0] == 403


def test_names_of_runs_and_exports_are_never_paths(server: Server) -> None:
    (server.folder.parent / "metrics.json").write_text("{}")  # the folder above looks like a run
    names = [
        "..",
        "%2e%2e",
        "..%2f..",
        "%2e%2e%2f",
        "a%00b",
        "%ff",
        "%ed%a0%80",
        ".",
        "*",
        "~",
        "%2fetc",
        ".uploads",
    ]
    for name in names:
        for kind in ("picture", "all", "ply", "..%2f..%2fmetrics.json", "%2e%2e"):
            status, _, content = ask(server, "GET", f"/runs/{name}/{kind}")
            assert status in (404, 405, 422), (name, kind, status)
            assert str(server.folder).encode() not in content
    assert works(server)


def test_hostile_names_of_files_are_stored_as_plain_ones(server: Server) -> None:
    def elsewhere() -> set[Path]:
        return {each for each in server.folder.parent.rglob("*") if ".uploads" not in each.parts}

    before = elsewhere()
    for name in HOSTILE_NAMES:
        upload = announce(server, (name, 1))
        status, answer = send(server, upload, b"x", "gps")
        assert status == 200, (name, answer)
        (stored,) = (server.folder / ".uploads" / upload).iterdir()
        assert stored.name.isascii()
        assert stored.name.startswith("gps")
        status, answer = send(server, announce(server, (name, 1), (name, 1)), b"xx", "gps")
        assert status == 422, name  # a run would have one
        assert "several" in answer
    assert elsewhere() == before
    assert len(list((server.folder / ".uploads").iterdir())) == 1  # those before it are deleted


def test_hostile_names_of_several_files_are_stored_as_plain_ones(tmp_path: Path) -> None:
    from torchslam.app.web import Uploads

    uploads, stored = Uploads(tmp_path / "results", 1 << 20), list[str]()

    def take(kind: str, path: Path, called: str) -> None:
        stored.extend(each.name for each in path.iterdir())

    async def chunks() -> AsyncIterator[bytes]:
        yield b"x" * len(HOSTILE_NAMES)

    upload = uploads.announce(json.dumps([(name, 1) for name in HOSTILE_NAMES]).encode())
    asyncio.run(uploads.receive(upload, "recording", chunks(), take))
    assert [name[:5] for name in sorted(stored)] == [f"{number:05d}" for number in range(len(HOSTILE_NAMES))]
    assert all(re.fullmatch(r"\d{5}(\.[a-z0-9]{1,8})?", name) for name in stored)
    assert {each.name for each in tmp_path.iterdir()} == {"results"}


def test_uploads_that_lie_about_themselves_are_refused_and_deleted(server: Server) -> None:
    lists = [
        b"",
        b"{}",
        b"[]",
        b"[1]",
        b'["ab"]',
        b'[["x"]]',
        b'[["x", -1]]',
        b'[["x", "1e9"]]',
        b'[["x", null]]',
        b'[["x", 1e999]]',
    ]
    lists += [
        b"\xff",
        b"[" * 100_000,
        b'[["x", ' + b"9" * 5000 + b"]]",
        json.dumps([["x", 1 << 40]]).encode(),
    ]
    lists += [json.dumps([["x", 1]] * 10_001).encode(), b" " * ((1 << 22) + 1)]
    for content in lists:
        assert ask(server, "POST", "/uploads", content)[0] == 422, content[:40]
    kept = set((server.folder / ".uploads").iterdir())
    for upload in ("nothing", "..", "%2e%2e", "a" * 32):
        assert ask(server, "PUT", f"/uploads/{upload}?kind=gps", b"x")[0] in (404, 405, 422), upload
    for sizes, content in (([3], b"more than three"), ([3], b"ab"), ([3, 2], b"abcd"), ([3, 2], b"")):
        upload = announce(server, *(("a.mp4", size) for size in sizes))
        assert send(server, upload, content, "gps")[0] == 422
        assert send(server, upload, b"x" * sum(sizes), "gps")[0] == 422  # a second time
    upload = announce(server, ("a.mp4", 1000))
    with socket.create_connection(("127.0.0.1", server.port)) as broken:
        head = f"PUT /uploads/{upload}?kind=gps HTTP/1.1\r\nhost: localhost\r\ncontent-length: 1000\r\n\r\n"
        broken.sendall(head.encode() + b"only this")
        wait_until(lambda: any((server.folder / ".uploads" / upload).glob("*")), 20)
    wait_until(lambda: not (server.folder / ".uploads" / upload).exists(), 20)
    assert send(server, announce(server, ("x", 1)), b"x", "../x")[0] == 422
    assert set((server.folder / ".uploads").iterdir()) == kept
    assert works(server)


def archive_of(**members: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name.replace("__", "/").replace("dots", ".."), data)
    return content.getvalue()


def link_archive() -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        link = zipfile.ZipInfo("0.png")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    return content.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        archive_of(dots__dots__escaped=b"x"),
        archive_of(**{"__tmp__torchslam-escaped.png": b"x"}),
        link_archive(),
        archive_of(**{"0.png": bytes(400_000_000)}),
        archive_of(**{"0.png": b"x"})[:-30],
        b"PK\x03\x04 no archive",
    ],
    ids=["parent", "absolute", "link", "bomb", "truncated", "no archive"],
)
def test_hostile_archives_are_refused_with_the_message_of_the_reader(server: Server, content: bytes) -> None:
    upload = announce(server, ("holiday.zip", len(content)))
    status, answer = send(server, upload, content)
    assert status == 422
    assert "holiday.zip" in json.loads(answer)["error"]
    assert str(server.folder) not in answer
    assert not (server.folder / ".uploads" / upload).exists()
    assert not list(server.folder.parent.rglob("*escaped*"))
    assert not Path("/tmp/torchslam-escaped.png").exists()
    assert works(server)


def test_fifty_tabs_and_messages_that_are_none(server: Server) -> None:
    async def many() -> int:
        messages = [os.urandom(200), b"", b"\x81\xa4type\xa1x", b"\xc1", "text", bytes(1 << 20)]
        address, options = (
            f"ws://127.0.0.1:{server.port}/",
            {"subprotocols": [PROTOCOL], "proxy": None, "max_size": None},
        )
        opened = [await websockets.connect(address, **options) for _ in range(50)]
        for number, each in enumerate(opened):
            await each.send(messages[number % len(messages)])
        await asyncio.sleep(1.0)
        answered = await websocket(server)
        for each in opened:
            await each.close()
        return int(answered)

    assert asyncio.run(many()) == 1
    assert works(server)


def test_the_viewer_itself_accepts_no_connection_but_that_of_the_page(tmp_path: Path) -> None:
    from torchslam.app.web import SECRET, Uploads, application

    viewer = viser.ViserServer("127.0.0.1", 0, verbose=False)
    nobody: Any = None
    application(viewer, nobody, Uploads(tmp_path, 1), nobody)

    async def received(**headers: str) -> int:
        address = f"ws://127.0.0.1:{viewer.get_port()}/"
        async with websockets.connect(
            address, subprotocols=[PROTOCOL], additional_headers=headers, proxy=None, max_size=None
        ) as connection:
            with pytest.raises(websockets.exceptions.ConnectionClosed):
                await asyncio.wait_for(connection.recv(), 10)
            return connection.close_code

    try:
        viewer.gui.add_text("secret", "secret")
        for headers in ({}, {SECRET: ""}, {SECRET: "0" * 64}, {"origin": "http://localhost"}):
            assert asyncio.run(received(**headers)) == 1008
    finally:
        viewer.stop()
