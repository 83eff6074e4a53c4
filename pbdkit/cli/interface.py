"""The commands of `pbdkit`: their arguments, options and help.

The function that executes a command is imported when the command is called, so that `--help` and
errors in the command line are fast. It has the name of the command, and is in the file that is
given to `call`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from pbdkit.cli.options import (
    NUMBER,
    PATH,
    at_option,
    call,
    color_option,
    completed_by,
    experiment_argument,
    json_option,
    load_experiment,
    outside_option,
    result_argument,
    set_option,
    times_option,
    verbose_option,
)
from pbdkit.cli.streams import restoring_folder
from pbdkit.errors import PbdkitWarning

LOOK = [
    color_option,
    click.option(
        "--field/--dots",
        "filled",
        default=None,
        help="Draw a filled field, or a dot for each particle; default the legible one.",
    ),
    click.option("--contours", is_flag=True, help="Draw filled contours at round levels."),
    click.option(
        "--bonds/--no-bonds", default=None, help="Draw bonds; by default if they are legible."
    ),
    click.option("--broken", is_flag=True, help="Draw broken bonds, dashed."),
    click.option("--outline", is_flag=True, help="Draw the outline of the body at rest."),
    click.option(
        "--range",
        "limits",
        nargs=2,
        type=NUMBER,
        metavar="LOW HIGH",
        default=None,
        help="Limits of the colour scale.",
    ),
    click.option(
        "--scale",
        "norm",
        type=click.Choice(["linear", "log", "sqrt", "symlog"]),
        default="linear",
        show_default=True,
        help="Scale of the colours.",
    ),
    click.option(
        "--limits",
        "limits_of",
        type=click.Choice(["all", "each"]),
        default="all",
        show_default=True,
        help="Limits of the colours of all drawn steps, or of each step.",
    ),
    click.option("--map", "cmap", metavar="NAME", help="Colour map of matplotlib, e.g. magma."),
    click.option(
        "--window",
        nargs=4,
        type=NUMBER,
        metavar="X0 X1 Y0 Y1",
        default=None,
        help="Part of the plane to draw, in the units of the axes.",
    ),
    click.option(
        "--size",
        "figsize",
        nargs=2,
        type=NUMBER,
        metavar="WIDTH HEIGHT",
        default=None,
        help="Size of the figure in inches.",
    ),
]
"""Options that pictures and movies have in common."""
quiet_option = click.option("--quiet", is_flag=True, help="Print nothing but errors.")
force_option = click.option("--force", is_flag=True, help="Replace an existing file.")


def look_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that pictures and movies have in common, in the order of the help."""

    @wraps(command)
    def with_limits(
        *args: Any, limits: tuple[float, float] | None, limits_of: str, **more: Any
    ) -> Any:
        vmin, vmax = limits or (None, None)
        return command(*args, vmin=vmin, vmax=vmax, limits=limits_of, **more)

    for option in reversed(LOOK):
        with_limits = option(with_limits)
    return with_limits


@click.command()
@experiment_argument
@click.option("-o", "--output", type=PATH, help="Output file; default NAME.nc.")
@set_option
@click.option(
    "--force", is_flag=True, help="Replace an existing output once the result is complete."
)
@quiet_option
@json_option
def run(
    experiment: str,
    output: Path | None,
    settings: tuple[str, ...],
    force: bool,
    quiet: bool,
    as_json: bool,
) -> int | None:
    """Run an experiment: a YAML file or the name of a shipped one, e.g. paper/a."""
    from pbdkit.mpi.launch import launched

    with launched() as communicator:
        quiet = quiet or not communicator.is_root
        with communicator.raise_together():
            with restoring_folder(), warnings.catch_warnings():
                if quiet:
                    warnings.simplefilter("ignore", PbdkitWarning)
                loaded = load_experiment(experiment, settings)
            path = output or Path(loaded.name.replace("/", "-") + ".nc")
            if communicator.is_root:
                call("output:refuse_output", path, force=force, experiment=Path(experiment))
        name = str(Path(experiment).absolute()) if Path(experiment).is_file() else experiment
        origin = {"experiment": name, "settings": list(settings)}
        options = {"force": force, "quiet": quiet, "as_json": as_json}
        return call("run:run", communicator, loaded, path, origin, **options)


@click.command()
@result_argument("output")
@click.option("--steps", type=click.IntRange(min=1), help="Continue a finished run to this step.")
@click.option(
    "--anyway",
    is_flag=True,
    help="Resume although the experiment or a version changed, or the last commits are lost.",
)
@quiet_option
@json_option
def resume(**options: Any) -> int | None:
    """Continue the interrupted run of OUT.nc; the result is the same bit for bit."""
    from pbdkit.mpi.launch import launched

    with launched() as communicator:
        return call("resume:resume", communicator, **options)


@click.command()
@experiment_argument
@set_option
@verbose_option
@json_option
def check(experiment: str, settings: tuple[str, ...], **options: Any) -> None:
    """Forecast a run without running it: supports and leaders, stability, steps to convergence,
    time and memory."""
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always", PbdkitWarning)
        loaded = load_experiment(experiment, settings)
    call("check:check", loaded, [str(warning.message) for warning in recorded], **options)


@click.command()
@experiment_argument
@set_option
@verbose_option
@json_option
def identify(experiment: str, settings: tuple[str, ...], **options: Any) -> None:
    """Identify the rule of an experiment: diffusion or an elastic body, with its constants."""
    call("identify:identify", load_experiment(experiment, settings), **options)


@click.command()
@result_argument("file", metavar="OUT.nc|EXPERIMENT")
@click.option("-o", "--output", type=PATH, help="PNG, SVG or PDF.")
@times_option
@at_option
@set_option
@outside_option
@look_options
@click.option("--numbers", is_flag=True, help="Write the numbers of particles if they are legible.")
@click.option(
    "--dpi", type=int, default=200, show_default=True, help="Resolution in pixels per inch."
)
@force_option
def plot(**options: Any) -> None:
    """Draw configurations of a result: kinds of particles, or a variable as dots, bonds or a field.

    For an experiment, draw the set-up before it runs, to NAME-setup.png: the body, supports,
    motions and loads.
    """
    call("plot:plot", **options)


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="MP4 or GIF; default OUT.mp4.")
@at_option
@look_options
@click.option(
    "--fps", type=float, default=25.0, show_default=True, help="Recorded steps per second."
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=1,
    metavar="N",
    help="Draw every N-th recorded step only.",
)
@click.option(
    "--dpi", type=int, default=120, show_default=True, help="Resolution in pixels per inch."
)
@force_option
def animate(**options: Any) -> None:
    """Make a movie of a result: every recorded step, with one colour scale."""
    call("plot:animate", **options)


CURVES = ("stress-strain", "load-displacement", "energies")
"""Kinds of curves of a result."""
CRACKS: dict[str, Any] = {"crack": "map", "crack-length": "length", "broken-bonds": "bonds"}
"""Kinds of pictures of cracks, with their names in `pbdkit.plotting.crack`."""
HISTORY = "history"
"""Kind of curves of particles and bonds."""


@click.command()
@result_argument("file")
@click.argument("kind", required=False, type=click.Choice([*CURVES, HISTORY, *CRACKS]))
@click.option("-o", "--output", type=PATH, help="PNG, SVG, PDF or CSV.")
@click.option("--y", metavar="VARIABLE", help="Variable to draw, e.g. reaction_x or pe1.")
@click.option("--x", metavar="VARIABLE", help="Variable of the abscissa; default the time.")
@click.option(
    "--particle",
    "particles",
    type=int,
    multiple=True,
    help="Draw the history of this particle; repeat it for further particles.",
)
@click.option(
    "--bond",
    nargs=2,
    type=int,
    metavar="A B",
    help="Draw the history of the bond between these two particles.",
)
@click.option("--group", type=int, help="Forces of this leader group.")
@click.option("--load", type=int, help="Forces of this load.")
@click.option("--obstacle", type=int, help="Forces of this obstacle.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing file.")
def curve(**options: Any) -> None:
    """Draw quantities of a result over time: a curve, histories, the crack.

    \b
    stress-strain      nominal stress over nominal strain
    load-displacement  force over displacement of a leader group, load or obstacle
    energies           the energies over the steps
    history            a variable (--y, else u) of particles or a bond over the steps
    crack              the broken bonds, by the step in which they broke
    crack-length       the length of the longest crack over the steps
    broken-bonds       their number over the steps

    KIND is by default the first that the result has. --y alone draws that variable over the steps,
    and with --particle or --bond its history there. Results of sweeps have a line for each member;
    for cracks, select one member with --at. With -o NAME.csv the points of the lines are written.
    """
    call("plot:curve", **options)


@click.command()
@result_argument("files", "FILE...", nargs=-1, required=True)
def verify(**options: Any) -> int | None:
    """Recompute the checksums of results, and report for each file whether it is unchanged."""
    return call("verify:verify", **options)


@click.command()
@result_argument("output")
@json_option
def status(**options: Any) -> None:
    """Report the progress of an unfinished run: step, rate and remaining time."""
    call("status:status", **options)


@click.command()
@result_argument("file")
@click.option(
    "--bond", nargs=2, type=int, metavar="A B", help="Numbers of the two particles of a bond."
)
@at_option
@json_option
def explain(**options: Any) -> None:
    """Explain fracture: which bonds broke, when, at which strain and in which order.

    For one bond, report how close it is to breaking or how it broke, and what happened around
    it.
    """
    call("result:explain", **options)


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="A .vtkhdf file; default OUT.vtkhdf.")
@at_option
@force_option
def export(**options: Any) -> None:
    """Write a result as VTKHDF for ParaView: every recorded step with all variables.

    Particles are vertices, bonds lines, and the cells of the lattice triangles and quads. The cell
    array `part` distinguishes them (0, 1, 2), and `broken` marks torn cells.
    """
    call("result:export", **options)


@click.command()
@click.argument("file", metavar="SWEEP", type=PATH)
@click.option("-o", "--output", "folder", type=PATH, help="Folder of the results of members.")
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Number of processes; default one for each processor.",
)
@click.option(
    "--dask", "address", metavar="ADDRESS", help="Run on the dask cluster at this address."
)
@outside_option
@quiet_option
def sweep(**options: Any) -> int | None:
    """Run an experiment for many parameter values; a second call runs the remaining members."""
    return call("sweep:sweep", **options)


@click.command()
@click.argument("file", metavar="FIT")
@click.option("-o", "--output", type=PATH, help="JSON file; default the name of FIT with .json.")
@click.option(
    "--plot",
    "picture",
    type=PATH,
    help="Picture (PNG, SVG or PDF): measurement, fit and residuals.",
)
@force_option
@outside_option
@quiet_option
def fit(**options: Any) -> None:
    """Fit parameters to measured fields, or strengths to repeated tests, and estimate their
    errors."""
    call("fit:fit", **options)


@click.command()
@click.argument("name", required=False, shell_complete=completed_by("completion:shipped"))
def experiments(**options: Any) -> None:
    """List the shipped experiments, or print the file of one, e.g. paper/f1."""
    call("init:experiments", **options)


@click.command()
@click.argument("file", required=False, type=PATH)
@click.option(
    "--from",
    "origin",
    metavar="NAME",
    shell_complete=completed_by("completion:shipped"),
    help="Shipped experiment to copy with its data files, e.g. paper/f1.",
)
def init(**options: Any) -> None:
    """Write an experiment to start from: a commented one, or a copy of a shipped one.

    FILE is experiment.yaml by default. With --from, it is the last part of NAME, followed by .yaml.
    """
    call("init:init", **options)


@click.command()
@click.argument(
    "what", type=click.Choice(["experiment", "dataset", "sweep", "fit"]), default="experiment"
)
@click.option("--builtin", is_flag=True, help="Leave out third-party components.")
def schema(**options: Any) -> None:
    """Print the JSON Schema of experiments, datasets, sweeps or fits, with all installed
    components."""
    call("schema:schema", **options)


INTERFACE_NAMES = (
    "FollowerRule", "Lattice", "NeighbourMetric", "FramePolicy", "FractureModel",
    "ParticleOperation", "Diagnostic",
)  # fmt: skip
"""Names of the open interfaces, listed here so that `--help` imports none of them."""


@click.group(invoke_without_command=True)
@click.pass_context
def plugins(context: click.Context) -> None:
    """List, check and create plugins."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@plugins.command("list")
@json_option
def list_(**options: Any) -> None:
    """List components and plugins, and their states."""
    call("plugins:list_", **options)


@plugins.command(short_help="Write a plugin project that installs and runs.")
@click.argument("name")
@click.option(
    "--interface",
    type=click.Choice(INTERFACE_NAMES),
    default=INTERFACE_NAMES[0],
    show_default=True,
    help="Interface of the component.",
)
@click.option(
    "--dir",
    "parent",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default=".",
    help="Folder in which the project is created; default the current one.",
)
def new(**options: Any) -> None:
    """Write a complete plugin project NAME, e.g. pbdkit-my-rule, ready to install and run."""
    call("plugins:new", **options)


@plugins.command("check", short_help="Check the components of plugins for conformance.")
@click.argument("distributions", metavar="[DISTRIBUTION]...", nargs=-1)
@click.option("--verbose", is_flag=True, help="Show every property: passed, failed and skipped.")
@json_option
def check_plugins(**options: Any) -> int | None:
    """Check the components of a distribution against the properties of their interface.

    Components of all plugins are checked by default. `pbdkit` is the distribution of the built-in
    components. The exit status is 3 if a property fails, or if a plugin does not load.
    """
    return call("plugins:check_plugins", **options)
