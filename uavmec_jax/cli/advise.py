"""The command that advises: whom to visit next, how long the network lasts, what fails first."""

import json
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import assignment, command_line, fail, print_tables
from uavmec_jax.cli.scenarios import town_of


@click.command()
@click.argument("layout", required=False, type=click.Path(path_type=Path))
@click.option(
    "--state", type=click.Path(path_type=Path), help="Where the network stands (JSON; default: at its start)."
)
@click.option(
    "--policy", default="generalist", help="Who decides: a policy by name or from a file (default: generalist)."
)
@click.option("--samples", type=int, default=256, help="Futures played for each candidate (default: 256).")
@click.option("--what-if/--no-what-if", default=True, help="Try every repair and removal of a device too.")
@click.option("--price", type=float, help="Slots of life that the first failure of the busiest device costs (0: none).")
@click.option("--powered", type=int, help="Devices with grid power, of a random town (default: 8).")
@click.option("--connected", type=int, help="Devices with communication, of a random town (default: 8).")
@click.option("--place", help="Where the random town's devices stand: a simulated evacuation (see uavmec traffic).")
@click.option("--seed", type=int, default=0, help="Of the random town and of the futures.")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="Change a number of Table 1.")
@click.option("--json", "as_json", is_flag=True, help="Print the advice as JSON on standard output.")
def advise(
    layout: Path | None,
    state: Path | None,
    policy: str,
    samples: int,
    what_if: bool,
    price: float | None,
    powered: int | None,
    connected: int | None,
    place: str | None,
    seed: int,
    settings: tuple[str, ...],
    as_json: bool,
) -> None:
    """Advise on the next visit in LAYOUT, a layout file (TOML or CSV), or in a random town: no training at the scene."""
    town = town_of(layout, powered, connected, place)
    if not 2 <= samples <= 100_000:
        fail(f"--samples is {samples}; give 2 to 100000 futures")
    from rich.console import Console

    from uavmec_jax.reporting.advice import advice_data, advice_lines, advice_tables
    from uavmec_jax.scenarios.advice import advise_at, load_scene

    scene = load_scene(
        layout,
        state,
        price=price,
        place=place,
        **town,
        seed=seed,
        settings=dict(assignment(setting) for setting in settings),
    )
    advice, warnings = advise_at(scene, policy, samples=samples, what_if=what_if, seed=seed)
    for line in warnings:
        click.echo(f"uavmec: warning: {line}", err=True)
    names = scene.inventory.names
    if as_json:
        told: dict[str, Any] = {"command": command_line(), "policy": policy, "warnings": warnings}
        click.echo(json.dumps(told | advice_data(advice, names) | {"state": scene.state_data()}, indent=1))
        return
    print_tables(Console(), advice_tables(advice, names), advice_lines(advice, names))
