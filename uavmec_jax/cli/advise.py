"""The command `advise`: which device to visit next, how long the network will last, what will fail first."""

from pathlib import Path

import click

from uavmec_jax.cli.common import command_line, print_json, print_tables, warn
from uavmec_jax.cli.options import ScenarioChoice, json_option, scenario_options
from uavmec_jax.cli.types import FiniteRange, LocalPath, NameOrPath, WholeNumber


@click.command()
@scenario_options(argument=True)
@click.option("--state", type=LocalPath(), help="File of the current state, JSON (default: the initial state).")
@click.option(
    "--policy",
    type=NameOrPath(),
    help="Name or file of the policy to follow (default: generalist; with several UAVs or depots, earliest-deadline).",
)
@click.option(
    "--samples",
    type=WholeNumber(2, 100_000),
    default=256,
    help="Futures to simulate for each candidate (default: 256).",
)
@click.option("--what-if/--no-what-if", default=True, help="Also evaluate every repair and removal of a device.")
@click.option(
    "--price", type=FiniteRange(0, 1e9), help="Price of a first failure of the busiest device, in slots of lifetime."
)
@json_option
def advise(
    scenario: ScenarioChoice,
    state: Path | None,
    policy: str | None,
    samples: int,
    what_if: bool,
    price: float | None,
    as_json: bool,
) -> None:
    """Recommend the next visit of each UAV in SCENARIO, a file (TOML or CSV), or in a random scenario; nothing is trained."""
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.reporting.advice import advice_data, advice_lines, advice_tables
    from uavmec_jax.scenarios.advice import advise_on, default_policy
    from uavmec_jax.scenarios.state_files import state_data

    named = scenario.load(state)
    if price is not None:
        named = named.with_failure_price(price)
    policy = default_policy(named) if policy is None else policy
    advice, warnings = advise_on(named, policy, samples=samples, what_if=what_if, seed=scenario.axes["seed"])
    for line in warnings:
        warn(line)
    if as_json:
        head = {"command": command_line(), "policy": policy, "warnings": warnings}
        print_json(head | advice_data(advice, named) | {"state": state_data(named)})
        return
    print_tables(new_console(), advice_tables(advice, named), advice_lines(advice, named))
