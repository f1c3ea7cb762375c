"""The HTTP part of the page: who may use it, uploads that go to disk, downloads, and the connection to the viewer."""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Callable
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import viser
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketClose, WebSocketDisconnect
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from torchslam.app.exports import check_disk, write_export
from torchslam.app.jobs import INPUT, Runs, shown, stored_name, without_paths
from torchslam.errors import ResultsError, TorchslamError
from torchslam.utils.files import parse_json

if TYPE_CHECKING:
    from torchslam.app.panel import Panel

UPLOADS = ".uploads"  # folder of what is being uploaded, and of what waits for its start
# Of users, and of the connection from here to the viewer.
COOKIE, SECRET = "torchslam-token", "x-torchslam-secret"
LOCAL = ("localhost", "127.0.0.1", "[::1]")  # names of this computer
MAX_FILES = 10_000  # photos of a walk that are uploaded together
MAX_LIST = 1 << 22  # bytes of the list of their names
MAX_TABS, MAX_OPEN = 100, 20  # connections to the viewer, and uploads, at the same time
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

        refusal = self._refusal(HTTPConnection(scope)) if scope["type"] in ("http", "websocket") else None
        if refusal is not None and scope["type"] == "websocket":
            refusal = WebSocketClose(1008)
        await (refusal or self._inner)(scope, receive, protected)

    def _refusal(self, asked: HTTPConnection) -> ASGIApp | None:
        host, path = asked.headers.get("host", ""), asked.scope["path"]
        is_opened = path == "/" and asked.headers.get("sec-fetch-mode") == "navigate"
        if not self._token and re.sub(r":\d+$", "", host).lower() not in LOCAL:
            return _error("not a name of this computer: open http://localhost", 403)
        site, origin = (asked.headers.get(name) for name in ("sec-fetch-site", "origin"))
        is_elsewhere = site not in (None, "none", "same-origin") and not is_opened
        if is_elsewhere or (origin is not None and urlsplit(origin).netloc != host):
            return _error("a page of another origin may not use this one", 403)
        if not self._token or self._is_right(asked.cookies.get(COOKIE, "")):
            return None
        if path != "/" or not self._is_right(asked.query_params.get("token", "")):
            return _error("token missing or wrong: open the address that the server printed", 401)
        welcome = RedirectResponse("/", 303)
        welcome.set_cookie(COOKIE, self._token, httponly=True, samesite="lax")
        return welcome

    def _is_right(self, token: str) -> bool:
        return secrets.compare_digest(token.encode(), self._token.encode())


def _error(words: str, status: int = 422) -> Response:
    return JSONResponse({"error": words}, status)


class Uploads:
    """Uploads of at most `limit` bytes in folders of their own below a folder; the last of each kind is kept."""

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder, self._limit = folder / UPLOADS, limit
        shutil.rmtree(self.folder, ignore_errors=True)  # of a server before this one: nothing refers to them
        self.folder.mkdir(parents=True)
        self._announced = dict[str, list[tuple[str, int]]]()
        self._kept = dict[str, Path]()

    def announce(self, content: bytes) -> str:
        """Announce files by JSON, a name and a size in bytes of each; return the name of their upload."""
        try:
            listed = [(str(name), int(size)) for name, size in parse_json(content.decode())]
        except (ValueError, TypeError, OverflowError):
            raise ResultsError("the names and sizes of the files are missing") from None
        if not 0 < len(listed) <= MAX_FILES or min(size for _, size in listed) < 0:
            raise ResultsError(f"{len(listed)} files: from 1 to {MAX_FILES} can be uploaded together")
        total = sum(size for _, size in listed)
        if total > self._limit:
            raise ResultsError(f"{total} bytes, more than the {self._limit} that are accepted (--max-upload)")
        check_disk(self.folder, total)
        if len(self._announced) >= MAX_OPEN:
            del self._announced[next(iter(self._announced))]
        name = secrets.token_hex(16)
        self._announced[name] = listed
        return name

    async def receive(
        self, name: str, kind: str, chunks: AsyncIterator[bytes], take: Callable[[str, Path, str], None]
    ) -> None:
        """Write the files of an upload, which come one after the other, and pass them to the page.

        `take` gets the kind, the file, or the folder of several, and how it is called. Raises TorchslamError if the
        files are not as announced, or cannot be read; then they are deleted.
        """
        listed, folder = self._announced.pop(name, None), self.folder / name
        if listed is None or len(list(self.folder.iterdir())) >= MAX_OPEN:
            raise ResultsError("no such upload was announced, or too many go on: begin it again")
        try:
            path, called = await _written(listed, folder, chunks)
            await run_in_threadpool(take, kind, path, called)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        if kind in self._kept:
            shutil.rmtree(self._kept[kind], ignore_errors=True)  # a run may have taken its files
        self._kept[kind] = folder


async def _written(
    listed: list[tuple[str, int]], folder: Path, chunks: AsyncIterator[bytes]
) -> tuple[Path, str]:
    called, is_several = shown(listed[0][0]), len(listed) > 1
    path = folder / (INPUT if is_several else stored_name(listed[0][0]))
    (path if is_several else folder).mkdir(parents=True)
    rest = b""
    for number, (name, left) in enumerate(listed):
        with (path / stored_name(name, f"{number:05d}") if is_several else path).open("xb") as file:
            while left:
                rest = rest or await anext(chunks, b"")
                if not rest:
                    raise ResultsError("the upload is not complete: try it again")
                await run_in_threadpool(file.write, rest[:left])
                left, rest = left - len(rest[:left]), rest[left:]
    if rest or await anext(chunks, b""):
        raise ResultsError("more bytes than were announced")
    return path, f"{called} and {len(listed) - 1} more" if is_several else called


def application(
    viewer: viser.ViserServer, runs: Runs, uploads: Uploads, page: Panel, token: str = ""
) -> Guard:
    """The page, its uploads and downloads."""
    secret, tabs = secrets.token_hex(32), asyncio.Semaphore(MAX_TABS)
    _accept_only(viewer, secret)
    home = (files("viser") / "client" / "build" / "index.html").read_text(encoding="utf-8")
    home = home.replace("<head>", '<head><script src="/page.js"></script>', 1)
    scripts = (files("torchslam.io") / "viewer" / "detail.js", files("torchslam.app") / "page.js")
    script = "".join(each.read_text(encoding="utf-8") for each in scripts)

    async def announce(request: Request) -> Response:
        content = b""
        async for chunk in request.stream():
            content += chunk
            if len(content) > MAX_LIST:
                raise ResultsError("the list of files is too long")
        return JSONResponse({"id": uploads.announce(content)})

    async def receive(request: Request) -> Response:
        kind = request.query_params.get("kind", "")
        await uploads.receive(request.path_params["id"], kind, request.stream(), page.received)
        return JSONResponse({})

    async def take(request: Request) -> Response:
        run, kind = request.path_params["run"], request.path_params["kind"]
        path = await run_in_threadpool(write_export, runs.path(run), kind)
        if request.method == "POST":  # written, to be fetched
            return JSONResponse({"address": request.url.path})
        return FileResponse(path, filename=f"{run}-{path.name}")  # to be stored, not shown

    async def relay(browser: WebSocket) -> None:
        """Connect a browser to the viewer, which accepts connections from here alone."""
        offered = [Subprotocol(each) for each in browser.scope["subprotocols"]]
        options: dict[str, Any] = {"max_size": None, "compression": None, "proxy": None}
        options |= {"subprotocols": offered or None, "additional_headers": {SECRET: secret}}
        if tabs.locked():
            await browser.close(1013)
            return
        # Either of both may be gone while the other one sends.
        with contextlib.suppress(WebSocketException, WebSocketDisconnect, RuntimeError):
            async with tabs, connect(f"ws://127.0.0.1:{viewer.get_port()}", **options) as inner:
                await browser.accept(inner.subprotocol)

                async def to_viewer() -> None:
                    while (message := await browser.receive())["type"] != "websocket.disconnect":
                        await inner.send(message.get("bytes") or message.get("text") or b"")
                    await inner.close()

                sending = asyncio.create_task(to_viewer())
                try:
                    async for message in inner:
                        await browser.send_bytes(message)
                finally:
                    sending.cancel()

    async def refused(request: Request, error: Exception) -> Response:
        words = error.strerror if isinstance(error, OSError) else str(error)
        return _error(without_paths(words or "the connection was lost", runs.folder))

    routes: list[Any] = [
        Route("/", lambda _: Response(home, media_type="text/html")),
        Route("/page.js", lambda _: Response(script, media_type="text/javascript")),
        Route("/uploads", announce, methods=["POST"]),
        Route("/uploads/{id}", receive, methods=["PUT"]),
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
