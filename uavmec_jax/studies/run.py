"""Run a study: plan it, train it, judge it, keep it."""

import datetime
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import pandas as pd

from uavmec_jax.errors import StudyError
from uavmec_jax.learning import population
from uavmec_jax.learning.algorithm import Agent, Algorithm
from uavmec_jax.learning.blocks import Blocks, PopulationTooLargeError, plan_blocks
from uavmec_jax.learning.population import Progress, TrainedBlock, Validation
from uavmec_jax.studies import host
from uavmec_jax.studies.evaluation import judge
from uavmec_jax.studies.results import SCHEMA, Results, holds_run
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import (
    evaluation_keys,
    identities,
    make_agents,
    make_algorithm,
    n_agents,
    seeds_of,
    validation_keys,
)


@dataclass(frozen=True)
class Plan:
    """What a run will take, known before anything is compiled or written."""

    agents: int
    total_steps: int
    blocks: Blocks
    free_bytes: int

    def __str__(self) -> str:
        blocks = f"{self.blocks.count} block{'s' * (self.blocks.count > 1)} of {self.blocks.size}"
        memory = f"{self.blocks.bytes / 2**30:.2f} GiB of {self.free_bytes / 2**30:.1f} GiB free"
        devices = f"{self.blocks.devices} device{'s' * (self.blocks.devices > 1)}"
        return f"{self.agents} agents x {self.total_steps // self.agents:,} steps in {blocks} on {devices}, {memory}"


def plan_study(study: Study) -> Plan:
    """Estimate memory and cut the population into blocks.

    Raises:
        StudyError: the population does not fit in memory.
    """
    algorithm, agents, free = make_algorithm(study), n_agents(study), host.free_memory()
    needed = agents * _BYTES_WITHOUT_TRAINING
    if needed > free:
        raise StudyError(
            f"{study.name}: {agents:,} agents need {needed / 2**30:,.0f} GiB before any of them trains, "
            f"{free / 2**30:.1f} GiB are free; shorten an axis"
        )
    try:
        blocks = plan_blocks(agents, algorithm.agent_bytes, free - needed)
    except PopulationTooLargeError as error:
        raise StudyError(f"{study.name}: steps is {study.steps}: {error}") from None
    return Plan(agents=agents, total_steps=agents * algorithm.total_steps, blocks=blocks, free_bytes=free)


_BYTES_WITHOUT_TRAINING = 100_000
"""An agent that waits for its block or is done: layout, keys, two sets of weights, evaluation."""


def check_directory(directory: Path) -> None:
    """Refuse a folder that cannot take a run.

    Raises:
        StudyError: it holds a run or something else, or is a file.
    """
    if holds_run(directory):
        raise StudyError(f"{directory}: already holds a run; give another folder with --out")
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise StudyError(f"{directory}: exists and is not an empty folder; give another one with --out")


def run_study(
    study: Study,
    directory: Path | None = None,
    *,
    command: str | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Results:
    """Train and judge the population of a study.

    After each block the finished agents are saved. Ctrl-C ends the run early: the results then hold the finished
    blocks and ``run["complete"]`` is False.

    Args:
        study: from :func:`uavmec_jax.studies.study.load_study`.
        directory: where to save; ``None`` saves nothing.
        command: the command line, for the label of the results.
        on_progress: told after every chunk.

    Raises:
        StudyError: the population does not fit, or the directory cannot take a run.
    """
    if directory is not None:
        check_directory(directory)
    plan = plan_study(study)
    started = time.perf_counter()
    results = Results(study=study, run=_label(study, plan, command))
    algorithm, agents = make_algorithm(study), make_agents(study)
    keys = evaluation_keys(study)
    validation = Validation(every=study.evaluation.validate_every, draws=study.evaluation.validation_draws)
    who = pd.DataFrame(identities(study))
    seconds: dict[str, float] = {"evaluate": 0.0}
    try:
        for block in population.train(
            algorithm,
            agents,
            validation_keys(study),
            validation=validation,
            blocks=plan.blocks,
            on_progress=on_progress,
        ):
            tick = time.perf_counter()
            _finish(results, algorithm, agents, keys, block, who)
            seconds["evaluate"] += time.perf_counter() - tick
            for activity, spent in block.seconds.items():
                seconds[activity] = seconds.get(activity, 0.0) + spent
            _measure(results, algorithm, plan, seconds, time.perf_counter() - started)
            if directory is not None:
                results.save(directory)
    except KeyboardInterrupt:
        results.run["complete"] = False
    return results


def _finish(
    results: Results, algorithm: Algorithm, agents: Agent, keys: Any, block: TrainedBlock, who: pd.DataFrame
) -> None:
    """Judge a trained block and add it to the results."""
    members = jax.tree.map(lambda leaf: leaf[block.agents], agents)
    weights = {"best": block.best, "last": block.last}
    baselines = results.study.evaluation.baselines
    judgements = judge(algorithm, members, keys[block.agents], weights, baselines)
    rows = who.iloc[block.agents].reset_index(drop=True)
    rows = rows.assign(
        steps=algorithm.total_steps,
        diverged_at=block.diverged_at,
        best_step=block.best_step,
        best_validation=block.best_score,
    )
    columns = {name: values for policy, judged in judgements.items() for name, values in judged.columns(policy).items()}
    evaluation = {
        f"{policy.replace('-', '_')}/{name}": values
        for policy, judged in judgements.items()
        for name, values in asdict(judged).items()
    }
    curves = {name: getattr(block, name) for name in ("chunk_steps", "episode_length", "look_steps", "validation")}
    results.add(rows.assign(**columns), curves, evaluation, weights)


def _label(study: Study, plan: Plan, command: str | None) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "study": study.name,
        "command": command or " ".join(sys.argv),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "complete": False,
        "agents": plan.agents,
        "seeds": seeds_of(study),
        "blocks": asdict(plan.blocks),
        **host.describe(),
    }


def _measure(results: Results, algorithm: Algorithm, plan: Plan, seconds: dict[str, float], wall: float) -> None:
    done = len(results.agents)
    results.run |= {
        "complete": done == plan.agents,
        "agents_done": done,
        "diverged": int((results.agents["diverged_at"] >= 0).sum()),
        "environment_steps": done * algorithm.total_steps,
        "seconds": {name: round(spent, 2) for name, spent in seconds.items()} | {"wall": round(wall, 2)},
        "training_steps_per_second": round(done * algorithm.total_steps / seconds["train"]),
        "validation_share": round(seconds["validate"] / (seconds["train"] + seconds["validate"]), 4),
    }
