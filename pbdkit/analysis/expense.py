"""Whether a scene is small enough for its step operator to be looked at in about a second."""

from __future__ import annotations

from pbdkit.scene.scene import Scene

MOST_PARTICLES, MOST_ENDS, MOST_ANSWERS, MANY = 50_000, 800_000, 2e8, 42
"""The most particles, ends of bonds, and answers of a rule: where somebody has more than MANY
neighbours each particle is asked what each neighbour does to each."""


def excess(scene: Scene) -> str:
    """What the scene has too much of, in words; empty where it is small enough."""
    particles, neighbourhood = scene.raster.count, scene.neighbourhood
    if particles > MOST_PARTICLES:
        return f"{particles} particles, {MOST_PARTICLES} at most"
    each = 2 * len(neighbourhood.planes) // len(neighbourhood.slots)
    most = min(MOST_ENDS // each, int(MOST_ANSWERS / each**2) if each > MANY else particles)
    if particles > most:
        return f"{particles} particles with {each} neighbours each, {most} at most"
    return ""
