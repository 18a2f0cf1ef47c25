"""The replay of states: rebuilt observations, the ring of scenarios, bootstrapping, and training on what it samples."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.populations import differs, make_agent, over_agents, stack, take
from uavmec_jax.agents import dqn, episode, state_replay
from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.agents.dqn import DQNHyper, DQNSpec
from uavmec_jax.env.drawn_rollouts import priced_lifetimes
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.scenario import Scenario

N = 6
SPEC = DQNSpec(total_steps=200, hidden=(8,), observation="full", batch_size=8, n_devices=N, scenario_ring=40)
SMALL = {"n_devices": N, "data_age_limit_slots": 2}  # episodes of about three slots


def drawing_agent(seed=0, limit=2, **hyper) -> Agent:
    """An agent whose episodes have 2 to 5 devices, padded to six, and last some slots."""
    distribution = ScenarioDistribution(
        params=Params(n_devices=N, data_age_limit_slots=limit),
        reward=make_reward({}, per_slot=1.0),
        typical=0.0,
        devices=(2, 5),
        typical_devices=5,
        typical_least=2,
    )
    return jax.tree.map(jnp.asarray, Agent(jax.random.key(seed), distribution, DQNHyper(**hyper)))


def fixed_agent(seed=0, **hyper) -> Agent:
    """An agent on one scenario of four devices, padded to six."""
    agent = make_agent(seed, 1, 1, params=Params(n_devices=4, data_age_limit_slots=2), **hyper)
    scenario = agent.scenario
    padded = Scenario(Params(**SMALL), pad_layout(scenario.layout, N), scenario.reward)
    return jax.tree.map(jnp.asarray, agent.replace(scenario=padded))


@functools.cache
def programs(spec):
    """Jitted functions of one agent: start, act, observe, sample."""
    functions = (
        functools.partial(dqn.init, spec),
        functools.partial(dqn._act, spec),
        spec.observation_spec.observation_fn,
    )
    return [jax.jit(function) for function in (*functions, functools.partial(dqn._sample, spec))]


def raw(params, layout, state):
    """Return what observations read, as it is: no arithmetic, so nothing rounds."""

    def one(state):
        read = (state.battery, state.age, state.uav_position, state.uav_energy, state.elapsed)
        known = (layout.capacity, layout.position, layout.has_power, layout.present, params.uav_speed_m_s)
        return jnp.concatenate([jnp.ravel(part).astype(jnp.float32) for part in (*read, *known)])

    return jax.vmap(one)(state) if jnp.ndim(state.slot) else one(state)


def play(spec, agent, steps):
    """Play some steps; return the state with a filled replay, and the list of transitions."""
    init, act, observe, _ = programs(spec)
    state, played, rows = init(agent), [], []
    uniform = jax.random.uniform(jax.random.key(7), (steps, spec.numbers_per_step))
    for k in range(steps):
        scenario = episode.scenario_of(agent, state.episode)
        seen = scenario.params, scenario.layout, state.env_state
        episodes = int(state.episodes)
        after, row = act(agent, state, jnp.int32(k), uniform[k])
        rows.append(row)
        ended = int(after.episodes) > episodes
        entry = {"row": row, "ended": ended, "episode": episodes}
        played.append(entry | {"observation": np.asarray(observe(*seen)), "raw": np.asarray(raw(*seen))})
        state = after
        if len(rows) == spec.train_frequency:
            start = jnp.int32(k + 1 - spec.train_frequency)
            buffer_state = dqn.replay.add(spec.replay, state.buffer_state, start, jnp.stack(rows))
            state, rows = state.replace(buffer_state=buffer_state), []
    return state, played


def sample(spec, agent, state, written, words):
    draw = programs(spec)[-1]
    return draw(agent, state, jnp.int32(written), jnp.asarray(words, jnp.uint32))


def sample_raw(spec, agent, state, written, words):
    """Sample with :func:`raw` for observations."""
    arguments = spec.replay, state.buffer_state, jnp.int32(written), jnp.asarray(words, jnp.uint32), 0.9
    return state_replay.sample(
        *arguments,
        oldest=episode.oldest_transition(state.episode),
        scenario_of=functools.partial(episode.kept_scenario, agent, state.episode),
        observation_fn=raw,
    )


@pytest.mark.parametrize("make", [drawing_agent, fixed_agent])
def test_rebuilt_observations_are_those_at_acting_time(make):
    """States and scenarios are rebuilt to the bit, also padded ones; the features that follow from them agree to 1e-6."""
    agent, steps = make(), 40
    state, played = play(SPEC, agent, steps)
    assert sum(entry["ended"] for entry in played) >= 4
    words = np.arange(steps)  # word i samples the transition i before the newest
    exact, batch = (draw(SPEC, agent, state, steps, words) for draw in (sample_raw, sample))
    for i in range(steps):
        entry = played[-1 - i]
        assert_array_equal(exact.observation[i], entry["raw"])
        assert_allclose(batch.observation[i], entry["observation"], rtol=1e-6, atol=1e-6)
        if i and not entry["ended"]:
            assert_array_equal(exact.next_observation[i], played[-i]["raw"])
            assert_allclose(batch.next_observation[i], played[-i]["observation"], rtol=1e-6, atol=1e-6)
        assert (batch.terminated[i] == 1) == entry["ended"]
    if make is drawing_agent:
        assert [int(entry["row"][-4]) for entry in played] == [entry["episode"] for entry in played]
        masks = {tuple(entry["observation"].reshape(N, -1)[:, -1]) for entry in played}
        assert len(masks) > 2


def test_the_observation_after_the_last_slot_is_rebuilt():
    """A state that ended an episode is bootstrapped from if the time limit ended it; its scenario is the old one."""
    agent = drawing_agent(limit=250)
    distribution = agent.scenario.replace(params=agent.scenario.params.replace(max_slots=jnp.int32(2)))
    agent, steps = agent.replace(scenario=distribution), 8
    state, played = play(SPEC, agent, steps)
    assert [entry["ended"] for entry in played] == [False, True] * 4
    batch = sample(SPEC, agent, state, steps, np.arange(steps))
    assert_array_equal(batch.terminated, 0)
    masks = np.asarray(batch.observation).reshape(steps, N, -1)[..., -1]
    next_masks = np.asarray(batch.next_observation).reshape(steps, N, -1)[..., -1]
    assert_array_equal(masks, next_masks)
    assert len({tuple(mask) for mask in masks}) > 1
    chex.assert_tree_all_finite(batch)


@pytest.mark.parametrize("ring", [2, 3])
def test_transitions_of_overwritten_scenarios_are_never_sampled(ring):
    spec = DQNSpec(total_steps=200, hidden=(8,), observation="full", n_devices=N, scenario_ring=ring)
    agent, steps = drawing_agent(), 40
    state, played = play(spec, agent, steps)
    running = int(state.episode.number)
    assert running > ring
    oldest = int(episode.oldest_transition(state.episode))
    kept = [k for k, entry in enumerate(played) if entry["episode"] > running - ring]
    assert kept == list(range(oldest, steps))
    batch = sample_raw(spec, agent, state, steps, np.arange(1000))
    sampled = {bytes(np.asarray(observation)) for observation in batch.observation}
    assert sampled == {bytes(played[k]["raw"]) for k in kept}


def test_there_is_always_a_transition_to_sample():
    """With a ring of two and an episode that has just ended, those of the episode before are left."""
    spec = DQNSpec(total_steps=200, hidden=(8,), observation="full", n_devices=N, scenario_ring=2, train_frequency=1)
    agent = drawing_agent()
    state, played = play(spec, agent, 40)
    last_end = max(k for k, entry in enumerate(played) if entry["ended"])
    state, played = play(spec, agent, last_end + 1)
    assert int(episode.oldest_transition(state.episode)) < last_end + 1
    batch = sample(spec, agent, state, last_end + 1, np.arange(50))
    chex.assert_tree_all_finite(batch)


def test_the_ring_has_room_for_two_scenarios():
    with pytest.raises(ValueError, match=r"^scenario_ring is 1; it should be at least 2$"):
        dqn.algorithm(DQNSpec(observation="full", scenario_ring=1))


def test_a_longer_ring_than_steps_is_cut():
    assert DQNSpec(total_steps=100, observation="full").scenarios_kept == 101
    assert DQNSpec(observation="full").scenarios_kept == 4096
    assert DQNSpec().scenarios_kept == 0


@pytest.mark.parametrize("n_step", [3, 10])
def test_n_step_returns_end_with_their_episode(n_step):
    spec = DQNSpec(
        total_steps=200,
        hidden=(8,),
        observation="full",
        n_devices=N,
        scenario_ring=40,
        n_step=n_step,
        replay_capacity=24,
    )
    agent, steps = drawing_agent(), 40
    state, played = play(spec, agent, steps)
    batch = sample_raw(spec, agent, state, steps, np.arange(24))  # with the discount 0.9
    rewards = [float(np.asarray(entry["row"][-2:-1]).view(np.float32)[0]) for entry in played]
    for i in range(24):
        total, summed = 0.0, 0
        for k in range(steps - 1 - i, min(steps - 1 - i + n_step, steps)):
            total += 0.9**summed * rewards[k]
            summed += 1
            if played[k]["ended"]:
                break
        assert_allclose(batch.reward[i], total, rtol=1e-5)
        assert_allclose(batch.discount[i], 0.9**summed, rtol=1e-6)
        assert (batch.terminated[i] == 1) == played[k]["ended"]
        assert_array_equal(batch.observation[i], played[-1 - i]["raw"])
        if not played[k]["ended"] and k + 1 < steps:
            assert_array_equal(batch.next_observation[i], played[k + 1]["raw"])


def test_a_row_holds_the_action_of_many_devices():
    n = 300
    spec = state_replay.StateReplaySpec(n_devices=n, capacity=8)
    params = Params(n_devices=n)
    layout = make_agent(params=params).scenario.layout
    state = initial_state(params, layout)
    yes = jnp.asarray(True)
    row = state_replay.pack(spec, jnp.int32(299), jnp.float32(1.5), state, jnp.int32(0), yes, yes)
    assert row.shape == (608,)
    assert int(row[-3]) == 299
    assert dqn.algorithm(DQNSpec(n_devices=n, observation="full")).name == "dqn"


def test_memory_counts_rows_and_scenarios():
    full = DQNSpec(total_steps=1000, observation="full")
    assert full.replay.words == 32  # 128 bytes, two cache lines
    assert full.replay.bytes == 4 * 1001 * 32
    agent = drawing_agent()
    ring = jax.eval_shape(functools.partial(dqn.init, SPEC), agent).episode.ring
    assert episode.ring_bytes(N, SPEC.scenarios_kept) == 4 * ring.size
    assert full.agent_bytes > full.replay.bytes + episode.ring_bytes(12, 1001)


def test_one_scenario_needs_no_ring():
    assert dqn.init(SPEC, fixed_agent()).episode is None
    assert dqn.init(DQNSpec(n_devices=N), drawing_agent()).episode.ring is None


@functools.cache
def update(spec):
    return over_agents(functools.partial(dqn.update, spec), 0, 0, None, None)


def train(spec, agents, last):
    return update(spec)(agents, jax.vmap(functools.partial(dqn.init, spec))(agents), 0, last)


@pytest.mark.slow
@pytest.mark.parametrize("observation", ["full", "paper"])
def test_all_variants_together_train_on_drawn_scenarios(observation):
    spec = DQNSpec(
        total_steps=800, hidden=(8,), observation=observation, n_devices=N, scenario_ring=16, replay_capacity=200,
        double=True, n_step=3, advantage_learning=True, layer_norm=True, spread_epsilon=True,
        guide="earliest-deadline", average_weights=True,
    )  # fmt: skip
    agents = stack([drawing_agent(seed, tau=0.01, target_interval=4) for seed in (0, 1)])
    state = train(spec, agents, 200)
    assert_array_equal(state.diverged_at, -1)
    assert all(differs(state.target, state.weights))
    assert (state.episode.number > 16).all()
    chex.assert_tree_all_finite(state.weights)


@pytest.mark.slow
@pytest.mark.bits
@pytest.mark.parametrize("make", [drawing_agent, pytest.param(fixed_agent, marks=pytest.mark.full)])
def test_a_batched_agent_is_the_agent_alone(make):
    """Its place in the batch changes no bit, and alone it acts in the same way."""
    agents = [make(seed) for seed in range(4)]
    together = train(SPEC, stack(agents), 50)
    reversed_ = train(SPEC, stack(agents[::-1]), 50)
    for i in range(4):
        chex.assert_trees_all_equal(
            take((together.weights, together.buffer_state), i), take((reversed_.weights, reversed_.buffer_state), 3 - i)
        )
    alone = train(SPEC, stack([agents[1]]), 50)
    assert_array_equal(take(alone.buffer_state, 0)[:, -4:-2], take(together.buffer_state, 1)[:, -4:-2])


@pytest.mark.slow
def test_a_horizon_is_played_with_the_full_observation():
    agent = fixed_agent()
    params = agent.scenario.params.replace(end="horizon", horizon_s=jnp.float32(20_000.0))
    agent = agent.replace(scenario=agent.scenario.replace(params=params))
    state = train(SPEC, stack([agent]), 50)
    assert_array_equal(state.diverged_at, -1)
    ages = np.asarray(state.buffer_state[0, 1:, N : 2 * N]).astype(np.int32)
    assert ages.max() > 3  # beyond the limit


@pytest.mark.slow
def test_training_on_drawn_scenarios_improves():
    """In scenarios of their own the greedy policies live longer than those of the initial weights."""
    spec = DQNSpec(total_steps=8_000, hidden=(16,), observation="full", n_devices=N, double=True, scenario_ring=512)
    hyper = {"learning_rate": 1e-3, "target_interval": 400}
    agents = stack([drawing_agent(seed, limit=3, **hyper) for seed in (0, 1)])
    keys = jax.random.split(jax.random.key(99), 128)

    @jax.jit
    @jax.vmap
    def mean_lifetime(agent, weights):
        policy = dqn.algorithm(spec).policy(agent.hyper, weights)
        return jnp.mean(priced_lifetimes(policy, agent.scenario, keys))

    before, after = (mean_lifetime(agents, train(spec, agents, last).weights) for last in (0, spec.iterations))
    assert (after > 1.3 * before).all(), (before, after)
