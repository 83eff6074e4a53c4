"""Requests of a page to a session. This module validates and executes them."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from pbdkit.errors import ExperimentError, printable
from pbdkit.plugin.component import Strict
from pbdkit.web.session import Session

MAX_COMMAND_BYTES = 4096
"""Maximum length of a command in bytes."""
MAX_COORDINATE = 1e12
"""Largest coordinate in lattice units. It is limited so that squares and differences of coordinates
are finite."""
Step = Annotated[int, Field(ge=0, lt=2**31)]
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Place = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
"""Position (x, y) in the plane of the page."""


class Play(Strict):
    """Start stepping, or stop it."""

    do: Literal["play"]
    on: bool


class Advance(Strict):
    """Advance by a number of steps."""

    do: Literal["step"]
    count: Annotated[int, Field(ge=1, le=100_000)] = 1


class Rewind(Strict):
    """Go back or forward to about the given step."""

    do: Literal["rewind"]
    step: Step


class Speed(Strict):
    """Set the number of steps per picture."""

    do: Literal["speed"]
    steps: Annotated[int, Field(ge=1, le=10_000)]


class Grab(Strict):
    """Grab a visible particle, given by its row. If it is a leader, its group is grabbed."""

    do: Literal["grab"]
    row: Annotated[int, Field(ge=0, lt=2**31)]


class Drag(Strict):
    """Move the grabbed particle. The displacement is relative to the position at which it was
    grabbed."""

    do: Literal["drag"]
    by: Place


class Release(Strict):
    """Release the grabbed particle."""

    do: Literal["release"]


class Turn(Strict):
    """Change the value of a parameter, given by its name."""

    do: Literal["turn"]
    name: Annotated[str, Field(max_length=200)]
    value: float


class CutLine(Strict):
    """Cut along a line across the deformed body."""

    do: Literal["cut"]
    from_: Place = Field(alias="from")
    to: Place


class CutBond(Strict):
    """Cut one bond, given by its row."""

    do: Literal["cut-bond"]
    row: Annotated[int, Field(ge=0, lt=2**31)]


class Colour(Strict):
    """Select the field that determines the colours of the particles, by its name."""

    do: Literal["colour"]
    by: Annotated[str, Field(max_length=200)]


class Save(Strict):
    """Write the session as an experiment."""

    do: Literal["save"]


class PictureReceived(Strict):
    """Acknowledge the last picture, so that the next picture may be sent."""

    do: Literal["seen"]


Command = (
    Play | Advance | Rewind | Speed | Grab | Drag | Release | Turn | CutLine | CutBond | Colour
    | Save | PictureReceived
)  # fmt: skip
_COMMANDS: TypeAdapter[Command] = TypeAdapter(Annotated[Command, Field(discriminator="do")])
"""Validation of all commands."""


def command_of(message: str | bytes | dict[str, Any]) -> Command:
    """Parse the command in a message. Raises ExperimentError if the message is not a command."""
    try:
        if not isinstance(message, dict):
            if len(message) > MAX_COMMAND_BYTES:
                raise ExperimentError(f"a command has at most {MAX_COMMAND_BYTES} bytes")
            message = json.loads(message)
        return _COMMANDS.validate_python(message)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        where = ".".join(map(str, fault["loc"]))
        raise ExperimentError(
            (f"invalid command: {where}: {printable(fault['msg'])}")[:300]
        ) from None
    except (ValueError, RecursionError) as error:
        raise ExperimentError(f"invalid command: {printable(str(error))}"[:300]) from None


def execute(session: Session, command: Command) -> None:
    """Execute a command between two steps. If this is impossible, PbdkitError is raised and nothing
    is changed."""
    match command:
        case Play():
            session.running, session.due_steps = command.on, 0
        case Advance():
            session.running, session.due_steps = False, session.due_steps + command.count
        case Rewind():
            session.rewind(command.step)
        case Speed():
            session.speed = command.steps
        case Grab():
            session.grab(command.row)
        case Drag():
            session.drag(command.by)
            if session.next_steps:
                # The picture after the next step shows the result. A picture now would only delay
                # it.
                return
        case Release():
            session.release()
        case Turn():
            session.turn(command.name, command.value)
        case CutLine():
            session.cut((command.from_, command.to))
        case CutBond():
            session.cut_bond(command.row)
        case Colour():
            session.colour(command.by)
        case Save():
            session.save()
        case PictureReceived():
            return
    session.pictures += 1
