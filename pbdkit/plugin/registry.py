"""Registry, which maps a `type` in an experiment to the class that implements it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

from pbdkit.errors import ExperimentError, PluginError, did_you_mean, one_line
from pbdkit.hooks import (
    ALL,
    COMMAND_GROUP,
    DISABLE,
    Offer,
    Plugin,
    canonical,
    disabled_names,
    installed_plugins,
)
from pbdkit.plugin import BUILTIN, Component
from pbdkit.plugin.discovery import checked, interface_of, is_retired, load_builtin, loaded

GIVEN = "components"
"""Name of the plugin with the classes that are passed as Python objects."""


class Registry:
    """Built-in components, components passed as Python objects and, on demand, installed
    components.

    Third-party code is imported only when it is needed: an experiment that uses only built-in
    components imports none, and an experiment that names a distribution imports only that
    distribution.

    Parameters
    ----------
    components
        Component classes in addition to the installed ones.
    """

    def __init__(self, components: Iterable[type[Component]] = ()) -> None:
        self._builtin = load_builtin()
        self._local = [self._builtin, _given(components, self._builtin)]
        self._loaded: dict[Plugin, Plugin] = {}

    @cached_property
    def installed(self) -> list[Plugin]:
        """Third-party plugins, imported when this property is read for the first time."""
        return self._load(self._found)

    @property
    def plugins(self) -> list[Plugin]:
        """Plugins with components, beginning with the built-in one."""
        return [p for p in self._local if p.offers] + self.installed

    def find(self, interface: type[Component], name: str) -> type[Component]:
        """Return the class that implements a type of an interface.

        Parameters
        ----------
        interface
            Interface of the component.
        name
            Type, optionally with its distribution: ``pbdkit-x:rule-name``.

        Raises
        ------
        ExperimentError
            If no distribution provides the type, or several do.
        PluginError
            If the distribution of the type is missing, disabled, broken or incompatible.
        """
        distribution, _, kind = name.rpartition(":")
        if distribution:
            plugins = self._of(distribution, kind)
        else:
            plugins = self._local if _offers(self._local, interface, kind) else self.installed
        offers, label = _offers(plugins, interface, kind), one_line(kind)
        classes = {p.distribution: o.component for p, o in offers if o.component}
        if len(classes) > 1:
            choice = ", ".join(f"'{source}:{kind}'" for source in classes)
            raise ExperimentError(f"'{label}' is offered by several distributions; write {choice}")
        if classes:
            return classes.popitem()[1]
        if distribution:
            for plugin in [p for p, _ in offers] or plugins:
                if plugin.fault:
                    raise PluginError(f"'{label}' belongs to {plugin}, which is {plugin.fault}")
            hint = did_you_mean(kind, [o.name for _, o in _offers(plugins, interface)])
            text = f"offers no {interface.__name__} '{label}'{hint}"
            raise ExperimentError(f"{one_line(distribution)} {text}")
        for plugin, offer in offers:
            raise PluginError(f"'{label}' belongs to {plugin}, which is broken: {offer.reason}")
        installed = sorted(names[0] for names in self.spellings(interface).values())
        hint = f"{did_you_mean(kind, installed)} (installed: {', '.join(installed)})"
        faults = "".join(f"; {p} is {p.fault}" for p in self.installed if p.fault)
        raise ExperimentError(f"unknown type '{label}'{hint}{faults}")

    def spellings(
        self, interface: type[Component], *, installed: bool = True
    ) -> dict[type[Component], list[str]]:
        """Return the usable components of an interface, each with all its names.

        The first name is the shortest.

        Parameters
        ----------
        interface
            Interface of the components.
        installed
            Whether to include third-party plugins.
        """
        result: dict[type[Component], list[str]] = {}
        for plugin, offer in _offers(self.plugins if installed else self._local, interface):
            if offer.component:
                names = result.setdefault(offer.component, [self._name_in(plugin, offer)])
                full = f"{plugin.distribution}:{offer.name}"
                if plugin not in self._local and full not in names:
                    names.append(full)
        return result

    def versions(self, used: Iterable[Component]) -> dict[str, str]:
        """Return the versions of the distributions of components.

        Classes without distribution are listed by their types under `GIVEN`.
        """
        classes = {type(component) for component in used}
        plugins = [self._builtin, *self._loaded.values()]
        versions = {p.distribution: p.version for p in plugins if classes & set(p.components)}
        local_classes = classes.difference(*(p.components for p in plugins))
        types = ", ".join(sorted(c.type_name() for c in local_classes))
        return versions | ({GIVEN: types} if local_classes else {})

    def name_of(self, component: Component) -> str:
        """Return the type by which another experiment can select the class of a component.

        The name includes the distribution if another plugin that has been imported provides the
        same type.
        """
        offers = [(p, o) for p in [*self._local, *self._loaded.values()] for o in p.offers]
        names = (self._name_in(p, o) for p, o in offers if o.component is type(component))
        return next(names, component.type_name())

    def warnings(self) -> list[str]:
        """Return warnings about disabled names that no installed plugin has."""
        plugins = [*self._found, *installed_plugins(COMMAND_GROUP)]
        names = {name for p in plugins for name in (p.distribution, p.name)}
        return [
            f"{DISABLE} contains '{name}', which is not installed{did_you_mean(name, names)}"
            for name in disabled_names()
            if name != ALL and not any(plugin.answers_to(name) for plugin in plugins)
        ]

    @cached_property
    def _found(self) -> list[Plugin]:
        return installed_plugins()

    def _load(self, plugins: list[Plugin]) -> list[Plugin]:
        self._loaded |= {p: loaded(p) for p in plugins if p not in self._loaded}
        return _judged([self._loaded[p] for p in plugins], self._builtin)

    def _of(self, distribution: str, name: str) -> list[Plugin]:
        """Return the loaded plugins of a distribution."""
        if canonical(distribution) == BUILTIN:
            return [self._builtin]
        key, plugins = canonical(distribution), self._found
        selected = [p for p in plugins if canonical(p.distribution) == key]
        if not selected:
            hint = did_you_mean(distribution, [p.distribution for p in plugins])
            text = f"'{one_line(name)}' belongs to {one_line(distribution)}"
            raise PluginError(f"{text}, which is not installed{hint}")
        return self._load(selected)

    def _name_in(self, plugin: Plugin, offer: Offer) -> str:
        if plugin in self._local:
            return offer.name
        if "installed" in self.__dict__:  # all plugins are loaded only then
            offers = _offers([*self._local, *self.installed], offer.interface, offer.name)
            if {p.distribution for p, o in offers if o.component} == {plugin.distribution}:
                return offer.name
        return f"{plugin.distribution}:{offer.name}"


def _offers(
    plugins: Iterable[Plugin], interface: type[Component] | None, name: str | None = None
) -> list[tuple[Plugin, Offer]]:
    """Return the offers (components that plugins provide) for an interface, optionally for one type
    only. Unusable ones are included."""
    offers = [(plugin, o) for plugin in plugins for o in plugin.offers if o.interface is interface]
    return [(plugin, o) for plugin, o in offers if name in (None, o.name)]


def _judged(plugins: list[Plugin], builtin: Plugin) -> list[Plugin]:
    """Add a reason to each offer that conflicts with another one."""
    result = []
    for plugin in plugins:
        offers = tuple(_judged_offer(plugin, o, plugins, builtin) for o in plugin.offers)
        result.append(replace(plugin, offers=offers))
    return result


def _judged_offer(plugin: Plugin, offer: Offer, plugins: list[Plugin], builtin: Plugin) -> Offer:
    if offer.component is None:
        return offer
    name, advice = offer.name, f"write '{plugin.distribution}:{offer.name}'"
    twins = [(p, o) for p, o in _offers(plugins, offer.interface, name) if o.component]
    classes = {o.component for p, o in twins if p.distribution == plugin.distribution}
    if len(classes) > 1:
        reason = f"it has two classes with the type '{name}'; change the type of one of them"
        return replace(offer, component=None, reason=reason)
    if _offers([builtin], offer.interface, name) or is_retired(offer.interface, name):
        what = f"'{name}' is the name of a built-in {interface_of(offer.component).__name__}"
        change = "change the type"
        remedy = f"{advice}, or {change}" if plugin.distribution else change
        return replace(offer, reason=f"{what}; {remedy}")
    if rivals := [str(p) for p, _ in twins if p.distribution != plugin.distribution]:
        reason = f"'{name}' is offered by {', '.join(rivals)} too; {advice}"
        return replace(offer, reason=reason)
    return offer


def _given(components: Iterable[type[Component]], builtin: Plugin) -> Plugin:
    """Return a plugin with classes that are passed as Python objects.

    Raises
    ------
    ExperimentError
        If a class is not usable.
    """
    if not isinstance(components, Iterable):
        raise ExperimentError(
            f"components: expected a list of classes, as [MyRule], got {components!r:.60}"
        )
    try:
        offers = tuple(dict.fromkeys(map(checked, components)))  # unique, in their order
    except TypeError as error:
        raise ExperimentError(f"components: {error}") from None
    (plugin,) = _judged([Plugin(GIVEN, "", "", offers=offers)], builtin)
    for offer in plugin.offers:
        if offer.reason:
            raise ExperimentError(f"components: {offer.reason}")
    return plugin
