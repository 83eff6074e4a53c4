"""What a page may ask of a session, checked as it comes in.

Does what a page asks of a session.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from pbdkit.errors import ExperimentError, printable
from pbdkit.plugin.component import Strict
from pbdkit.web.session import Session

LONGEST = 4096
"""Bytes of a command."""
FARTHEST = 1e12
"""Largest coordinate, in lattice units: squares and differences of it are finite."""
Step = Annotated[int, Field(ge=0, lt=2**31)]
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Place = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
"""(x, y) on the page's plane."""


class Play(Strict):
    """Goes on stepping, or stops."""

    do: Literal["play"]
    on: bool


class Advance(Strict):
    """So many steps and no more."""

    do: Literal["step"]
    count: Annotated[int, Field(ge=1, le=100_000)] = 1


class Rewind(Strict):
    """Back to about that step, or forward again."""

    do: Literal["rewind"]
    step: Step


class Speed(Strict):
    """Steps a picture."""

    do: Literal["speed"]
    steps: Annotated[int, Field(ge=1, le=10_000)]


class Grab(Strict):
    """Takes hold of a particle shown, by its row: of its group where it leads."""

    do: Literal["grab"]
    row: Annotated[int, Field(ge=0, lt=2**31)]


class Drag(Strict):
    """Leads what is held so far from where it was grabbed."""

    do: Literal["drag"]
    by: Place


class Release(Strict):
    """Lets go of it."""

    do: Literal["release"]


class Turn(Strict):
    """Another value of a number, by its name."""

    do: Literal["turn"]
    name: Annotated[str, Field(max_length=200)]
    value: float


class CutLine(Strict):
    """Cuts along a line across the body as it stands."""

    do: Literal["cut"]
    from_: Place = Field(alias="from")
    to: Place


class CutBond(Strict):
    """Cuts one bond, by its row."""

    do: Literal["cut-bond"]
    row: Annotated[int, Field(ge=0, lt=2**31)]


class Colour(Strict):
    """What particles are coloured by."""

    do: Literal["colour"]
    by: Literal["kind", "displacement", "last-step"]


class Save(Strict):
    """Writes what was done as an experiment."""

    do: Literal["save"]


class PictureReceived(Strict):
    """The last picture has come; the next may."""

    do: Literal["seen"]


Command = (
    Play | Advance | Rewind | Speed | Grab | Drag | Release | Turn | CutLine | CutBond | Colour
    | Save | PictureReceived
)  # fmt: skip
_COMMANDS: TypeAdapter[Command] = TypeAdapter(Annotated[Command, Field(discriminator="do")])


def command_of(given: str | bytes | dict[str, Any]) -> Command:
    """The command in a message. Raises ExperimentError for what is none."""
    try:
        if not isinstance(given, dict):
            if len(given) > LONGEST:
                raise ExperimentError(f"a command takes at most {LONGEST} bytes")
            given = json.loads(given)
        return _COMMANDS.validate_python(given)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        where = ".".join(map(str, fault["loc"]))
        raise ExperimentError(f"no command: {where}: {printable(fault['msg'])}"[:300]) from None
    except (ValueError, RecursionError) as error:
        raise ExperimentError(f"no command: {printable(str(error))}"[:300]) from None


def obey(session: Session, command: Command) -> None:
    """Does it, between two steps. Raises PbdkitError, with nothing done, where that cannot be."""
    match command:
        case Play():
            session.running, session.owed = command.on, 0
        case Advance():
            session.running, session.owed = False, session.owed + command.count
        case Rewind():
            session.rewind(command.step)
        case Speed():
            session.speed = command.steps
        case Grab():
            session.grab(command.row)
        case Drag():
            session.drag(command.by)
            if session.next_steps:
                return  # the next step shows it; a picture of now would only keep that one waiting
        case Release():
            session.release()
        case Turn():
            session.turn(command.name, command.value)
        case CutLine():
            session.cut((command.from_, command.to))
        case CutBond():
            session.cut_bond(command.row)
        case Colour():
            session.camera.colour = command.by
        case Save():
            session.save()
        case PictureReceived():
            return
    session.pictures += 1
