"""Who may see a session, and lead it: whoever knows its address, and no other page.

A browser sends requests to this machine for any page that asks it to. Such a page knows no token;
the browser says whose it is (Origin), and under which name it found the server (Host).

Runs a session in a thread of its own, for all who look at it.

Serves a session to pages on this machine: one page, and a socket.
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
from pbdkit.web.requests import LONGEST, Command, PictureReceived, Rewind, command_of, obey
from pbdkit.web.session import Judge, Judgement, Message, Session, scenery, standing
from pbdkit.web.view_frames import ViewFrame

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
Headers = Callable[[str], Sequence[str]]
"""All values of the header of a name."""


def new_token() -> str:
    """Nobody guesses it."""
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """To the server at a port."""

    port: int
    token: str = field(default_factory=new_token, repr=False)

    @property
    def address(self) -> str:
        """What to open."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def refusal(self, target: str, headers: Headers, *, is_socket: bool) -> str:
        """Why a request is refused; empty where it is not. A socket says which page opens it; who
        types an address comes from none."""
        hosts, origins = headers("Host"), headers("Origin")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "the server is asked under another name than its own"
        if len(origins) > 1 or any(origin != f"http://{hosts[0]}" for origin in origins):
            return "the page is of another server"
        if is_socket and not origins:
            return "it is not said which page asks"
        given = parse_qs(urlsplit(target).query).get("token", [])
        right = self.token.encode()
        if len(given) != 1 or not secrets.compare_digest(given[0].encode(), right):
            return "the token is missing or wrong; open the address that pbdkit has printed"
        return ""

    @property
    def _hosts(self) -> list[str]:
        return [f"{name}:{self.port}" for name in NAMES]


SHORTEST_S = 1 / 60
"""Between two pictures."""
CLOSE_S = 1.0


class Viewer(ABC):
    """One page that looks on. Its methods are called from the session's thread, and do not wait."""

    ready = True
    """Whether the last picture has come to it, so that the next may be sent."""
    seen: ViewFrame | None = None
    """The last that was sent."""

    @abstractmethod
    def tell(self, message: Message) -> None:
        """What is to be known besides pictures."""

    @abstractmethod
    def show(self, picture: bytes) -> None:
        """The newest picture."""


What = Command | Judgement | Literal["join", "leave", "close"]
Asked = tuple[Viewer | None, What]


class Conductor:
    """Hands commands to a session, lets it step in between, and shows the newest picture to whoever
    is ready for one: no picture ever waits for another."""

    def __init__(self, session: Session) -> None:
        self._session = session
        session.says = self._tell
        self._viewers: list[Viewer] = []
        self._asked: queue.SimpleQueue[Asked] = queue.SimpleQueue()
        self._standing: Message = {}
        self._judge = Judge(lambda judgement: self._asked.put((None, judgement)))
        self._judged: Any = None
        self._judgement: Message | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="session", daemon=True)

    def start(self) -> None:
        """Begins; the body rests until somebody lets it go."""
        self._thread.start()

    def join(self, viewer: Viewer) -> None:
        """One more looks on."""
        self._asked.put((viewer, "join"))

    def leave(self, viewer: Viewer) -> None:
        """One looks on no more."""
        self._asked.put((viewer, "leave"))

    def ask(self, viewer: Viewer, command: Command) -> None:
        """What a page asks for: done between two steps."""
        self._asked.put((viewer, command))

    def close(self) -> None:
        """End the session's thread after the steps that it is at, or, where these take longer than
        `CLOSE_S`, with the process."""
        self._asked.put((None, "close"))
        self._judge.close()
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _work(self) -> None:
        due = 0.0
        while not self._closed:
            rests = self._session.next_steps == 0
            for viewer, what in self._taken(None if rests else max(0.0, due - monotonic())):
                self._do(viewer, what)
            steps = self._session.next_steps
            if steps and monotonic() >= due and not self._closed:
                due = monotonic() + SHORTEST_S
                self._try(None, lambda steps=steps: self._session.advance(steps))
            self._try(None, self._publish)

    def _taken(self, seconds: float | None) -> Iterator[Asked]:
        """All that was asked by now, waiting for so long until something is. Of some places to go
        back to, one after the other, the last counts."""
        found: list[Asked] = []
        try:
            found.append(self._asked.get(timeout=seconds))
            while True:
                found.append(self._asked.get_nowait())
        except queue.Empty:
            pass
        for n, (viewer, what) in enumerate(found):
            later = found[n + 1][1] if n + 1 < len(found) else None
            if not (isinstance(what, Rewind) and isinstance(later, Rewind)):
                yield viewer, what

    def _do(self, viewer: Viewer | None, what: What) -> None:
        if what == "close":
            self._closed = True
        elif isinstance(what, Judgement):
            self._judgement = {"is": "judgement", "word": what.word, "why": what.why}
            self._tell(self._judgement)
        elif what == "join" and viewer:
            self._viewers.append(viewer)
            for message in (scenery(self._session), self._standing, self._judgement):
                if message:
                    viewer.tell(message)
        elif what == "leave" and viewer in self._viewers:
            self._viewers.remove(viewer)
            if not self._viewers:  # nobody is there to see it
                self._try(None, self._session.rest)
        elif isinstance(what, PictureReceived) and viewer:
            viewer.ready = True
        elif not isinstance(what, str):
            self._try(viewer, lambda: obey(self._session, what))

    def _try(self, viewer: Viewer | None, act: Any) -> None:
        """Says what cannot be to whoever asked for it, or to all; what goes wrong here ends no
        session."""
        try:
            act()
        except PbdkitError as error:
            text = str(error)
        except Exception as error:
            self._session.running, self._session.owed = False, 0
            text = f"a bug in pbdkit, please report it: {type(error).__name__}: {error}"
        else:
            return
        message = {"is": "error", "text": text}
        if viewer:
            viewer.tell(message)
        else:
            self._tell(message)

    def _tell(self, message: Message) -> None:
        for viewer in self._viewers:
            viewer.tell(message)

    def _publish(self) -> None:
        session = self._session
        if (now := standing(session)) != self._standing:
            self._standing = now
            self._tell(now)
        held = [number.after(session.step) for number in session.script.numbers.values()]
        if held != self._judged:
            self._judged = held
            self._judge.ask(session.plain())
        ready = [
            one for one in self._viewers
            if one.ready and (one.seen is None or one.seen.made != session.pictures)
        ]  # fmt: skip
        frame = session.frame() if ready else None
        for viewer in ready:
            assert frame
            viewer.ready = False
            picture, viewer.seen = frame.encoded(viewer.seen), frame
            viewer.show(picture)


MOST_WAITING = 1000
"""Messages to a page that takes none; then its line is cut."""
MOST_PAGES = 8
SERVER_CLOSE_S = 0.5
"""Seconds that pages have at the end to answer; then their lines are cut."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; "
    "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def _silent() -> logging.Logger:
    """The library's notes on doubtful connections would stand between those of the program."""
    log = logging.getLogger("pbdkit.web")
    log.setLevel(logging.CRITICAL)
    return log


class SocketViewer(Viewer):
    """A page at the other end of a socket."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waiting: asyncio.Queue[str | bytes | None] = asyncio.Queue(MOST_WAITING)

    def tell(self, message: Message) -> None:
        """Puts it in line."""
        self._put(as_json(message))

    def show(self, picture: bytes) -> None:
        """Puts it in line, where no other picture is."""
        self._put(picture)

    async def send(self, socket: ServerConnection) -> None:
        """Hands on what comes, until the line is cut."""
        with suppress(ConnectionClosed):  # whoever listens to the socket is told, too
            while (message := await self._waiting.get()) is not None:
                await socket.send(message)
            await socket.close()

    def _put(self, message: str | bytes) -> None:
        def put() -> None:
            if self._waiting.full():  # nobody takes anything there
                self._waiting.get_nowait()
                self._waiting.put_nowait(None)
            else:
                self._waiting.put_nowait(message)

        with suppress(RuntimeError):  # the loop has been closed: nobody is there any more
            self._loop.call_soon_threadsafe(put)


class SessionServer:
    """Serves one session at a port of 127.0.0.1, 0 for any that is free."""

    def __init__(self, conductor: Conductor, title: str, port: int = 0) -> None:
        self._conductor, self._title, self._port = conductor, title, port
        self._pages = 0
        self._transports: WeakSet[Any] = WeakSet()
        self.access = Access(port)

    async def run(self, ready: Callable[[str], None], end: asyncio.Event) -> None:
        """Serves until the end; `ready` is told the address. Raises ExperimentError where the port
        is taken."""
        try:
            server = await self._started()
        except OSError as error:
            raise ExperimentError(
                f"--port {self._port}: cannot be served at: {error.strerror}; take another, or none"
            ) from None
        async with server:
            ready(self.access.address)
            await end.wait()
            server.close()
            with suppress(TimeoutError):
                await asyncio.wait_for(server.wait_closed(), SERVER_CLOSE_S)
            for transport in self._transports:  # half-open requests, and pages that do not read
                transport.abort()

    async def _started(self) -> Server:
        server = await serve(
            self._talk, HOST, self._port, process_request=self._answer, max_size=LONGEST,
            max_queue=64, compression=None, server_header=None, logger=_silent(),
            create_connection=self._connection(),
        )  # fmt: skip
        self.access = Access(next(iter(server.sockets)).getsockname()[1], self.access.token)
        return server

    def _connection(self) -> type[ServerConnection]:
        """Return the class of connections, of which each leaves its transport here."""
        transports = self._transports

        class Connection(ServerConnection):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                transports.add(transport)
                super().connection_made(transport)

        return Connection

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, a refusal, or nothing where the socket may open."""
        path, is_socket = urlsplit(request.path).path, "Upgrade" in request.headers
        refusal = self.access.refusal(
            request.path, request.headers.get_all, is_socket=is_socket or path == "/socket"
        )
        if refusal:
            return connection.respond(HTTPStatus.FORBIDDEN, f"refused: {refusal}\n")
        if path == "/socket" and is_socket and self._pages < MOST_PAGES:
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
                    self._conductor.ask(viewer, command_of(message))
                except ExperimentError as error:
                    viewer.tell({"is": "error", "text": str(error)})
        except ConnectionClosed:
            pass
        finally:
            self._pages -= 1
            self._conductor.leave(viewer)
            sending.cancel()


def page(title: str, nonce: str) -> str:
    """The page of a session; its script and style are those of the nonce."""
    return Template(source("live.html")).substitute(
        title=escape(title), nonce=nonce, style=source("live.css"), script=script("socket")
    )


def as_json(message: Message) -> str:
    """What a browser takes as JSON."""
    return json.dumps(message, allow_nan=False)
