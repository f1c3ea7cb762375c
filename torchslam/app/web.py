"""The HTTP part of the page: who may use it, uploads that go to disk, downloads, and the connection to the viewer."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import viser
import websockets
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from torchslam.app.jobs import shown, stored_name
from torchslam.errors import ResultsError, TorchslamError

UPLOADS = ".uploads"  # folder of what is being uploaded, and of what waits for its start
COOKIE = "torchslam-token"
SECRET = "x-torchslam-secret"  # header of the connection from here to the viewer
LOCAL = ("localhost", "127.0.0.1", "[::1]")  # names of this computer
MAX_FILES = 10_000  # of one upload: photos of a walk
MAX_TABS = 100  # connections to the viewer at the same time
MAX_OPEN = 20  # uploads that were begun and neither ended nor started
FREE = 1 << 30  # bytes of the disk that uploads leave free
STALE_S = 24 * 3600.0  # seconds after which an upload that was never started is deleted; tried at a day only
PROTECTION = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    # The viewer is one page with its scripts in it; it may fetch nothing from elsewhere.
    "content-security-policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; worker-src blob:; "
    "connect-src 'self' ws: wss: data: blob:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
}


class Guard:
    """Lets in what comes from the page itself, and from users who have the token if one is needed.

    A page of another origin cannot use the server: its requests have another Origin or Sec-Fetch-Site. A name that
    leads to this computer by DNS is no name of the server, unless a token is needed, which no other page has.
    """

    def __init__(self, inner: ASGIApp, token: str = "") -> None:
        self._inner, self._token = inner, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is None:
            await self._inner(scope, receive, _protected(send))
        elif scope["type"] == "http":
            await refusal(scope, receive, _protected(send))
        else:
            await receive()  # the request to connect
            await send({"type": "websocket.close", "code": 1008})

    def _refusal(self, scope: Scope) -> Response | None:
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        host = headers.get("host", "")
        if not self._token and _without_port(host) not in LOCAL:
            return JSONResponse({"error": "not a name of this computer: open http://localhost"}, 403)
        if (origin := headers.get("origin")) is not None and urlsplit(origin).netloc != host:
            return JSONResponse({"error": "a page of another origin may not use this one"}, 403)
        is_opened = scope["path"] == "/" and headers.get("sec-fetch-mode") == "navigate"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and not is_opened:
            return JSONResponse({"error": "a page of another origin may not use this one"}, 403)
        if not self._token or self._is_known(headers.get("cookie", "")):
            return None
        if scope["type"] == "http" and scope["path"] == "/" and scope["method"] == "GET":
            given = Request(scope).query_params.get("token", "")
            if secrets.compare_digest(given.encode(), self._token.encode()):
                welcome = RedirectResponse("/", 303)
                welcome.set_cookie(COOKIE, self._token, httponly=True, samesite="lax")
                return welcome
        return JSONResponse(
            {"error": "the token is missing or wrong: open the address that the server printed"}, 401
        )

    def _is_known(self, cookies: str) -> bool:
        with contextlib.suppress(CookieError):
            found = SimpleCookie(cookies).get(COOKIE)
            return found is not None and secrets.compare_digest(found.value.encode(), self._token.encode())
        return False


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return (name if colon and port.isdigit() else host).lower()


def _protected(send: Send) -> Send:
    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            added = [(name.encode(), value.encode()) for name, value in PROTECTION.items()]
            message = message | {"headers": [*message["headers"], *added]}
        await send(message)

    return with_headers


@dataclass
class Upload:
    """Files that are uploaded together.

    Attributes:
        folder: where they are.
        count: number of files that were announced.
        names: how the user calls the files, by position; only to be shown.
        left: bytes that may still come.
        began: seconds of the clock.
    """

    folder: Path
    count: int
    left: int
    names: dict[int, str] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)


class Uploads:
    """Uploads of the page, each in a folder with a random name, until they are started or too old.

    Args:
        folder: of all results.
        limit: bytes of an upload.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self._folder, self._limit = folder / UPLOADS, limit
        shutil.rmtree(self._folder, ignore_errors=True)  # of a server before this one: nothing refers to them
        self._folder.mkdir(parents=True)
        self._open = dict[str, Upload]()

    def begin(self, size: int, count: int) -> str:
        """Begin an upload; return its name. Raises ResultsError if it is too large."""
        for name, each in list(self._open.items()):
            if time.monotonic() - each.began > STALE_S:
                self.discard(name)
        if not 0 < count <= MAX_FILES:
            raise ResultsError(f"{count} files: from 1 to {MAX_FILES} can be uploaded together")
        if size > self._limit:
            raise ResultsError(f"{size} bytes, more than the {self._limit} that are accepted (--max-upload)")
        if size + FREE > shutil.disk_usage(self._folder).free:
            raise ResultsError("the disk of the server has not enough space")
        if len(self._open) >= MAX_OPEN:
            self.discard(min(self._open, key=lambda name: self._open[name].began))
        name = secrets.token_hex(16)
        folder = self._folder / name
        folder.mkdir()
        self._open[name] = Upload(folder, count, min(max(size, 0), self._limit))
        return name

    def file(self, name: str, position: int, called: str) -> Path:
        """Where a file of an upload is written. Raises ResultsError for one that was not announced."""
        upload = self._found(name)
        if not 0 <= position < upload.count or position in upload.names:
            raise ResultsError("no such file was announced")
        upload.names[position] = shown(called)
        stem = "input" if upload.count == 1 else f"{position:05d}"
        return upload.folder / stored_name(called, stem)

    def take(self, name: str, size: int) -> None:
        """Count bytes that came. Raises ResultsError if they are more than were announced."""
        upload = self._found(name)
        upload.left -= size
        if upload.left < 0:
            raise ResultsError("more bytes than were announced")

    def end(self, name: str) -> tuple[Path, str]:
        """End an upload: the file or folder that came, and how it is called. Raises ResultsError if some is missing."""
        upload = self._found(name)
        found = sorted(upload.folder.iterdir())
        if len(upload.names) != upload.count or len(found) != upload.count or upload.left:
            raise ResultsError("the upload is not complete: try it again")
        if upload.count == 1:
            return found[0], upload.names[0]
        folder = upload.folder / "input"
        folder.mkdir()
        for each in found:
            each.rename(folder / each.name)
        return folder, f"{upload.count} images from {upload.names[0]}"

    def discard(self, name: str) -> None:
        """Delete an upload with its files."""
        upload = self._open.pop(name, None)
        if upload is not None:
            shutil.rmtree(upload.folder, ignore_errors=True)

    def _found(self, name: str) -> Upload:
        if name not in self._open:
            raise ResultsError("no such upload: begin it again")
        return self._open[name]


class Handlers(NamedTuple):
    """What the page does; each may take long and raise TorchslamError, whose words are shown.

    Attributes:
        received: an upload of a kind has ended: the file or folder, and how it is called.
        taken: write an export of a run, by their names; returns the file and the name under which it is saved.
        picture: the file of the picture of a run; None without one.
    """

    received: Callable[[str, Path, str], None]
    taken: Callable[[str, str], tuple[Path, str]]
    picture: Callable[[str], Path | None]


def application(viewer: viser.ViserServer, uploads: Uploads, handlers: Handlers, token: str = "") -> Guard:
    """The page, its uploads and downloads."""
    secret, tabs = secrets.token_hex(32), set[int]()
    _only_with(viewer, secret)
    home = files("viser") / "client" / "build" / "index.html"
    page = home.read_text(encoding="utf-8").replace("<head>", '<head><script src="/page.js"></script>', 1)
    script = (files("torchslam.app") / "page.js").read_text(encoding="utf-8")

    async def index(request: Request) -> Response:
        return HTMLResponse(page)

    async def page_script(request: Request) -> Response:
        return Response(script, media_type="text/javascript")

    async def begin(request: Request) -> Response:
        size, count = (_number(request.query_params.get(name, "")) for name in ("size", "count"))
        return JSONResponse({"id": uploads.begin(size, count)})

    async def piece(request: Request) -> Response:
        name = request.path_params["id"]
        path = uploads.file(name, request.path_params["position"], request.query_params.get("name", ""))
        try:
            with path.open("xb") as file:
                async for chunk in request.stream():
                    uploads.take(name, len(chunk))
                    await run_in_threadpool(file.write, chunk)
        except BaseException:
            uploads.discard(name)
            raise
        return JSONResponse({})

    async def end(request: Request) -> Response:
        name = request.path_params["id"]
        try:
            path, called = uploads.end(name)
            await run_in_threadpool(handlers.received, request.query_params.get("kind", ""), path, called)
        except BaseException:
            uploads.discard(name)
            raise
        return JSONResponse({})

    async def take(request: Request) -> Response:
        run, kind = request.path_params["run"], request.path_params["kind"]
        await run_in_threadpool(handlers.taken, run, kind)
        return JSONResponse({"address": f"/runs/{run}/{kind}"})

    async def download(request: Request) -> Response:
        path, name = await run_in_threadpool(
            handlers.taken, request.path_params["run"], request.path_params["kind"]
        )
        return FileResponse(path, filename=name, media_type="application/octet-stream")

    async def picture(request: Request) -> Response:
        path = handlers.picture(request.path_params["run"])
        return Response(status_code=404) if path is None else FileResponse(path)

    async def relay(browser: WebSocket) -> None:
        """Connect a browser to the viewer, which accepts connections from here alone."""
        if len(tabs) >= MAX_TABS:
            await browser.close(1013)
            return
        tabs.add(id(browser))
        offered = [Subprotocol(each) for each in browser.scope.get("subprotocols", ())]
        try:
            async with connect(
                f"ws://127.0.0.1:{viewer.get_port()}",
                subprotocols=offered or None,
                additional_headers={SECRET: secret},
                max_size=None,
                compression=None,
                proxy=None,
            ) as inner:
                await browser.accept(inner.subprotocol)
                await _relay(browser, inner)
        except websockets.exceptions.WebSocketException:
            with contextlib.suppress(RuntimeError):  # it is closed already
                await browser.close(1011)
        finally:
            tabs.discard(id(browser))

    async def refused(request: Request, error: Exception) -> Response:
        words = error.strerror if isinstance(error, OSError) else str(error)
        return JSONResponse({"error": words or type(error).__name__}, 422)

    async def vanished(request: Request, error: Exception) -> Response:
        return JSONResponse({"error": "the connection was lost"}, 400)

    routes: list[Any] = [
        Route("/", index),
        Route("/page.js", page_script),
        Route("/uploads", begin, methods=["POST"]),
        Route("/uploads/{id}/{position:int}", piece, methods=["PUT"]),
        Route("/uploads/{id}/end", end, methods=["POST"]),
        Route("/runs/{run}/picture", picture),
        Route("/runs/{run}/{kind}", take, methods=["POST"]),
        Route("/runs/{run}/{kind}", download),
        WebSocketRoute("/", relay),
    ]
    errors: dict[Any, Any] = {TorchslamError: refused, OSError: refused, ClientDisconnect: vanished}
    return Guard(Starlette(routes=routes, exception_handlers=errors), token)


def _number(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 15:
        raise ResultsError("not a number")
    return int(text)


def _only_with(viewer: viser.ViserServer, secret: str) -> None:
    """Make the viewer refuse connections without the secret, and all that this page does not use.

    Its own server listens at this computer alone, but pages of other origins and other users reach it there. A client
    may also ask it for a public address, or send it files, which it keeps in memory.
    """
    inner = viewer._websock_server

    @inner.on_client_connect
    async def check(connection: Any) -> None:
        request = inner._live_connections[connection.client_id].request
        if not secrets.compare_digest(request.headers.get(SECRET, ""), secret):
            await inner._live_connections[connection.client_id].close(1008)

    for message in ("ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload", "FileTransferPart"):
        inner.unregister_handler(getattr(viser._messages, message))
    inner.disconnect_all_clients()  # those that came before


async def _relay(browser: WebSocket, inner: Any) -> None:
    async def to_viewer() -> None:
        while True:
            message = await browser.receive()
            if message["type"] == "websocket.disconnect":
                return
            await inner.send(message.get("bytes") or message.get("text") or b"")

    async def to_browser() -> None:
        async for message in inner:
            await (browser.send_text(message) if isinstance(message, str) else browser.send_bytes(message))

    tasks = [asyncio.create_task(each()) for each in (to_viewer, to_browser)]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        found = await asyncio.gather(*tasks, return_exceptions=True)
    expected = (
        asyncio.CancelledError,
        WebSocketDisconnect,
        websockets.exceptions.WebSocketException,
        RuntimeError,
    )
    for each in found:
        if isinstance(each, BaseException) and not isinstance(each, expected):
            raise each
