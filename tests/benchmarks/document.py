"""The measured tables as Markdown, put between markers in docs/validation/performance.md."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable
from pathlib import Path
from typing import Any

from cost import TERMS
from front import fronts

Data = dict[str, Any]


def refresh(path: Path, data: Data, tables: Container[str]) -> None:
    """Replaces what stands between `<!-- measured: name -->` and `<!-- end -->`, of these names."""
    text = path.read_text("utf-8")
    derived = {"choice": "engines", "interval": "cost"}
    data = data | {name: data[source] for name, source in derived.items() if source in data}
    for name, write in TABLES.items():
        if name in data and name in tables:
            marked = re.compile(rf"(<!-- measured: {name} -->\n).*?(<!-- end -->)", re.S)
            if not marked.search(text):
                raise SystemExit(f"{path}: has no place for the table '{name}'")
            table = write(data[name])
            text = marked.sub(lambda found, new=table: f"{found[1]}\n{new}\n{found[2]}", text)
    path.write_text(text, "utf-8")


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [tuple(head)]
    lines += [("---",) * len(lines[0]), *map(tuple, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _machine(m: Data) -> str:
    return (
        f"{m['date']}: {m['processor']}, {m['processors']} processors, Python {m['python']}, "
        f"numpy {m['numpy']}, numba {m['numba']}. Load before the measurements "
        f"{m['load']:.2f}, after them {m['load_after']:.2f}.\n"
    )


def _goals(rows: list[Data]) -> str:
    def cells(g: Data) -> tuple[str, ...]:
        sign, unit = ("≤" if g["at_most"] else "≥"), g["unit"].replace("×", " ×").replace("B", " B")
        spread = f"{g['low']:.3g}–{g['high']:.3g}" if g["low"] != g["high"] else ""
        met = "met" if g["met"] else "**not met**"
        measured = f"{g['measured']:.3g}{unit}"
        return g["name"], f"{sign} {g['goal']:g}{unit}", measured, spread, met, g["note"]

    head = ("quantity", "goal", "measured", "quartiles", "", "")
    return _table(head, map(cells, rows))


def _engines(rows: list[Data]) -> str:
    def cells(r: Data) -> tuple[str, ...]:
        error = "not finite" if r["error"] is None else f"{r['error']:.1e}" if r["error"] else "0"
        return (
            r["rule"],
            f"{r['size']}²",
            f"{r['method']}, {r['precision']}" + (f", {r['threads']} threads" * (r["threads"] > 1)),
            f"{r['setup_first_s']:.2f} / {r['setup_s']:.2f}",
            f"{r['ns_per_particle_step']:.3g}",
            f"{r['peak_memory_mib']:.0f}",
            error,
        )

    head = ("rule", "size", "method", "set-up s, first / cached", "ns", "MiB", "error")
    return _table(head, map(cells, rows))


def _threads(rows: list[Data]) -> str:
    head = ("size", "rule", "one thread, ns", "two, ns", "gain")
    return _table(
        head,
        (
            (f"{r['size']}²", r["rule"], f"{r['one_ns']:.3g}", f"{r['two_ns']:.3g}",
             f"{r['one_ns'] / r['two_ns']:.2f}")
            for r in rows
        ),
    )  # fmt: skip


def _limit(rows: list[Data]) -> str:
    head = (
        "size", "copying, ns", "bare sweep, ns", "pbdkit, ns", "copying / pbdkit",
        "copying on two threads, ns", "pbdkit on two threads, ns", "copying / pbdkit",
    )  # fmt: skip

    def cells(r: Data) -> tuple[str, ...]:
        ns = {name: f"{r[f'{name}_ns']:.2f}" for name in ("copy", "bare", "pbdkit")}
        one, two = r["copy_ns"] / r["pbdkit_ns"], r["copy_two_ns"] / r["two_threads_ns"]
        both = f"{r['copy_two_ns']:.2f}", f"{r['two_threads_ns']:.2f}"
        return f"{r['size']}²", *ns.values(), f"{one:.0%}", *both, f"{two:.0%}"

    return _table(head, map(cells, rows))


def _cache(rows: list[Data]) -> str:
    def cells(r: Data) -> tuple[str, ...]:
        ns = f"{r['small_ns']:.2f}", f"{r['large_ns']:.2f}"
        return r["rule"], r["with"], *ns, f"{r['small_ns'] / r['large_ns']:.0%}"

    return _table(("rule", "with", "100², ns", "3000², ns", "relative rate"), map(cells, rows))


def _cost(found: Data) -> str:
    fits = [
        (
            engine,
            *(f"{found[engine][key]:.3g}" for key in TERMS),
            *(f"{found[engine][key]:.0%}" for key in ("typical_deviation", "largest_deviation")),
        )
        for engine in ("compiled", "numpy")
    ]
    head = (
        "engine", "step, µs", "slot, µs", "particle, ns", "neighbour, ns", "far, ns", "farther, ns",
        "typical deviation", "largest deviation",
    )  # fmt: skip
    runs = [
        (r["run"], f"{r['measured_s']:.3g}", f"{r['model_s']:.3g}",
         f"{r['model_s'] / r['measured_s'] - 1:+.0%}")
        for r in found["foretold"]
    ]  # fmt: skip
    per = (
        f"The set-up of a scene takes {found['setup_ns_a_particle']:.0f} ns per particle, a record "
        f"{found['record_ns_a_particle']:.3g} ns per particle, and a file "
        f"{found['file_ms']:.0f} ms.\n"
    )
    titles = ("whole run, not used for the fit", "measured s", "predicted s", "difference")
    return f"{_table(head, fits)}\n{per}\n{_table(titles, runs)}"


def _peers(rows: list[Data]) -> str:
    def ns(value: Any) -> str:
        return value if isinstance(value, str) else f"{value:.3g}" if value else ""

    rows = sorted(rows, key=lambda r: r["program"] != "pbdkit")
    cells = ((r["program"], r["what"], ns(r.get("100")), ns(r.get("1000"))) for r in rows)
    return _table(("program", "an iteration of", "100², ns", "1000², ns"), cells)


def _elements(found: Data) -> str:
    return fronts(found, _table)


def _choice(rows: list[Data]) -> str:
    """Steps from which the compiled engine's set-up is won back."""

    def cells(size: int) -> tuple[str, ...]:
        numpy, compiled = (
            next(
                r
                for r in rows
                if (r["rule"], r["size"], r["method"]) == ("barycentre", size, engine)
                and (r["precision"], r["threads"]) == ("float64", 1)
            )
            for engine in ("numpy", "compiled")
        )
        won_s = (numpy["ns_per_particle_step"] - compiled["ns_per_particle_step"]) * 1e-9
        won_s *= numpy["particles"]
        first, cached = (
            max(1, round((compiled[key] - numpy[key]) / won_s))
            for key in ("setup_first_s", "setup_s")
        )
        gain = numpy["ns_per_particle_step"] / compiled["ns_per_particle_step"]
        return f"{size}²", f"{gain:.0f} ×", f"{_two_digits(cached)}", f"{_two_digits(first)}"

    sizes = sorted({r["size"] for r in rows if r["rule"] == "barycentre"})
    head = (
        "size", "ratio of the times of a step", "steps if the kernel is in the cache",
        "steps if the kernel must be compiled",
    )  # fmt: skip
    return _table(head, map(cells, sizes))


def _two_digits(n: int) -> str:
    return f"{float(f'{n:.1e}'):,.0f}".replace(",", " ")


def _interval(found: Data) -> str:
    c, size = found["compiled"], 10**6
    a_step = c["particle_ns"] + 4 * c["neighbour_ns"] + c["far_ns"] + c["farther_ns"]
    a_step += (c["step_us"] + 4 * c["slot_us"]) * 1e3 / size
    steps = found["record_ns_a_particle"] / a_step
    rows = ((f"{k}", f"{steps / k:.0%}") for k in (1, 10, 100, 1000))
    text = f"At 1000², 4 neighbours, compiled on one thread, a record costs as much as {steps:.0f} "
    return f"{text}steps:\n\n" + _table(("recorded every (steps)", "additional time"), rows)


def _gpu(rows: list[Data]) -> str:
    lines = ((r["what"], f"{r['size']}²", r["precision"], f"{r['ps']:.3g}") for r in rows)
    return _table(("what", "size", "precision", "ps a particle and step"), lines)


def _ranks(found: Data) -> str:
    ns = {k: found[k] * 1e9 / found["steps"] / found["size"] ** 2 for k in ("1", "2", "shared")}
    mib = [held / 2**20 for held in (found["alone_bytes"], *found["rank_bytes"])]
    rows = [
        ("one process, one thread", f"{ns['1']:.2f} ns per particle and step", ""),
        ("one process, two threads", f"{ns['2']:.2f} ns",
         f"{ns['1'] / ns['2']:.2f} × as fast as one thread"),
        ("two processes", f"{ns['shared']:.2f} ns",
         f"{ns['1'] / ns['shared']:.2f} × as fast as one thread, "
         f"{ns['2'] / ns['shared']:.2f} × as fast as two"),
        ("an exchange", f"{found['exchange'] * 1e3:.2f} ms",
         f"{found['sent_bytes'] / 1e6:.1f} MB each way, every {found['between']} steps"),
        ("4000² in one process", f"{mib[0]:.0f} MiB", ""),
    ]  # fmt: skip
    for n, held in enumerate(mib[1:]):
        rows.append((f"process {n} of {len(mib) - 1}", f"{held:.0f} MiB", f"{held / mib[0]:.1%}"))
    return _table(("", "", ""), rows)


def _weak(found: list[Data]) -> str:
    rows = []
    for part in found:
        alone = part["alone"]
        lines = [part["part"] / alone - 1, 2 * part["exchange"] / alone]
        count = 1000 * part["rows"]
        rows.append((
            f"{count:,} rows of {10**9 // count:,}".replace(",", " "),
            f"{part['rows']}",
            f"{part['steps']}",
            *(f"{share:.1%}" for share in lines),
            f"{1 / (1 + sum(lines)):.0%}",
        ))  # fmt: skip
    head = (
        "lattice", "rows per part", "k",
        "additional time due to the halo and to fewer steps per pass",
        "additional time due to exchanges", "efficiency",
    )  # fmt: skip
    return _table(head, rows)


SCALE = {"ranks", "weak"}
"""Scales measured for docs/validation/scale.md."""
TABLES: dict[str, Callable[[Any], str]] = {
    "machine": _machine,
    "goals": _goals,
    "engines": _engines,
    "threads": _threads,
    "limit": _limit,
    "cache": _cache,
    "cost": _cost,
    "peers": _peers,
    "choice": _choice,
    "interval": _interval,
    "elements": _elements,
    "gpu": _gpu,
    "ranks": _ranks,
    "weak": _weak,
}
