"""The live progress bar of a run."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

from rich import progress as rich_progress
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavmec_jax.runs.run_plan import RunPlan
from uavmec_jax.training.population import Progress


class RunBar:
    """The bar of a run: it appears with the run plan, and moves with its progress."""

    def __init__(self, bar: rich_progress.Progress) -> None:
        self._bar = bar
        self._shards = 0

    def start(self, plan: RunPlan) -> None:
        """Show the bar of a run that is about to begin."""
        unit = "steps" if plan.total_steps else "scenarios"
        self._shards = len(plan.shards)
        self._task = self._bar.add_task("compiling", total=plan.work, speed="-", length="-", unit=unit, detail="")

    def report(self, progress: Progress) -> None:
        """Move the bar."""
        speed, length = self._bar.tasks[self._task].speed, progress.mean_episode_length
        self._bar.update(
            self._task,
            completed=progress.steps,
            description=f"shard {progress.shard + 1}/{self._shards}",
            speed=f"{speed:,.0f}" if speed else "-",
            length="-" if math.isnan(length) else f"{length:.1f}",
            detail=progress.detail,
        )


@contextmanager
def progress_bar(console: Console) -> Iterator[RunBar]:
    """Show speed, mean episode length and time left of a run."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[speed]} {task.fields[unit]}/s"),
        TextColumn("episode {task.fields[length]} slots"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
    )
    with rich_progress.Progress(*columns, console=console) as bar:
        yield RunBar(bar)
