"""The live progress bar of a run."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavmec_jax.learning.population import Progress as News
from uavmec_jax.studies.run import Plan


@contextmanager
def progress_bar(console: Console, plan: Plan) -> Iterator[Callable[[News], None]]:
    """Show steps/s, mean episode length and time left; yields what the run reports to."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[speed]} steps/s"),
        TextColumn("episode {task.fields[length]} slots"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("compiling", total=plan.total_steps, speed="-", length="-")

        def report(news: News) -> None:
            speed = bar.tasks[task].speed
            bar.update(
                task,
                completed=news.steps,
                description=f"block {news.block + 1}/{plan.blocks.count}",
                speed=f"{speed:,.0f}" if speed else "-",
                length=f"{news.mean_length:.1f}",
            )

        yield report
