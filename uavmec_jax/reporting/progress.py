"""The live progress bar of a run."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich import progress as rich_progress
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavmec_jax.runs.run_plan import RunPlan
from uavmec_jax.training.population import Progress


@contextmanager
def progress_bar(console: Console, plan: RunPlan) -> Iterator[Callable[[Progress], None]]:
    """Show speed, mean episode length and time left; yield the function that the run reports its progress to."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[speed]} {task.fields[unit]}/s"),
        TextColumn("episode {task.fields[length]} slots"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with rich_progress.Progress(*columns, console=console) as bar:
        unit = "steps" if plan.total_steps else "scenarios"
        task = bar.add_task("compiling", total=plan.work, speed="-", length="-", unit=unit)

        def report(progress: Progress) -> None:
            speed, length = bar.tasks[task].speed, progress.mean_episode_length
            bar.update(
                task,
                completed=progress.steps,
                description=f"shard {progress.shard + 1}/{len(plan.shards)}",
                speed=f"{speed:,.0f}" if speed else "-",
                length="-" if math.isnan(length) else f"{length:.1f}",
            )

        yield report
