"""What a page has to know of a session besides pictures."""

from __future__ import annotations

from base64 import b64encode
from typing import Any

from pbdkit.sessions.frames import COLOURS
from pbdkit.sessions.session import Session

Message = dict[str, Any]


def scenery(session: Session) -> Message:
    """What stays as it is: the body, its bonds (pairs of rows, 32 bits each), its numbers."""
    camera, scene = session.camera, session.stage.scene
    return {
        "is": "scene",
        "name": session.experiment.name,
        "particles": scene.raster.count,
        "count": len(camera.rows),
        "every": camera.every,
        "spacing": camera.spacing,
        "bonds": b64encode(camera.bonds.astype("<u4").tobytes()).decode(),
        "colours": COLOURS,
        "numbers": [
            {"name": number.name, "span": number.span} for number in session.script.numbers.values()
        ],
    }


def standing(session: Session) -> Message:
    """What may change at any step, but for what pictures tell."""
    choice, held = session.stage.choice, session.held
    threads = f" on {choice.threads} threads" if choice.threads > 1 else ""
    return {
        "is": "standing",
        "running": session.running,
        "speed": session.speed,
        "colour": session.camera.colour,
        "engine": choice.engine + threads,
        "held": held is not None,
        "numbers": {
            name: number.at(session.step + 1) for name, number in session.script.numbers.items()
        },
        "cuts": len(session.script.cuts),
    }
