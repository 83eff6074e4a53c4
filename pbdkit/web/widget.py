"""Widget for notebooks with the live view. It uses the messages of the widget in place of a
socket."""

from __future__ import annotations

from typing import Any

import anywidget

from pbdkit.errors import ExperimentError
from pbdkit.web.page import script, source
from pbdkit.web.requests import command_of
from pbdkit.web.server import Conductor, Viewer
from pbdkit.web.session import Message, Session


class _Cells(Viewer):
    """The notebook cells that show one widget."""

    def __init__(self, widget: anywidget.AnyWidget) -> None:
        self._widget = widget

    def post(self, message: Message) -> None:
        self._widget.send(message)

    def show(self, picture: bytes) -> None:
        self._widget.send({"is": "picture"}, buffers=[picture])


class LiveWidget(anywidget.AnyWidget):
    """Live session in a notebook, returned by `live`.

    Parameters
    ----------
    session : Session
        Session that the widget displays.
    **traits : object
        Traits of anywidget.
    """

    _esm = script("notebook", exports=True) + "\nexport default { render };\n"
    _css = source("live.css")

    def __init__(self, session: Session, **traits: Any) -> None:
        super().__init__(**traits)
        self.session = session
        self._conductor = Conductor(session)
        self._cells = _Cells(self)
        self.on_msg(self._receive)
        self._conductor.start()

    def close(self) -> None:
        """End the session of the widget."""
        self._conductor.close()
        super().close()

    def _receive(self, widget: Any, message: Any, buffers: Any) -> None:
        """Execute the message of a cell. A new cell joins as a new viewer."""
        if message == {"do": "join"}:
            self._conductor.leave(self._cells)
            self._cells = _Cells(self)
            self._conductor.join(self._cells)
            return
        try:
            self._conductor.submit(self._cells, command_of(message))
        except ExperimentError as error:
            self._cells.post({"is": "error", "text": str(error)})
