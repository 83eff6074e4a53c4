"""Bad or extreme input is answered soon, in one short message that names it."""

from __future__ import annotations

import copy
import json
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from hostile_input import mutant
from ruamel.yaml.scanner import Scanner
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit import Experiment
from pbdkit.errors import MAX_CHARACTERS, PbdkitError, printable
from pbdkit.model.reading import MAX_DEPTH, Source, read_text
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import rehearse
from pbdkit.stability.forecast import forecast

Call = Callable[..., Any]
SOON_S = 5.0
"""Largest processor time in seconds, so that a busy machine does not decide."""


def checked(**parts: Any) -> tuple[Any, float]:
    """The forecast of paper/a with other parts, and what it took."""
    data = json.loads(pbdkit.load("paper/a").model_dump_json(by_alias=True)) | parts
    begun = time.process_time()
    found = forecast(build_scene(Experiment.build(Source("e.yaml", data))))
    return found, time.process_time() - begun


def grid(columns: int, rows: int) -> dict[str, Any]:
    return {"type": "grid", "columns": columns, "rows": rows}


def test_messages_are_bounded_and_escaped() -> None:
    error = pbdkit.ExperimentError("e.yaml:1:1: \x1b[31mred\ud800 " + "x" * 100_000 + "; remedy")
    assert len(str(error)) < 1100
    assert str(error).startswith(r"e.yaml:1:1: \x1b[31mred\ud800 xxx")
    assert str(error).endswith("xxx; remedy")
    assert printable(str(error)) == str(error)
    assert len(str(pbdkit.StorageError("\n".join(["y" * 9000] * 300)))) <= 4000


@pytest.mark.parametrize("field", ["lattice", "rule", "body", "fracture"])
@pytest.mark.parametrize(
    "name", ["x" * 100_000, "\x1b[2Jx", "\ud800"], ids=["long", "escapes", "surrogate"]
)
def test_an_unknown_type_is_shortened_and_escaped(field: str, name: str) -> None:
    with pytest.raises(
        pbdkit.ExperimentError, match=rf"(?m)^{field}.type: unknown type '"
    ) as caught:
        Experiment.build(Source(data={"name": "x", field: {"type": name}}))
    text = str(caught.value)
    assert len(text) < MAX_CHARACTERS
    assert all(c.isprintable() or c == "\n" for c in text)
    text.encode()


@pytest.mark.parametrize(
    "text",
    ['"\\ud800": 1', 'name: "\\udfff"', 'rule: {type: "\\ud800"}'],
    ids=["key", "value", "in"],
)
def test_unpaired_surrogates_are_refused_in_files(text: str) -> None:
    with pytest.raises(pbdkit.ExperimentError, match=r"^e:1:\d+: an unpaired surrogate"):
        read_text(text, "e")


TEXTS = {
    "newlines": lambda size: "\n" * (size - 1),
    "quoted newlines": lambda size: '"' + "\n" * (size - 3) + '"',
    "words": lambda size: "a: " + "x " * (size // 2 - 4),
    "a block": lambda size: "a: |\n" + " x\n" * (size // 3 - 3),
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_large_file_is_read_quickly(text: Any) -> None:
    """The limit is half the time that two looks at every event took, in proportion to the size. The
    file is a quarter of the largest accepted one; in the profile `long` it is the largest."""
    share = 1 if AT_LENGTH else 4
    begun = time.process_time()
    with pytest.raises(pbdkit.ExperimentError):
        Experiment.build(read_text(text(2**20 // share), "e"))
    assert time.process_time() - begun < SOON_S / share


@pytest.mark.parametrize("opening", ["[", "{a: ", "[ {x: "])
def test_cost_of_nested_brackets_is_bounded(opening: str, monkeypatch: Any) -> None:
    """At each character ruamel goes through the keys that may have begun."""
    noted, original = [0], Scanner.stale_possible_simple_keys

    def stale(scanner: Any) -> None:
        noted.append(len(scanner.possible_simple_keys))
        original(scanner)

    monkeypatch.setattr(Scanner, "stale_possible_simple_keys", stale)
    with pytest.raises(pbdkit.ExperimentError, match="nested more than 32 levels deep"):
        read_text("a: " + opening * 1000, "e")
    assert 0 < max(noted) <= MAX_DEPTH + 1


@pytest.mark.parametrize(
    ("radius", "weights"),
    [(1e9, (1, 1)), (40.0, (1, 1)), (1.5, (1e-30, 1)), (1.0, (1e16, 1e-16)), (1e300, (1e-300, 1))],
)
@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_too_many_neighbours_are_refused_before_they_are_listed(lattice, radius, weights) -> None:
    metric = {"type": "euclidean", "radius": radius, "weights": [float(w) for w in weights]}
    begun = time.process_time()
    text = "neighbours on this lattice; the maximum is 4224"
    with pytest.raises(pbdkit.ExperimentError, match=text):
        checked(neighbours=metric, lattice={"type": lattice, "a": 1.0})
    assert time.process_time() - begun < SOON_S


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_thirty_two_shells_are_the_maximum(lattice: str) -> None:
    scene = build_scene(
        Experiment(
            name="many",
            lattice={"type": lattice, "a": 1.0},
            body=grid(3, 3),
            neighbours={"type": "chebyshev", "shells": 32},
            rule={"type": "barycentre"},
            frame={"type": "none"},
            steps=1,
        )
    )
    assert {len(own) for own in scene.neighbourhood.slots} == {4224}


@pytest.mark.parametrize("a", [1e-20, 1e-60, 1e-100, 1e100])
def test_check_is_independent_of_the_unit_of_length(a: float) -> None:
    select = {"nearest": [[7.1 * a, 3.9 * a]]}
    leaders = [{"select": select, "motion": {"type": "displace", "displacement": [0.1 * a, 0.0]}}]
    found, took = checked(lattice={"type": "square", "a": a}, leaders=leaders)
    usual, _ = checked(
        leaders=[
            {
                "select": {"nearest": [[7.1, 3.9]]},
                "motion": {"type": "displace", "displacement": [0.1, 0.0]},
            }
        ]
    )
    assert found.spectral_radius == pytest.approx(usual.spectral_radius, rel=1e-12)
    assert found.bonds == usual.bonds
    assert took < SOON_S


BODIES = {
    "a long strip, a frame that lags": (
        {"body": grid(3000, 10), "frame": {"type": "mean", "lag": 1}},
        "eigenvalues lie too close together",
    ),
    "a long strip, 24 neighbours": (
        {"body": grid(3000, 10), "neighbours": {"type": "chebyshev", "shells": 2}},
        "42056 particles with 24 neighbours each exceed the maximum of 33333",
    ),
    "many neighbours": (
        {"neighbours": {"type": "chebyshev", "shells": 16}},
        "1764 particles with 1088 neighbours each exceed the maximum of 168",
    ),
    "a large body, a frame that lags": (
        {"body": grid(225, 225), "frame": {"type": "mean", "lag": 1}},
        "51529 particles exceed the maximum of 50000",
    ),
    "a large body that nothing holds": (
        {"body": grid(225, 225), "leaders": []},
        "51529 particles exceed the maximum of 50000",
    ),
}


@pytest.mark.parametrize(("parts", "said"), BODIES.values(), ids=BODIES)
def test_slow_analyses_are_omitted_with_a_warning(parts: Any, said: str) -> None:
    found, took = checked(diagnostics=[], **parts)
    assert took < 2 * SOON_S
    assert found.spectral_radius is found.lag is None
    (warning,) = [w for w in found.warnings if "omitted" in w]
    assert warning.startswith(
        "analysis: the spectrum and the distance from equilibrium are omitted, "
    )
    assert said in warning


def test_omitted_analysis_of_steps_is_no_warning_for_an_equilibrium() -> None:
    parts, _ = BODIES["many neighbours"]
    found, _ = checked(diagnostics=[], solver={"type": "equilibrium"}, **parts)
    assert found.spectral_radius is None
    assert not [warning for warning in found.warnings if "omitted" in warning]


def group(number: int, begin: int) -> dict[str, Any]:
    motion = {"type": "velocity", "velocity": [0.1, 0.0], "steps": 2}
    return {"select": {"numbers": [number]}, "motion": motion, "from": begin, "until": begin + 2}


@pytest.mark.parametrize(
    "groups",
    [
        [group(67 + n % 3, 1) for n in range(600)],
        [group(67, 1 + 3 * n) for n in range(600)],
    ],
    ids=["alike", "one after the other"],
)
def test_hundreds_of_leader_groups_are_compared_quickly(groups: Any) -> None:
    _, took = checked(leaders=groups, steps=1800)
    assert took < SOON_S


def test_path_of_thousands_of_knots_is_checked_quickly() -> None:
    steps = list(range(1, 5001))
    path = {"type": "path", "steps": steps, "displacements": [[1e-4 * n, 0.0] for n in steps]}
    _, took = checked(leaders=[{"select": {"edge": "right"}, "motion": path}], steps=5000)
    assert took < SOON_S


PLAIN = {
    "track": {"diagnostics": [{"type": "track", "numbers": [0xFFFFFFFFFFFFFFFFFFFF]}]},
    "noise": {"initial": {"type": "noise", "amplitude": 1e308}},
    "affine": {"initial": {"type": "affine", "gradient": [[1e308, 0.0], [0.0, 1e308]]}},
}


@pytest.mark.parametrize("parts", PLAIN.values(), ids=PLAIN)
def test_numbers_out_of_range_are_refused(parts: Any) -> None:
    with pytest.raises(pbdkit.ExperimentError, match="should be less than"):
        checked(**parts)


def test_sites_indistinguishable_in_double_precision_are_refused() -> None:
    with pytest.raises(pbdkit.ExperimentError, match=r"^e.yaml: lattice.origin: at 1e\+17 double"):
        checked(lattice={"type": "square", "a": 1.0, "origin": [1e17, 0.0]})
    far, _ = checked(lattice={"type": "square", "a": 1.0, "origin": [1e12, 0.0]})
    assert far.particles == 144


def test_gauge_of_zero_length_is_refused_by_check(call: Call) -> None:
    parts = {
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "diagnostics": [
            {
                "type": "stress-strain",
                "youngs_modulus": 1.0,
                "width": 9.0,
                "points": [[3.0, 0.0], [3.0, 9.0]],
            }
        ],
    }
    settings = [f"--set={name}={json.dumps(part)}" for name, part in parts.items()]
    result = call("check", "paper/a", *settings)
    assert result.code == 2
    assert "the gauge has no length along x" in result.err


def test_points_far_from_the_body_give_a_warning() -> None:
    far = {"select": {"nearest": [[100.0, 100.0], [9.4, 3.0]]}, "motion": {"type": "hold"}}
    (warning,) = [w for w in checked(leaders=[far])[0].warnings if "nearest" in w]
    assert warning == (
        "leaders.0.select.nearest: the distance of (100, 100) from the body is 128.7 lattice "
        "units; the nearest particle is 131, at (9, 9)"
    )


def test_files_of_another_kind_are_recognised(call: Call, tmp_path: Path) -> None:
    assert call("run", "paper/e", "-o", "m3.nc").code == 0
    result = call("run", "m3.nc")
    assert result.code == 2
    assert "m3.nc: is a result, not an experiment; `pbdkit plot m3.nc` draws it" in result.err
    for command in ("explain", "curve"):
        result = call(command, "e.json")
        assert result.code == 2
        assert (
            "e.json: is an experiment; `pbdkit run e.json` computes its result and prints the path"
            in result.err
        )


class Raising(pbdkit.FollowerRule):
    type: Literal["raising"] = "raising"
    kind: ClassVar[str] = "ValueError"

    @staticmethod
    def gather(d, r, w, p):
        raise KINDS[Raising.kind]

    @staticmethod
    def apply(total, here, p):
        return total


KINDS = {
    "ValueError": ValueError("inside out"),
    "ExperimentError": pbdkit.ExperimentError("inside out"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_exception_in_a_rule_names_the_rule(engine: str, kind: str, monkeypatch: Any) -> None:
    monkeypatch.setattr(Raising, "kind", kind)
    given = json.loads(pbdkit.load("paper/a").model_dump_json(by_alias=True))
    given |= {"rule": Raising(), "solver": {"type": "stepping", "engine": engine}}
    told = f"FollowerRule 'raising' failed .*{kind}: inside out"
    with pytest.raises(pbdkit.PluginError, match=told) as caught:
        pbdkit.run(given, progress=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_interrupt_in_a_rule_names_the_place(engine: str, monkeypatch: Any) -> None:
    monkeypatch.setattr(Raising, "kind", "interrupt")
    monkeypatch.setitem(KINDS, "interrupt", KeyboardInterrupt())
    given = json.loads(pbdkit.load("paper/a").model_dump_json(by_alias=True))
    given |= {"rule": Raising(), "solver": {"type": "stepping", "engine": engine}}
    with pytest.raises(KeyboardInterrupt, match="in FollowerRule 'raising'"):
        pbdkit.run(given, progress=False)


def test_import_that_changes_directory_or_is_interrupted(install: Any, call: Call) -> None:
    install("zz-wanders", "import os\nos.chdir('/')\n")
    before = Path.cwd()
    call("plugins", "list")
    assert Path.cwd() == before
    install("zz-stops", "raise KeyboardInterrupt\n")
    result = call("plugins", "list")
    assert (result.code, result.err.lstrip()) == (
        130,
        "pbdkit: interrupted while zz-stops was loaded\n",
    )


BASES = ["paper/a", "paper/d1", "paper/f2", "paper/e", "paper/c-chebyshev"]


@pytest.mark.parametrize("seed", range(8))
def test_mutated_experiments_are_checked_or_refused(seed: int) -> None:
    """Whatever is written into an experiment, `check` answers soon, with a message of its own."""
    bases = [json.loads(pbdkit.load(name).model_dump_json(by_alias=True)) for name in BASES]
    for n in range(15):
        data = mutant(random.Random(1000 * seed + n), bases)
        begun, message = time.process_time(), ""
        try:
            scene = build_scene(Experiment.build(Source("e.yaml", copy.deepcopy(data))))
            rehearse(scene)
            message = "\n".join(forecast(scene).warnings)
        except PbdkitError as error:
            message = str(error)
        assert time.process_time() - begun < 2 * SOON_S, data
        assert len(message) <= 4000, data
        assert all(c.isprintable() or c == "\n" for c in message), data
