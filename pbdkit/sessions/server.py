"""Serves a session to pages on this machine: one page, and a socket."""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections.abc import Callable
from contextlib import suppress
from html import escape
from http import HTTPStatus
from string import Template
from typing import Any
from urllib.parse import urlsplit
from weakref import WeakSet

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from pbdkit.errors import ExperimentError
from pbdkit.pages.page import script, source
from pbdkit.sessions.access import HOST, Access
from pbdkit.sessions.commands import LONGEST, command_of
from pbdkit.sessions.conductor import Conductor, Viewer
from pbdkit.sessions.scenery import Message

MOST_WAITING = 1000
"""Messages to a page that takes none; then its line is cut."""
MOST_PAGES = 8
CLOSE_S = 0.5
"""Seconds that pages have at the end to answer; then their lines are cut."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; "
    "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def _silent() -> logging.Logger:
    """The library's notes on doubtful connections would stand between those of the program."""
    log = logging.getLogger("pbdkit.sessions")
    log.setLevel(logging.CRITICAL)
    return log


class Page(Viewer):
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
                await asyncio.wait_for(server.wait_closed(), CLOSE_S)
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
        viewer = Page(asyncio.get_running_loop())
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
