"""The one hook of pbdkit, its marker, and the version of what plugins hold on to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from pbdkit.interfaces import Component

GROUP = "pbdkit"
"""The entry-point group of plugins, and the project name of their hook markers."""

API = 1
"""The version of the hook and the six interfaces. A plugin may declare the one that it was written
for as `pbdkit_api`, in the module or on the object that its entry point names."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class Hooks:
    """What a plugin may implement, as functions of the module that its entry point names."""

    @hookspec
    def pbdkit_components(self) -> list[type[Component]]:  # type: ignore[empty-body]  # a specification only
        """The component classes that the distribution offers."""
