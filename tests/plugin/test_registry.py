"""Plugins: the others load in spite of the errors of one, and errors are reported."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import pytest
from plugin_sources import BROKEN, hook, rule

import pbdkit
from pbdkit.plugin.registry import Registry

Install = Callable[..., None]


@pytest.mark.parametrize(("source", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_plugin_stops_no_other(install: Install, source: str, reason: str) -> None:
    install("pbdkit-broken", source, "0.3")
    install("pbdkit-after", rule("after"))
    registry = Registry()
    plugins = {p.distribution: p for p in registry.installed}
    assert list(plugins) == ["pbdkit-after", "pbdkit-broken"]
    broken = plugins["pbdkit-broken"]
    assert (broken.version, broken.state, broken.components) == ("0.3", "broken", ())
    assert broken.reason.startswith(reason)
    assert plugins["pbdkit-after"].state == "ok"
    assert registry.find(pbdkit.FollowerRule, "after").type_name() == "after"
    with pytest.raises(pbdkit.PluginError) as caught:
        registry.find(pbdkit.FollowerRule, "pbdkit-broken:lost")
    expected = f"'lost' belongs to pbdkit-broken 0.3, which is broken: {reason}"
    assert str(caught.value).startswith(expected)


def test_hook_that_returns_nothing_is_reported(install: Install) -> None:
    install("pbdkit-empty", hook("return None"))
    (plugin,) = Registry().installed
    assert plugin.state == "broken"
    assert "implements no hook" not in plugin.reason


def test_no_component_of_a_generator_is_lost(install: Install) -> None:
    install("pbdkit-lazy", rule("lazy").replace("return [Rule]", "yield Rule"))
    (plugin,) = Registry().installed
    assert plugin.state == "broken" or [c.type_name() for c in plugin.components] == ["lazy"]


def test_an_unknown_type_names_the_broken_plugins(install: Install, tensile: Any) -> None:
    install("pbdkit-broken", "import no_such_module", "0.3")
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.Experiment(**tensile | {"rule": {"type": "lost"}})
    assert "pbdkit-broken 0.3 is broken: ModuleNotFoundError: " in str(caught.value)


def test_a_plugin_runs_and_is_named_in_the_dataset(install: Install, tensile: Any) -> None:
    install("pbdkit-after", rule("after"), "2.1")
    ds = pbdkit.run(tensile | {"rule": {"type": "after"}}, progress=False)
    same = pbdkit.run(tensile | {"rule": {"type": "mean-displacement"}}, progress=False)
    np.testing.assert_array_equal(ds["position"], same["position"])
    assert json.loads(ds.attrs["plugins"])["pbdkit-after"] == "2.1"


def test_order_does_not_choose_a_distribution(install: Install, tensile: Any) -> None:
    install("pbdkit-one", rule("twin"))
    install("pbdkit-two", rule("twin"))
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.Experiment(**tensile | {"rule": {"type": "twin"}})
    assert str(caught.value) == (
        "rule.type: 'twin' is offered by several distributions; write 'pbdkit-one:twin', "
        "'pbdkit-two:twin'"
    )
    chosen = pbdkit.Experiment(**tensile | {"rule": {"type": "pbdkit-two:twin"}})
    assert type(chosen.rule).__module__ == "pbdkit_two"
    assert chosen.distributions() == {"pbdkit": pbdkit.__version__, "pbdkit-two": "1.0"}


def test_dataset_stores_the_chosen_distribution(install: Install, tensile: Any) -> None:
    install("pbdkit-one", rule("twin"))
    install("pbdkit-two", rule("twin"))
    ds = pbdkit.run(tensile | {"rule": {"type": "pbdkit-two:twin"}}, progress=False)
    again = pbdkit.rerun(ds, progress=False)
    assert again.attrs["plugins"] == ds.attrs["plugins"]


def test_type_provided_twice_is_in_conflict(install: Install, tensile: Any) -> None:
    install("pbdkit-one", rule("twin"))
    install("pbdkit-two", rule("twin"))
    install("pbdkit-thief", rule("barycentre"))
    assert type(pbdkit.Experiment(**tensile).rule).__module__ == "pbdkit.components.rules"
    assert [p.state for p in Registry().installed] == ["conflict"] * 3


def test_a_missing_distribution_is_named(tensile: Any) -> None:
    with pytest.raises(pbdkit.PluginError) as caught:
        pbdkit.Experiment(**tensile | {"rule": {"type": "pbdkit-missing:lost"}})
    assert "'lost' belongs to pbdkit-missing, which is not installed" in str(caught.value)


def test_a_distribution_without_that_component(install: Install, tensile: Any) -> None:
    install("pbdkit-after", rule("after"))
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.Experiment(**tensile | {"rule": {"type": "pbdkit-after:aftr"}})
    assert str(caught.value).startswith("rule.type: pbdkit-after offers no FollowerRule 'aftr'")
    assert "did you mean 'after'?" in str(caught.value)


class Still(pbdkit.FollowerRule):
    type: Literal["still"] = "still"

    @staticmethod
    def gather(d: Any, r: Any, w: Any, p: Any) -> tuple[Any, ...]:
        return (1.0,)

    @staticmethod
    def apply(total: Any, here: Any, p: Any) -> Any:
        return 0.0 * here.u


class Rightwards(pbdkit.NeighbourMetric):
    type: Literal["rightwards"] = "rightwards"

    def shells_around(self, cell: pbdkit.plugin.Cell, sublattice: int) -> Sequence[Sequence[Any]]:
        return [[o for o in cell.offsets(sublattice, 1.0) if o.site > (0, 0)]]


class Loose(pbdkit.FramePolicy):
    type: Literal["loose"] = "loose"

    def depth(self, reach: int) -> int:
        return reach

    def follow(self, frame: pbdkit.plugin.FrameSites) -> pbdkit.plugin.FrameMap:
        point, body = frame.nearest()
        followed = point != 2
        return pbdkit.plugin.FrameMap(point[followed], body[followed], np.ones(followed.sum()))


class Misshapen(pbdkit.Diagnostic):
    type: Literal["misshapen"] = "misshapen"

    def variables(self) -> tuple[pbdkit.plugin.Variable, ...]:
        return (pbdkit.plugin.Variable("m", ("particle",), "too short by one", "1"),)

    def measure(self, now: pbdkit.plugin.Moment) -> tuple[Any, ...]:
        return (np.zeros(29),)


def test_a_component_from_python(tensile: Any) -> None:
    by_name = pbdkit.run(tensile | {"rule": {"type": "still"}}, components=[Still], progress=False)
    experiment = pbdkit.Experiment(**tensile | {"rule": Still()})
    np.testing.assert_array_equal(
        by_name["position"], pbdkit.run(experiment, progress=False)["position"]
    )
    assert float(by_name["position"][-1, 7, 0]) == 0.0


def test_components_must_be_components(tensile: Any) -> None:
    with pytest.raises(pbdkit.ExperimentError, match=r"^components: <class 'int'> does not impl"):
        pbdkit.run(tensile, components=[int], progress=False)


def test_two_components_of_one_type_are_refused(tensile: Any) -> None:
    class Twin(Still):
        pass

    with pytest.raises(pbdkit.ExperimentError, match="still"):
        pbdkit.run(tensile, components=[Still, Twin], progress=False)


@pytest.mark.parametrize(
    ("part", "component", "expected"),
    [
        ("neighbours", Rightwards, "neighbours: 'rightwards' is not mutual: the neighbour at site"),
        (
            "frame",
            Loose,
            "frame: 'loose' maps frame point 3 to no particle of the body, so that the point",
        ),
    ],
)
def test_component_with_an_invalid_model_is_refused(
    tensile: Any, part: str, component: Any, expected: str
) -> None:
    given = tensile | {part: {"type": component.type_name()}}
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.run(given, components=[component], progress=False)
    assert str(caught.value).startswith(expected)


def test_a_measured_array_of_the_wrong_shape_is_named(tensile: Any) -> None:
    given = tensile | {"diagnostics": [{"type": "misshapen"}]}
    with pytest.raises(pbdkit.PluginError, match="misshapen"):
        pbdkit.run(given, components=[Misshapen], progress=False)
