"""Does what a page asks of a session."""

from __future__ import annotations

from pbdkit.sessions import commands
from pbdkit.sessions.session import Session


def obey(session: Session, command: commands.Command) -> None:
    """Does it, between two steps. Raises PbdkitError, with nothing done, where that cannot be."""
    match command:
        case commands.Play():
            session.running, session.owed = command.on, 0
        case commands.Advance():
            session.running, session.owed = False, session.owed + command.count
        case commands.Rewind():
            session.rewind(command.step)
        case commands.Speed():
            session.speed = command.steps
        case commands.Grab():
            session.grab(command.row)
        case commands.Drag():
            session.drag(command.by)
            if session.next_steps:
                return  # the next step shows it; a picture of now would only keep that one waiting
        case commands.Release():
            session.release()
        case commands.Turn():
            session.turn(command.name, command.value)
        case commands.CutLine():
            session.cut((command.from_, command.to))
        case commands.CutBond():
            session.cut_bond(command.row)
        case commands.Colour():
            session.camera.colour = command.by
        case commands.Save():
            session.save()
        case commands.Seen():
            return
    session.pictures += 1
