"""The curve of Stable-Baselines3's DQN, with the nearest setting that it has to `table5-best-dqn`, on five layouts.

`time_to_quality.py` calls it; every layout is trained by a process of its own. Reward, scale of the ages, n-step returns,
batch, discount, learning rate and its fall, target network, epsilon and layers are those of the study. Not there: the double
and the dueling network, layer norm, the gap, averaged weights, guided exploration and epsilons that differ between episodes.
"""

import os
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pandas as pd

DRAWS = 20
"""Held-out draws on which weights are evaluated."""
_STEPS, _EVERY = 120_000, 5_000
"""Environment steps of a training, and between evaluations."""
_CELLS = ((12, 6), (10, 4), (8, 8), (6, 12), (4, 4))
"""Counts of powered and connected devices."""


def bound_of(agents: Any, keys: Any) -> np.ndarray:
    """Return the mean upper bound of each agent's draws, slots."""
    import jax

    from uavmec_jax.planning.fleet_demand import planned_slots
    from uavmec_jax.planning.parallel import beam_episodes, bound_scenarios

    repeat = lambda tree: jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), DRAWS, axis=0), tree)  # noqa: E731
    params, layouts, draws = repeat(agents.scenario.params), repeat(agents.scenario.layout), keys.reshape(-1)
    slots = planned_slots(params, layouts)
    reached = np.asarray(beam_episodes(params, layouts, draws, slots=slots, width=16)[1].length)
    return bound_scenarios(params, layouts, draws, reached, slots=slots).reshape(-1, DRAWS).mean(1)


def sb3_worker(cell: tuple[int, int]) -> None:
    """Train Stable-Baselines3's DQN on one layout, and print its curve as CSV: steps, seconds, mean lifetime, bound."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    import jax
    import torch
    from gymnasium.wrappers import TransformObservation
    from stable_baselines3 import DQN

    from uavmec_jax.env.rewards import make_reward
    from uavmec_jax.env.scenario import make_scenario
    from uavmec_jax.interop.gymnasium_env import UavMecGymEnv
    from uavmec_jax.studies.population import evaluation_keys, make_agents
    from uavmec_jax.studies.study import load_study

    study = load_study("table5-best", {"axes.seeds": 1, "evaluation.draws": DRAWS})
    agents, keys = make_agents(study), evaluation_keys(study)[:, :DRAWS]
    layouts = agents.scenario.layout
    counts = np.stack([np.asarray(layouts.has_power).sum(1), np.asarray(layouts.has_comms).sum(1)], axis=1)
    index = int(np.flatnonzero((counts == cell).all(1))[0])
    one = jax.tree.map(lambda leaf: leaf[index : index + 1], agents)
    bound = float(bound_of(one, keys[index : index + 1])[0])
    layout = jax.tree.map(lambda leaf: leaf[0], one.scenario.layout)
    scenario = make_scenario(layout, reward=make_reward({}, per_slot=0.1))
    torch.set_num_threads(1)
    env = TransformObservation(UavMecGymEnv(scenario), scaled, None)
    model = DQN(
        "MlpPolicy", env, learning_rate=lambda left: 0.001 * left, batch_size=64, gamma=0.99, n_steps=10,
        target_update_interval=1000, buffer_size=_STEPS, exploration_fraction=0.1, exploration_final_eps=0.2,
        policy_kwargs={"net_arch": [64, 64]}, device="cpu", seed=0,
    )  # fmt: skip
    model.learn(_STEPS, callback=looks(scenario, keys[index], bound))


def scaled(observation: np.ndarray) -> np.ndarray:
    """Return the paper's 24 numbers with the ages times 0.1: :func:`scale_ages` in NumPy, which is faster for one."""
    half = observation.shape[-1] // 2
    return np.concatenate([observation[..., :half], 0.1 * observation[..., half:]], axis=-1)


def looks(scenario: Any, keys: Any, bound: float) -> Any:
    """Return a callback that prints the curve; the looks do not count as time."""
    started, looking = time.perf_counter(), 0.0

    def look(values: dict[str, Any], _: dict[str, Any]) -> bool:
        nonlocal looking
        model = values["self"]
        if model.num_timesteps % _EVERY == 0:
            tick = time.perf_counter()
            spent, lifetime = tick - started - looking, lifetimes_of(model, scenario, keys).mean()
            print(f"curve,{model.num_timesteps},{spent},{lifetime},{bound}", flush=True)
            looking += time.perf_counter() - tick
        return True

    return look


def lifetimes_of(model: Any, scenario: Any, keys: Any) -> np.ndarray:
    """Return the lifetimes of a model's greedy policy on draws of the task volumes, slots."""
    import jax

    from uavmec_jax.env.dynamics import Cause, initial_state, transition
    from uavmec_jax.env.observation import observe
    from uavmec_jax.env.rollout import volume_table

    params, layout, slots = scenario.params, scenario.layout, 64
    volumes = np.asarray(jax.vmap(lambda key: volume_table(params, 12, key, slots))(keys))
    state = jax.tree.map(
        lambda leaf: np.broadcast_to(leaf, (len(keys), *np.shape(leaf))), initial_state(params, layout)
    )
    step = jax.jit(jax.vmap(lambda state, action, volumes: transition(params, layout, state, action, volumes)))
    length = np.zeros(len(keys), int)
    for slot in range(slots):
        observation = np.asarray(jax.vmap(observe, (None, None, 0))(params, layout, state))
        action, _ = model.predict(scaled(observation), deterministic=True)
        state, outcome = step(state, action, volumes[:, slot])
        length = np.where(length > 0, length, np.where(np.asarray(outcome.cause) != Cause.NONE, slot + 1, 0))
    return np.where(length > 0, length, slots)


def measure_sb3() -> pd.DataFrame:
    """Train Stable-Baselines3 on five layouts, one process per core, and return its curve."""
    cores, curves = os.cpu_count() or 1, []
    waiting = list(_CELLS)
    while waiting:
        batch, waiting = waiting[:cores], waiting[cores:]
        command = [sys.executable, __file__]
        running = [subprocess.Popen([*command, *map(str, cell)], stdout=subprocess.PIPE, text=True) for cell in batch]
        for process in running:
            lines = [line.split(",")[1:] for line in process.communicate()[0].splitlines() if line.startswith("curve,")]
            curves.append(np.array(lines, float))
    steps, seconds, lifetime, bound = np.stack(curves).transpose(2, 0, 1)
    return pd.DataFrame(
        {
            "learner": "Stable-Baselines3 DQN, nearest setting",
            "agents": len(curves),
            "steps": steps[0].astype(int),
            "seconds": seconds.mean(0) / cores,
            "share": lifetime.sum(0) / bound.sum(0),
            "worst_cell": (lifetime / bound).min(0),
        }
    )


if __name__ == "__main__":
    sb3_worker((int(sys.argv[1]), int(sys.argv[2])))
