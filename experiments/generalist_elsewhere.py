"""The generalist away from its training: other towns, batteries and two real places; and what traffic costs.

    uv run python experiments/generalist_elsewhere.py [--towns 100] [--out results/generalist]

Every row of `elsewhere.csv` is one kind of scenario: towns that differ from the paper's in one respect, with random counts of
powered and connected devices, the same towns and volumes for every policy; differences are paired, with 95 % intervals over
the towns. `traffic.csv` is the trade-off between lifetime and first failures on high-traffic devices: a price in slots of
life is put on them, and the same weights decide. Writes the figure `traffic.png` besides.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from uavmec_jax.training import host

host.use_all_cores()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
from generalist_figures import trade_off_figure

from uavmec_jax.env.layout import Layout, Traffic, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.parallel import policy_episodes
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.traffic.evacuation import HIGH_TRAFFIC, load_evacuation

PLACES = ("albany", "round_lake")
PRICES = (0.0, 2.0, 5.0, 10.0, 20.0)
_TOWNS, _VOLUMES = 30_000, 30_001


def kinds() -> dict[str, tuple[Params, str | None]]:
    """Name -> parameters and place."""
    paper, found = Params(), {}
    for n in (6, 24, 48):
        found[f"{n} devices"] = (replace(paper, n_devices=n), None)
    for side in (400.0, 1200.0, 2000.0):
        found[f"{side:,.0f} m"] = (replace(paper, region_m=(side, side)), None)
    for name, factor in (("half batteries", 0.5), ("double batteries", 2.0)):
        low, high = paper.device_battery_range_j
        found[name] = (replace(paper, device_battery_range_j=(low * factor, high * factor)), None)
    for place in PLACES:
        evacuation = load_evacuation(place)
        found[place] = (replace(paper, n_devices=evacuation.n_devices, region_m=evacuation.region_m()), place)
    return found


def towns(params: Params, place: str | None, count: int) -> Layout:
    """Layouts ``[count, n]``; a third to all of the devices have power, and as many communication."""
    n = params.n_devices

    def one(key: Any) -> Layout:
        k_layout, *k_counts = jax.random.split(key, 3)
        powered, connected = (jax.random.randint(k, (), -(-n // 3), n + 1) for k in k_counts)
        return sample_layout(k_layout, params, powered, connected)

    layouts = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(_TOWNS), count))
    if place is None:
        return layouts
    there = on_place(jax.tree.map(lambda leaf: leaf[0], layouts), load_evacuation(place))
    spread = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), (there.position, there.traffic)
    )
    return replace(layouts, position=spread[0], traffic=spread[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--towns", type=int, default=100)
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument(
        "--only",
        nargs="+",
        choices=list(kinds()),
        default=list(kinds()),
        metavar="KIND",
        help="these kinds of scenarios, and their traffic, and random weights",
    )
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()

    policy = load_policy(arguments.policy)
    chosen = {name: kind for name, kind in kinds().items() if name in arguments.only}
    elsewhere = pd.DataFrame(
        [row(name, *kind, policy, arguments.towns, arguments.draws) for name, kind in chosen.items()]
    )
    traffic = pd.DataFrame(
        [
            one
            for name, (params, layouts) in traffic_scenes(chosen, arguments.towns).items()
            for one in prices(name, params, layouts, policy, arguments.draws)
        ]
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    elsewhere.to_csv(arguments.out / "elsewhere.csv", index=False, float_format="%.5g")
    traffic.to_csv(arguments.out / "traffic.csv", index=False, float_format="%.5g")
    trade_off_figure(traffic, arguments.out / "traffic.png")
    label = {"command": "uv run python experiments/generalist_elsewhere.py", "towns": arguments.towns}
    label |= {"draws": arguments.draws, **host.describe()}
    (arguments.out / "elsewhere.json").write_text(json.dumps(label, indent=1) + "\n", encoding="utf-8")
    print(elsewhere.round(2).to_string(index=False))
    print(traffic.round(3).to_string(index=False))


def lives(policy: Any, params: Params, layouts: Layout, draws: int) -> Any:
    """Episodes ``[towns, draws]``."""
    count = layouts.capacity.shape[0]
    keys = jax.random.split(jax.random.key(_VOLUMES), (count, draws))
    every = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (count, *jnp.shape(leaf))), params)
    return jax.tree.map(np.asarray, policy_episodes(policy, every, layouts, keys))


def row(name: str, params: Params, place: str | None, policy: Any, count: int, draws: int) -> dict[str, Any]:
    """Mean lifetimes in one kind of scenario, and the paired differences of the generalist."""
    layouts = towns(params, place, count)
    rules = ("oldest-first", "earliest-deadline")
    mean = {rule: lives(HEURISTICS[rule], params, layouts, draws).length.mean(axis=1) for rule in rules}
    own = lives(policy, params, layouts, draws).length.mean(axis=1)
    found: dict[str, Any] = {"kind": name, "generalist": own.mean()}
    for rule, life in mean.items():
        found[rule] = life.mean()
        found |= dict(
            zip((f"over_{rule}", f"over_{rule}_low", f"over_{rule}_high"), mean_interval(own - life), strict=True)
        )
    return found


def traffic_scenes(chosen: dict[str, tuple[Params, str | None]], count: int) -> dict[str, tuple[Params, Layout]]:
    """The places, and towns with random weights."""
    found = {place: (params, towns(params, place, count)) for params, place in chosen.values() if place}
    params = Params()
    layouts = towns(params, None, count)
    weight = jax.random.uniform(jax.random.key(_TOWNS + 2), (count, 1, params.n_devices)) ** 2
    nowhere = jnp.full(count, jnp.inf)
    return found | {"random weights": (params, replace(layouts, traffic=Traffic(weight, nowhere, jnp.zeros(count))))}


def prices(name: str, params: Params, layouts: Layout, policy: Any, draws: int) -> list[dict[str, Any]]:
    """Lifetime and first failures on high-traffic devices, one row for each price."""
    rows = []
    traffic: Any = layouts.traffic
    weight = np.asarray(traffic.weight)[:, :1]
    free: Any = None
    for price in PRICES:
        priced = replace(layouts, traffic=replace(traffic, price=jnp.full(len(weight), price)))
        played = lives(policy, params, priced, draws)
        busy = (played.first_failure * (weight >= HIGH_TRAFFIC)).sum(axis=-1).mean(axis=1)
        cost = (played.first_failure * weight).sum(axis=-1).mean(axis=1)
        length = played.length.mean(axis=1)
        free = (length, busy) if free is None else free
        row: dict[str, Any] = {"place": name, "price": price, "lifetime": length.mean(), "busy_first": busy.mean()}
        row |= {"weight_of_first": cost.mean()}
        for column, paired in (("lifetime", length - free[0]), ("busy_first", busy - free[1])):
            row |= dict(
                zip((f"{column}_gain", f"{column}_gain_low", f"{column}_gain_high"), mean_interval(paired), strict=True)
            )
        rows.append(row)
    return rows


if __name__ == "__main__":
    main()
