"""The live progress bar of a run."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavmec_jax.runs.run_plan import RunPlan
from uavmec_jax.training.population import Progress as SearchProgress


@contextmanager
def progress_bar(console: Console, plan: RunPlan) -> Iterator[Callable[[SearchProgress], None]]:
    """Show steps/s, mean episode length and time left; yields what the run reports to."""
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
    with Progress(*columns, console=console) as bar:
        unit = "steps" if plan.total_steps else "scenarios"
        task = bar.add_task("compiling", total=plan.work, speed="-", length="-", unit=unit)

        def report(news: SearchProgress) -> None:
            speed = bar.tasks[task].speed
            bar.update(
                task,
                completed=news.steps,
                description=f"shard {news.shard + 1}/{len(plan.shards)}",
                speed=f"{speed:,.0f}" if speed else "-",
                length="-" if math.isnan(news.mean_episode_length) else f"{news.mean_episode_length:.1f}",
            )

        yield report
