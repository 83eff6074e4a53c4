"""Arguments that several commands take."""

from __future__ import annotations

import click

experiment_argument = click.argument("experiment", metavar="EXPERIMENT")
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    help="Change a value, e.g. rule.K=-0.002 or leaders.1.until=20.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
