"""One batch of trials: a population of trials x towns in which, rung after rung, only the best go on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.errors import StudyError
from uavmec_jax.search.space import REWARD, Space, reward_with
from uavmec_jax.studies.evaluation import judge_learned
from uavmec_jax.studies.population import (
    Who,
    evaluation_keys,
    identities,
    make_agents,
    make_algorithm,
    validation_keys,
)
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.training import host
from uavmec_jax.training.partition import Blocks, PopulationTooLargeError, plan_blocks
from uavmec_jax.training.population import take
from uavmec_jax.training.regroup import regroup
from uavmec_jax.training.training import Trainer, Training, Validation

Values = Mapping[str, Any]
"""A trial: setting -> value."""


@dataclass(frozen=True)
class Outcome:
    """How a trial did.

    Attributes:
        value: of the objective; ``None`` if it was given up.
        rungs: step of one agent -> mean validation lifetime of the best weights by then.
    """

    value: float | None
    rungs: dict[int, float]


@dataclass
class Brackets:
    """Makes the batches of a search; programs are compiled once for each shape.

    Attributes:
        space: of the search.
        on_progress: told ``(share of the batch, trials that are left)``.
    """

    space: Space
    on_progress: Callable[[float, int], None] = lambda share, left: None
    _trainers: dict[Any, Trainer] = field(default_factory=dict)

    @cached_property
    def study(self) -> Study:
        """The study on the search's own towns."""
        base, towns = self.space.base(), self.space.validation
        cells = {"cells": [list(cell) for cell in towns.cells]} if towns.cells else {}
        kept = {name: base.axes[name] for name in ("powered", "connected", "cells") if name in base.axes and not cells}
        seeds = list(range(towns.first_seed, towns.first_seed + towns.seeds))
        evaluation = base.evaluation.model_copy(update={"draws": towns.draws})
        return base.model_copy(update={"axes": kept | cells | {"seeds": seeds}, "evaluation": evaluation})

    @cached_property
    def who(self) -> Who:
        """The agents of one trial: one on each town."""
        return identities(self.study)

    @property
    def towns(self) -> int:
        """Agents of one trial."""
        return len(self.who)

    def run(self, trials: Sequence[Values]) -> list[Outcome]:
        """Train and judge a batch. What shapes the program is the same for all of its trials.

        Raises:
            StudyError: the batch does not fit in memory.
        """
        agents, keys, algorithm = self._population(trials)
        trainer = self._trainer(trials[0], algorithm, agents, keys, len(trials) * self.towns)
        size = trainer.blocks.size
        trainings = [trainer.start(*take((agents, keys), block * size, size)) for block in range(trainer.blocks.count)]
        left = list(range(len(trials)))
        rungs: list[dict[int, float]] = [{} for _ in trials]
        for chunk in self._rungs(trainer):
            self._advance(trainings, chunk, len(left))
            scores = self._by_trial(_best_scores(trainings), len(left))
            for trial, score in zip(left, scores, strict=True):
                rungs[trial][trainings[0].steps] = float(score)
            if chunk < len(trainer.chunks):
                n = max(1, round(self.space.halving.keep * len(left)))
                best = np.sort(np.argsort(-scores, kind="stable")[:n])
                left = [left[k] for k in best]
                trainings = regroup(trainings, self._members(best))
        agents = jax.tree.map(lambda leaf: leaf[self._members(left)], agents)
        values = dict(zip(left, self._judged(agents, trainings, algorithm), strict=True))
        return [Outcome(values.get(k), rungs[k]) for k in range(len(trials))]

    def _population(self, trials: Sequence[Values]) -> tuple[Agent, Any, Algorithm]:
        """Trials x towns: agents, validation draws, and the algorithm of the batch."""
        study = self._shaped(trials[0])
        every = self.who * len(trials)
        agents = make_agents(study, who=every)
        per_agent = [trial for trial in trials for _ in self.who]
        hyper = {
            name: jnp.asarray([trial[name] for trial in per_agent], getattr(agents.hyper, name).dtype)
            for name in vars(agents.hyper)
            if name in trials[0]
        }
        agents = replace(agents, hyper=replace(agents.hyper, **hyper))
        if any(key.startswith(REWARD) for key in trials[0]):
            rewards = [make_reward(reward_with(study, trial), study.guard) for trial in trials]
            weights = jnp.repeat(jnp.stack([reward.weights for reward in rewards]), self.towns, axis=0)
            scenario = replace(agents.scenario, reward=replace(agents.scenario.reward, weights=weights))
            agents = replace(agents, scenario=scenario)
        algorithm = make_algorithm(study)
        assert algorithm is not None
        return agents, validation_keys(study, every), algorithm

    def _shaped(self, trial: Values) -> Study:
        """The study with a trial's settings of the kind that shapes the program."""
        name = self.study.algorithms[0]
        settings = getattr(self.study, name)
        shape = {key: tuple(v) if isinstance(v, list) else v for key, v in trial.items() if hasattr(settings, key)}
        return self.study.model_copy(update={name: settings.model_copy(update=shape)})

    def _trainer(self, trial: Values, algorithm: Algorithm, agents: Agent, keys: Any, n: int) -> Trainer:
        """The programs for a shape: compiled for the first batch that has it."""
        study = self._shaped(trial)
        settings = getattr(study, study.algorithms[0])
        shape = tuple(
            (key, str(getattr(settings, key))) for key in sorted(trial) if key in ALGORITHMS[algorithm.name].static
        )
        blocks = self._blocks(algorithm, n)
        if (known := self._trainers.get((shape, blocks.size))) is None:
            validation = Validation(every=study.evaluation.validate_every, draws=study.evaluation.validation_draws)
            members, draws = take((agents, keys), 0, blocks.size)
            known = self._trainers[(shape, blocks.size)] = Trainer.compile(
                algorithm, members, draws, validation, blocks
            )
        return replace(known, blocks=blocks)

    def _blocks(self, algorithm: Algorithm, n: int) -> Blocks:
        """A batch as equal blocks, all of which are in memory; half of it is for regrouping."""
        try:
            blocks = plan_blocks(n, algorithm.agent_bytes, host.free_memory())
        except PopulationTooLargeError as error:
            raise StudyError(f"{self.space.name}: {error}") from None
        needed, free = 2 * blocks.count * blocks.bytes, host.free_memory()
        if needed > free:
            raise StudyError(
                f"{self.space.name}: batch is {self.space.batch}: {n} agents need {needed / 2**30:.1f} GiB, "
                f"{free / 2**30:.1f} GiB are free; train fewer trials at a time, or fewer steps"
            )
        return blocks

    def _rungs(self, trainer: Trainer) -> list[int]:
        """Chunks at which trials are compared: the first looks after each rung, and the end."""
        looks = [k + 1 for k, (_, _, is_look) in enumerate(trainer.chunks) if is_look]
        wanted = [share * len(trainer.chunks) for share in sorted(self.space.halving.rungs)]
        return sorted({min(look for look in looks if look >= chunk) for chunk in wanted} | {len(trainer.chunks)})

    def _advance(self, trainings: list[Training], chunk: int, left: int) -> None:
        total = len(trainings) * len(trainings[0].trainer.chunks)
        for training in trainings:
            while training.done < chunk:
                training.advance()
                self.on_progress(sum(one.done for one in trainings) / total, left)

    def _by_trial(self, values: np.ndarray, n: int) -> np.ndarray:
        """``[trials]`` means over the towns."""
        return values[: n * self.towns].reshape(n, self.towns).mean(axis=1)

    def _members(self, trials: Sequence[int] | np.ndarray) -> np.ndarray:
        """Places of the agents of some trials in the population."""
        return (np.asarray(trials)[:, None] * self.towns + np.arange(self.towns)).ravel()

    def _judged(self, agents: Agent, trainings: list[Training], algorithm: Algorithm) -> list[float]:
        """The objective of trials that are trained to the end, on draws that no look has seen."""
        n, size = agents.key.shape[0], trainings[0].trainer.blocks.size
        keys = evaluation_keys(self.study, self.who * (n // self.towns))
        sizes = [min(size, n - k * size) for k in range(len(trainings))]
        pieces = [training.weights(size)["best"] for training, size in zip(trainings, sizes, strict=True)]
        best = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
        lifetimes = judge_learned(algorithm, agents, keys, {"best": best})["best"].mean_lifetime
        per_trial = lifetimes.reshape(-1, self.towns)
        if self.space.objective == "mean":
            return [float(mean) for mean in per_trial.mean(axis=1)]
        return [mean_interval(own)[1] for own in per_trial]


def _best_scores(trainings: list[Training]) -> np.ndarray:
    """``[A]`` the best validation score of every agent so far."""
    return np.concatenate([training.best_scores for training in trainings])
