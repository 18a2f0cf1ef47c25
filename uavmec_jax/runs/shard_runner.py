"""One shard of a study: its agents made from their identities, trained, judged, and kept in a file."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import pandas as pd

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.env.rewards import Reward, make_reward
from uavmec_jax.runs.run_plan import Plan, Shard
from uavmec_jax.studies.evaluation import Distinct, Judgement, judge_all, judge_learned
from uavmec_jax.studies.population import (
    Who,
    evaluation_keys,
    identities,
    make_agents,
    make_algorithm,
    parts,
    validation_keys,
)
from uavmec_jax.studies.schema import TRACED_PARAMS, Study
from uavmec_jax.studies.shard_result import Finished
from uavmec_jax.training.training import Trainer, Training, Validation

_WHAT_IS_PLAYED = ("seed", "powered", "connected", "scenarios", "place", *TRACED_PARAMS)
"""Columns that say what an agent plays; all others say how it learns (as the seed does where scenarios are drawn)."""


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
