"""Commands about existing runs: resume and status."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import InputError, Interrupt, print_json, print_line, print_results
from uavmec_jax.cli.options import directory_argument, json_option, ray_options
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.errors import one_line
from uavmec_jax.runs.options import RunOptions

_EVENTS = {
    "ignored": "ignored, since no run wrote them: {names}",
    "damaged": "shard {shard}: {error}; the file is renamed and not used",
    "restored": "shard {shard} resumes from {file}, step {steps:,}",
    "failed": "shard {shard} failed: {error}",
    "lost": "shard {shard}: worker or node lost ({error}); retrying",
    "retried": "shard {shard}: {error}; retrying",
    "waiting": "{error}; waiting for one that can",
}
"""Events of a run that are printed, and how."""


def event_printer(console: Any) -> Callable[[str, dict[str, Any]], None]:
    """Return an ``on_event`` that prints the events that a user should see."""

    def print_event(event: str, facts: dict[str, Any]) -> None:
        if event in _EVENTS:
            console.print(one_line(_EVENTS[event].format(**facts)), highlight=False, soft_wrap=True)

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
@ray_options
@click.option(
    "--take-over",
    is_flag=True,
    help="Take the run over from an owner on another machine that you know to be dead.",
)
@click.option(
    "--other-code", is_flag=True, help="Resume although code or libraries have changed; the results may differ."
)
@json_option
def resume(directory: Path, ray: Any, take_over: bool, other_code: bool, as_json: bool) -> None:
    """Resume the run in DIRECTORY after it was stopped or killed; the results are those of an uninterrupted run."""
    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.reporting.progress import progress_bar
    from uavmec_jax.runs.folder import RunFolder
    from uavmec_jax.runs.run import resume_run

    console = new_console(stderr=as_json)
    plan = RunFolder.open(directory).plan
    console.print_heading(str(directory), str(plan), soft_wrap=True)
    with progress_bar(console) as bar:
        bar.start(plan)
        results = resume_run(
            directory,
            ray=ray,
            take_over=take_over,
            other_code=other_code,
            on_progress=bar.report,
            on_event=event_printer(console),
        )
    report_results(results, directory, console, as_json)


@click.command()
@directory_argument
@json_option
def status(directory: Path, as_json: bool) -> None:
    """Print the progress of the run in DIRECTORY: shards, speed, time left, disk usage."""
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.reporting.status import status_lines
    from uavmec_jax.runs.status import run_status

    current = run_status(directory)
    if as_json:
        print_json(current.as_json())
        return
    console = new_console()
    for line in status_lines(current):
        console.print(line, highlight=False, soft_wrap=True)


def print_simulation(
    study: Any,
    speed: float | None,
    devices: int | None,
    shard_size: int | None,
    ray: RayOptions | None,
    options: RunOptions,
    as_json: bool,
) -> None:
    """Print how long a run would take at a given speed, and how much disk space and memory.

    Raises:
        InputError: something is trained, and no speed is given.
    """
    from uavmec_jax.cluster.connection import devices_per_shard
    from uavmec_jax.runs.run_plan import plan_run
    from uavmec_jax.runs.simulate import simulate
    from uavmec_jax.training.machine import Machine

    if speed is None and study.algorithms:
        raise InputError(
            "--simulate needs --speed, the training steps per second of one device: training_steps_per_second in the "
            "run.json of an earlier run, divided by its devices"
        )
    machine = Machine.here()
    if ray is not None:
        machine = replace(machine, devices=devices_per_shard(ray), accelerator=ray.gpus_per_shard > 0)
    plan = plan_run(study, shard_size=shard_size, machine=machine)
    estimate = simulate(
        study,
        plan,
        speed={} if speed is None else speed,
        devices=devices or machine.devices,
        options=options,
        on_ray=ray is not None,
    )
    if as_json:
        print_json(estimate.as_json())
    else:
        print_line(f"{study.name}: {plan}\n{estimate}")
