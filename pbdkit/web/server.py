"""Server of a live session. It serves one page and a socket, on this machine only.

A browser sends requests to this machine on behalf of any page that it displays. Requests of other
pages are recognised for two reasons: these pages do not have the token, and the browser adds to a
request the origin of the page (Origin) and the name of the server (Host). All viewers share the
session, which runs in a separate thread.
"""

from __future__ import annotations

import asyncio
import json
import logging
import queue
import secrets
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from html import escape
from http import HTTPStatus
from string import Template
from time import monotonic
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit
from weakref import WeakSet

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.web.page import script, source
from pbdkit.web.requests import (
    MAX_COMMAND_BYTES,
    Command,
    PictureReceived,
    Rewind,
    command_of,
    execute,
)
from pbdkit.web.session import Judge, Judgement, Message, Session, static_message, status_message
from pbdkit.web.view_frames import ViewFrame

HOST = "127.0.0.1"
"""Address on which the server listens."""
NAMES = (HOST, "localhost")
"""Names of this server that are accepted in requests."""
Headers = Callable[[str], Sequence[str]]
"""Function that returns all values of a header."""


def new_token() -> str:
    """Return a random token."""
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """Address of the server, with a method that checks requests."""

    port: int
    token: str = field(default_factory=new_token, repr=False)

    @property
    def address(self) -> str:
        """Return the URL of the page."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def refusal(self, target: str, headers: Headers, *, is_socket: bool) -> str:
        """Return the reason why a request is refused, or an empty text. The request for a socket
        contains the origin of the page. The request for a page contains no origin if the user
        entered the address."""
        hosts, origins = headers("Host"), headers("Origin")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "the Host header does not name this server"
        if len(origins) > 1 or any(origin != f"http://{hosts[0]}" for origin in origins):
            return "the page was served by another server"
        if is_socket and not origins:
            return "the Origin header is missing"
        tokens = parse_qs(urlsplit(target).query).get("token", [])
        expected = self.token.encode()
        if len(tokens) != 1 or not secrets.compare_digest(tokens[0].encode(), expected):
            return "the token is missing or wrong; open the address that pbdkit has printed"
        return ""

    @property
    def _hosts(self) -> list[str]:
        return [f"{name}:{self.port}" for name in NAMES]


MIN_PICTURE_INTERVAL_S = 1 / 60
"""Minimum time in seconds between two pictures."""
CLOSE_S = 1.0
"""Time in seconds to wait until the thread of the session ends."""


class Viewer(ABC):
    """One page that shows the session. Its methods are called from the session's thread, and do not
    wait."""

    is_ready = True
    """True if the last picture was acknowledged, so that the next picture may be sent."""
    last_frame: ViewFrame | None = None
    """The frame that was sent last."""

    def awaits(self, picture: int) -> bool:
        """Return whether a picture can be sent, and the picture with the given number has not been
        sent to the viewer yet."""
        return self.is_ready and (self.last_frame is None or self.last_frame.picture != picture)

    @abstractmethod
    def post(self, message: Message) -> None:
        """Send a message other than a picture."""

    @abstractmethod
    def show(self, picture: bytes) -> None:
        """Send the newest picture."""


What = Command | Judgement | Literal["join", "leave", "close"]
ViewerRequest = tuple[Viewer | None, What]


class Conductor:
    """Thread that passes commands to a session and makes steps between the commands. It sends the
    newest picture to each viewer that is ready; pictures are never queued."""

    def __init__(self, session: Session) -> None:
        self._session = session
        session.notify = self._broadcast
        self._viewers: list[Viewer] = []
        self._queue: queue.SimpleQueue[ViewerRequest] = queue.SimpleQueue()
        self._status: Message = {}
        self._judge = Judge(lambda judgement: self._queue.put((None, judgement)))
        self._judged: Any = None
        self._judgement: Message | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="session", daemon=True)

    def start(self) -> None:
        """Start the thread. No steps are made until a viewer starts stepping."""
        self._thread.start()

    def join(self, viewer: Viewer) -> None:
        """Add a viewer to the session."""
        self._queue.put((viewer, "join"))

    def leave(self, viewer: Viewer) -> None:
        """Remove a viewer from the session."""
        self._queue.put((viewer, "leave"))

    def submit(self, viewer: Viewer, command: Command) -> None:
        """Queue a command of a page, to be executed between two steps."""
        self._queue.put((viewer, command))

    def close(self) -> None:
        """End the thread of the session after the steps in progress. If these take longer than
        `CLOSE_S`, the thread ends with the process."""
        self._queue.put((None, "close"))
        self._judge.close()
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _work(self) -> None:
        due = 0.0
        while not self._closed:
            rests = self._session.next_steps == 0
            for viewer, what in self._requests(None if rests else max(0.0, due - monotonic())):
                self._do(viewer, what)
            steps = self._session.next_steps
            if steps and monotonic() >= due and not self._closed:
                due = monotonic() + MIN_PICTURE_INTERVAL_S
                self._try(None, lambda steps=steps: self._session.advance(steps))
            self._try(None, self._publish)

    def _requests(self, seconds: float | None) -> Iterator[ViewerRequest]:
        """Generate the queued requests, after waiting for some time for the first one. Of
        consecutive requests to rewind only the last one is generated."""
        requests: list[ViewerRequest] = []
        try:
            requests.append(self._queue.get(timeout=seconds))
            while True:
                requests.append(self._queue.get_nowait())
        except queue.Empty:
            pass
        for n, (viewer, what) in enumerate(requests):
            later = requests[n + 1][1] if n + 1 < len(requests) else None
            if not (isinstance(what, Rewind) and isinstance(later, Rewind)):
                yield viewer, what

    def _do(self, viewer: Viewer | None, what: What) -> None:
        if what == "close":
            self._closed = True
        elif isinstance(what, Judgement):
            self._judgement = {"is": "judgement", "word": what.word, "why": what.why}
            self._broadcast(self._judgement)
        elif what == "join" and viewer:
            self._viewers.append(viewer)
            for message in (static_message(self._session), self._status, self._judgement):
                if message:
                    viewer.post(message)
        elif what == "leave" and viewer in self._viewers:
            self._viewers.remove(viewer)
            if not self._viewers:  # No viewer is connected.
                self._try(None, self._session.rest)
        elif isinstance(what, PictureReceived) and viewer:
            viewer.is_ready = True
        elif not isinstance(what, str):
            self._try(viewer, lambda: execute(self._session, what))

    def _try(self, viewer: Viewer | None, act: Any) -> None:
        """Execute an action. Errors are reported to the viewer, or to all viewers, and do not end
        the session."""
        try:
            act()
        except PbdkitError as error:
            text = str(error)
        except Exception as error:
            self._session.running, self._session.due_steps = False, 0
            text = f"a bug in pbdkit, please report it: {type(error).__name__}: {error}"
        else:
            return
        message = {"is": "error", "text": text}
        if viewer:
            viewer.post(message)
        else:
            self._broadcast(message)

    def _broadcast(self, message: Message) -> None:
        for viewer in self._viewers:
            viewer.post(message)

    def _publish(self) -> None:
        session = self._session
        if (status := status_message(session)) != self._status:
            self._status = status
            self._broadcast(status)
        values = [number.after(session.step) for number in session.script.numbers.values()]
        if values != self._judged:
            self._judged = values
            self._judge.submit(session.plain())
        viewers = [viewer for viewer in self._viewers if viewer.awaits(session.pictures)]
        frame = session.frame() if viewers else None
        for viewer in viewers:
            assert frame
            viewer.is_ready = False
            picture, viewer.last_frame = frame.encoded(viewer.last_frame), frame
            viewer.show(picture)


MAX_WAITING = 1000
"""Maximum number of messages that wait for a page. A page that does not read them is
disconnected."""
MAX_PAGES = 8
"""Maximum number of connected pages."""
SERVER_CLOSE_S = 0.5
"""Time in seconds that pages have to answer at the end, before they are disconnected."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; "
    "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page."""


def _silent() -> logging.Logger:
    """Return a logger that suppresses the messages of the library about incomplete and invalid
    connections."""
    log = logging.getLogger("pbdkit.web")
    log.setLevel(logging.CRITICAL)
    return log


class SocketViewer(Viewer):
    """A page, connected by a socket."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waiting: asyncio.Queue[str | bytes | None] = asyncio.Queue(MAX_WAITING)

    def post(self, message: Message) -> None:
        """Queue a message to the page."""
        self._put(as_json(message))

    def show(self, picture: bytes) -> None:
        """Queue a picture. At most one picture is queued, because the next one is sent only after
        the last one was acknowledged."""
        self._put(picture)

    async def send(self, socket: ServerConnection) -> None:
        """Send queued messages until the connection is closed."""
        with suppress(ConnectionClosed):  # The viewer is informed of the end by the close event.
            while (message := await self._waiting.get()) is not None:
                await socket.send(message)
            await socket.close()

    def _put(self, message: str | bytes) -> None:
        def put() -> None:
            if self._waiting.full():  # The viewer does not read messages.
                self._waiting.get_nowait()
                self._waiting.put_nowait(None)
            else:
                self._waiting.put_nowait(message)

        with suppress(RuntimeError):  # the loop has been closed
            self._loop.call_soon_threadsafe(put)


class SessionServer:
    """Server of one session on a port of 127.0.0.1. Port 0 selects a free port."""

    def __init__(self, conductor: Conductor, title: str, port: int = 0) -> None:
        self._conductor, self._title, self._port = conductor, title, port
        self._pages = 0
        self._transports: WeakSet[Any] = WeakSet()
        self.access = Access(port)

    async def run(self, on_ready: Callable[[str], None], end: asyncio.Event) -> None:
        """Serve until the event `end`. `on_ready` is called with the address. Raises
        ExperimentError if the port is in use."""
        try:
            server = await self._started()
        except OSError as error:
            raise ExperimentError(
                f"--port {self._port}: cannot be served at: {error.strerror}; choose another port, "
                "or omit --port"
            ) from None
        async with server:
            on_ready(self.access.address)
            await end.wait()
            server.close()
            with suppress(TimeoutError):
                await asyncio.wait_for(server.wait_closed(), SERVER_CLOSE_S)
            # The remaining connections are requests that are not complete, and pages that do not
            # read.
            for transport in self._transports:
                transport.abort()

    async def _started(self) -> Server:
        server = await serve(
            self._talk, HOST, self._port, process_request=self._answer, max_size=MAX_COMMAND_BYTES,
            max_queue=64, compression=None, server_header=None, logger=_silent(),
            create_connection=self._connection(),
        )  # fmt: skip
        self.access = Access(next(iter(server.sockets)).getsockname()[1], self.access.token)
        return server

    def _connection(self) -> type[ServerConnection]:
        """Return the class of connections. It registers the transport of each connection in this
        server."""
        transports = self._transports

        class Connection(ServerConnection):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                transports.add(transport)
                super().connection_made(transport)

        return Connection

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the page, a refusal, or None if the socket may open."""
        path, is_socket = urlsplit(request.path).path, "Upgrade" in request.headers
        refusal = self.access.refusal(
            request.path, request.headers.get_all, is_socket=is_socket or path == "/socket"
        )
        if refusal:
            return connection.respond(HTTPStatus.FORBIDDEN, f"refused: {refusal}\n")
        if path == "/socket" and is_socket and self._pages < MAX_PAGES:
            return None
        if path != "/" or is_socket:
            return connection.respond(HTTPStatus.NOT_FOUND, "there is no such page\n")
        nonce = secrets.token_urlsafe(16)
        response = connection.respond(HTTPStatus.OK, page(self._title, nonce))
        del response.headers["Content-Type"]
        for name, value in {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Security-Policy": POLICY.format(nonce=nonce, host=request.headers["Host"]),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
        }.items():
            response.headers[name] = value
        return response

    async def _talk(self, socket: ServerConnection) -> None:
        viewer = SocketViewer(asyncio.get_running_loop())
        self._pages += 1
        sending = asyncio.create_task(viewer.send(socket))
        self._conductor.join(viewer)
        try:
            async for message in socket:
                try:
                    self._conductor.submit(viewer, command_of(message))
                except ExperimentError as error:
                    viewer.post({"is": "error", "text": str(error)})
        except ConnectionClosed:
            pass
        finally:
            self._pages -= 1
            self._conductor.leave(viewer)
            sending.cancel()


def page(title: str, nonce: str) -> str:
    """Return the page of a session, with the nonce in its script and style."""
    return Template(source("live.html")).substitute(
        title=escape(title), nonce=nonce, style=source("live.css"), script=script("socket")
    )


def as_json(message: Message) -> str:
    """Serialise a message as JSON for a browser."""
    return json.dumps(message, allow_nan=False)
