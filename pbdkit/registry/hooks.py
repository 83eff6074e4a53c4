"""The one hook of pbdkit, and its marker."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from pbdkit.interfaces import Component

GROUP = "pbdkit"
"""The entry-point group of plugins, and the project name of their hook markers."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class Hooks:
    """What a plugin may implement, as functions of the module that its entry point names."""

    @hookspec
    def pbdkit_components(self) -> list[type[Component]]:  # type: ignore[empty-body]  # a specification only
        """The component classes that the distribution offers."""
