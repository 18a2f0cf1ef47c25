"""Commands about existing runs: resume, status, and workers that share a run."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import (
    InputError,
    Interrupt,
    assignment,
    command_line,
    new_folder,
    print_json,
    print_results,
)
from uavmec_jax.cli.options import json_option, out_option, run_options, set_option
from uavmec_jax.runs.options import RunOptions

directory_argument = click.argument("directory", type=click.Path(path_type=Path))

_EVENTS = {
    "damaged": "shard {shard}: {error}; the file is renamed and not used",
    "restored": "shard {shard} resumes from {file}, step {steps:,}",
    "failed": "shard {shard} failed: {error}",
    "lost": "{error}",
    "died": "worker {pid} died (exit code {exit_code}); the others take over",
}
"""Events of a run that are printed, and how."""


def event_printer(console: Any) -> Callable[[str, dict[str, Any]], None]:
    """Return an ``on_event`` that prints the events that a user should see."""

    def print_event(event: str, facts: dict[str, Any]) -> None:
        if event in _EVENTS:
            console.print(_EVENTS[event].format(**facts), highlight=False, soft_wrap=True)

    return print_event


def report_results(results: Any, directory: Path, console: Any, as_json: bool) -> None:
    """Print the tables and draw the figure of a run.

    Raises:
        Interrupt: the run was stopped; the message says how to resume it.
    """
    from uavmec_jax.reporting import canvas, figures

    if len(results.agents):
        canvas.save(figures.run_figure(results), directory / "figure.png")
        print_results(results, directory, console, as_json)
    if not results.run["complete"]:
        finished = f"{len(results.agents):,} of {results.run['agents']:,} agents are finished"
        raise Interrupt(f"{finished}; resume with: uavmec resume {directory}", results.run["stopped_by"])


@click.command()
@directory_argument
@click.option(
    "--workers", type=click.IntRange(1, 256), help="Number of processes on this machine (default: as planned)."
)
@click.option(
    "--other-code", is_flag=True, help="Resume although code or libraries have changed; the results may differ."
)
@json_option
def resume(directory: Path, workers: int | None, other_code: bool, as_json: bool) -> None:
    """Resume the run in DIRECTORY after it was stopped or killed; the results are those of an uninterrupted run."""
    from uavmec_jax.training import host

    host.use_all_cores()
    from rich.console import Console

    from uavmec_jax.reporting.progress import progress_bar
    from uavmec_jax.runs.folder import RunFolder
    from uavmec_jax.runs.run import resume_run

    console = Console(stderr=as_json)
    plan = RunFolder.open(directory).plan
    console.print(f"[bold]{directory}[/bold]: {plan}", soft_wrap=True)
    with progress_bar(console, plan) as on_progress:
        results = resume_run(
            directory,
            workers=workers,
            other_code=other_code,
            on_progress=on_progress,
            on_event=event_printer(console),
        )
    report_results(results, directory, console, as_json)


@click.command()
@directory_argument
@json_option
def status(directory: Path, as_json: bool) -> None:
    """Print the progress of the run in DIRECTORY: shards, speed, time left, disk usage."""
    from rich.console import Console

    from uavmec_jax.reporting.status import status_lines
    from uavmec_jax.runs.status import run_status

    current = run_status(directory)
    if as_json:
        print_json(current.as_json())
        return
    for line in status_lines(current):
        Console().print(line, highlight=False, soft_wrap=True)


@click.command()
@directory_argument
@click.option("--share", metavar="I/N", help="Use the I-th of N equal parts of this machine's cores.")
@click.option(
    "--no-wait", is_flag=True, help="End when no shard is free, instead of waiting to take over from dead workers."
)
def worker(directory: Path, share: str | None, no_wait: bool) -> None:
    """Join the workers of the run in DIRECTORY, on this machine or on any that shares the folder."""
    from uavmec_jax.training import host

    host.use_all_cores(_share(share))
    from rich.console import Console

    from uavmec_jax.runs.shared_run import work_on
    from uavmec_jax.runs.signals import Interrupted

    try:
        complete = work_on(directory, wait=not no_wait, on_event=event_printer(Console()))
    except Interrupted as stop:
        raise Interrupt(
            f"progress is saved; start a worker again with: uavmec worker {directory}", stop.signal
        ) from stop
    click.echo(f"{directory}: {'complete' if complete else 'no shard is free; some are still running or have failed'}")


def _share(text: str | None) -> tuple[int, int] | None:
    """Parse ``I/N``, numbers from 1."""
    if text is None:
        return None
    part, slash, parts = text.partition("/")
    if not slash or not part.isdigit() or not parts.isdigit() or not 1 <= int(part) <= int(parts):
        raise InputError(f"--share {text}: give I/N, e.g. 1/2 for the first half of the cores")
    return int(part), int(parts)


@click.command()
@click.argument("study")
@click.option(
    "--jobs", type=click.IntRange(1, 10_000), required=True, help="Number of workers to start on the cluster."
)
@click.option("--executor", default="slurm", help="Executor of submitit: slurm, local or debug (default: slurm).")
@click.option(
    "--with",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="Parameter of submitit, e.g. --with slurm_partition=cpu.",
)
@set_option(help="Override any setting, as in `uavmec run`.")
@out_option(help="Folder of the run, which all machines must share.")
@run_options
def submit(
    study: str,
    jobs: int,
    executor: str,
    parameters: tuple[str, ...],
    settings: tuple[str, ...],
    out: Path | None,
    workers: int,
    shard_size: int | None,
    **options: Any,
) -> None:
    """Plan STUDY and submit workers for it to a cluster (SLURM) by submitit: pip install 'uavmec-jax[cluster]'."""
    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.runs.cluster import submit_workers
    from uavmec_jax.runs.shared_run import prepare_run
    from uavmec_jax.studies.study import load_study

    resolved = load_study(study, dict(assignment(setting) for setting in settings))
    directory = out or new_folder(resolved.name)

    def prepare() -> Path:
        prepare_run(
            resolved,
            directory,
            command=command_line(),
            workers=workers,
            shard_size=shard_size,
            jobs=jobs,
            options=RunOptions(**options),
        )
        return directory.absolute()

    names = submit_workers(prepare, jobs, executor, dict(assignment(text, "--with") for text in parameters))
    click.echo(f"{directory}: {len(names)} workers submitted ({', '.join(names[:4])}{', ...' * (len(names) > 4)})")
    click.echo(f"progress: uavmec status {directory}; results, once complete: uavmec show {directory}")


def print_simulation(
    study: Any,
    speed: float | None,
    devices: int | None,
    workers: int,
    shard_size: int | None,
    options: RunOptions,
    as_json: bool,
) -> None:
    """Print how long a run would take at a given speed, and how much disk space and memory.

    Raises:
        InputError: no speed is given.
    """
    from uavmec_jax.runs.run_plan import plan_run
    from uavmec_jax.runs.simulate import simulate

    if speed is None:
        raise InputError(
            "--simulate needs --speed, the training steps per second of one device: training_steps_per_second in the "
            "run.json of an earlier run, divided by its devices"
        )
    plan = plan_run(study, workers=workers, shard_size=shard_size)
    estimate = simulate(study, plan, speed=speed, devices=devices or os.cpu_count() or 1, options=options)
    if as_json:
        print_json(estimate.as_json())
    else:
        click.echo(f"{study.name}: {plan}\n{estimate}")
