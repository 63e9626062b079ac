"""The web server behind `mmmgpu study serve`: the blind page, its clips, and the answers.

A participant's address holds a random token, without which nothing is answered. What is shown is
addressed by the number of the pair and the side alone, and no header tells one clip from another.
The server decides which pair is next and keeps the first answer to each; the page only asks. An
answer is in the database before the page hears that it is stored, so that it may be asked to store
one again: after a lost reply, the same choice is confirmed, another one is refused.
"""

import json
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from importlib import resources
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mmmgpu.errors import InputError
from mmmgpu.studies import CHOICES, SIDES, Participant, Place, Study, clip_path
from mmmgpu.study_store import AnswerStore
from mmmgpu.web_pages import strict_headers

LARGEST_BODY = 1000  # bytes of a request
BACKLOG = 1000  # connections that wait to be accepted
KEEP_ALIVE_S = 75  # of a silent connection: longer than a pair takes
CLOSING_S = 1  # for requests that are being answered when the server ends
PAGE_FILES = {"study.css": "text/css", "study.js": "text/javascript"}
HEADERS = strict_headers(
    {
        "script-src": "'self'",
        "style-src": "'self'",
        "media-src": "'self'",
        "connect-src": "'self'",
        "img-src": "data:",
    }
) | {"X-Robots-Tag": "noindex"}
_TELLING = ("etag", "last-modified")  # headers that could tell one clip from another


class StudyPage:
    """Answers the requests of a study's participants."""

    def __init__(self, folder: Place, study: Study, store: AnswerStore):
        """Serve the clips of the study folder and keep answers in `store`."""
        self._folder = folder
        self._introduction = study.introduction
        self._store = store
        self._numbers = {p.token: i for i, p in enumerate(study.participants, start=1)}
        self._participants = study.participants

    def application(self) -> ASGIApp:
        """The ASGI application."""
        routes = [
            Route("/{token}", self.to_page),
            Route("/{token}/", self.page),
            Route("/{token}/state", self.state),
            Route("/{token}/pairs/{pair:int}/answer", self.answer, methods=["POST"]),
            Route("/{token}/pairs/{pair:int}/{side}.mp4", self.clip),
            Route("/{token}/{name}", self.page),
        ]
        handlers: dict[Any, Callable[[Request, Any], Response | Awaitable[Response]]] = {
            HTTPException: _refusal,
            InputError: _unavailable,
        }
        application = Starlette(routes=routes, exception_handlers=handlers)
        application.router.redirect_slashes = False
        return _with_headers(application)

    def page(self, request: Request) -> Response:
        """The page itself, and what belongs to it."""
        self._participant(request)
        name = request.path_params.get("name")
        if name is None:
            return Response(_page_file("study.html"), media_type="text/html")
        if name not in PAGE_FILES:
            raise HTTPException(HTTPStatus.NOT_FOUND, _NOTHING)
        return Response(_page_file(name), media_type=PAGE_FILES[name])

    def to_page(self, request: Request) -> Response:
        """For a link that has lost its last slash; relative, so that it holds behind a proxy."""
        self._participant(request)
        location = {"Location": f"{request.path_params['token']}/"}
        return Response(status_code=HTTPStatus.TEMPORARY_REDIRECT, headers=location)

    def state(self, request: Request) -> Response:
        """What the page needs to know: how far the participant is."""
        number, participant = self._participant(request)
        facts = {"introduction": self._introduction, "pairs": len(participant.pairs)}
        return JSONResponse(facts | {"answered": self._store.count(number)})

    def clip(self, request: Request) -> Response:
        """One side of a pair, whole or in ranges."""
        _, participant = self._participant(request)
        pair = _pair_number(request, participant)
        side = request.path_params["side"]
        if side not in SIDES:
            raise HTTPException(HTTPStatus.NOT_FOUND, _NOTHING)
        clip = participant.pairs[pair - 1].chosen(side)
        assert clip is not None  # it is one of the sides
        return FileResponse(clip_path(self._folder, clip), media_type="video/mp4")

    async def answer(self, request: Request) -> Response:
        """Store the answer to the next pair, or confirm one that is stored."""
        number, participant = self._participant(request)
        pair = _pair_number(request, participant)
        choice = _choice(await _body(request))
        return await run_in_threadpool(self._store_answer, number, pair, choice)

    def _store_answer(self, number: int, pair: int, choice: str) -> Response:
        answered = self._store.count(number)
        if pair > answered + 1:
            line = f"pair {pair} is not shown yet: pair {answered + 1} comes first"
            return _conflict(line, answered)
        stored = self._store.add(number, pair, choice)
        answered = self._store.count(number)
        if stored != choice:
            return _conflict(f"pair {pair} is answered already: the first answer counts", answered)
        return JSONResponse({"answered": answered})

    def _participant(self, request: Request) -> tuple[int, Participant]:
        """The participant whose address it is, with their number."""
        number = self._numbers.get(request.path_params["token"])
        if number is None:
            line = "this address is not known here: use the whole link that you were given"
            raise HTTPException(HTTPStatus.NOT_FOUND, line)
        return number, self._participants[number - 1]


_NOTHING = "there is nothing at this address"


def _pair_number(request: Request, participant: Participant) -> int:
    pair = int(request.path_params["pair"])
    if not 1 <= pair <= len(participant.pairs):
        raise HTTPException(HTTPStatus.NOT_FOUND, f"there is no pair {pair}")
    return pair


async def _body(request: Request) -> Any:
    """The JSON value of the request, which is read no further than is needed."""
    data = b""
    async for chunk in request.stream():
        data += chunk
        if len(data) > LARGEST_BODY:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too large")
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        raise HTTPException(HTTPStatus.BAD_REQUEST, "the request is not JSON") from None


def _choice(value: Any) -> str:
    choice = value.get("choice") if isinstance(value, Mapping) else None
    if choice not in CHOICES:
        line = f"the answer must be one of {', '.join(CHOICES)}"
        raise HTTPException(HTTPStatus.BAD_REQUEST, line)
    return str(choice)


def _conflict(line: str, answered: int) -> Response:
    return JSONResponse({"error": line, "answered": answered}, HTTPStatus.CONFLICT)


def _refusal(request: Request, error: HTTPException) -> Response:
    """One line: as text where a person reads it, as JSON where the page does."""
    if request.path_params.keys() <= {"token"} or request.path_params.get("name"):
        return PlainTextResponse(f"{error.detail}\n", error.status_code)
    return JSONResponse({"error": error.detail}, error.status_code)


def _unavailable(_request: Request, _error: InputError) -> Response:
    """The database fails: nothing is stored, and the page tries again."""
    line = "the answers cannot be stored or read at the moment"
    return JSONResponse({"error": line}, HTTPStatus.SERVICE_UNAVAILABLE)


def _with_headers(application: ASGIApp) -> ASGIApp:
    """`application`, with HEADERS in every answer, and without those that could tell."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        async def strict(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name in _TELLING:
                    del headers[name]
                headers.update(HEADERS)
            await send(message)

        await application(scope, receive, strict)

    return answer


def _page_file(name: str) -> bytes:
    return resources.files("mmmgpu.study_page").joinpath(name).read_bytes()


@contextmanager
def serving(application: ASGIApp, *, host: str, port: int) -> Iterator[int]:
    """Serve an application in a thread for the time of the block; yield the port.

    port: 0: any free one.

    Raises:
        InputError: Host and port cannot be had.
    """
    listener = _listen(host, port)
    settings = uvicorn.Config(
        application,
        log_config=None,
        access_log=False,
        server_header=False,
        ws="none",
        lifespan="off",
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=CLOSING_S,
    )
    server = uvicorn.Server(settings)
    thread = threading.Thread(target=server.run, args=([listener],), name="study", daemon=True)
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family, backlog=BACKLOG)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"--host {host} --port {port}: {reason}; choose others") from error
