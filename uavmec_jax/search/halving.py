"""Successive halving of one batch of trials: a population of trials x scenarios, pruned at every rung."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.errors import StudyError
from uavmec_jax.search.space import REWARD, Space, reward_with
from uavmec_jax.studies.evaluation import evaluate_learned
from uavmec_jax.studies.population import (
    AgentId,
    evaluation_keys,
    make_agent_ids,
    make_agents,
    make_algorithm,
    validation_keys,
)
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.training import host
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import Partition, PopulationTooLargeError, partition_population
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.regroup import regroup
from uavmec_jax.training.training import Trainer, Training

Values = Mapping[str, Any]
"""The settings of a trial: name -> value."""


@dataclass(frozen=True)
class TrialOutcome:
    """The outcome of a trial.

    Attributes:
        value: its objective; ``None`` if the trial was pruned.
        rungs: environment steps of one agent -> mean validation score of the best weights so far.
    """

    value: float | None
    rungs: dict[int, float]


@dataclass
class SuccessiveHalving:
    """Runs the batches of a search; programs are compiled once per shape.

    Attributes:
        space: the search space.
        on_progress: called with ``(finished share of the batch, trials in training)``.
    """

    space: Space
    on_progress: Callable[[float, int], None] = lambda share, trials: None
    _trainers: dict[Any, Trainer] = field(default_factory=dict)

    @cached_property
    def study(self) -> Study:
        """The study on the validation scenarios of the search."""
        base, scenarios = self.space.base(), self.space.validation
        if scenarios.cells:
            axes: dict[str, Any] = {"cells": [list(cell) for cell in scenarios.cells]}
        else:
            axes = {name: base.axes[name] for name in ("powered", "connected", "cells") if name in base.axes}
        seeds = list(range(scenarios.first_seed, scenarios.first_seed + scenarios.seeds))
        evaluation = base.evaluation.model_copy(update={"draws": scenarios.draws})
        return base.model_copy(update={"axes": axes | {"seeds": seeds}, "evaluation": evaluation})

    @cached_property
    def agent_ids(self) -> list[AgentId]:
        """Identities of the agents of one trial, one per scenario."""
        return make_agent_ids(self.study)

    @property
    def n_scenarios(self) -> int:
        """Number of scenarios, and thus of agents of one trial."""
        return len(self.agent_ids)

    def run(self, trials: Sequence[Values]) -> list[TrialOutcome]:
        """Train and evaluate a batch of trials that share their static settings.

        Raises:
            StudyError: the batch does not fit in memory.
        """
        agents, keys, algorithm = self._population(trials)
        trainer = self._trainer(trials[0], algorithm, agents, keys, len(trials) * self.n_scenarios)
        size = trainer.partition.shard_size
        trainings = [
            trainer.start(*take_padded((agents, keys), shard * size, size)) for shard in range(trainer.partition.shards)
        ]
        remaining = list(range(len(trials)))
        rungs: list[dict[int, float]] = [{} for _ in trials]
        for chunk in self._rungs(trainer):
            self._train_until(trainings, chunk, len(remaining))
            scores = self._trial_means(np.concatenate([self._scores(one) for one in trainings]), len(remaining))
            for trial, score in zip(remaining, scores, strict=True):
                rungs[trial][trainings[0].steps] = float(score)
            if chunk < len(trainer.chunks):
                n = max(1, round(self.space.halving.keep * len(remaining)))
                best = np.sort(np.argsort(-scores, kind="stable")[:n])
                remaining = [remaining[k] for k in best]
                trainings = regroup(trainings, self._members(best))
        agents = jax.tree.map(lambda leaf: leaf[self._members(remaining)], agents)
        values = dict(zip(remaining, self._objective(agents, trainings, algorithm), strict=True))
        return [TrialOutcome(values.get(k), rungs[k]) for k in range(len(trials))]

    def _population(self, trials: Sequence[Values]) -> tuple[Agent, Key[Array, "A D"], Algorithm]:
        """Make the population of a batch, trials x scenarios: its agents, validation draws and algorithm."""
        study = self._with_static(trials[0])
        agent_ids = self.agent_ids * len(trials)
        agents = make_agents(study, agent_ids=agent_ids)
        per_agent = [trial for trial in trials for _ in self.agent_ids]
        hyper = {
            name: jnp.asarray([trial[name] for trial in per_agent], getattr(agents.hyper, name).dtype)
            for name in vars(agents.hyper)
            if name in trials[0]
        }
        agents = replace(agents, hyper=replace(agents.hyper, **hyper))
        if any(key.startswith(REWARD) for key in trials[0]):
            rewards = [make_reward(reward_with(study, trial), study.guard) for trial in trials]
            weights = jnp.repeat(jnp.stack([reward.weights for reward in rewards]), self.n_scenarios, axis=0)
            scenario = replace(agents.scenario, reward=replace(agents.scenario.reward, weights=weights))
            agents = replace(agents, scenario=scenario)
        keys = validation_keys(study, agent_ids)
        chex.assert_tree_shape_prefix((agents, keys), (len(agent_ids),))
        algorithm = make_algorithm(study)
        assert algorithm is not None
        return agents, keys, algorithm

    def _with_static(self, trial: Values) -> Study:
        """Return the study with a trial's static settings."""
        name = self.study.algorithms[0]
        settings = getattr(self.study, name)
        static = {key: tuple(v) if isinstance(v, list) else v for key, v in trial.items() if hasattr(settings, key)}
        return self.study.model_copy(update={name: settings.model_copy(update=static)})

    def _trainer(self, trial: Values, algorithm: Algorithm, agents: Agent, keys: Key[Array, "A D"], n: int) -> Trainer:
        """Return the trainer for a batch of ``n`` agents, compiled with the first batch of its shape."""
        study = self._with_static(trial)
        settings, static = getattr(study, study.algorithms[0]), ALGORITHMS[algorithm.name].static
        shape = tuple((key, str(getattr(settings, key))) for key in sorted(trial) if key in static)
        partition = self._partition(algorithm, n)
        trainer = self._trainers.get((shape, partition.shard_size))
        if trainer is None:
            validation = Validation(every=study.evaluation.validate_every, draws=study.evaluation.validation_draws)
            members, draws = take_padded((agents, keys), 0, partition.shard_size)
            trainer = Trainer.compile(algorithm, members, draws, validation, partition)
            self._trainers[(shape, partition.shard_size)] = trainer
        return replace(trainer, partition=partition)

    def _partition(self, algorithm: Algorithm, n: int) -> Partition:
        """Cut a batch into equal shards, which all fit in memory twice: regrouping copies them."""
        try:
            partition = partition_population(n, algorithm.agent_bytes, host.free_memory())
        except PopulationTooLargeError as error:
            raise StudyError(f"{self.space.name}: {error}") from None
        needed, free = 2 * partition.shards * partition.shard_bytes, host.free_memory()
        if needed > free:
            raise StudyError(
                f"{self.space.name}: batch is {self.space.batch}: {n} agents need {needed / 2**30:.1f} GiB, "
                f"{free / 2**30:.1f} GiB are free; train fewer trials at a time, or fewer steps"
            )
        return partition

    def _rungs(self, trainer: Trainer) -> list[int]:
        """Return the numbers of chunks after which trials are compared: the first validation after each rung, and the end."""
        validations = [k + 1 for k, chunk in enumerate(trainer.chunks) if chunk.validates]
        rungs = [share * len(trainer.chunks) for share in sorted(self.space.halving.rungs)]
        return sorted({min(v for v in validations if v >= rung) for rung in rungs} | {len(trainer.chunks)})

    def _train_until(self, trainings: list[Training], chunk: int, trials: int) -> None:
        total = len(trainings) * len(trainings[0].trainer.chunks)
        for training in trainings:
            for _ in training.run(until=chunk):
                self.on_progress(sum(shard.chunks_done for shard in trainings) / total, trials)

    def _trial_means(self, values: Float[np.ndarray, " padded"], trials: int) -> Float[np.ndarray, " trials"]:
        """Return each trial's mean over its scenarios, from one value per agent."""
        return values[: trials * self.n_scenarios].reshape(trials, self.n_scenarios).mean(axis=1)

    def _scores(self, training: Training) -> Float[np.ndarray, " padded"]:
        """Return the validation scores by which trials are compared: the best so far, or the last ones."""
        return training.best_scores if self.space.weights == "best" else training.scores[-1]

    def _members(self, trials: Sequence[int] | np.ndarray) -> Int[np.ndarray, " members"]:
        """Return the indices of the agents of some trials in the population."""
        return (np.asarray(trials)[:, None] * self.n_scenarios + np.arange(self.n_scenarios)).ravel()

    def _objective(self, agents: Agent, trainings: list[Training], algorithm: Algorithm) -> list[float]:
        """Evaluate the objective of fully trained trials, on draws that no validation has used."""
        n, size = agents.key.shape[0], trainings[0].trainer.partition.shard_size
        keys = evaluation_keys(self.study, self.agent_ids * (n // self.n_scenarios))
        sizes = [min(size, n - k * size) for k in range(len(trainings))]
        pieces = [training.weights(size)[self.space.weights] for training, size in zip(trainings, sizes, strict=True)]
        weights = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
        lifetimes = evaluate_learned(algorithm, agents, keys, {"searched": weights})["searched"].mean_lifetime
        per_trial = lifetimes.reshape(-1, self.n_scenarios)
        if self.space.objective == "mean":
            return [float(mean) for mean in per_trial.mean(axis=1)]
        return [mean_interval(lifetimes)[1] for lifetimes in per_trial]
