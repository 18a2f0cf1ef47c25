"""How fast the generalist learns, and whether it should first imitate the beam.

    uv run python experiments/generalist_training.py [--scenarios 3000] [--out results/generalist]

The study `generalist` is trained by PPO alone, and again after imitating the clairvoyant beam: the beam plays drawn
scenarios, and the networks learn its visits (cross-entropy) and its remaining lifetime (squared error). At every validation
both play the 25 cells of unseen layouts. The paper's DQN, which learns each layout by itself, is shown beside them
(`results/table5`, at the speed of one agent alone, `results/benchmark`). Writes `training.json` and `training.png`.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from uavmec_jax.training import host

host.use_all_cores()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from generalist_figures import training_figure  # noqa: E402

from uavmec_jax.agents import actor_critic  # noqa: E402
from uavmec_jax.agents.gae import log_prob_and_entropy  # noqa: E402
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam  # noqa: E402
from uavmec_jax.agents.registry import ALGORITHMS  # noqa: E402
from uavmec_jax.env.dynamics import initial_state  # noqa: E402
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw  # noqa: E402
from uavmec_jax.env.rollout import rollouts, tour_policy, trace, volume_table  # noqa: E402
from uavmec_jax.planning.beam import WIDTH, beam_search, horizon, longest  # noqa: E402
from uavmec_jax.planning.parallel import spread  # noqa: E402
from uavmec_jax.runs.results_folder import load_results  # noqa: E402
from uavmec_jax.runs.run_plan import plan_run  # noqa: E402
from uavmec_jax.studies.population import evaluation_keys, make_agents, make_algorithm, seeds_of, validation_keys  # noqa: E402
from uavmec_jax.studies.schema import Study  # noqa: E402
from uavmec_jax.studies.study import load_study  # noqa: E402
from uavmec_jax.training.training import Trainer, Training, Validation  # noqa: E402

_OPTIMIZER = clipped_adam(eps=1e-5)
_BATCH = 1024
_TEACHER = 20_000
"""Seed of the scenarios that the beam plays."""
_LONGEST = 64
"""Most slots that the UAV's battery allows in a scenario that the beam plays."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=3000, help="that the beam plays")
    parser.add_argument("--epochs", type=int, default=20, help="passes over its visits")
    parser.add_argument("--steps", type=int, help="environment steps of PPO (default: the study's)")
    parser.add_argument("--towns", type=int, default=20, help="in each of the 25 cells")
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()

    more = {"steps": arguments.steps} if arguments.steps else {}
    study = load_study("generalist", {"evaluation.validate_every": 250_000, **more})
    evaluate, lines = grid(study, arguments.towns)
    trainer = compiled(study)
    alone = train(start(trainer, study), evaluate)

    tick = time.perf_counter()
    distribution = jax.tree.map(lambda leaf: leaf[0], make_agents(study).scenario)
    demonstrations = collect(study, distribution, arguments.scenarios)
    collected = time.perf_counter() - tick
    seeds = len(seeds_of(study))
    weights = [imitate(study, demonstrations, seed, arguments.epochs) for seed in range(seeds)]
    learned = time.perf_counter() - tick - collected
    slower = load_study("generalist", {"ppo.learning_rate": study.ppo.learning_rate / 3, **more})
    pretrained = train(with_weights(start(trainer, slower), weights), evaluate, begun_s=collected + learned)

    report = {
        "command": "uv run python experiments/generalist_training.py",
        "steps": study.steps,
        "seeds": seeds,
        "beam": {"scenarios": arguments.scenarios, "visits": len(demonstrations[1]), "seconds": round(collected, 1)},
        "imitation_seconds": round(learned, 1),
        "imitation_slots": np.round(evaluate(jax.tree.map(lambda *leaves: jnp.stack(leaves), *weights)), 3).tolist(),
        "ppo": alone.report(),
        "imitation_then_ppo": pretrained.report(),
        "towns": 25 * arguments.towns,
        "lines": lines,
        "dqn": paper_dqn(),
        **host.describe(),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "training.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    training_figure(report, arguments.out / "training.png")
    shown = ("beam", "imitation_seconds", "imitation_slots", "ppo", "imitation_then_ppo", "lines")
    print(json.dumps({name: report[name] for name in shown}, indent=1))


@dataclass
class Run:
    """A study's agents in training, and their mean lifetime at every validation, in slots, one number for each seed."""

    training: Training
    seconds: list[float] = field(default_factory=list)
    slots: list[np.ndarray] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "seconds": np.round(self.seconds, 1).tolist(),
            "slots": np.round(np.mean(self.slots, axis=1), 3).tolist(),
            "slots_by_seed": np.round(self.slots, 3).T.tolist(),
            "validation": np.round(np.stack(self.training.scores, 1), 3).tolist(),
            "best_validation": np.round(self.training.best_scores, 3).tolist(),
        }


def compiled(study: Study) -> Trainer:
    """Compile the programs that train the agents of the study, with any learning rate."""
    algorithm, agents, keys = make_algorithm(study), make_agents(study), validation_keys(study)
    assert algorithm is not None
    settings, partition = study.evaluation, plan_run(study).partitions["ppo"]
    validation = Validation(every=settings.validate_every, draws=settings.validation_draws, chunks=1)
    return Trainer.compile(algorithm, agents, keys, validation, partition)


def start(trainer: Trainer, study: Study) -> Run:
    """Return the agents of the study before their first step."""
    return Run(trainer.start(make_agents(study), validation_keys(study)))


def train(run: Run, evaluate: Callable[[Any], np.ndarray], begun_s: float = 0.0) -> Run:
    """Train to the end and evaluate after every validation; the seconds are those of training and validation."""
    for _ in run.training.run():
        run.seconds.append(begun_s + sum(run.training.seconds[name] for name in ("train", "validate")))
        run.slots.append(evaluate(run.training.weights(run.training.trainer.partition.shard_size)["last"]))
    return run


def grid(study: Study, towns: int) -> tuple[Callable[[Any], np.ndarray], dict[str, float]]:
    """Return a function of weights ``[seeds, ...]``, their mean lifetimes on unseen layouts, and those of other policies.

    The layouts are those of the study `planning`.
    """
    planning = load_study("planning", {"axes.seeds": towns})
    scenario, keys = make_agents(planning).scenario, evaluation_keys(planning)[:, :1]
    algorithm = make_algorithm(study)
    hyper = jax.tree.map(lambda leaf: leaf[0], make_agents(study).hyper)
    assert algorithm is not None

    @jax.jit
    def slots(weights: Any) -> Any:
        policy = algorithm.policy(hyper, weights)
        lifetimes = lambda params, layout, keys: rollouts(policy, params, layout, keys).length  # noqa: E731
        return jnp.mean(spread(lifetimes, scenario.params, scenario.layout, keys, batch=64).astype(jnp.float32))

    def evaluate(weights: Any) -> np.ndarray:
        count = jax.tree.leaves(weights)[0].shape[0]
        return np.array([float(slots(jax.tree.map(lambda leaf, i=i: leaf[i], weights))) for i in range(count)])

    others = load_results(Path("results/planning")).evaluation
    names = ("oldest_first", "earliest_deadline", "bound")
    return evaluate, {name: round(float(others[f"{name}/lifetime"][: len(keys), 0].mean()), 3) for name in names}


def collect(study: Study, distribution: ScenarioDistribution, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations ``[N, obs_size]``, the beam's visits ``[N]`` and its remaining lifetimes in slots ``[N]``."""
    keys = jax.random.split(jax.random.key(_TEACHER), 2 * count)
    scenarios = jax.jit(jax.vmap(partial(scenario_from_draw, distribution)))(keys)
    # A few drawn scenarios can last for hundreds of slots, and the beam for hours on them.
    short = np.flatnonzero(np.asarray(longest(scenarios.params, scenarios.layout)) <= _LONGEST)[:count]
    scenarios, keys = jax.tree.map(lambda leaf: leaf[short], (scenarios, keys))
    slots, observation_fn = horizon(scenarios.params, scenarios.layout), spec_of(study).observation_spec.observation_fn

    def demonstrate(params: Any, layout: Any, key: Any) -> tuple[Any, ...]:
        volumes = volume_table(params, layout.capacity.shape[0], key, slots)
        tour = beam_search(params, layout, volumes, WIDTH)
        played = trace(tour_policy(tour.actions), params, layout, key, slots)
        first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], initial_state(params, layout))
        before = jax.tree.map(lambda begun, leaf: jnp.concatenate([begun, leaf[:-1]]), first, played.state)
        return observation_fn(params, layout, before), played.action, tour.lifetime - before.slot, played.played

    results = jax.jit(lambda *arguments: spread(demonstrate, *arguments))(scenarios.params, scenarios.layout, keys)
    observations, visits, remaining, played = (np.asarray(leaf) for leaf in results)
    return observations[played], visits[played], remaining[played].astype(np.float32)


def spec_of(study: Study) -> Any:
    """Return the static settings of the study's PPO."""
    return ALGORITHMS["ppo"].spec_of(study.ppo.model_dump(), total_steps=study.steps, n_devices=study.params.n_devices)


def imitate(study: Study, demonstrations: tuple[np.ndarray, ...], seed: int, epochs: int) -> Any:
    """Return weights that make the beam's visits likely and predict its return, in the study's reward."""
    spec, gamma = spec_of(study), study.ppo.gamma
    hyper = actor_critic.ActorCriticHyper(gamma=gamma)
    weights = spec.network.init(jax.random.key(seed), jnp.zeros((1, spec.obs_size)))
    observations, visits, remaining = (jnp.asarray(part) for part in demonstrations)
    returns = study.slot_reward * (1.0 - gamma**remaining) / (1.0 - gamma)
    updates = max(epochs * len(visits) // _BATCH, 1)

    def loss_of(weights: Any, chosen: Any) -> Any:
        logits, values = actor_critic.logits_and_value(spec, hyper, weights, observations[chosen])
        log_prob, _ = log_prob_and_entropy(logits, visits[chosen])
        return -jnp.mean(log_prob) + 0.5 * jnp.mean(jnp.square(values - returns[chosen]))

    def step(number: Any, train_state: TrainState) -> TrainState:
        chosen = jax.random.randint(jax.random.fold_in(jax.random.key(seed), number), (_BATCH,), 0, len(visits))
        loss, gradient = jax.value_and_grad(loss_of)(train_state.weights, chosen)
        rate = study.ppo.learning_rate * 0.1 ** (number / updates)
        settings: dict[str, Any] = {"learning_rate": rate, "max_norm": 0.5, "count": number + 1, "steps_done": number}
        return apply_gradients(_OPTIMIZER, train_state, loss, gradient, **settings)

    initial = TrainState(weights, _OPTIMIZER.init(weights), jnp.int32(-1))
    return jax.jit(lambda train_state: jax.lax.fori_loop(0, updates, step, train_state))(initial).weights


def with_weights(run: Run, weights: list[Any]) -> Run:
    """Set the initial weights of every agent."""
    stacked, first = jax.tree.map(lambda *leaves: np.stack(leaves), *weights), 0
    for batch in run.training.group_batches:
        size = batch.state.diverged_at.shape[0]
        part = jax.tree.map(lambda leaf, first=first, size=size: leaf[first : first + size], stacked)
        placed = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), part, batch.state.weights)
        batch.state = replace(batch.state, weights=placed)
        first += size
    return run


def paper_dqn() -> dict[str, Any]:
    """Return the validation lifetimes of the agents of `results/table5`, and the seconds that one of them takes alone."""
    curves = load_results(Path("results/table5")).curves["dqn"]
    rows = json.loads(Path("results/benchmark/benchmark_dqn.json").read_text(encoding="utf-8"))["training"]
    speed = next(row["steps_per_second"] for row in rows if row["agents"] == 1)
    chosen = np.unique(np.geomspace(1, len(curves["validation_steps"]), 12).astype(int)) - 1
    return {
        "seconds": np.round(curves["validation_steps"][chosen] / speed, 2).tolist(),
        "slots": np.round(curves["validation"][:, chosen].mean(axis=0), 3).tolist(),
        "towns": len(curves["validation"]),
    }


if __name__ == "__main__":
    main()
