"""The generalist outside its training: other sizes, batteries and two real places; and the price of avoiding traffic.

    uv run python experiments/generalist_elsewhere.py [--layouts 100] [--out results/generalist]

Every row of `elsewhere.csv` is a kind of scenarios: layouts that differ from the paper's in one respect, with random counts
of powered and connected devices. All policies play the same layouts and volumes; differences are paired, with 95 %
intervals over the layouts. `traffic.csv` is the trade-off between the lifetime and first failures on devices in high
traffic: these failures get a price in slots of lifetime, and the same weights decide. `traffic.png` is its figure.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from generalist_figures import trade_off_figure
from jaxtyping import Array, Key
from reports import write_report

from uavmec_jax.env.layout import Layout, Traffic, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.parallel import policy_episodes
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.traffic.evacuation import HIGH_TRAFFIC, load_evacuation
from uavmec_jax.training import host

PLACES = ("albany", "round_lake")
PRICES = (0.0, 2.0, 5.0, 10.0, 20.0)
"""Slots of lifetime."""
RULES = ("oldest-first", "earliest-deadline")

_LAYOUT_SEED, _VOLUME_SEED, _TRAFFIC_SEED = 30_000, 30_001, 30_002

Kind = tuple[Params, str | None]
"""A kind of scenarios: parameters, and the place if there is one."""


def kinds() -> dict[str, Kind]:
    """Return the kinds of scenarios by name."""
    paper = Params()
    low, high = paper.device_battery_range_j
    result: dict[str, Kind] = {f"{n} devices": (replace(paper, n_devices=n), None) for n in (6, 24, 48)}
    for side in (400.0, 1200.0, 2000.0):
        result[f"{side:,.0f} m"] = (replace(paper, region_m=(side, side)), None)
    for name, factor in (("half batteries", 0.5), ("double batteries", 2.0)):
        result[name] = (replace(paper, device_battery_range_j=(low * factor, high * factor)), None)
    for place in PLACES:
        evacuation = load_evacuation(place)
        result[place] = (replace(paper, n_devices=evacuation.n_devices, region_m=evacuation.region_m()), place)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--layouts", type=int, default=100)
    parser.add_argument("--draws", type=int, default=4, help="volume draws for each layout")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=list(kinds()),
        default=list(kinds()),
        metavar="KIND",
        help="these kinds of scenarios, and traffic in their places and with random weights",
    )
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()
    host.use_all_cores()

    policy, count, draws = load_policy(arguments.policy), arguments.layouts, arguments.draws
    chosen = {name: kind for name, kind in kinds().items() if name in arguments.only}
    elsewhere = pd.DataFrame([compare(name, *kind, policy, count, draws) for name, kind in chosen.items()])
    with_traffic = traffic_scenarios(chosen, count)
    rows = [row for name, scenarios in with_traffic.items() for row in trade_off(name, *scenarios, policy, draws)]
    traffic = pd.DataFrame(rows)
    arguments.out.mkdir(parents=True, exist_ok=True)
    elsewhere.to_csv(arguments.out / "elsewhere.csv", index=False, float_format="%.5g")
    traffic.to_csv(arguments.out / "traffic.csv", index=False, float_format="%.5g")
    trade_off_figure(traffic, arguments.out / "traffic.png")
    label = {"command": "uv run python experiments/generalist_elsewhere.py", "towns": count, "draws": draws}
    write_report(arguments.out / "elsewhere.json", label | host.describe())
    print(elsewhere.round(2).to_string(index=False))
    print(traffic.round(3).to_string(index=False))


def sample_layouts(params: Params, place: str | None, count: int) -> Layout:
    """Draw layouts ``[count, n]``; a third to all of the devices have power, and as many communication."""
    n = params.n_devices

    def sample(key: Key[Array, ""]) -> Layout:
        k_layout, *k_counts = jax.random.split(key, 3)
        powered, connected = (jax.random.randint(k, (), -(-n // 3), n + 1) for k in k_counts)
        return sample_layout(k_layout, params, powered, connected)

    layouts = jax.jit(jax.vmap(sample))(jax.random.split(jax.random.key(_LAYOUT_SEED), count))
    if place is None:
        return layouts
    placed = on_place(jax.tree.map(lambda leaf: leaf[0], layouts), load_evacuation(place))
    position, traffic = repeat((placed.position, placed.traffic), count)
    return replace(layouts, position=position, traffic=traffic)


def repeat(tree: Any, count: int) -> Any:
    """Repeat every leaf along a new leading axis."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (count, *jnp.shape(leaf))), tree)


def play(policy: Policy, params: Params, layouts: Layout, draws: int) -> Episode:
    """Play episodes ``[layouts, draws]``."""
    count = layouts.capacity.shape[0]
    keys = jax.random.split(jax.random.key(_VOLUME_SEED), (count, draws))
    return jax.tree.map(np.asarray, policy_episodes(policy, repeat(params, count), layouts, keys))


def compare(name: str, params: Params, place: str | None, policy: Policy, count: int, draws: int) -> dict[str, Any]:
    """Return mean lifetimes in a kind of scenarios, and the generalist's paired differences from the rules."""
    layouts = sample_layouts(params, place, count)
    by_rule = {rule: play(HEURISTICS[rule], params, layouts, draws).length.mean(axis=1) for rule in RULES}
    lifetime = play(policy, params, layouts, draws).length.mean(axis=1)
    row: dict[str, Any] = {"kind": name, "generalist": lifetime.mean()}
    for rule, rule_lifetime in by_rule.items():
        row |= {rule: rule_lifetime.mean()} | with_interval(f"over_{rule}", lifetime - rule_lifetime)
    return row


def with_interval(name: str, values: np.ndarray) -> dict[str, float]:
    """Return the mean of values and its 95 % interval: ``<name>``, ``<name>_low``, ``<name>_high``."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), mean_interval(values), strict=True))


def traffic_scenarios(chosen: dict[str, Kind], count: int) -> dict[str, tuple[Params, Layout]]:
    """Return parameters and layouts of the places, and of layouts with random traffic weights."""
    scenarios = {place: (params, sample_layouts(params, place, count)) for params, place in chosen.values() if place}
    params = Params()
    weight = jax.random.uniform(jax.random.key(_TRAFFIC_SEED), (count, 1, params.n_devices)) ** 2
    traffic = Traffic(weight, window_s=jnp.full(count, jnp.inf), price=jnp.zeros(count))
    layouts = replace(sample_layouts(params, None, count), traffic=traffic)
    return scenarios | {"random weights": (params, layouts)}


def trade_off(name: str, params: Params, layouts: Layout, policy: Policy, draws: int) -> list[dict[str, Any]]:
    """Return lifetime and first failures on devices in high traffic, one row per price."""
    rows: list[dict[str, Any]] = []
    traffic = layouts.traffic
    assert traffic is not None
    weight = np.asarray(traffic.weight)[:, :1]
    free: tuple[np.ndarray, np.ndarray] | None = None
    for price in PRICES:
        priced = replace(layouts, traffic=replace(traffic, price=jnp.full(len(weight), price)))
        episodes = play(policy, params, priced, draws)
        lifetime = episodes.length.mean(axis=1)
        busy_first = (episodes.first_failure * (weight >= HIGH_TRAFFIC)).sum(axis=-1).mean(axis=1)
        weight_of_first = (episodes.first_failure * weight).sum(axis=-1).mean(axis=1)
        free = (lifetime, busy_first) if free is None else free
        row = {"place": name, "price": price, "lifetime": lifetime.mean(), "busy_first": busy_first.mean()}
        row |= {"weight_of_first": weight_of_first.mean()}
        row |= with_interval("lifetime_gain", lifetime - free[0])
        row |= with_interval("busy_first_gain", busy_first - free[1])
        rows.append(row)
    return rows


if __name__ == "__main__":
    main()
