"""Estimate the wall time, disk space and memory of a run from the training speed and the number of devices."""

import datetime
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from uavmec_jax.agents.networks import count_weights
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.checks import LARGEST, SMALLEST, check_range
from uavmec_jax.runs.checkpoints import interval_s
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run_plan import RunPlan
from uavmec_jax.studies.axes import TRACED_PARAMS
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.population import n_agents, n_clairvoyant_seeds, n_seeds
from uavmec_jax.studies.schema import Study

_MOST_DEVICES = 1_000_000

# Measured on two cores of a laptop-sized machine; see results/simulation.
_START_S = 4.0
"""Start of a process, until it can compile."""
_RAY_START_S = 7.0
"""Start of Ray on this machine, and of its first worker."""
_COMPILE_S = {"training": 9.0, "evaluation": 8.0, "planners": 9.0}
"""Compilation of one algorithm's programs."""
_PLANNING_S = 0.035
"""Rollout planner, beam and bound, for one draw of one scenario with one UAV; about K**3 times as long for K UAVs."""
_CLAIRVOYANT_SHARE = 0.75
"""Share of this time that beam and bound take."""
_PROCESS_BYTES = 900e6
"""A process with its compiled programs."""
_COPIES = 3
"""Copies of all results in memory while they are assembled."""


@dataclass(frozen=True)
class Simulation:
    """What a run would take.

    Attributes:
        training_s: wall time of training, seconds.
        other_s: wall time of compilation, evaluation and planning, seconds.
        disk_bytes: largest disk usage during the run.
        result_bytes: disk usage of the results.
        memory_bytes: largest memory of one process.
        shards_at_once: number of shards that train at the same time, each in its process.
        devices: number of devices of all of them together.
    """

    training_s: float
    other_s: float
    disk_bytes: float
    result_bytes: float
    memory_bytes: float
    shards_at_once: int
    devices: int

    @property
    def wall_s(self) -> float:
        """Total wall time, seconds."""
        return self.training_s + self.other_s

    def as_json(self) -> dict[str, Any]:
        """Return the estimate as plain data."""
        return asdict(self) | {"wall_s": self.wall_s}

    def __str__(self) -> str:
        training, other = (datetime.timedelta(seconds=round(s)) for s in (self.training_s, self.other_s))
        wall = datetime.timedelta(seconds=round(self.wall_s))
        return (
            f"wall time {wall}: training {training}, compilation and evaluation {other}; "
            f"{self.shards_at_once} shard{'s' * (self.shards_at_once > 1)} at a time on {self.devices} "
            f"device{'s' * (self.devices > 1)}\n"
            f"disk at most {self.disk_bytes / 2**30:,.2f} GiB, of which results {self.result_bytes / 2**30:,.2f} GiB\n"
            f"memory {self.memory_bytes / 2**30:,.2f} GiB per process"
        )


def simulate(
    study: Study,
    plan: RunPlan,
    *,
    speed: float | Mapping[str, float],
    devices: int,
    options: RunOptions | None = None,
    on_ray: bool = False,
) -> Simulation:
    """Estimate the wall time, disk space and memory of a run without running it.

    Args:
        study: the study to run.
        plan: how it is cut into shards.
        speed: training steps per second of one device, for all algorithms or by algorithm.
        devices: number of devices of all machines together.
        options: how the run would be checkpointed.
        on_ray: whether Ray is started for it.

    Raises:
        ArgumentError: the speed or the number of devices is out of range; one line.
    """
    options = options or RunOptions()
    check_range("devices", devices, ge=1, le=_MOST_DEVICES, whole=True)
    for device_speed in speed.values() if isinstance(speed, Mapping) else (speed,):
        check_range("speed", device_speed, ge=SMALLEST, le=LARGEST)
    training = other = checkpoints = shards = results = 0.0
    groups = max(partition.groups for partition in plan.partitions.values())
    at_once = max(min(devices // groups, len(plan.shards)), 1)
    for part in split_study(study):
        name, evaluation = part.study.algorithm, part.study.evaluation
        partition, members, steps = plan.partitions[part.name], plan.members[part.name], plan.steps[part.name]
        rounds = math.ceil(partition.shards / at_once)
        if steps:
            device_speed = speed[name] if isinstance(speed, Mapping) else speed
            shard_s = partition.shard_size * steps / (device_speed * min(partition.groups, devices))
            training += rounds * shard_s
            size = partition.shard_bytes
            checkpoints = max(checkpoints, size * _checkpoint_files(options, size, shard_s))
            other += _COMPILE_S["training"]
        if evaluation.planners:
            draws = min(evaluation.planner_draws, evaluation.draws)
            share_of_process = min(rounds * partition.shard_size / members, 1.0)
            planned = _distinct_scenarios(part.study) * draws * share_of_process
            other += _COMPILE_S["planners"] + _planning_s(part.study) * planned
        if evaluation.baselines or steps:
            other += _COMPILE_S["evaluation"]
        result_bytes, episode_bytes = _agent_bytes(part.study)
        shards += members * (result_bytes + episode_bytes)
        results += members * result_bytes
    largest = max(partition.shard_bytes for partition in plan.partitions.values())
    return Simulation(
        training_s=training,
        other_s=_START_S + _RAY_START_S * on_ray + other,
        disk_bytes=shards + results + at_once * checkpoints,
        result_bytes=results,
        memory_bytes=_PROCESS_BYTES + max(1.0 * largest, _COPIES * shards),
        shards_at_once=at_once,
        devices=devices,
    )


def _checkpoint_files(options: RunOptions, size: float, shard_s: float) -> int:
    """Return the number of checkpoints of a shard on disk: two and one being written, if the shard takes long enough."""
    if options.checkpoint == "weights":
        return 0
    return min(int(shard_s / interval_s(options.checkpoint_every_s, options.checkpoint_share, size)), 3)


_SCENARIO_AXES = ("seeds", "powered", "connected", "cells", "place", *TRACED_PARAMS)


def _planning_s(study: Study) -> float:
    """Return the mean seconds that the planners take for one draw of one scenario in one part of a study."""
    left_out = 1 - n_clairvoyant_seeds(study) / n_seeds(study)
    return _PLANNING_S * study.uavs**3 * (1 - _CLAIRVOYANT_SHARE * left_out)


def _distinct_scenarios(study: Study) -> int:
    """Return the number of distinct scenarios of a study of one algorithm."""
    repeats = [len(v) for name, v in study.axes.items() if name not in _SCENARIO_AXES and isinstance(v, list)]
    return max(n_agents(study) // math.prod(repeats), 1)


def _agent_bytes(study: Study) -> tuple[int, int]:
    """Return the bytes of an agent's results: weights and its row of the table; episodes and curves, which compress well."""
    n, settings = study.params.n_devices, study.evaluation
    episode = 4 + 1 + 4 * n
    episodes = len(settings.baselines) * (settings.draws + 1) + len(settings.planners) * settings.planner_draws
    if study.algorithm == "none":
        return 1000, episode * episodes
    declared = ALGORITHMS[study.algorithm]
    spec = declared.spec_of(getattr(study, study.algorithm).model_dump(), n_devices=n)
    validations = study.steps // settings.validate_every + 1
    episodes += 2 * (settings.draws + 1)
    return 2 * 4 * count_weights(spec.network, spec.obs_size) + 1000, episode * episodes + 4 * 5 * validations
