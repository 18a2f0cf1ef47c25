"""The status of a run as lines of text."""

import datetime

from uavmec_jax.runs.status import Status

_MAX_LINES = 8
"""Nodes, running shards and failures that are listed, each."""


def status_lines(status: Status) -> list[str]:
    """Return the lines that ``uavmec status`` prints."""
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
    if status.retries:
        lines.append(f"retries: {status.retries:,}")
    if len(status.nodes) > 1:
        lines += _truncate([f"node {node}: {count} shards" for node, count in status.nodes.items()])
    lines += _truncate(status.running)
    lines += _truncate([f"shard {number} failed: {why}" for number, why in status.failures.items()])
    if not status.complete:
        resume = f"no driver is running; resume with: uavmec resume {status.directory}"
        lines.append(f"driver: {status.owner}" if status.owner else resume)
    return lines


def _truncate(lines: list[str]) -> list[str]:
    """Return the first lines, and how many more there are."""
    return lines[:_MAX_LINES] + [f"... and {len(lines) - _MAX_LINES} more"] * (len(lines) > _MAX_LINES)
