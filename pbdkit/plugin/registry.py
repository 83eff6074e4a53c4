"""The registry: from the `type` in an experiment to the class that implements it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

from pbdkit.errors import ExperimentError, PluginError, did_you_mean, one_line
from pbdkit.plugin import BUILTIN, Component
from pbdkit.plugin.discovery import (
    ALL,
    DISABLE,
    Offer,
    Plugin,
    canonical,
    checked,
    disabled_names,
    installed_plugins,
    interface_of,
    is_retired,
    load_builtin,
    loaded,
)
from pbdkit.plugin.hooks import COMMAND_GROUP

GIVEN = "components"
"""How classes that were handed over in Python appear among the plugins."""


class Registry:
    """The built-in components, those handed over in Python, and, once needed, the installed ones.

    An experiment that uses only built-in names imports no third-party code, and one that names a
    distribution imports no other.
    """

    def __init__(self, components: Iterable[type[Component]] = ()) -> None:
        self._builtin = load_builtin()
        self._own = [self._builtin, _given(components, self._builtin)]
        self._loaded: dict[Plugin, Plugin] = {}

    @cached_property
    def installed(self) -> list[Plugin]:
        """The third-party plugins; the first look at them imports them."""
        return self._load(self._found)

    @property
    def plugins(self) -> list[Plugin]:
        """Every plugin, the built-in one first."""
        return [p for p in self._own if p.offers] + self.installed

    def find(self, interface: type[Component], name: str) -> type[Component]:
        """The class of that interface and type.

        `name` may name its distribution: ``pbdkit-x:rule-name``. Raises ExperimentError for a name
        that nobody offers or that several offer, PluginError where the distribution that it is
        asked of, or that it comes from, is missing, disabled, broken or incompatible.
        """
        distribution, _, kind = name.rpartition(":")
        if distribution:
            plugins = self._of(distribution, kind)
        else:
            plugins = self._own if _offers(self._own, interface, kind) else self.installed
        offers, told = _offers(plugins, interface, kind), one_line(kind)
        classes = {p.distribution: o.component for p, o in offers if o.component}
        if len(classes) > 1:
            choice = ", ".join(f"'{one}:{kind}'" for one in classes)
            raise ExperimentError(f"'{told}' is offered by several distributions: write {choice}")
        if classes:
            return classes.popitem()[1]
        if distribution:
            for plugin in [p for p, _ in offers] or plugins:
                if plugin.fault:
                    raise PluginError(f"'{told}' is asked of {plugin}, which is {plugin.fault}")
            hint = did_you_mean(kind, [o.name for _, o in _offers(plugins, interface)])
            what = f"offers no {interface.__name__} '{told}'{hint}"
            raise ExperimentError(f"{one_line(distribution)} {what}")
        for plugin, offer in offers:
            raise PluginError(f"'{told}' comes from {plugin}, which is broken: {offer.reason}")
        installed = sorted(names[0] for names in self.spellings(interface).values())
        hint = f"{did_you_mean(kind, installed)} (installed: {', '.join(installed)})"
        others = "".join(f"; {p} is {p.fault}" for p in self.installed if p.fault)
        raise ExperimentError(f"unknown type '{told}'{hint}{others}")

    def spellings(
        self, interface: type[Component], *, installed: bool = True
    ) -> dict[type[Component], list[str]]:
        """Every usable component of an interface, third parties' too if `installed`, with all names
        that an experiment may give it, the shortest first."""
        found: dict[type[Component], list[str]] = {}
        for plugin, offer in _offers(self.plugins if installed else self._own, interface):
            if offer.component:
                names = found.setdefault(offer.component, [self._name_in(plugin, offer)])
                full = f"{plugin.distribution}:{offer.name}"
                if plugin not in self._own and full not in names:
                    names.append(full)
        return found

    def versions(self, used: Iterable[Component]) -> dict[str, str]:
        """The distributions that these components come from, with their versions; under GIVEN the
        types of those that come from none."""
        classes = {type(component) for component in used}
        known = [self._builtin, *self._loaded.values()]
        found = {p.distribution: p.version for p in known if classes & set(p.components)}
        given = classes.difference(*(p.components for p in known))
        types = ", ".join(sorted(c.type_name() for c in given))
        return found | ({GIVEN: types} if given else {})

    def name_of(self, component: Component) -> str:
        """The type by which an experiment finds this component again: with its distribution unless
        nobody else is known to offer the type."""
        known = [(p, o) for p in [*self._own, *self._loaded.values()] for o in p.offers]
        names = (self._name_in(p, o) for p, o in known if o.component is type(component))
        return next(names, component.type_name())

    def doubts(self) -> list[str]:
        """Return warnings about names to be disabled that no installed plugin has."""
        plugins = [*self._found, *installed_plugins(COMMAND_GROUP)]
        known = {name for p in plugins for name in (p.distribution, p.name)}
        return [
            f"{DISABLE} names '{name}', which is not installed{did_you_mean(name, known)}"
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
        """The plugins of a distribution."""
        if canonical(distribution) == BUILTIN:
            return [self._builtin]
        own = [p for p in self._found if canonical(p.distribution) == canonical(distribution)]
        if not own:
            hint = did_you_mean(distribution, [p.distribution for p in self._found])
            asked = f"'{one_line(name)}' is asked of {one_line(distribution)}"
            raise PluginError(f"{asked}, which is not installed{hint}")
        return self._load(own)

    def _name_in(self, plugin: Plugin, offer: Offer) -> str:
        if plugin in self._own:
            return offer.name
        if "installed" in self.__dict__:  # only then are all known
            offers = _offers([*self._own, *self.installed], offer.interface, offer.name)
            if {p.distribution for p, o in offers if o.component} == {plugin.distribution}:
                return offer.name
        return f"{plugin.distribution}:{offer.name}"


def _offers(
    plugins: Iterable[Plugin], interface: type[Component] | None, name: str | None = None
) -> list[tuple[Plugin, Offer]]:
    """The offers of that interface, and of one type where it is given, the broken ones too."""
    every = [(plugin, o) for plugin in plugins for o in plugin.offers if o.interface is interface]
    return [(plugin, o) for plugin, o in every if name in (None, o.name)]


def _judged(plugins: list[Plugin], builtin: Plugin) -> list[Plugin]:
    """The plugins, with the reason at each offer that is in conflict with others."""
    found = []
    for plugin in plugins:
        offers = tuple(_judged_offer(plugin, o, plugins, builtin) for o in plugin.offers)
        found.append(replace(plugin, offers=offers))
    return found


def _judged_offer(plugin: Plugin, offer: Offer, plugins: list[Plugin], builtin: Plugin) -> Offer:
    if offer.component is None:
        return offer
    name, chosen = offer.name, f"write '{plugin.distribution}:{offer.name}'"
    twins = [(p, o) for p, o in _offers(plugins, offer.interface, name) if o.component]
    own = {o.component for p, o in twins if p.distribution == plugin.distribution}
    if len(own) > 1:
        reason = f"it offers two classes with the type '{name}'; give one of them another"
        return replace(offer, component=None, reason=reason)
    if _offers([builtin], offer.interface, name) or is_retired(offer.interface, name):
        what = f"'{name}' is the name of a built-in {interface_of(offer.component).__name__}"
        remedy = f"{chosen}, or give it another type" if plugin.distribution else "give it another"
        return replace(offer, reason=f"{what}; {remedy}")
    if others := [str(p) for p, _ in twins if p.distribution != plugin.distribution]:
        reason = f"'{name}' is offered by {', '.join(others)} too; {chosen}"
        return replace(offer, reason=reason)
    return offer


def _given(components: Iterable[type[Component]], builtin: Plugin) -> Plugin:
    """Classes from Python as a plugin; ExperimentError for what cannot be used."""
    try:
        offers = tuple(dict.fromkeys(map(checked, components)))  # each once, in their order
    except TypeError as error:
        raise ExperimentError(f"components: {error}") from None
    (given,) = _judged([Plugin(GIVEN, "", "", offers=offers)], builtin)
    for offer in given.offers:
        if offer.reason:
            raise ExperimentError(f"components: {offer.reason}")
    return given
