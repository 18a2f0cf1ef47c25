"""A run's status in words."""

import datetime

from uavmec_jax.runs.status import Status

_MOST = 8
"""Workers and failures that are named."""


def status_lines(status: Status) -> list[str]:
    """What stands in ``uavmec status``."""
    states = ", ".join(f"{count:,} {state}" for state, count in status.shards.items() if count)
    share = status.steps / max(status.total_steps, 1)
    lines = [
        f"{status.directory}: {'complete' if status.complete else 'not complete'}, {status.agents:,} agents",
        f"shards: {states}",
        f"steps: {status.steps:,} of {status.total_steps:,} ({share:.0%})",
        f"disk: {status.disk_bytes / 2**20:,.1f} MiB",
    ]
    if status.seconds_left is not None:
        left = datetime.timedelta(seconds=round(status.seconds_left))
        lines.append(f"speed: {status.steps_per_second:,.0f} steps/s, training left: {left}")
    lines += _first(status.workers)
    lines += _first([f"shard {number} failed: {why}" for number, why in status.failures.items()])
    if not status.complete and not status.workers:
        lines.append(f"nobody is at work; go on with: uavmec resume {status.directory}")
    return lines


def _first(lines: list[str]) -> list[str]:
    return lines[:_MOST] + [f"... and {len(lines) - _MOST} more"] * (len(lines) > _MOST)
