"""The HTTP part of the page: who may use it, uploads that go to disk, downloads, and the connection to the viewer."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import shutil
import time
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import viser
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from torchslam.app.exports import check_disk
from torchslam.app.jobs import INPUT, shown, stored_name
from torchslam.errors import ResultsError, TorchslamError

if TYPE_CHECKING:
    from torchslam.app.panel import Panel

UPLOADS = ".uploads"  # folder of what is being uploaded, and of what waits for its start
# Of users, and of the connection from here to the viewer.
COOKIE, SECRET = "torchslam-token", "x-torchslam-secret"
LOCAL = ("localhost", "127.0.0.1", "[::1]")  # names of this computer
MAX_FILES = 10_000  # of one upload: photos of a walk
MAX_TABS = 100  # connections to the viewer at the same time
MAX_OPEN = 20  # uploads that were begun and not started: the oldest is deleted before another one
PROTECTION = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    # The viewer is one page with its scripts in it; it fetches nothing from elsewhere.
    "content-security-policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; worker-src blob:; "
    "connect-src 'self' data: blob:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
}
OTHER_ORIGIN = "a page of another origin may not use this one"


class Guard:
    """Lets in what comes from the page itself, and from users who have the token if one is needed.

    Requests of a page of another origin have another Origin or Sec-Fetch-Site. A name that leads to this computer by
    DNS is no name of the server, unless a token is needed, which no other page has.
    """

    def __init__(self, inner: ASGIApp, token: str = "") -> None:
        self._inner, self._token = inner, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""

        async def protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                added = [(name.encode(), value.encode()) for name, value in PROTECTION.items()]
                message = message | {"headers": [*message["headers"], *added]}
            await send(message)

        refusal = self._refusal(scope) if scope["type"] in ("http", "websocket") else None
        if refusal is None:
            await self._inner(scope, receive, protected)
        elif scope["type"] == "http":
            await refusal(scope, receive, protected)
        else:
            await receive()  # the request to connect
            await send({"type": "websocket.close", "code": 1008})

    def _refusal(self, scope: Scope) -> Response | None:
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        host, site = headers.get("host", ""), headers.get("sec-fetch-site", "none")
        name, colon, port = host.rpartition(":")
        if not self._token and (name if colon and port.isdigit() else host).lower() not in LOCAL:
            return JSONResponse({"error": "not a name of this computer: open http://localhost"}, 403)
        if (origin := headers.get("origin")) is not None and urlsplit(origin).netloc != host:
            return JSONResponse({"error": OTHER_ORIGIN}, 403)
        is_opened = scope["path"] == "/" and headers.get("sec-fetch-mode") == "navigate"
        if site not in ("none", "same-origin") and not is_opened:
            return JSONResponse({"error": OTHER_ORIGIN}, 403)
        if not self._token or self._is_right(_cookie(headers.get("cookie", ""))):
            return None
        if (
            scope["type"] == "http"
            and scope["path"] == "/"
            and self._is_right(Request(scope).query_params.get("token"))
        ):
            welcome = RedirectResponse("/", 303)
            welcome.set_cookie(COOKIE, self._token, httponly=True, samesite="lax")
            return welcome
        return JSONResponse(
            {"error": "token missing or wrong: open the address that the server printed"}, 401
        )

    def _is_right(self, token: str | None) -> bool:
        return secrets.compare_digest((token or "").encode(), self._token.encode())


def _cookie(header: str) -> str:
    with contextlib.suppress(CookieError):
        found = SimpleCookie(header).get(COOKIE)
        return "" if found is None else found.value
    return ""


@dataclass
class Upload:
    """Files that are uploaded together: their folder, number, names as the user calls them, and bytes that may come."""

    folder: Path
    count: int
    left: int
    names: dict[int, str] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)


class Uploads:
    """Uploads of at most `limit` bytes below a folder, each with a random name, until they are started."""

    def __init__(self, folder: Path, limit: int) -> None:
        self._folder, self._limit = folder / UPLOADS, limit
        shutil.rmtree(self._folder, ignore_errors=True)  # of a server before this one: nothing refers to them
        self._folder.mkdir(parents=True)
        self._open = dict[str, Upload]()

    def begin(self, size: str, count: str) -> str:
        """Begin an upload; return its name. Raises ResultsError if it is too large."""
        if not all(each.isascii() and each.isdigit() and len(each) < 16 for each in (size, count)):
            raise ResultsError("the size of the upload is missing")
        if not 0 < int(count) <= MAX_FILES:
            raise ResultsError(f"{count} files: from 1 to {MAX_FILES} can be uploaded together")
        if int(size) > self._limit:
            raise ResultsError(f"{size} bytes, more than the {self._limit} that are accepted (--max-upload)")
        check_disk(self._folder, int(size))
        if len(self._open) >= MAX_OPEN:
            self.discard(min(self._open, key=lambda name: self._open[name].began))
        name = secrets.token_hex(16)
        self._open[name] = Upload(self._folder / name, int(count), int(size))
        self._open[name].folder.mkdir()
        return name

    def file(self, name: str, position: int, called: str) -> Path:
        """Where a file of an upload is written. Raises ResultsError for one that was not announced."""
        upload = self._open.get(name)
        if upload is None or not 0 <= position < upload.count or position in upload.names:
            raise ResultsError("no such file was announced: begin the upload again")
        upload.names[position] = shown(called)
        return upload.folder / stored_name(called, INPUT if upload.count == 1 else f"{position:05d}")

    def take(self, name: str, size: int) -> None:
        """Count bytes that came. Raises ResultsError if they are more than were announced."""
        upload = self._open.get(name)
        if upload is None or upload.left < size:
            raise ResultsError("more bytes than were announced")
        upload.left -= size

    def end(self, name: str) -> tuple[Path, str]:
        """End an upload: the file or folder that came, and how it is called. Raises ResultsError if some is missing."""
        upload = self._open.get(name)
        found = [] if upload is None else sorted(upload.folder.iterdir())
        if upload is None or len(upload.names) != upload.count or len(found) != upload.count or upload.left:
            raise ResultsError("the upload is not complete: try it again")
        if upload.count == 1:
            return found[0], upload.names[0]
        folder = upload.folder / INPUT
        folder.mkdir()
        for each in found:
            each.rename(folder / each.name)
        return folder, f"{upload.names[0]} and {upload.count - 1} more"

    def discard(self, name: str) -> None:
        """Delete an upload with its files."""
        upload = self._open.pop(name, None)
        if upload is not None:
            shutil.rmtree(upload.folder, ignore_errors=True)


def application(viewer: viser.ViserServer, uploads: Uploads, page: Panel, token: str = "") -> Guard:
    """The page, its uploads and downloads."""
    secret, tabs = secrets.token_hex(32), set[int]()
    _accept_only(viewer, secret)
    home = (files("viser") / "client" / "build" / "index.html").read_text(encoding="utf-8")
    home = home.replace("<head>", '<head><script src="/page.js"></script>', 1)
    script = (files("torchslam.app") / "page.js").read_text(encoding="utf-8")

    async def begin(request: Request) -> Response:
        size, count = (request.query_params.get(name, "") for name in ("size", "count"))
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
            await run_in_threadpool(page.received, request.query_params.get("kind", ""), path, called)
        except BaseException:
            uploads.discard(name)
            raise
        return JSONResponse({})

    async def take(request: Request) -> Response:
        run, kind = request.path_params["run"], request.path_params["kind"]
        path = await run_in_threadpool(page.taken, run, kind)
        if request.method == "POST":  # written, to be fetched
            return JSONResponse({"address": request.url.path})
        return FileResponse(path, filename=f"{run}-{path.name}", media_type="application/octet-stream")

    async def picture(request: Request) -> Response:
        return FileResponse(page.picture(request.path_params["run"]))

    async def relay(browser: WebSocket) -> None:
        """Connect a browser to the viewer, which accepts connections from here alone."""
        tabs.add(id(browser))
        offered = [Subprotocol(each) for each in browser.scope["subprotocols"]]
        address, headers = f"ws://127.0.0.1:{viewer.get_port()}", {SECRET: secret}
        options: dict[str, Any] = {"max_size": None, "compression": None, "proxy": None}
        try:
            if len(tabs) > MAX_TABS:
                await browser.close(1013)
                return
            async with connect(
                address, subprotocols=offered or None, additional_headers=headers, **options
            ) as inner:
                await browser.accept(inner.subprotocol)
                await _relay(browser, inner)
        except WebSocketException:
            with contextlib.suppress(RuntimeError):  # it is closed already
                await browser.close(1011)
        finally:
            tabs.discard(id(browser))

    async def refused(request: Request, error: Exception) -> Response:
        words = error.strerror if isinstance(error, OSError) else str(error)
        return JSONResponse({"error": words or "the connection was lost"}, 422)

    routes: list[Any] = [
        Route("/", lambda _: Response(home, media_type="text/html")),
        Route("/page.js", lambda _: Response(script, media_type="text/javascript")),
        Route("/uploads", begin, methods=["POST"]),
        Route("/uploads/{id}/{position:int}", piece, methods=["PUT"]),
        Route("/uploads/{id}/end", end, methods=["POST"]),
        Route("/runs/{run}/picture", picture),
        Route("/runs/{run}/{kind}", take, methods=["GET", "POST"]),
        WebSocketRoute("/", relay),
    ]
    errors: dict[Any, Any] = dict.fromkeys((TorchslamError, OSError, ClientDisconnect), refused)
    return Guard(Starlette(routes=routes, exception_handlers=errors), token)


def _accept_only(viewer: viser.ViserServer, secret: str) -> None:
    """Make the viewer refuse connections without the secret, and messages that this page does not use.

    Its own server listens at this computer alone, but pages of other origins and other users reach it there. A client
    could also ask it for a public address, or send it files, which it keeps in memory.
    """
    inner = viewer._websock_server

    @inner.on_client_connect
    async def check(connection: Any) -> None:
        opened = inner._live_connections[connection.client_id]
        if not secrets.compare_digest(opened.request.headers.get(SECRET, ""), secret):
            await opened.close(1008)

    for message in ("ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload", "FileTransferPart"):
        inner.unregister_handler(getattr(viser._messages, message))
    inner.disconnect_all_clients()  # those that came before


async def _relay(browser: WebSocket, inner: Any) -> None:
    async def to_viewer() -> None:
        while (message := await browser.receive())["type"] != "websocket.disconnect":
            await inner.send(message.get("bytes") or message.get("text") or b"")

    async def to_browser() -> None:
        async for message in inner:
            await browser.send_bytes(message)

    tasks = [asyncio.create_task(each()) for each in (to_viewer, to_browser)]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
    for found in await asyncio.gather(*tasks, return_exceptions=True):
        # The browser may be gone while something is sent to it.
        if isinstance(found, Exception) and not isinstance(found, WebSocketException | RuntimeError):
            raise found
