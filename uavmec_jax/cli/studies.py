"""Commands about studies and their results."""

import json
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import (
    InputError,
    assignments,
    command_line,
    new_folder,
    print_json,
    print_line,
    print_results,
    print_tables,
)
from uavmec_jax.cli.options import (
    directory_argument,
    json_option,
    ray_options,
    run_folder_option,
    run_options,
    set_option,
)
from uavmec_jax.cli.runs import event_printer, print_simulation, report_results
from uavmec_jax.cli.types import FiniteRange, FolderOfRun, NameOrPath, WholeNumber, refuse_given
from uavmec_jax.errors import printable
from uavmec_jax.runs.file_names import RUN_PLAN
from uavmec_jax.runs.options import RunOptions

QUICK_STEPS, QUICK_SEEDS, QUICK_VALIDATE_EVERY = 50_000, 3, 5_000

_NOT_SIMULATED = ("out", "tensorboard", "resources", "retries", "time_limit_s")
"""Options of `run` that an estimate does not depend on."""

_OF_TRAINING = ("steps", "checkpoint", "checkpoint_every_s", "checkpoint_share", "tensorboard", "speed")
"""Options of `run` that a study without training does not depend on."""


@click.command()
@click.argument("study", type=NameOrPath())
@click.option("--seeds", type=WholeNumber(1, 2**31 - 1), help="Number of seeds (axes.seeds).")
@click.option("--steps", type=WholeNumber(1, 2_000_000_000), help="Environment steps per agent.")
@click.option(
    "--quick", is_flag=True, help=f"{QUICK_SEEDS} seeds x {QUICK_STEPS:,} steps: first results within a minute."
)
@set_option(help="Override any setting, e.g. --set dqn.gamma=0.99 or --set axes.learning_rate=[0.001,0.0071].")
@run_folder_option(help="Folder of the run, a path or a URL such as s3://bucket/run (default: runs/<study>-<time>).")
@json_option
@run_options
@ray_options
@click.option("--simulate", is_flag=True, help="Estimate wall time, disk space and memory, and run nothing.")
@click.option(
    "--speed", type=FiniteRange(0.001, 1e12), help="With --simulate: training steps per second of one device."
)
@click.option(
    "--devices", type=WholeNumber(1, 1_000_000), help="With --simulate: number of devices (default: this machine's)."
)
def run(
    study: str,
    seeds: int | None,
    steps: int | None,
    quick: bool,
    settings: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    simulate: bool,
    speed: float | None,
    devices: int | None,
    shard_size: int | None,
    ray: Any,
    **options: Any,
) -> None:
    """Train and evaluate STUDY: one that ships with the package (table5, table6, table7, planning, ...) or a TOML file."""
    overrides = _overrides(quick, seeds, steps, settings)
    if simulate:
        refuse_given("has no meaning with --simulate, which runs nothing", *_NOT_SIMULATED)
    else:
        refuse_given("is only for --simulate", "speed", "devices")

    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.files.output_folders import check_directory
    from uavmec_jax.reporting.progress import progress_bar
    from uavmec_jax.runs.run import run_study
    from uavmec_jax.studies.study import load_study

    console = new_console(stderr=as_json)
    resolved = load_study(study, overrides)
    if not resolved.algorithms:
        refuse_given(f"is about training, and {resolved.name} trains nothing", *_OF_TRAINING)
    if simulate:
        print_simulation(resolved, speed, devices, shard_size, ray, RunOptions(**options), as_json)
        return
    directory = out or new_folder(resolved.name)
    check_directory(directory)
    with progress_bar(console) as bar:

        def on_plan(plan: Any) -> None:
            console.print_heading(resolved.name, str(plan))
            bar.start(plan)

        results = run_study(
            resolved,
            directory,
            command=command_line(),
            ray=ray,
            shard_size=shard_size,
            options=RunOptions(**options),
            on_plan=on_plan,
            on_progress=bar.report,
            on_event=event_printer(console),
        )
    report_results(results, directory, console, as_json)


def _overrides(quick: bool, seeds: int | None, steps: int | None, settings: tuple[str, ...]) -> dict[str, Any]:
    """Return the settings of the study that the options change."""
    overrides: dict[str, Any] = {}
    if quick:
        overrides |= {
            "axes.seeds": QUICK_SEEDS,
            "steps": QUICK_STEPS,
            "evaluation.validate_every": QUICK_VALIDATE_EVERY,
            "evaluation.planner_draws": 1,
        }
    overrides |= {name: value for name, value in (("axes.seeds", seeds), ("steps", steps)) if value is not None}
    changes = assignments(settings)
    for option, name, value in (("--seeds", "axes.seeds", seeds), ("--steps", "steps", steps)):
        if value is not None and name in changes:
            raise InputError(f"{option} is {value}, and --set {name} is given too; leave one of them out")
    return overrides | changes


@click.command()
@directory_argument
@json_option
def show(directory: Path, as_json: bool) -> None:
    """Print the tables of the run in DIRECTORY; of one that is not complete, as far as it is, and its status."""
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.runs.results_folder import load_results
    from uavmec_jax.runs.status import run_status

    results = load_results(directory)
    there = results.run["complete"] or not (directory / RUN_PLAN).exists()
    console = new_console(stderr=as_json)
    print_results(results, directory, console, as_json, None if there else run_status(directory))


@click.command()
@click.argument("run_a", type=FolderOfRun())
@click.argument("run_b", type=FolderOfRun())
@click.option("--a", "where_a", multiple=True, metavar="NAME=VALUE", help="Which agents of A, e.g. --a algorithm=dqn.")
@click.option("--b", "where_b", multiple=True, metavar="NAME=VALUE", help="Which agents of B.")
@click.option("--policy-a", default="best", help="Policy of A: best, last, oldest-first, ... (default: best).")
@click.option("--policy-b", default="best", help="Policy of B (default: best).")
@json_option
def compare(
    run_a: Path,
    run_b: Path,
    where_a: tuple[str, ...],
    where_b: tuple[str, ...],
    policy_a: str,
    policy_b: str,
    as_json: bool,
) -> None:
    """Compare RUN_A with RUN_B seed by seed: paired differences, interquartile means, probability of improvement."""
    of_a, of_b = assignments(where_a, "--a"), assignments(where_b, "--b")

    from uavmec_jax.cli.console import new_console
    from uavmec_jax.reporting.compare import comparison
    from uavmec_jax.runs.results_folder import load_results
    from uavmec_jax.studies.compare import Side

    a = Side(load_results(run_a), policy_a, of_a)
    b = Side(load_results(run_b), policy_b, of_b)
    tables, data = comparison(a, b)
    if as_json:
        print_json({"command": command_line(), **data})
        return
    print_tables(new_console(), tables, [])


@click.command()
@click.argument("file", type=NameOrPath())
@click.option("--json", "as_json", is_flag=True, help="Print the resolved study as JSON.")
def validate(file: str, as_json: bool) -> None:
    """Check the study FILE (or a shipped study) without running it."""
    from uavmec_jax.studies.places import load_evacuations
    from uavmec_jax.studies.population import n_agents
    from uavmec_jax.studies.study import load_study

    study = load_study(file)
    load_evacuations(study)
    if as_json:
        print_json(json.loads(study.model_dump_json()))
    else:
        print_line(f"{printable(file)}: a valid study: {n_agents(study):,} agents x {study.steps:,} steps")
