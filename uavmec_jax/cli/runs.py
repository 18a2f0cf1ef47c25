"""Commands about runs that go on, stop, are taken up again, and have several workers."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import assignment, command_line, fail, new_folder, print_results

_DIRECTORY = click.argument("directory", type=click.Path(path_type=Path))
_WORKERS = click.option(
    "--workers", type=click.IntRange(1, 256), default=1, help="Processes on this machine (default: 1)."
)


def durability_options(command: Callable) -> Callable:
    """The options that say how a run is cut and kept."""
    for option in reversed(
        (
            _WORKERS,
            click.option(
                "--shard-size", type=click.IntRange(1), help="Most agents in a shard (default: what caches hold)."
            ),
            click.option(
                "--snapshot",
                type=click.Choice(["full", "weights"]),
                default="full",
                help="Of a shard in training, keep all (it goes on from there) or weights alone (it starts again).",
            ),
            click.option(
                "--snapshot-every",
                "snapshot_every_s",
                type=click.FloatRange(0),
                default=60.0,
                help="Seconds between snapshots, at least (default: 60).",
            ),
            click.option(
                "--snapshot-share",
                type=click.FloatRange(0.001, 1),
                default=0.02,
                help="Share of the time that they may take (default: 0.02): large ones come less often.",
            ),
            click.option(
                "--lease",
                "lease_s",
                type=click.FloatRange(1),
                default=60.0,
                help="Seconds without a sign after which a worker on another machine counts as dead (default: 60).",
            ),
            click.option("--tensorboard", is_flag=True, help="Write TensorBoard event files too (needs tensorboardX)."),
        )
    ):
        command = option(command)
    return command


def teller(console: Any) -> Callable[[str, dict[str, Any]], None]:
    """Prints those events of a run that a person should see."""
    lines = {
        "damaged": "shard {shard}: {error}; it is set aside",
        "restored": "shard {shard} goes on from {file}, step {steps:,}",
        "failed": "shard {shard} failed: {error}",
        "lost": "{error}",
        "died": "worker {pid} died (exit code {exit_code}); the others take over",
    }

    def tell(event: str, facts: dict[str, Any]) -> None:
        if event in lines:
            console.print(lines[event].format(**facts), highlight=False, soft_wrap=True)

    return tell


def conclude(results: Any, directory: Path, console: Any, as_json: bool) -> None:
    """Tables and figure of what is finished; if that is not all, how to go on, and the exit code of the signal."""
    from uavmec_jax.reporting import canvas, figures

    if len(results.agents):
        canvas.save(figures.run_figure(results), directory / "figure.png")
        print_results(results, directory, console, as_json)
    if not results.run["complete"]:
        done, of = len(results.agents), results.run["agents"]
        click.echo(
            f"interrupted: {done:,} of {of:,} agents are finished; go on with: uavmec resume {directory}", err=True
        )
        sys.exit(128 + results.run["stopped_by"])


@click.command()
@_DIRECTORY
@click.option("--workers", type=click.IntRange(1, 256), help="Processes on this machine (default: as planned).")
@click.option("--other-code", is_flag=True, help="Go on although code or libraries have changed; the bits may differ.")
@click.option("--json", "as_json", is_flag=True, help="Print the cells as JSON on standard output.")
def resume(directory: Path, workers: int | None, other_code: bool, as_json: bool) -> None:
    """Go on with the run in DIRECTORY, which was stopped or killed, and end as if nothing had happened."""
    from uavmec_jax.training import host

    host.use_every_core()
    from rich.console import Console

    from uavmec_jax.reporting.progress import progress_bar
    from uavmec_jax.runs.folder import RunFolder
    from uavmec_jax.runs.run import resume_run

    console = Console(stderr=as_json)
    plan = RunFolder.open(directory).plan
    console.print(f"[bold]{directory}[/bold]: {plan}", soft_wrap=True)
    with progress_bar(console, plan) as on_progress:
        results = resume_run(
            directory, workers=workers, other_code=other_code, on_progress=on_progress, on_event=teller(console)
        )
    conclude(results, directory, console, as_json)


@click.command()
@_DIRECTORY
@click.option("--json", "as_json", is_flag=True, help="Print as JSON on standard output.")
def status(directory: Path, as_json: bool) -> None:
    """How far the run in DIRECTORY is: shards, speed, time left, disk."""
    from rich.console import Console

    from uavmec_jax.reporting.status import status_lines
    from uavmec_jax.runs.status import run_status

    found = run_status(directory)
    if as_json:
        click.echo(json.dumps(found.as_json(), indent=1))
        return
    for line in status_lines(found):
        Console().print(line, highlight=False, soft_wrap=True)


@click.command()
@_DIRECTORY
@click.option("--share", metavar="I/N", help="Use the I-th of N equal parts of this machine's cores.")
@click.option(
    "--no-wait", is_flag=True, help="End when no shard is free, instead of waiting to take over from the dead."
)
def worker(directory: Path, share: str | None, no_wait: bool) -> None:
    """Work on the run in DIRECTORY beside others, on this machine or on any that shares the folder."""
    from uavmec_jax.training import host

    host.use_every_core(_share(share))
    from rich.console import Console

    from uavmec_jax.runs.shared_run import work_on
    from uavmec_jax.runs.signals import Stopped

    try:
        complete = work_on(directory, wait=not no_wait, on_event=teller(Console()))
    except Stopped as stopped:
        click.echo(
            f"interrupted: what this worker had is kept; start another with: uavmec worker {directory}", err=True
        )
        sys.exit(128 + stopped.signal)
    click.echo(
        f"{directory}: {'complete' if complete else 'no shard is free; others are still at work or have failed'}"
    )


def _share(text: str | None) -> tuple[int, int] | None:
    """``I/N`` as numbers from 1."""
    if text is None:
        return None
    part, slash, of = text.partition("/")
    if not slash or not part.isdigit() or not of.isdigit() or not 1 <= int(part) <= int(of):
        fail(f"--share {text}: give I/N, e.g. 1/2 for the first half of the cores")
    return int(part), int(of)


@click.command()
@click.argument("study")
@click.option("--jobs", type=click.IntRange(1, 10_000), required=True, help="Workers to start on the cluster.")
@click.option("--executor", default="slurm", help="Of submitit: slurm, local or debug (default: slurm).")
@click.option(
    "--with", "parameters", multiple=True, metavar="NAME=VALUE", help="For submitit, e.g. --with slurm_partition=cpu."
)
@click.option(
    "--set", "settings", multiple=True, metavar="NAME=VALUE", help="Override any setting, as in `uavmec run`."
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the run, which all hosts must see.")
@durability_options
def submit(
    study: str,
    jobs: int,
    executor: str,
    parameters: tuple[str, ...],
    settings: tuple[str, ...],
    out: Path | None,
    workers: int,
    shard_size: int | None,
    **durability: Any,
) -> None:
    """Plan STUDY and submit workers for it to a cluster (SLURM) by submitit: pip install 'uavmec-jax[cluster]'."""
    from uavmec_jax.training import host

    host.use_every_core()
    from uavmec_jax.runs.cluster import submit_workers
    from uavmec_jax.runs.folder import Durability
    from uavmec_jax.runs.shared_run import prepare_run
    from uavmec_jax.studies.study import load_study

    resolved = load_study(study, dict(assignment(setting) for setting in settings))
    directory = out or new_folder(resolved.name)
    options = dict(assignment(one, "--with") for one in parameters)

    def prepare() -> Path:
        prepare_run(
            resolved,
            directory,
            command=command_line(),
            workers=workers,
            shard_size=shard_size,
            jobs=jobs,
            durability=Durability(**durability),
        )
        return directory.absolute()

    names = submit_workers(prepare, jobs, executor, options)
    click.echo(f"{directory}: {len(names)} workers submitted ({', '.join(names[:4])}{', ...' * (len(names) > 4)})")
    click.echo(f"how far it is: uavmec status {directory}; the results, when it is complete: uavmec show {directory}")


def tell_simulation(
    study: Any,
    speed: float | None,
    devices: int | None,
    workers: int,
    shard_size: int | None,
    durability: Any,
    as_json: bool,
) -> None:
    """What a run would take, for a given speed."""
    from uavmec_jax.runs.run_plan import plan_study
    from uavmec_jax.runs.simulate import simulate

    if speed is None:
        fail("--simulate needs --speed, the training steps per second of one device; `uavmec doctor` measures it")
    plan = plan_study(study, workers=workers, shard_size=shard_size)
    found = simulate(study, plan, speed=speed, devices=devices or os.cpu_count() or 1, durability=durability)
    click.echo(json.dumps(found.as_json(), indent=1) if as_json else f"{study.name}: {plan}\n{found}")
