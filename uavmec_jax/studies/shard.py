"""One shard of a study: its agents made from their identities, trained, judged, and kept in a file."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import StudyError
from uavmec_jax.files import read_checked, write_checked
from uavmec_jax.learning.algorithm import Agent, Algorithm
from uavmec_jax.learning.training import Trainer, Training, Validation
from uavmec_jax.studies.evaluation import Distinct, Judgement, judge_all, judge_learned
from uavmec_jax.studies.plan import Plan, Shard
from uavmec_jax.studies.schema import TRACED_PARAMS, Study
from uavmec_jax.studies.study import (
    Who,
    evaluation_keys,
    identities,
    make_agents,
    make_algorithm,
    parts,
    validation_keys,
)
from uavmec_jax.world.rewards import Reward, make_reward

SCHEMA = 1
"""Version of a finished shard's file."""

_WHAT_IS_PLAYED = ("seed", "powered", "connected", "scenarios", "place", *TRACED_PARAMS)
"""Columns that say what an agent plays; all others say how it learns (as the seed does where scenarios are drawn)."""


@dataclass(frozen=True)
class Finished:
    """A shard that is trained and judged.

    Attributes:
        algorithm: its name.
        rows: tidy table, one row per agent.
        curves, evaluation, weights: see :class:`uavmec_jax.studies.results.Results`.
        seconds: by activity.
        steps: environment steps of all its agents.
    """

    algorithm: str
    rows: pd.DataFrame
    curves: dict[str, Any]
    evaluation: dict[str, Any]
    weights: dict[str, Any]
    seconds: dict[str, float]
    steps: int

    def write(self, path: Path) -> None:
        """Into one checked file, whole or not at all."""
        trees = {"curves": self.curves, "evaluation": self.evaluation, "weights": self.weights}
        columns = {
            f"rows/{name}": column.to_numpy() if column.dtype.kind in "biuf" else column.to_numpy(dtype=str)
            for name, column in self.rows.items()
        }
        arrays = columns | {
            f"{kind}/{name}": np.asarray(leaf)
            for kind, tree in trees.items()
            for name, leaf in traverse_util.flatten_dict(tree, sep="/").items()
        }
        facts = {"algorithm": self.algorithm, "seconds": self.seconds, "steps": self.steps, "columns": [*self.rows]}
        write_checked(path, SCHEMA, facts, arrays, compressed=False)

    @classmethod
    def read(cls, path: Path) -> "Finished":
        """What :meth:`write` wrote.

        Raises:
            StudyError: the file is not there, damaged, altered, something else or of another version.
        """
        facts, arrays = read_checked(path, SCHEMA, "a finished shard", StudyError)

        def of(kind: str) -> dict[str, Any]:
            return {name.removeprefix(f"{kind}/"): leaf for name, leaf in arrays.items() if name.startswith(f"{kind}/")}

        found = of("rows")
        rows = {
            name: found[name] if found[name].dtype.kind in "biuf" else found[name].tolist() for name in facts["columns"]
        }
        return cls(
            algorithm=facts["algorithm"],
            rows=pd.DataFrame(rows),
            curves=of("curves"),
            evaluation=of("evaluation"),
            weights=traverse_util.unflatten_dict(of("weights"), sep="/"),
            seconds=facts["seconds"],
            steps=facts["steps"],
        )


class Bench:
    """Trains and judges shards of one study in this process; every algorithm is compiled once."""

    def __init__(self, study: Study, plan: Plan, reward: Callable[[Mapping[str, Any]], Any] | None = None) -> None:
        own = make_reward(reward, study.guard) if reward is not None else None
        self._parts: dict[str, _Part] = {
            part.algorithm: _Part(part, plan, "algorithm" in study.axes, own) for part in parts(study)
        }

    def start(self, shard: Shard) -> Training | None:
        """The shard before its first step; ``None`` if nothing is trained."""
        return self._parts[shard.algorithm].start(shard)

    def finish(self, shard: Shard, training: Training | None) -> Finished:
        """Judge a shard that is trained to the end, or needs no training."""
        return self._parts[shard.algorithm].finish(shard, training)

    def who(self, shard: Shard) -> Who:
        """The identities of a shard's agents."""
        return self._parts[shard.algorithm].who[shard.first : shard.first + shard.agents]


@dataclass
class _Part:
    """The agents of one algorithm of a study, or those that nothing trains."""

    study: Study
    plan: Plan
    named: bool
    """Whether the table names the algorithm."""
    reward: Reward | None
    trainer: Trainer | None = None
    """Compiled for the first shard."""

    @cached_property
    def who(self) -> Who:
        return identities(self.study)

    @cached_property
    def algorithm(self) -> Algorithm | None:
        return make_algorithm(self.study)

    def members(self, shard: Shard) -> tuple[Who, Agent]:
        """The agents of a shard, the last one repeated to fill the block."""
        size = self.plan.blocks[self.study.algorithm].size
        who = self.who[shard.first : shard.first + shard.agents]
        who = who + [who[-1]] * (size - shard.agents)
        return who, make_agents(self.study, self.reward, who)

    def start(self, shard: Shard) -> Training | None:
        if self.algorithm is None:
            return None
        who, agents = self.members(shard)
        keys = validation_keys(self.study, who)
        if self.trainer is not None:
            return self.trainer.start(agents, keys)
        settings, blocks = self.study.evaluation, self.plan.blocks[self.study.algorithm]
        validation = Validation(every=settings.validate_every, draws=settings.validation_draws)
        self.trainer = Trainer.compile(self.algorithm, agents, keys, validation, blocks)
        training = self.trainer.start(agents, keys)
        training.seconds["compile"] = self.trainer.compile_seconds
        return training

    def finish(self, shard: Shard, training: Training | None) -> Finished:
        tick = time.perf_counter()
        who, agents = self.members(shard)
        keys = evaluation_keys(self.study, who)
        members, keys = jax.tree.map(lambda leaf: leaf[: shard.agents], (agents, keys))
        rows = pd.DataFrame(who[: shard.agents])
        drawn = "scenarios" in rows
        distinct = Distinct.of(
            rows[[name for name in rows if name in _WHAT_IS_PLAYED and not (drawn and name == "seed")]]
        )
        if self.named:
            rows.insert(3, "algorithm", self.study.algorithm)
        weights: dict[str, Any] = {}
        curves: dict[str, Any] = {}
        learned: dict[str, Judgement] = {}
        if self.algorithm and training:
            trained = training.trained(shard.agents)
            weights = {"best": trained.best, "last": trained.last}
            names = ("chunk_steps", "episode_length", "look_steps", "validation")
            curves = {name: getattr(trained, name) for name in names}
            rows = rows.assign(
                steps=self.algorithm.total_steps,
                diverged_at=trained.diverged_at,
                best_step=trained.best_step,
                best_validation=trained.best_score,
            )
            learned = judge_learned(self.algorithm, members, keys, weights)
        columns, evaluation, planning = judge_all(members, keys, learned, distinct, self.study.evaluation)
        seconds = {"evaluate": time.perf_counter() - tick - planning, "plan": planning}
        return Finished(
            algorithm=self.study.algorithm,
            rows=rows.assign(**columns),
            curves=curves,
            evaluation=evaluation,
            weights=weights,
            seconds=seconds | (training.seconds if training else {}),
            steps=shard.agents * (self.algorithm.total_steps if self.algorithm else 0),
        )
