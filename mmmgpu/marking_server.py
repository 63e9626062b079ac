"""The local web server behind `mmmgpu mark`: the page, its pictures, and what is marked on it.

It listens to this computer alone, on the loopback address. The page's address holds a random token
without which nothing is answered, and the Host header must be its own, so that no other web page
can reach it (DNS rebinding). Nothing from outside is ever loaded.
"""

import json
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.marking import Session, StaleError, folded_points, warped_onto
from mmmgpu.web_pages import LOOPBACK, strict_headers

LARGEST_BODY = 1_000_000  # bytes of a request
PAGE_FILES = {
    "": ("mark.html", "text/html; charset=utf-8"),
    "mark.css": ("mark.css", "text/css; charset=utf-8"),
    **{
        name: (name, "text/javascript; charset=utf-8")
        for name in ("keeper.js", "mark.js", "marks.js", "view.js")
    },
}
HEADERS = strict_headers(
    {
        "script-src": "'self'",
        "style-src": "'self'",
        "img-src": "'self' blob: data:",
        "connect-src": "'self'",
    }
)
Answer = tuple[str, bytes]  # content type, content
JSON_TYPE, PNG_TYPE = "application/json", "image/png"


class Refusal(Exception):
    """A request that is answered with an HTTP status and one line."""

    def __init__(self, status: HTTPStatus, text: str):
        super().__init__(text)
        self.status = status


class MarkingServer(ThreadingHTTPServer):
    """Serves one `Session` on the loopback address.

    address: what to open in a browser. finished: set when the person is done.
    """

    daemon_threads = True

    def __init__(self, session: Session, *, port: int = 0):
        """Listen to `port`, or to any free one if 0.

        Raises:
            InputError: The port cannot be had.
        """
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"--port {port}: {reason}; choose another, or none") from error
        self.session = session
        self.token = secrets.token_urlsafe(24)
        self.finished = threading.Event()

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}/{self.token}/"

    @property
    def hosts(self) -> set[str]:
        """The Host headers that are its own."""
        return {f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost")}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that closes a connection early is no error."""


@contextmanager
def serving(session: Session, *, port: int = 0) -> Iterator[MarkingServer]:
    """Serve `session` in threads for the time of the block."""
    server = MarkingServer(session, port=port)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Answers one request; connections are not kept, so that none outlives the server."""

    server: MarkingServer
    server_version, sys_version = "mmmgpu", ""
    timeout = 60  # s, of a silent connection

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_PUT(self) -> None:
        self._answer(self._put)

    def do_POST(self) -> None:
        self._answer(self._post)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet: the terminal is for the command."""

    def _answer(self, route: Callable[[list[str]], Answer]) -> None:
        """Send what `route` returns for the path, or the reason why there is nothing."""
        try:
            path = self._admit()
            status, kind, body = HTTPStatus.OK, *route(path)
        except Refusal as refusal:
            status, kind, body = refusal.status, *_json({"error": str(refusal)})
        except StaleError as error:
            status, kind, body = HTTPStatus.CONFLICT, *_json({"error": str(error), "stale": True})
        except InputError as error:
            status, kind, body = HTTPStatus.CONFLICT, *_json({"error": str(error)})
        except Exception as error:  # a defect: the page says so, the points stay
            text = f"{type(error).__name__}: {error} (this is a defect, please report it)"
            status, kind, body = HTTPStatus.INTERNAL_SERVER_ERROR, *_json({"error": text})
        self._send(status, kind, body)
        if route == self._post and status is HTTPStatus.OK and path == ["finish"]:
            self.server.finished.set()

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind, "Content-Length": len(body)}.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(body)

    def _admit(self) -> list[str]:
        """The parts of the path after the token.

        Raises:
            Refusal: The token or the host is wrong.
        """
        token, *parts = self.path.partition("?")[0].lstrip("/").split("/")
        if not secrets.compare_digest(token.encode(), self.server.token.encode()) or not parts:
            raise Refusal(HTTPStatus.FORBIDDEN, "wrong address: use the one that mmmgpu mark said")
        if self.headers.get("Host") not in self.server.hosts:
            raise Refusal(HTTPStatus.FORBIDDEN, "wrong host: use the address mmmgpu mark said")
        return parts

    def _body(self) -> Any:
        """The JSON value of the request."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise Refusal(HTTPStatus.LENGTH_REQUIRED, "the length of the request is missing")
        if int(length) > LARGEST_BODY:
            raise Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too large")
        try:
            return json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            raise Refusal(HTTPStatus.BAD_REQUEST, "the request is not JSON") from None

    def _get(self, path: list[str]) -> Answer:
        session = self.server.session
        match path:
            case [name] if name in PAGE_FILES:
                return _page_file(name)
            case ["state"]:
                return _json(session.describe())
            case ["picture", kind, ("a" | "b") as side] if kind in session.frames:
                return _png(session.frames[kind]["ab".index(side)].picture)
            case ["warped", kind] if kind in session.frames:
                return _png(warped_onto(session.pair(kind), session.frames[kind][0].picture))
            case ["folded", kind] if kind in session.frames:
                return _json({"points": folded_points(session.pair(kind))})
        raise _nothing()

    def _put(self, path: list[str]) -> Answer:
        session = self.server.session
        match path:
            case ["points", kind] if kind in session.frames:
                body = self._body()
                if not isinstance(body, Mapping):
                    raise Refusal(HTTPStatus.BAD_REQUEST, "the request must be a JSON object")
                return _json(session.replace(kind, body.get("points"), body.get("revision")))
        raise _nothing()

    def _post(self, path: list[str]) -> Answer:
        match path:
            case ["save"] | ["finish"]:
                self._body()
                return _json(self.server.session.save())
        raise _nothing()


def _nothing() -> Refusal:
    return Refusal(HTTPStatus.NOT_FOUND, "there is nothing at this address")


def _json(value: Any) -> Answer:
    return JSON_TYPE, json.dumps(value, allow_nan=False).encode()


def _png(picture: NDArray[np.uint8]) -> Answer:
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return PNG_TYPE, cv2.imencode(".png", picture[..., ::-1], options)[1].tobytes()


def _page_file(name: str) -> Answer:
    file, kind = PAGE_FILES[name]
    return kind, resources.files("mmmgpu.marking_page").joinpath(file).read_bytes()
