"""Train and evaluate the shards of a study in this process."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import pandas as pd

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.env.rewards import Reward, make_reward
from uavmec_jax.runs.run_plan import RunPlan, Shard
from uavmec_jax.studies.axes import TRACED_PARAMS
from uavmec_jax.studies.evaluation import DistinctScenarios, evaluate_all, evaluate_learned
from uavmec_jax.studies.evaluation_result import EvaluationResult
from uavmec_jax.studies.parts import Part, split_study
from uavmec_jax.studies.population import (
    AgentId,
    evaluation_keys,
    make_agent_ids,
    make_agents,
    make_algorithm,
    n_clairvoyant_seeds,
    seeds_of,
    validation_keys,
)
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.training import Trainer, Training

_SCENARIO_AXES = ("seed", "powered", "connected", "scenarios", "place", *TRACED_PARAMS)
"""Axes that change an agent's scenario; all others concern its training, as does the seed of drawn scenarios."""


class ShardRunner:
    """Trains and evaluates the shards of one study; each of its parts is compiled once."""

    def __init__(self, study: Study, plan: RunPlan, reward: Callable[[Mapping[str, Any]], Any] | None = None) -> None:
        """Prepare for a study.

        Args:
            study: the study.
            plan: how it is cut into shards.
            reward: a function of the reward's terms that replaces the study's reward.
        """
        replacement = make_reward(reward, study.guard) if reward is not None else None
        self._runners = {
            part.name: _PartRunner(part, plan.partitions[part.name], replacement) for part in split_study(study)
        }

    def start(self, shard: Shard) -> Training | None:
        """Start the training of a shard; ``None`` where nothing is trained."""
        return self._runners[shard.part].start(shard)

    def finish(self, shard: Shard, training: Training | None) -> ShardResult:
        """Evaluate a shard whose training is finished, or which needs none."""
        return self._runners[shard.part].finish(shard, training)

    def algorithm(self, shard: Shard) -> str:
        """Return the name of a shard's algorithm, ``none`` where nothing is trained."""
        return self._runners[shard.part].study.algorithm

    def agent_ids(self, shard: Shard) -> list[AgentId]:
        """Return the identities of a shard's agents."""
        return self._runners[shard.part].agent_ids[shard.first : shard.first + shard.agents]


@dataclass
class _PartRunner:
    """Runs the shards of one part of a study."""

    part: Part
    partition: Partition
    reward: Reward | None
    trainer: Trainer | None = None
    """Compiled with the first shard."""

    @property
    def study(self) -> Study:
        return self.part.study

    @cached_property
    def agent_ids(self) -> list[AgentId]:
        return make_agent_ids(self.study)

    @cached_property
    def algorithm(self) -> Algorithm | None:
        return make_algorithm(self.study)

    def members(self, shard: Shard) -> tuple[list[AgentId], Agent]:
        """Make the agents of a shard; the last one is repeated as padding."""
        agent_ids = self.agent_ids[shard.first : shard.first + shard.agents]
        agent_ids = agent_ids + [agent_ids[-1]] * (self.partition.shard_size - shard.agents)
        return agent_ids, make_agents(self.study, self.reward, agent_ids)

    def start(self, shard: Shard) -> Training | None:
        if self.algorithm is None:
            return None
        agent_ids, agents = self.members(shard)
        keys = validation_keys(self.study, agent_ids)
        if self.trainer is not None:
            return self.trainer.start(agents, keys)
        settings = self.study.evaluation
        validation = Validation(every=settings.validate_every, draws=settings.validation_draws)
        self.trainer = Trainer.compile(self.algorithm, agents, keys, validation, self.partition)
        training = self.trainer.start(agents, keys)
        training.seconds["compile"] = self.trainer.compile_seconds
        return training

    def finish(self, shard: Shard, training: Training | None) -> ShardResult:
        started = time.perf_counter()
        agent_ids, agents = self.members(shard)
        keys = evaluation_keys(self.study, agent_ids)
        members, keys = jax.tree.map(lambda leaf: leaf[: shard.agents], (agents, keys))
        rows = pd.DataFrame(agent_ids[: shard.agents])
        distinct = DistinctScenarios.of(rows[_scenario_columns(rows)])
        clairvoyant = rows["seed"].isin(seeds_of(self.study)[: n_clairvoyant_seeds(self.study)]).to_numpy()
        for name, value in reversed(self.part.values.items()):
            rows.insert(min(3, rows.shape[1]), name, value)
        weights: dict[str, Any] = {}
        curves: dict[str, Any] = {}
        learned: dict[str, EvaluationResult] = {}
        if self.algorithm and training:
            trained = training.result(shard.agents)
            weights = {"best": trained.best, "last": trained.last}
            names = ("chunk_steps", "episode_length", "validation_steps", "validation")
            curves = {name: getattr(trained, name) for name in names}
            rows = rows.assign(
                steps=self.algorithm.total_steps,
                diverged_at=trained.diverged_at,
                best_step=trained.best_step,
                best_validation=trained.best_score,
            )
            learned = evaluate_learned(self.algorithm, members, keys, weights)
        settings = self.study.evaluation
        columns, evaluation, planning = evaluate_all(members, keys, learned, distinct, settings, clairvoyant)
        seconds = {"evaluate": time.perf_counter() - started - planning, "plan": planning}
        return ShardResult(
            algorithm=self.study.algorithm,
            rows=rows.assign(**columns),
            curves=curves,
            evaluation=evaluation,
            weights=weights,
            seconds=seconds | (training.seconds if training else {}),
            steps=shard.agents * (self.algorithm.total_steps if self.algorithm else 0),
        )


def _scenario_columns(rows: pd.DataFrame) -> list[str]:
    """Return the columns by which agents' scenarios differ."""
    drawn = "scenarios" in rows
    return [name for name in rows if name in _SCENARIO_AXES and not (drawn and name == "seed")]
