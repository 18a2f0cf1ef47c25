"""What a run would take: wall time, disk and memory, for a given training speed and number of devices."""

import datetime
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from uavmec_jax.agents.networks import count_weights
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.runs.checkpoints import interval_s
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run_plan import RunPlan
from uavmec_jax.studies.axes import TRACED_PARAMS
from uavmec_jax.studies.population import n_agents, split_by_algorithm
from uavmec_jax.studies.schema import Study

# Measured on two cores of a laptop-sized machine; see results/simulation.
_START_S = 4.0
"""A process until it can compile."""
_COMPILE_S = {"training": 9.0, "evaluation": 8.0, "planners": 9.0}
"""The programs of one algorithm."""
_PLANNING_S = 0.035
"""Rollout planner, beam and bound: one draw of one scenario."""
_PROCESS_BYTES = 900e6
"""A process with its compiled programs."""
_COPIES = 3
"""Of all results, in memory, while they are put together."""


@dataclass(frozen=True)
class Simulation:
    """What a run would take.

    Attributes:
        training_s, other_s: wall time of training, and of compiling, judging and planning.
        disk_bytes: at most, while it goes on.
        result_bytes: of what it leaves.
        memory_bytes: at most, of one worker.
        workers: that are at work at the same time.
        devices: that they have together.
    """

    training_s: float
    other_s: float
    disk_bytes: float
    result_bytes: float
    memory_bytes: float
    workers: int
    devices: int

    @property
    def wall_s(self) -> float:
        """Wall time in all."""
        return self.training_s + self.other_s

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"wall_s": self.wall_s}

    def __str__(self) -> str:
        training, other = (datetime.timedelta(seconds=round(s)) for s in (self.training_s, self.other_s))
        wall = datetime.timedelta(seconds=round(self.wall_s))
        return (
            f"wall time {wall}: training {training}, compiling and judging {other}; "
            f"{self.workers} worker{'s' * (self.workers > 1)} on {self.devices} device{'s' * (self.devices > 1)}\n"
            f"disk {self.disk_bytes / 2**30:,.2f} GiB at most, of it results {self.result_bytes / 2**30:,.2f} GiB\n"
            f"memory {self.memory_bytes / 2**30:,.2f} GiB for each worker"
        )


def simulate(
    study: Study,
    plan: RunPlan,
    *,
    speed: float | Mapping[str, float],
    devices: int,
    options: RunOptions | None = None,
) -> Simulation:
    """Wall time, disk and memory of a run, without running it.

    Args:
        study: what would be run.
        plan: how it is cut.
        speed: training steps per second of one device; or by algorithm.
        devices: of all machines together.
        options: how it would be kept.
    """
    options = options or RunOptions()
    kept = 0.0
    training = other = shards = results = 0.0
    groups = max(cut.groups for cut in plan.partitions.values())
    workers = max(min(devices // groups, len(plan.shards)), 1)
    for part in split_by_algorithm(study):
        cut, steps = plan.partitions[part.algorithm], plan.steps[part.algorithm]
        turns = math.ceil(cut.shards / workers)
        if steps:
            own = speed[part.algorithm] if isinstance(speed, Mapping) else speed
            shard_s = cut.shard_size * steps / (own * min(cut.groups, devices))
            training += turns * shard_s
            kept = max(kept, cut.shard_bytes * _generations(options, cut.shard_bytes, shard_s))
            other += _COMPILE_S["training"]
        judged = turns * cut.shard_size / plan.members[part.algorithm]
        draws = min(part.evaluation.planner_draws, part.evaluation.draws)
        if part.evaluation.planners:
            other += _COMPILE_S["planners"] + _PLANNING_S * _scenarios(part) * draws * min(judged, 1.0)
        if part.evaluation.baselines or steps:
            other += _COMPILE_S["evaluation"]
        shards += plan.members[part.algorithm] * sum(_agent_bytes(part))
        results += plan.members[part.algorithm] * _agent_bytes(part)[0]
    largest = max(cut.shard_bytes for cut in plan.partitions.values())
    return Simulation(
        training_s=training,
        other_s=_START_S + other,
        disk_bytes=shards + results + workers * kept,
        result_bytes=results,
        memory_bytes=_PROCESS_BYTES + max(1.0 * largest, _COPIES * shards),
        workers=workers,
        devices=devices,
    )


def _generations(options: RunOptions, size: float, shard_s: float) -> int:
    """Checkpoints of a shard that lie side by side: two, and one being written, if there is time for so many."""
    if options.checkpoint == "weights":
        return 0
    return min(int(shard_s / interval_s(options.checkpoint_every_s, options.checkpoint_share, size)), 3)


def _scenarios(study: Study) -> int:
    """How many different ones the agents of a study of one algorithm play."""
    same = [len(values) for name, values in study.axes.items() if name not in _PLAYED and isinstance(values, list)]
    return max(n_agents(study) // math.prod(same), 1)


_PLAYED = ("seeds", "powered", "connected", "cells", "place", *TRACED_PARAMS)


def _agent_bytes(study: Study) -> tuple[int, int]:
    """What one agent leaves: two sets of weights and a row of the table; and episodes and curves, which compress well."""
    n, settings = study.params.n_devices, study.evaluation
    episode = 4 + 1 + 4 * n
    episodes = len(settings.baselines) * (settings.draws + 1) + len(settings.planners) * settings.planner_draws
    if study.algorithm == "none":
        return 1000, episode * episodes
    declared = ALGORITHMS[study.algorithm]
    spec = declared.spec_of(getattr(study, study.algorithm).model_dump(), n_devices=n)
    looks = study.steps // settings.validate_every + 1
    episodes += 2 * (settings.draws + 1)
    return 2 * 4 * count_weights(spec.network, spec.obs_size) + 1000, episode * episodes + 4 * 5 * looks
