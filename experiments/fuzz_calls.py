"""Python calls of the public functions with hostile values in one or two places of valid arguments."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from random import Random
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from fuzz_values import MANY, OTHER_TYPE, Range, hostile

import uavmec_jax as um
from uavmec_jax.env.params import Params

_DEVICES = 3


@dataclass(frozen=True)
class Call:
    """A public function and valid arguments.

    Attributes:
        weight: share of the calls.
        function: called with the arguments by name.
        arguments: makes valid arguments by name; made once.
        ranges: argument -> the least and largest number that it may be.
        fixed: arguments that stay valid.
        valid: whether the arguments are accepted; there is no run to load.
        checks: whether the function checks what it is given (docs/api.md, "What calls check"); the others are called in
            programs, or read a part of it.
    """

    weight: int
    function: Callable[..., Any]
    arguments: Callable[[], dict[str, Any]]
    ranges: Mapping[str, Range] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    valid: bool = True
    checks: bool = True


@dataclass(frozen=True)
class HostileCall:
    """A call that is ready to be made.

    Attributes:
        make: makes it.
        text: the values that are hostile, in words.
        must_refuse: why it must not be accepted, empty if it may.
        other_type: whether a value is of another type or shape, which Python and JAX may refuse in words of their own.
        finite: whether what it returns must be finite: the function checks all of its arguments.
    """

    make: Callable[[], Any]
    text: str
    must_refuse: str
    other_type: bool = False
    finite: bool = True


def make_call(name: str, rng: Random) -> HostileCall:
    """Make a call with one or two hostile values."""
    call = CALLS[name]
    arguments = dict(_arguments(name))
    places, reasons = [], []
    free = [key for key in arguments if key not in call.fixed]
    for key in rng.sample(free, min(rng.choice((1, 1, 1, 2)), len(free))):
        arguments[key], place, reason = hostile(rng, arguments[key], key, call.ranges.get(key))
        places.append(place)
        reasons.append(reason if reason == OTHER_TYPE or call.checks or key in call.ranges else "")
    why = next((reason for reason in reasons if reason not in ("", OTHER_TYPE)), "")
    must_refuse = f"{name}: {why}" if why and OTHER_TYPE not in reasons else ""
    text = "; ".join(places)
    return HostileCall(lambda: call.function(**arguments), text, must_refuse, OTHER_TYPE in reasons, finite=call.checks)


@cache
def _arguments(name: str) -> dict[str, Any]:
    return CALLS[name].arguments()


@cache
def _params() -> Params:
    return um.Params(n_devices=_DEVICES, max_slots=4)


@cache
def _layout() -> Any:
    return um.sample_layout(jax.random.key(0), _params(), 1, 1)


@cache
def _state() -> Any:
    return um.initial_state(_params(), _layout())


@cache
def _named() -> Any:
    return um.scenarios.name_scenario(_layout(), _params(), "tiny")


@cache
def _study() -> Any:
    overrides = {"axes.powered": [8], "axes.connected": [8], "axes.seeds": 1, "steps": 1000}
    return um.load_study("table5", overrides)


def _call(
    weight: int,
    function: Callable[..., Any],
    known: str = "",
    ranges: Mapping[str, Range] | None = None,
    fixed: str = "",
    /,
    **values: Any,
) -> Call:
    """Make a call of arguments that are known by their names, and of values; functions make those values when needed."""

    def make() -> dict[str, Any]:
        key = jax.random.key(1)
        all_known: dict[str, Any] = {
            "params": _params(),
            "layout": _layout(),
            "state": _state(),
            "key": key,
            "keys": jax.random.split(key, 2),
            "draws": jax.random.split(key, 1),
            "policy": um.planning.earliest_deadline,
            "volumes": jnp.full(_DEVICES, 3e6),
            "action": 1,
            "scenario": um.make_scenario(_layout(), _params()),
            "reward": um.make_reward(),
        }
        made = {name: value() if isinstance(value, FunctionType) else value for name, value in values.items()}
        return {name: all_known[name] for name in known.split()} | made

    return Call(weight, function, make, ranges or {}, tuple(fixed.split()), checks=function not in _UNCHECKED)


def _table() -> Any:
    return jnp.full((4, _DEVICES), 3e6)


def _gym_step(action: Any) -> Any:
    from uavmec_jax.interop.gymnasium_env import UavMecGymEnv  # type: ignore[attr-defined]

    env = UavMecGymEnv(um.make_scenario(_layout(), _params()))
    env.reset(seed=0)
    return env.step(action)


def _named_arguments() -> dict[str, Any]:
    names = ("x_m", "y_m", "capacity_j")
    device = dict(zip(names, (10.0, 20.0, 60_000.0), strict=True)) | {"type": "Jetson Nano", "task": "DNN"}
    data = {"name": "x", "params": {"max_slots": 5}, "device": [device | {"name": name} for name in ("a", "b")]}
    return {"data": data, "source": "data"}


def _train(steps: int, hyper: Any, settings: Any, key: Any) -> Any:
    return um.train("a2c", _batch(_scenario()), key=key, steps=steps, hyper=hyper, settings=settings)


def _act(observation: Any) -> Any:
    return _policy().act(observation)


@cache
def _policy() -> Any:
    return um.load_policy("generalist")


def _trace(slots: int) -> Any:
    return um.env.trace(um.planning.earliest_deadline, _params(), _layout(), jax.random.key(0), slots)


def _plan(shard_size: Any) -> Any:
    return um.runs.plan_run(_study(), shard_size=shard_size)


def _simulate(speed: Any, devices: Any) -> Any:
    return um.runs.simulate(_study(), um.runs.plan_run(_study()), speed=speed, devices=devices)


def _place(moving: Any, scale_to_m: Any) -> Any:
    layout = um.sample_layout(jax.random.key(0), um.Params(), 8, 8)
    return um.scenarios.on_place(layout, um.traffic.load_evacuation("albany"), moving=moving, scale_to_m=scale_to_m)


def _distribution() -> Any:
    return um.ScenarioDistribution(um.Params(n_devices=4), um.make_reward())


def _scenario() -> Any:
    return um.make_scenario(_layout(), _params())


def _batch(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], tree)


def _with_horizon() -> Params:
    return um.Params(n_devices=_DEVICES, end="horizon", horizon_s=3000.0)


_ENV = um.UavMecEnv()
_UNCHECKED = (
    *(um.transition, um.env.advance, um.env.observe, um.planning.observe_devices, um.env.draw_volumes),
    *(um.planning.earliest_deadline, um.planning.HEURISTICS["oldest-first"], um.planning.planned_slots),
    *(um.env.make_fleet, um.env.pad_layout, um.env.measure, _ENV.step, um.training.Validation),
)
_ACTION: dict[str, Range] = {"action": (0, _DEVICES - 1)}
_COUNTS: dict[str, Range] = {"n_powered": (0, _DEVICES), "n_connected": (0, _DEVICES)}
_VOLUMES: dict[str, Range] = {"volumes": (0, 1e30)}
_SCENARIO: dict[str, Range] = {"powered": (0, 12), "connected": (0, 12), "seed": (0, 2**32), "uavs": (1, 100)}
_TABLES: dict[str, Range] = {"device_type": (0, 5), "task": (0, 4), "capacity": (1e-30, 1e30)}
_RAY: dict[str, Range] = {"cpus_per_shard": MANY, "gpus_per_shard": (0, 10**6), "retries": (0, 10**9)}
_RUN: dict[str, Range] = {"checkpoint_every_s": (0, math.inf), "checkpoint_share": (0, 1)}
_LAYOUT = ("position", "device_type", "task", "capacity", "has_power", "has_comms")
_STUDY = {"steps": 100, "axes.seeds": 2, "dqn.gamma": 0.9, "params.uav_speed_m_s": 4.0, "evaluation.draws": 3}
_PLACE = {"demand": {"vehicles": 10}, "simulation": {"seeds": 1}}

CALLS: dict[str, Call] = {
    "sample_layout": _call(5, um.sample_layout, "key params", _COUNTS, n_powered=1, n_connected=1),
    "make_layout": Call(4, um.make_layout, lambda: {name: getattr(_layout(), name) for name in _LAYOUT}, _TABLES),
    "pad_layout": _call(2, um.env.pad_layout, "layout", {"size": (_DEVICES, 1000)}, size=5),
    "initial_state": _call(3, um.initial_state, "params layout"),
    "transition": _call(6, um.transition, "params layout state action volumes", _ACTION | _VOLUMES),
    "observe": _call(2, um.env.observe, "params layout state"),
    "observe_devices": _call(2, um.planning.observe_devices, "params layout state"),
    "draw_volumes": _call(2, um.env.draw_volumes, "params", uniform=lambda: jnp.full(_DEVICES, 0.5)),
    "volume_table": _call(2, um.env.volume_table, "params key", {"slots": MANY}, n_devices=3, slots=4),
    "make_reward": _call(
        4, um.make_reward, reward={"U": 1.0, "log A": 1.0}, guard="clamp", traffic_bonus=1.0, per_slot=0.0
    ),
    "make_fleet": _call(4, um.env.make_fleet, "params", {"uavs": (1, 100)}, uavs=2, battery_j=1e6, speed_m_s=5.0),
    "make_depots": _call(
        4, um.env.make_depots, position=lambda: jnp.zeros((2, 2)), kind="swap", pads=1.0, packs=2.0, power_w=1.0
    ),
    "make_scenario": _call(2, um.make_scenario, "params layout reward"),
    "sample_scenario": _call(2, um.sample_scenario, "key", distribution=lambda: _distribution()),
    "advance": _call(2, um.env.advance, "scenario state action volumes", _ACTION | _VOLUMES),
    "UavMecEnv.step": _call(3, _ENV.step, "key state action", _ACTION, params=lambda: _scenario()),
    "UavMecGymEnv.step": _call(2, _gym_step, "action", _ACTION),
    "rollout": _call(2, um.rollout, "policy params layout key", None, "policy"),
    "rollouts": _call(2, um.rollouts, "policy params layout keys", None, "policy"),
    "rollout_from": _call(2, um.env.rollout_from, "policy params layout state key", None, "policy"),
    "rollout_draws": _call(1, um.env.rollout_draws, "policy scenario keys", None, "policy"),
    "returns": _call(1, um.env.returns, "policy scenario keys", None, "policy"),
    "trace": _call(1, _trace, "", {"slots": MANY}, slots=3),
    "measure": _call(
        1, um.env.measure, "params layout", None, "trace", trace=lambda: _trace(3), weight=lambda: jnp.ones(3)
    ),
    "earliest_deadline": _call(2, um.planning.earliest_deadline, "params layout state key"),
    "oldest-first": _call(1, um.planning.HEURISTICS["oldest-first"], "params layout state key"),
    "planned_slots": _call(
        1, um.planning.planned_slots, params=lambda: _batch(_params()), layouts=lambda: _batch(_layout())
    ),
    "upper_bound": _call(
        5, um.planning.upper_bound, "params layout", {"reached": (0, 10**6)}, volumes=_table, reached=1
    ),
    "service_bound": _call(2, um.planning.service_bound, "layout", params=lambda: _with_horizon()),
    "beam_search": _call(2, um.planning.beam_search, "params layout", {"width": (1, 10**5)}, volumes=_table, width=2),
    "rollout_planner": _call(1, um.planning.rollout_planner, "", {"samples": MANY}, samples=2),
    "make_forecast": _call(
        2, um.planning.make_forecast, "policy params layout state key", {"samples": MANY}, "policy", samples=2
    ),
    "advise": _call(1, um.planning.advise, "policy params layout state key", {"samples": MANY}, "policy", samples=2),
    "make_plan": _call(
        1, um.planning.make_plan, "params layout draws", {"width": MANY, "samples": MANY}, width=2, samples=1
    ),
    "train": _call(
        1,
        _train,
        "key",
        {"steps": MANY},
        steps=20,
        hyper={"learning_rate": 1e-3, "gamma": 0.9},
        settings={"hidden": (4,)},
    ),
    "Validation": _call(1, um.training.Validation, every=100, draws=2, chunks=2),
    "RunOptions": _call(
        2, um.runs.RunOptions, "", _RUN, checkpoint="full", checkpoint_every_s=1.0, checkpoint_share=0.1
    ),
    "RayOptions": _call(2, um.RayOptions, "", _RAY, cpus_per_shard=1, gpus_per_shard=0, retries=1, time_limit_s=9.0),
    "load_scenario": _call(
        5, um.load_scenario, "", _SCENARIO, powered=8, connected=8, seed=1, uavs=1, settings={"max_slots": 9}
    ),
    "make_named_scenario": Call(3, um.scenarios.make_named_scenario, _named_arguments),
    "name_scenario": _call(2, um.scenarios.name_scenario, "params layout", name="x", device_names=["a", "b", "c"]),
    "layout_for_seed": _call(3, um.scenarios.layout_for_seed, "params", _COUNTS, seed=1, n_powered=1, n_connected=1),
    "held_out_draws": _call(
        2, um.scenarios.held_out_draws, "", {"draws": MANY}, seed=1, powered=8, connected=8, draws=2
    ),
    "on_place": _call(2, _place, "", {"scale_to_m": (1e-30, math.inf)}, moving=False, scale_to_m=800.0),
    "scenario_text": _call(1, um.scenarios.scenario_text, scenario=lambda: _named(), suffix=".toml"),
    "TrainedPolicy.act": _call(2, _act, observation=lambda: np.zeros(2 * (len(um.planning.FEATURES) + 1), np.float32)),
    "load_policy": _call(2, um.load_policy, source="generalist", which="best", seed=0),
    "load_study": _call(4, partial(um.load_study, "table5"), overrides=_STUDY),
    "load_space": _call(2, partial(um.search.load_space, "dqn"), overrides={"trials": 4, "batch": 2, "seed": 1}),
    "load_place": _call(2, partial(um.traffic.load_place, "albany"), overrides=_PLACE),
    "plan_run": _call(2, _plan, "", {"shard_size": MANY}, shard_size=2),
    "simulate": _call(3, _simulate, "", {"speed": (1e-30, 1e30), "devices": MANY}, speed=1e4, devices=2),
    "load_results": Call(1, um.load_results, lambda: {"directory": "nowhere"}, valid=False),
    "load_weights": Call(1, um.studies.load_weights, lambda: {"directory": "nowhere", "which": "last"}, valid=False),
    "run_status": Call(1, um.runs.run_status, lambda: {"directory": "nowhere"}, valid=False),
    "load_evacuation": _call(1, um.traffic.load_evacuation, source="albany"),
    "evaluate_policy": _call(
        1, um.studies.evaluate_policy, "policy draws", None, "policy scenario", name="x", scenario=lambda: _named()
    ),
}
"""Public function -> the calls that are made of it."""
