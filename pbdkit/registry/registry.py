"""The registry: from the `type` in an experiment to the class that implements it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.interfaces import Component
from pbdkit.interfaces.naming import did_you_mean
from pbdkit.registry.checking import check_component
from pbdkit.registry.conflicts import judged, named
from pbdkit.registry.discovery import (
    ALL,
    DISABLE,
    Point,
    canonical,
    disabled,
    disabled_names,
    installed_points,
)
from pbdkit.registry.loading import Offer, Plugin, load_builtin, load_plugin, offer_of
from pbdkit.registry.searching import declares

GIVEN = "components"
"""How classes that were handed over in Python appear among the plugins."""


class Registry:
    """The built-in components, those handed over in Python, and, once needed, the installed ones.

    An experiment that uses only built-in names imports no third-party code, and one that names a
    distribution imports no other.
    """

    def __init__(self, components: Iterable[type[Component]] = ()) -> None:
        self._builtin = load_builtin()
        self._given = Plugin(GIVEN, "", "", "ok", offers=_given(components, self._builtin))
        self._loaded: dict[Point, Plugin] = {}

    @cached_property
    def installed(self) -> list[Plugin]:
        """The third-party plugins; the first look at them imports them."""
        return judged([self._load(point) for point in self._points], self._builtin)

    @property
    def plugins(self) -> list[Plugin]:
        """Every plugin, the built-in one first."""
        given = [self._given] if self._given.offers else []
        return [self._builtin, *given, *self.installed]

    def find(self, interface: type[Component], name: str) -> type[Component]:
        """The class of that interface and type.

        `name` may name its distribution: ``pbdkit-x:rule-name``. Raises ExperimentError for a name
        that nobody offers or that several offer, PluginError where the distribution that it is
        asked of, or that it comes from, is missing, disabled, broken or incompatible.
        """
        if ":" in name:
            return self._find_in_distribution(interface, *name.split(":", 1))
        own = named([self._builtin, self._given], interface, name)
        offers = own or named(self.installed, interface, name)
        classes = {p.distribution: o.component for p, o in offers if o.component is not None}
        if len(classes) > 1:
            choice = ", ".join(f"'{distribution}:{name}'" for distribution in classes)
            raise ExperimentError(f"'{name}' is offered by several distributions: write {choice}")
        if classes:
            return next(iter(classes.values()))
        self._blame_its_plugin(interface, name)
        raise ExperimentError(self._unknown(interface, name))

    def components(
        self, interface: type[Component], *, installed: bool = True
    ) -> dict[str, type[Component]]:
        """Every usable component of an interface by the name that an experiment gives it; third
        parties' too if `installed`."""
        spellings = self.spellings(interface, installed=installed)
        return {names[0]: component for component, names in spellings.items()}

    def spellings(
        self, interface: type[Component], *, installed: bool = True
    ) -> dict[type[Component], list[str]]:
        """The same by class, with all names that an experiment may give it, the shortest first."""
        found: dict[type[Component], list[str]] = {}
        for plugin in self.plugins if installed else [self._builtin, self._given]:
            for offer in plugin.offers:
                if offer.component is not None and offer.interface is interface:
                    names = found.setdefault(offer.component, [self._name_in(plugin, offer)])
                    if plugin not in (self._builtin, self._given):
                        names.append(f"{plugin.distribution}:{offer.name}")
        return {component: list(dict.fromkeys(names)) for component, names in found.items()}

    def versions(self, used: Iterable[Component]) -> dict[str, str]:
        """The distributions that these components come from, with their versions; under GIVEN the
        types of those that come from none."""
        classes = {type(component) for component in used}
        loaded = [self._builtin, *self._loaded.values()]
        found = {p.distribution: p.version for p in loaded if classes & set(p.components)}
        offered = {c for p in loaded for c in p.components}
        given = sorted({c.type_name() for c in classes - offered})
        return found | ({GIVEN: ", ".join(given)} if given else {})

    def name_of(self, component: Component) -> str:
        """The type by which an experiment finds this component again: with its distribution unless
        nobody else is known to offer the type."""
        for plugin in [self._builtin, self._given, *self._loaded.values()]:
            for offer in plugin.offers:
                if offer.component is type(component):
                    return self._name_in(plugin, offer)
        return component.type_name()

    def doubts(self) -> list[str]:
        """What the user may have meant otherwise: names to be disabled that nothing has."""
        known = {name for p in self._points for name in (p.distribution, p.name)}
        return [
            f"{DISABLE} names '{name}', which is not installed{did_you_mean(name, known)}"
            for name in disabled_names()
            if name != ALL and not any(point.answers_to(name) for point in self._points)
        ]

    @cached_property
    def _points(self) -> list[Point]:
        return installed_points()

    @cached_property
    def _disabled(self) -> dict[Point, str]:
        return disabled(self._points)

    def _load(self, point: Point) -> Plugin:
        if point not in self._loaded:
            why = self._disabled.get(point)
            self._loaded[point] = (
                Plugin(point.name, point.distribution, point.version, "disabled", why)
                if why
                else load_plugin(point)
            )
        return self._loaded[point]

    def _name_in(self, plugin: Plugin, offer: Offer) -> str:
        own = [self._builtin, self._given]
        if plugin in own:
            return offer.name
        alone = "installed" in self.__dict__ and not named(own, offer.interface, offer.name)
        offers = named(self.installed, offer.interface, offer.name) if alone else []
        if len({p.distribution for p, o in offers if o.component}) == 1:
            return offer.name
        return f"{plugin.distribution}:{offer.name}"

    def _find_in_distribution(
        self, interface: type[Component], distribution: str, name: str
    ) -> type[Component]:
        if canonical(distribution) == canonical(self._builtin.distribution):
            plugins = [self._builtin]
        else:
            points = [
                p for p in self._points if canonical(p.distribution) == canonical(distribution)
            ]
            plugins = judged([self._load(point) for point in points], self._builtin)
        if not plugins:
            known = did_you_mean(distribution, {p.distribution for p in self._points})
            raise PluginError(f"'{name}' is asked of {distribution}, which is not installed{known}")
        offers = named(plugins, interface, name)
        if usable := [offer.component for _, offer in offers if offer.component is not None]:
            return usable[0]
        for plugin in [p for p, _ in offers] or plugins:
            if plugin.state not in ("ok", "conflict"):
                raise PluginError(f"'{name}' is asked of {plugin}, which is {_why(plugin)}")
        offered = [o.name for p in plugins for o in p.offers if o.interface is interface]
        hint = did_you_mean(name, offered)
        raise ExperimentError(f"{distribution} offers no {interface.__name__} '{name}'{hint}")

    def _blame_its_plugin(self, interface: type[Component], name: str) -> None:
        """PluginError where the type is that of a plugin which is not in order."""
        for plugin, offer in named(self.installed, interface, name):
            raise PluginError(f"'{name}' comes from {plugin}, which is broken: {offer.reason}")
        for point, plugin in zip(self._points, self.installed, strict=True):
            if not plugin.components and plugin.state != "ok" and declares(point, name):
                raise PluginError(f"'{name}' comes from {plugin}, which is {_why(plugin)}")

    def _unknown(self, interface: type[Component], name: str) -> str:
        offered = sorted(self.components(interface))
        hint = did_you_mean(name, offered)
        missing = [p for p in self.installed if p.state not in ("ok", "conflict")]
        others = "".join(f"; {plugin} is {_why(plugin)}" for plugin in missing)
        return f"unknown type '{name}'{hint} (installed: {', '.join(offered)}){others}"


def _why(plugin: Plugin) -> str:
    return f"{plugin.state}: {plugin.reason}"


def _given(components: Iterable[type[Component]], builtin: Plugin) -> tuple[Offer, ...]:
    """The offers of classes from Python; ExperimentError for what cannot be used."""
    offers: list[Offer] = []
    for component in components:
        try:
            check_component(component)
        except TypeError as error:
            raise ExperimentError(f"components: {error}") from None
        offer = offer_of(component)
        if offer.interface and named([builtin], offer.interface, offer.name):
            raise ExperimentError(
                f"components: '{offer.name}' is the name of a built-in "
                f"{offer.interface.__name__}; give {component.__name__} another type"
            )
        twins = [o for o in offers if (o.interface, o.name) == (offer.interface, offer.name)]
        if any(o.component is not component for o in twins):
            raise ExperimentError(f"components: two classes have the type '{offer.name}'")
        offers += [] if twins else [offer]
    return tuple(offers)
