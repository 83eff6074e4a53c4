"""Runs a session in a thread of its own, for all who look at it."""

from __future__ import annotations

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from time import monotonic
from typing import Any, Literal

from pbdkit.errors import PbdkitError
from pbdkit.sessions.commands import Command, Rewind, Seen
from pbdkit.sessions.frames import Frame
from pbdkit.sessions.judgement import Judge, Judgement
from pbdkit.sessions.obeying import obey
from pbdkit.sessions.scenery import Message, scenery, standing
from pbdkit.sessions.session import Session

SHORTEST_S = 1 / 60
"""Between two pictures."""
CLOSE_S = 1.0


class Viewer(ABC):
    """One page that looks on. Its methods are called from the session's thread, and do not wait."""

    ready = True
    """Whether the last picture has come to it, so that the next may be sent."""
    seen: Frame | None = None
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
        elif isinstance(what, Seen) and viewer:
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
