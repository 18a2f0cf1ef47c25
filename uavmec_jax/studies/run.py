"""Run a study: plan it, train it, judge it, keep it."""

import datetime
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
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
from uavmec_jax.studies.evaluation import Distinct, Judgement, judge_all, judge_learned
from uavmec_jax.studies.places import describe_places, load_evacuations
from uavmec_jax.studies.results import SCHEMA, Results, holds_run
from uavmec_jax.studies.schema import TRACED_PARAMS, Study
from uavmec_jax.studies.study import (
    evaluation_keys,
    identities,
    make_agents,
    make_algorithm,
    n_agents,
    parts,
    seeds_of,
    validation_keys,
)
from uavmec_jax.world.rewards import make_reward


@dataclass(frozen=True)
class Plan:
    """What a run will take, known before anything is compiled or written."""

    agents: int
    total_steps: int
    blocks: dict[str, Blocks]
    """Algorithm -> how its agents are cut."""
    free_bytes: int

    @property
    def n_blocks(self) -> int:
        """Blocks of all algorithms."""
        return sum(blocks.count for blocks in self.blocks.values())

    def __str__(self) -> str:
        if not self.total_steps:
            return f"{self.agents} scenarios, nothing is trained"
        every = list(self.blocks.values())
        each = self.n_blocks > 1
        sizes = "+".join(f"{blocks.count} x {blocks.size}" for blocks in every)
        cut = f"{self.n_blocks} block{'s' * each}{f' ({sizes})' if len(every) > 1 else f' of {every[0].size}'}"
        memory = f"{max(b.bytes for b in every) / 2**30:.2f} GiB of {self.free_bytes / 2**30:.1f} GiB free"
        devices = max(blocks.devices for blocks in every)
        return (
            f"{self.agents} agents x {self.total_steps // self.agents:,} steps in {cut} "
            f"on {devices} device{'s' * (devices > 1)}, {memory}"
        )


def plan_study(study: Study) -> Plan:
    """Estimate memory and cut the population into blocks.

    Raises:
        StudyError: the population does not fit in memory.
        TrafficError: a place of the study is not usable.
    """
    load_evacuations(study)
    agents, free = n_agents(study), host.free_memory()
    needed = agents * _BYTES_WITHOUT_TRAINING
    if needed > free:
        raise StudyError(
            f"{study.name}: {agents:,} agents need {needed / 2**30:,.0f} GiB before any of them trains, "
            f"{free / 2**30:.1f} GiB are free; shorten an axis"
        )
    blocks: dict[str, Blocks] = {}
    total_steps = 0
    for part in parts(study):
        algorithm, members = make_algorithm(part), n_agents(part)
        if algorithm is None:
            size = min(_UNTRAINED_BLOCK, members)
            blocks[part.algorithm] = Blocks(-(-members // size), size, jax.local_device_count(), bytes=0)
            continue
        try:
            blocks[part.algorithm] = plan_blocks(members, algorithm.agent_bytes, free - needed)
        except PopulationTooLargeError as error:
            raise StudyError(f"{study.name}: steps is {study.steps}: {error}") from None
        total_steps += members * algorithm.total_steps
    return Plan(agents=agents, total_steps=total_steps, blocks=blocks, free_bytes=free)


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
    reward: Callable[[Mapping[str, Any]], Any] | None = None,
    command: str | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Results:
    """Train and judge the population of a study.

    After each block the finished agents are saved. Ctrl-C ends the run early: the results then hold the finished
    blocks and ``run["complete"]`` is False.

    Args:
        study: from :func:`uavmec_jax.studies.study.load_study`.
        directory: where to save; ``None`` saves nothing.
        reward: a function of the terms (see :func:`um.make_reward`) in place of the study's reward; the run's label
            then names it.
        command: the command line, for the label of the results.
        on_progress: told after every chunk.

    Raises:
        StudyError: the population does not fit, the directory cannot take a run, or ``reward`` stands beside an axis of
            rewards.
    """
    if directory is not None:
        check_directory(directory)
    if reward is not None and "reward" in study.axes:
        raise StudyError(f"{study.name}: axes.reward is given, and a reward function too; leave one of them out")
    plan = plan_study(study)
    started = time.perf_counter()
    results = Results(study=study, run=_label(study, plan, command))
    if reward is not None:
        results.run["reward_function"] = getattr(reward, "__qualname__", repr(reward))
    seconds: dict[str, float] = {"evaluate": 0.0, "plan": 0.0}
    steps_before = 0
    try:
        for part in parts(study):
            own = make_reward(reward, study.guard) if reward is not None else None
            members = _Population(part, make_algorithm(part), make_agents(part, own), evaluation_keys(part))
            report = _report(on_progress, plan, part.algorithm, steps_before)
            for place, trained in members.blocks(plan.blocks[part.algorithm], report):
                members.finish(results, place, trained, seconds)
                steps_before += (place.stop - place.start) * members.steps
                for activity, spent in trained.seconds.items() if trained else ():
                    seconds[activity] = seconds.get(activity, 0.0) + spent
                _measure(results, plan, steps_before, seconds, time.perf_counter() - started)
                if directory is not None:
                    results.save(directory)
    except KeyboardInterrupt:
        results.run["complete"] = False
    return results


def _report(
    on_progress: Callable[[Progress], None], plan: Plan, algorithm: str, steps_before: int
) -> Callable[[Progress], None]:
    """News of one algorithm as news of the whole run."""
    names = list(plan.blocks)
    blocks_before = sum(plan.blocks[name].count for name in names[: names.index(algorithm)])

    def report(news: Progress) -> None:
        steps, of_steps = steps_before + news.steps, plan.total_steps or plan.agents
        on_progress(replace(news, block=blocks_before + news.block, steps=steps, of_steps=of_steps))

    return report


@dataclass(frozen=True)
class _Population:
    """The agents of one algorithm of a study, or those that nothing trains."""

    study: Study
    algorithm: Algorithm | None
    agents: Agent
    keys: Any

    @property
    def steps(self) -> int:
        """Environment steps of one agent."""
        return self.algorithm.total_steps if self.algorithm else 0

    def blocks(
        self, cut: Blocks, on_progress: Callable[[Progress], None]
    ) -> Iterator[tuple[slice, TrainedBlock | None]]:
        """Block after block, trained if the study trains; if not, progress counts scenarios."""
        if self.algorithm is None:
            n = self.keys.shape[0]
            for block in range(cut.count):
                place = slice(block * cut.size, min((block + 1) * cut.size, n))
                yield place, None
                on_progress(Progress(block, place.stop, n, float("nan")))
            return
        settings = self.study.evaluation
        validation = Validation(every=settings.validate_every, draws=settings.validation_draws)
        for trained in population.train(
            self.algorithm,
            self.agents,
            validation_keys(self.study),
            validation=validation,
            blocks=cut,
            on_progress=on_progress,
        ):
            yield trained.agents, trained

    def finish(self, results: Results, place: slice, trained: TrainedBlock | None, seconds: dict[str, float]) -> None:
        """Judge a block, trained or not, and add it to the results."""
        members, keys = jax.tree.map(lambda leaf: leaf[place], (self.agents, self.keys))
        rows = pd.DataFrame(identities(self.study)[place])
        weights: dict[str, Any] = {}
        curves: dict[str, Any] = {}
        learned: dict[str, Judgement] = {}
        distinct = Distinct.of(rows[[name for name in rows if name in _WHAT_IS_PLAYED]])
        if "algorithm" in results.study.axes:
            rows.insert(3, "algorithm", self.study.algorithm)
        tick = time.perf_counter()
        if self.algorithm and trained:
            weights = {"best": trained.best, "last": trained.last}
            names = ("chunk_steps", "episode_length", "look_steps", "validation")
            curves = {name: getattr(trained, name) for name in names}
            rows = rows.assign(
                steps=self.steps,
                diverged_at=trained.diverged_at,
                best_step=trained.best_step,
                best_validation=trained.best_score,
            )
            learned = judge_learned(self.algorithm, members, keys, weights)
        columns, evaluation, planning = judge_all(members, keys, learned, distinct, self.study.evaluation)
        seconds["plan"] += planning
        seconds["evaluate"] += time.perf_counter() - tick - planning
        results.add(self.study.algorithm, rows.assign(**columns), curves, evaluation, weights)


_WHAT_IS_PLAYED = ("seed", "powered", "connected", "place", *TRACED_PARAMS)
"""Columns that say what an agent plays; all others say how it learns."""


def _label(study: Study, plan: Plan, command: str | None) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "study": study.name,
        "command": command or " ".join(sys.argv),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "complete": False,
        "agents": plan.agents,
        "seeds": seeds_of(study),
        **({"places": places} if (places := describe_places(study)) else {}),
        "blocks": {name: asdict(blocks) for name, blocks in plan.blocks.items()},
        **host.describe(),
    }


def _measure(results: Results, plan: Plan, steps: int, seconds: dict[str, float], wall: float) -> None:
    done = len(results.agents)
    results.run |= {
        "complete": done == plan.agents,
        "agents_done": done,
        "seconds": {name: round(spent, 2) for name, spent in seconds.items()} | {"wall": round(wall, 2)},
    }
    if steps:
        results.run |= {
            "diverged": int((results.agents["diverged_at"] >= 0).sum()),
            "environment_steps": steps,
            "training_steps_per_second": round(steps / seconds["train"]),
            "validation_share": round(seconds["validate"] / (seconds["train"] + seconds["validate"]), 4),
        }
