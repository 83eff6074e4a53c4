"""The registry: from the `type` in an experiment to the class that implements it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.interfaces import INTERFACES, Component
from pbdkit.interfaces.naming import did_you_mean
from pbdkit.registry.loading import Plugin, check_component, load_builtin, load_installed

GIVEN = "components"
"""How classes that were handed over in Python appear among the plugins."""


class Registry:
    """The built-in components, those handed over in Python, and, once needed, the installed ones.

    An experiment that uses only built-in names imports no third-party code.
    """

    def __init__(self, components: Iterable[type[Component]] = ()) -> None:
        self._builtin = load_builtin()
        self._given = Plugin(GIVEN, "", "", "ok", components=tuple(components))
        for component in self._given.components:
            try:
                check_component(component)
            except TypeError as error:
                raise ExperimentError(f"components: {error}") from None
            self._refuse_taken(component)

    @cached_property
    def installed(self) -> list[Plugin]:
        """The third-party plugins; the first look at them imports them."""
        found = load_installed()
        return [self._judged(plugin, found) for plugin in found]

    @property
    def plugins(self) -> list[Plugin]:
        """Every plugin, the built-in one first."""
        given = [self._given] if self._given.components else []
        return [self._builtin, *given, *self.installed]

    def find(self, interface: type[Component], name: str) -> type[Component]:
        """The class of that interface and type.

        `name` may name its distribution: ``pbdkit-x:rule-name``. Raises ExperimentError for a name
        that nobody offers or that two distributions offer, PluginError where the distribution
        named is missing or broken.
        """
        if ":" in name:
            return self._find_in_distribution(interface, *name.split(":", 1))
        for plugins in ([self._builtin], [self._given]):
            if found := _named(plugins, interface, name):
                return found[0][1]
        found = _named(self.installed, interface, name)
        if len(found) > 1:
            offers = ", ".join(f"'{plugin.distribution}:{name}'" for plugin, _ in found)
            raise ExperimentError(f"'{name}' is offered by several distributions: write {offers}")
        if not found:
            raise ExperimentError(self._unknown(interface, name))
        return found[0][1]

    def components(
        self, interface: type[Component], *, installed: bool = True
    ) -> dict[str, type[Component]]:
        """Every usable component of an interface by type; third parties' too if `installed`."""
        plugins = self.plugins if installed else [self._builtin, self._given]
        return {
            component.type_name(): component
            for plugin in reversed(plugins)
            for component in plugin.components
            if issubclass(component, interface)
        }

    def versions(self, used: Iterable[Component]) -> dict[str, str]:
        """The distributions that these components come from, with their versions; under GIVEN the
        types of those that come from none."""
        classes = {type(component) for component in used}
        loaded = [self._builtin, *self.__dict__.get("installed", ())]
        found = {p.distribution: p.version for p in loaded if classes & set(p.components)}
        offered = {c for p in loaded for c in p.components}
        given = sorted({c.type_name() for c in classes - offered})
        return found | ({GIVEN: ", ".join(given)} if given else {})

    def name_of(self, component: Component) -> str:
        """The type by which an experiment finds this component again, with its distribution where
        several offer the type."""
        name, interface = component.type_name(), interface_of(type(component))
        if _named([self._builtin, self._given], interface, name):
            return name
        found = _named(self.__dict__.get("installed", ()), interface, name)
        own = [plugin for plugin, offered in found if offered is type(component)]
        return f"{own[0].distribution}:{name}" if len(found) > 1 and own else name

    def _judged(self, plugin: Plugin, installed: list[Plugin]) -> Plugin:
        """The plugin, in conflict where a component of it cannot be named by its type alone."""
        reasons = []
        for component in plugin.components:
            name, interface = component.type_name(), interface_of(component)
            offers = _named([self._builtin, *installed], interface, name)
            if others := [p.distribution for p, _ in offers if p is not plugin]:
                reasons.append(f"'{name}' is offered by {', '.join(others)} too")
        return replace(plugin, state="conflict", reason="; ".join(reasons)) if reasons else plugin

    def _refuse_taken(self, component: type[Component]) -> None:
        name, interface = component.type_name(), interface_of(component)
        if _named([self._builtin], interface, name):
            raise ExperimentError(
                f"components: '{name}' is the name of a built-in {interface.__name__}; "
                f"give {component.__name__} another type"
            )
        if len({c for _, c in _named([self._given], interface, name)}) > 1:
            raise ExperimentError(f"components: two classes have the type '{name}'")

    def _find_in_distribution(
        self, interface: type[Component], distribution: str, name: str
    ) -> type[Component]:
        own = [self._builtin] if distribution == self._builtin.distribution else []
        of_it = own or [p for p in self.installed if p.distribution == distribution]
        if not of_it:
            raise PluginError(f"'{name}' is asked of {distribution}, which is not installed")
        if found := _named(of_it, interface, name):
            return found[0][1]
        for plugin in of_it:
            if plugin.state != "ok":
                raise PluginError(
                    f"'{name}' is asked of {distribution} {plugin.version}, "
                    f"which is {plugin.state}: {plugin.reason}"
                )
        offered = [c.type_name() for p in of_it for c in p.components if issubclass(c, interface)]
        hint = did_you_mean(name, offered)
        raise ExperimentError(f"{distribution} offers no {interface.__name__} '{name}'{hint}")

    def _unknown(self, interface: type[Component], name: str) -> str:
        offered = sorted(self.components(interface))
        hint = did_you_mean(name, offered)
        broken = "".join(
            f"; {p.distribution} {p.version} is {p.state}: {p.reason}"
            for p in self.installed
            if p.state != "ok"
        )
        return f"unknown type '{name}'{hint} (installed: {', '.join(offered)}){broken}"


def interface_of(component: type[Component]) -> type[Component]:
    """The open interface that a component class implements."""
    return next(i for i in INTERFACES.values() if issubclass(component, i))


def _named(
    plugins: Iterable[Plugin], interface: type[Component], name: str
) -> list[tuple[Plugin, type[Component]]]:
    return [
        (plugin, component)
        for plugin in plugins
        for component in plugin.components
        if issubclass(component, interface) and component.type_name() == name
    ]
