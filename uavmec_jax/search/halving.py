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
from uavmec_jax.agents.networks import Weights
from uavmec_jax.cluster.connection import Cluster
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.errors import StudyError
from uavmec_jax.search.batches import Batch, BatchInProcess, BatchOnRay
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
from uavmec_jax.training.chunks import Chunk, Validation, chunks_of
from uavmec_jax.training.machine import Machine
from uavmec_jax.training.on_ray import ShardProgram
from uavmec_jax.training.partition import Partition, PopulationTooLargeError
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.training import Trainer

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
        cluster: where the batches train; ``None`` for this process.
        machine: what a shard has there; by default this machine.
        on_progress: called with ``(finished share of the batch, trials in training)``.
    """

    space: Space
    cluster: Cluster | None = None
    machine: Machine | None = None
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
            StudyError: the batch does not fit in memory, or a shard failed on the cluster.
        """
        agents, keys, algorithm = self._population(trials)
        chunks = chunks_of(algorithm, self._validation)
        batch = self._start(algorithm, agents, keys, chunks)
        remaining = list(range(len(trials)))
        rungs: list[dict[int, float]] = [{} for _ in trials]
        for rung in self._rungs(chunks):

            def on_share(share: float, n_trials: int = len(remaining)) -> None:
                self.on_progress(share, n_trials)

            batch.train_until(rung, on_share)
            scores = self._trial_means(batch.scores(self.space.weights), len(remaining))
            steps = chunks[rung - 1].last * algorithm.steps_per_iteration
            for trial, score in zip(remaining, scores, strict=True):
                rungs[trial][steps] = float(score)
            if rung < len(chunks):
                n = max(1, round(self.space.halving.keep * len(remaining)))
                best = np.sort(np.argsort(-scores, kind="stable")[:n])
                remaining = [remaining[k] for k in best]
                batch.keep(self._members(best))
        agents = jax.tree.map(lambda leaf: leaf[self._members(remaining)], agents)
        weights = batch.weights(self.space.weights)
        values = dict(zip(remaining, self._objective(agents, weights, algorithm), strict=True))
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

    @property
    def _validation(self) -> Validation:
        settings = self.study.evaluation
        return Validation(every=settings.validate_every, draws=settings.validation_draws)

    def _start(self, algorithm: Algorithm, agents: Agent, keys: Key[Array, "A D"], chunks: list[Chunk]) -> Batch:
        """Start the training of a batch, on the cluster if there is one."""
        partition = self._partition(algorithm, keys.shape[0])
        if self.cluster is not None:
            program = ShardProgram.of(algorithm, self._validation, partition)
            return BatchOnRay(self.cluster, program, chunks, agents, keys)
        return BatchInProcess(self._trainer(algorithm, agents, keys, partition), agents, keys)

    def _trainer(self, algorithm: Algorithm, agents: Agent, keys: Key[Array, "A D"], partition: Partition) -> Trainer:
        """Return the trainer for a batch, compiled with the first batch of its shape."""
        shape = (algorithm.spec, partition.shard_size)
        trainer = self._trainers.get(shape)
        if trainer is None:
            members, draws = take_padded((agents, keys), 0, partition.shard_size)
            trainer = self._trainers[shape] = Trainer.compile(algorithm, members, draws, self._validation, partition)
        return replace(trainer, partition=partition)

    def _partition(self, algorithm: Algorithm, n: int) -> Partition:
        """Cut a batch into equal shards, which all fit in this machine's memory twice: regrouping copies them."""
        try:
            partition = (self.machine or Machine.here()).partition(n, algorithm.agent_bytes)
        except PopulationTooLargeError as error:
            raise StudyError(f"{self.space.name}: {error}") from None
        needed, free = 2 * partition.shards * partition.shard_bytes, host.free_memory()
        if needed > free:
            raise StudyError(
                f"{self.space.name}: batch is {self.space.batch}: {n} agents need {needed / 2**30:.1f} GiB, "
                f"{free / 2**30:.1f} GiB are free; train fewer trials at a time, or fewer steps"
            )
        return partition

    def _rungs(self, chunks: list[Chunk]) -> list[int]:
        """Return the numbers of chunks after which trials are compared: the first validation after each rung, and the end."""
        validations = [k + 1 for k, chunk in enumerate(chunks) if chunk.validates]
        rungs = [share * len(chunks) for share in sorted(self.space.halving.rungs)]
        return sorted({min(v for v in validations if v >= rung) for rung in rungs} | {len(chunks)})

    def _trial_means(self, values: Float[np.ndarray, " padded"], trials: int) -> Float[np.ndarray, " trials"]:
        """Return each trial's mean over its scenarios, from one value per agent."""
        return values[: trials * self.n_scenarios].reshape(trials, self.n_scenarios).mean(axis=1)

    def _members(self, trials: Sequence[int] | np.ndarray) -> Int[np.ndarray, " members"]:
        """Return the indices of the agents of some trials in the population."""
        return (np.asarray(trials)[:, None] * self.n_scenarios + np.arange(self.n_scenarios)).ravel()

    def _objective(self, agents: Agent, weights: Weights, algorithm: Algorithm) -> list[float]:
        """Evaluate the objective of fully trained trials, on draws that no validation has used."""
        keys = evaluation_keys(self.study, self.agent_ids * (agents.key.shape[0] // self.n_scenarios))
        lifetimes = evaluate_learned(algorithm, agents, keys, {"searched": weights})["searched"].mean_lifetime
        per_trial = lifetimes.reshape(-1, self.n_scenarios)
        if self.space.objective == "mean":
            return [float(mean) for mean in per_trial.mean(axis=1)]
        return [mean_interval(lifetimes)[1] for lifetimes in per_trial]
