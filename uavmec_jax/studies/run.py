"""Run a study: plan it, train it, judge it, keep it."""

import datetime
import sys
import time
from collections.abc import Callable, Iterator
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
from uavmec_jax.studies.evaluation import Judgement, PlannedJudgement, judge, judge_planners, planned_columns
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
        if not self.total_steps:
            return f"{self.agents} scenarios, nothing is trained"
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
    if algorithm is None:
        size = min(_UNTRAINED_BLOCK, agents)
        blocks = Blocks(count=-(-agents // size), size=size, devices=jax.local_device_count(), bytes=0)
        return Plan(agents=agents, total_steps=0, blocks=blocks, free_bytes=free)
    try:
        blocks = plan_blocks(agents, algorithm.agent_bytes, free - needed)
    except PopulationTooLargeError as error:
        raise StudyError(f"{study.name}: steps is {study.steps}: {error}") from None
    return Plan(agents=agents, total_steps=agents * algorithm.total_steps, blocks=blocks, free_bytes=free)


_UNTRAINED_BLOCK = 100
"""Scenarios between two savings where nothing is trained."""

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
    who = pd.DataFrame(identities(study))
    seconds: dict[str, float] = {"evaluate": 0.0, "plan": 0.0}
    try:
        for place, trained in _blocks(study, algorithm, agents, plan, on_progress):
            _finish(results, algorithm, agents, keys, place, trained, who, seconds)
            for activity, spent in trained.seconds.items() if trained else ():
                seconds[activity] = seconds.get(activity, 0.0) + spent
            _measure(results, algorithm, plan, seconds, time.perf_counter() - started)
            if directory is not None:
                results.save(directory)
    except KeyboardInterrupt:
        results.run["complete"] = False
    return results


def _blocks(
    study: Study, algorithm: Algorithm | None, agents: Agent, plan: Plan, on_progress: Callable[[Progress], None]
) -> Iterator[tuple[slice, TrainedBlock | None]]:
    """Block after block, trained if the study trains; if not, progress counts scenarios."""
    if algorithm is None:
        for block in range(plan.blocks.count):
            place = slice(block * plan.blocks.size, min((block + 1) * plan.blocks.size, plan.agents))
            yield place, None
            on_progress(Progress(block, place.stop, plan.agents, float("nan")))
        return
    looks = validation_keys(study)
    validation = Validation(every=study.evaluation.validate_every, draws=study.evaluation.validation_draws)
    for trained in population.train(
        algorithm, agents, looks, validation=validation, blocks=plan.blocks, on_progress=on_progress
    ):
        yield trained.agents, trained


def _finish(
    results: Results,
    algorithm: Algorithm | None,
    agents: Agent,
    keys: Any,
    place: slice,
    trained: TrainedBlock | None,
    who: pd.DataFrame,
    seconds: dict[str, float],
) -> None:
    """Judge a block, trained or not, and add it to the results."""
    members = jax.tree.map(lambda leaf: leaf[place], agents)
    rows = who.iloc[place].reset_index(drop=True)
    weights: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    if algorithm and trained:
        weights = {"best": trained.best, "last": trained.last}
        names = ("chunk_steps", "episode_length", "look_steps", "validation")
        curves = {name: getattr(trained, name) for name in names}
        rows = rows.assign(
            steps=algorithm.total_steps,
            diverged_at=trained.diverged_at,
            best_step=trained.best_step,
            best_validation=trained.best_score,
        )
    settings = results.study.evaluation
    tick = time.perf_counter()
    judgements = judge(algorithm, members, keys[place], weights, settings.baselines)
    tock = time.perf_counter()
    planned = judge_planners(members, keys[place, :-1], settings, [judged.lifetime for judged in judgements.values()])
    seconds["evaluate"] += tock - tick
    seconds["plan"] += time.perf_counter() - tock
    columns = {name: values for policy, judged in judgements.items() for name, values in judged.columns(policy).items()}
    columns |= planned_columns(judgements, planned)
    everyone: dict[str, Judgement | PlannedJudgement] = {**judgements, **planned}
    evaluation = {
        f"{policy.replace('-', '_')}/{name}": values
        for policy, anyone in everyone.items()
        for name, values in asdict(anyone).items()
        if values is not None
    }
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


def _measure(results: Results, algorithm: Algorithm | None, plan: Plan, seconds: dict[str, float], wall: float) -> None:
    done = len(results.agents)
    results.run |= {
        "complete": done == plan.agents,
        "agents_done": done,
        "seconds": {name: round(spent, 2) for name, spent in seconds.items()} | {"wall": round(wall, 2)},
    }
    if algorithm is not None:
        steps = done * algorithm.total_steps
        results.run |= {
            "diverged": int((results.agents["diverged_at"] >= 0).sum()),
            "environment_steps": steps,
            "training_steps_per_second": round(steps / seconds["train"]),
            "validation_share": round(seconds["validate"] / (seconds["train"] + seconds["validate"]), 4),
        }
