"""Components that their type alone does not name: never settled by the order of loading."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pbdkit.interfaces import Component
from pbdkit.registry.discovery import canonical
from pbdkit.registry.loading import Offer, Plugin


def named(
    plugins: Iterable[Plugin], interface: type[Component] | None, name: str
) -> list[tuple[Plugin, Offer]]:
    """The offers of that interface and type, the broken ones too."""
    return [
        (plugin, offer)
        for plugin in plugins
        for offer in plugin.offers
        if offer.interface is interface and offer.name == name
    ]


def judged(plugins: list[Plugin], builtin: Plugin) -> list[Plugin]:
    """The third-party plugins with their clashes: among each other and with built-in names."""
    return [_judged(plugin, plugins, builtin) for plugin in plugins]


def _judged(plugin: Plugin, plugins: list[Plugin], builtin: Plugin) -> Plugin:
    offers = tuple(_judged_offer(plugin, offer, plugins, builtin) for offer in plugin.offers)
    changed = [new for new, old in zip(offers, plugin.offers, strict=True) if new is not old]
    if not changed:
        return plugin
    states = {plugin.state, *(offer.state for offer in changed)}
    reason = "; ".join(filter(None, [plugin.reason, *(offer.reason for offer in changed)]))
    state = "broken" if "broken" in states else "conflict"
    return replace(plugin, state=state, reason=reason, offers=offers)


def _judged_offer(plugin: Plugin, offer: Offer, plugins: list[Plugin], builtin: Plugin) -> Offer:
    if offer.component is None or offer.interface is None:
        return offer
    name, kind = offer.name, offer.interface.__name__
    chosen = f"write '{plugin.distribution}:{name}'"
    if named([builtin], offer.interface, name):
        reason = f"'{name}' is the name of a built-in {kind}; {chosen}, or give it another type"
        return replace(offer, state="conflict", reason=reason)
    found = named(plugins, offer.interface, name)
    others = [p for p, o in found if o.component is not None and not _is_same(p, o, plugin, offer)]
    if not others:
        return offer
    if any(canonical(p.distribution) == canonical(plugin.distribution) for p in others):
        reason = f"it offers two classes with the type '{name}'; give one of them another"
        return replace(offer, component=None, state="broken", reason=reason)
    reason = f"'{name}' is offered by {', '.join(map(str, others))} too; {chosen}"
    return replace(offer, state="conflict", reason=reason)


def _is_same(plugin: Plugin, offer: Offer, other: Plugin, own: Offer) -> bool:
    """One class that two entry points of a distribution lead to."""
    return offer.component is own.component and plugin.distribution == other.distribution
