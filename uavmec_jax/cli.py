"""The command `uavmec`: parse, call, show. What it does lives in the package; jax is imported only when needed."""

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Any, NoReturn

import click

from uavmec_jax.errors import UserError

QUICK_STEPS, QUICK_SEEDS, QUICK_VALIDATE_EVERY = 50_000, 3, 5_000


class OneLine(click.Group):
    """A group whose commands tell a user's mistake, or a full or closed disk, in one line: exit code 2."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except UserError as error:
            _fail(error)
        except OSError as error:
            _fail(f"{error.filename}: {error.strerror}" if error.filename else error)


@click.group(cls=OneLine, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="uavmec-jax")
def main() -> None:
    """Which device should a rescue UAV serve next, and which will fail first?

    \b
    uavmec run table5 --quick     the paper's Table 5 on this machine, in under a minute
    uavmec run my-study.toml      a study of your own
    uavmec plan my-town.toml      tours for your own devices, what fails first, what to repair
    uavmec show runs/...          the tables of a run again
    """


@main.command()
@click.argument("study")
@click.option("--seeds", type=int, help="Number of seeds (axes.seeds).")
@click.option("--steps", type=int, help="Environment steps of one agent.")
@click.option(
    "--quick", is_flag=True, help=f"{QUICK_SEEDS} seeds x {QUICK_STEPS:,} steps: a first look within a minute."
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    help="Override any setting, e.g. --set dqn.gamma=0.99 or --set axes.learning_rate=[0.001,0.0071].",
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the run (default: runs/<study>-<time>).")
@click.option("--json", "as_json", is_flag=True, help="Print the cells as JSON on standard output.")
def run(
    study: str,
    seeds: int | None,
    steps: int | None,
    quick: bool,
    settings: tuple[str, ...],
    out: Path | None,
    as_json: bool,
) -> None:
    """Train and judge STUDY: a study that ships with the package (table5, table5-tuned, planning) or a TOML file."""
    overrides: dict[str, Any] = {}
    if quick:
        overrides |= {
            "axes.seeds": QUICK_SEEDS,
            "steps": QUICK_STEPS,
            "evaluation.validate_every": QUICK_VALIDATE_EVERY,
            "evaluation.planner_draws": 1,
        }
    overrides |= {name: value for name, value in (("axes.seeds", seeds), ("steps", steps)) if value is not None}
    overrides |= dict(_setting(setting) for setting in settings)

    from uavmec_jax.studies import host

    host.use_every_core()
    from rich.console import Console

    from uavmec_jax.reporting import figures
    from uavmec_jax.reporting.progress import progress_bar
    from uavmec_jax.studies.run import check_directory, plan_study, run_study
    from uavmec_jax.studies.study import load_study

    console = Console(stderr=as_json)
    resolved = load_study(study, overrides)
    directory = out or _new_folder(resolved.name)
    check_directory(directory)
    plan = plan_study(resolved)
    console.print(f"[bold]{resolved.name}[/bold]: {plan}")
    with progress_bar(console, plan) as on_progress:
        results = run_study(resolved, directory, command=_command(), on_progress=on_progress)
    if len(results.agents):
        figures.save(figures.run_figure(results), directory / "figure.png")
        _print(results, directory, console, as_json)
    if not results.run["complete"]:
        done = len(results.agents)
        kept = f"{done} finished agents are kept in {directory}" if done else "no block was finished, nothing was kept"
        click.echo(f"interrupted: {kept}", err=True)
        sys.exit(130)


@main.command()
@click.argument("scenario", required=False, type=click.Path(path_type=Path))
@click.option("--powered", type=int, help="Devices with grid power, of a random town (default: 8).")
@click.option("--connected", type=int, help="Devices with communication, of a random town (default: 8).")
@click.option("--seed", type=int, default=0, help="Of the random town and of the task volumes.")
@click.option("--draws", type=int, default=8, help="Volume draws that lifetimes are judged on (default: 8).")
@click.option("--width", type=int, default=256, help="States the beam keeps (default: 256).")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="Change a number of Table 1.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the plan (default: runs/plan-<time>).")
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON on standard output.")
def plan(
    scenario: Path | None,
    powered: int | None,
    connected: int | None,
    seed: int,
    draws: int,
    width: int,
    settings: tuple[str, ...],
    out: Path | None,
    as_json: bool,
) -> None:
    """Plan for SCENARIO, a layout file (TOML or CSV), or for a random town: tours, bound, first failure, repairs."""
    if scenario is not None and (powered, connected) != (None, None):
        _fail(f"{scenario}: says itself who has power and communication; leave out --powered and --connected")
    if not 1 <= width <= 100_000:
        _fail(f"--width is {width}; give 1 to 100000 states")
    from uavmec_jax.studies import host

    host.use_every_core()
    from rich.console import Console

    from uavmec_jax.planning.outlook import look_ahead
    from uavmec_jax.reporting.outlook import outlook_data, outlook_summary, outlook_tables, save_outlook
    from uavmec_jax.studies.run import check_directory
    from uavmec_jax.studies.scenario import load_scenario

    inventory, keys = load_scenario(
        scenario,
        powered=8 if powered is None else powered,
        connected=8 if connected is None else connected,
        seed=seed,
        draws=draws,
        settings=dict(_setting(setting) for setting in settings),
    )
    directory = out or _new_folder("plan")
    check_directory(directory)
    outlook = look_ahead(inventory.params, inventory.layout, keys, width=width)
    save_outlook(outlook, inventory, directory, _command())
    if as_json:
        click.echo(json.dumps(outlook_data(outlook, inventory.names, inventory.file.name), indent=1))
        return
    console = Console()
    _print_tables(
        console, outlook_tables(outlook, inventory.names), outlook_summary(outlook, inventory.names), directory
    )


@main.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the cells as JSON on standard output.")
def show(directory: Path, as_json: bool) -> None:
    """Print the tables of the run in DIRECTORY again."""
    from rich.console import Console

    from uavmec_jax.studies.results import load_results

    results = load_results(directory)
    _print(results, directory, Console(stderr=as_json), as_json)


@main.command()
@click.argument("file")
@click.option("--json", "as_json", is_flag=True, help="Print the resolved study as JSON.")
def validate(file: str, as_json: bool) -> None:
    """Check the study FILE (or a shipped study) without running it."""
    from uavmec_jax.studies.study import load_study, n_agents

    study = load_study(file)
    if as_json:
        click.echo(study.model_dump_json(indent=1))
    else:
        click.echo(f"{file}: a valid study: {n_agents(study):,} agents x {study.steps:,} steps")


@main.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def doctor(as_json: bool) -> None:
    """Say versions, devices and memory, and check the speed for two seconds."""
    from uavmec_jax.studies import host

    host.use_every_core()
    from uavmec_jax.studies.speed import environment_speed

    facts = host.describe() | {"environment_steps_per_second": round(environment_speed(seconds=2.0))}
    if as_json:
        click.echo(json.dumps(facts, indent=1))
        return
    for name, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} {version}" for key, version in value.items())
        elif isinstance(value, list):
            value = ", ".join(value)
        click.echo(
            f"{name.replace('_', ' '):>30}  {value:,}"
            if isinstance(value, int)
            else f"{name.replace('_', ' '):>30}  {value}"
        )


def _setting(text: str) -> tuple[str, Any]:
    """``name=value`` with the value as in TOML; a bare word is a string."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        _fail(f"--set {text}: give NAME=VALUE, e.g. --set dqn.gamma=0.99")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name.strip(), value.strip()


def _print(results: Any, directory: Path, console: Any, as_json: bool) -> None:
    from uavmec_jax.reporting.tables import summary, tables

    if as_json:
        cells = json.loads(results.cells().to_json(orient="records"))
        click.echo(json.dumps({"directory": str(directory), "run": results.run, "cells": cells}, indent=1))
        return
    _print_tables(console, tables(results), summary(results), directory)


def _print_tables(console: Any, tables: dict[str, Any], lines: list[str], directory: Path) -> None:
    for title, table in tables.items():
        console.print(f"[bold]{title}[/bold]")
        console.print(table)
    for line in lines:
        console.print(line, highlight=False)
    console.print(f"Files: {directory}", highlight=False, soft_wrap=True)


def _new_folder(name: str) -> Path:
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def _command() -> str:
    return " ".join(["uavmec", *sys.argv[1:]])


def _fail(message: object) -> NoReturn:
    """One line on standard error, exit code 2."""
    click.echo(f"uavmec: {' '.join(str(message).split())}", err=True)
    sys.exit(2)
