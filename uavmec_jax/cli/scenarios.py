"""Commands about one scenario."""

import json
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import assignment, command_line, fail, new_folder, print_tables


@click.command()
@click.argument("scenario", required=False, type=click.Path(path_type=Path))
@click.option("--powered", type=int, help="Devices with grid power, of a random town (default: 8).")
@click.option("--connected", type=int, help="Devices with communication, of a random town (default: 8).")
@click.option("--place", help="Where the random town's devices stand: a simulated evacuation (see uavmec traffic).")
@click.option("--seed", type=int, default=0, help="Of the random town and of the task volumes.")
@click.option("--draws", type=int, default=8, help="Volume draws that lifetimes are judged on (default: 8).")
@click.option("--width", type=int, default=256, help="States the beam keeps (default: 256).")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="Change a number of Table 1.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the plan (default: runs/plan-<time>).")
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON on standard output.")
def plan(
    scenario: Path | None,
    powered: int | None,
    connected: int | None,
    place: str | None,
    seed: int,
    draws: int,
    width: int,
    settings: tuple[str, ...],
    out: Path | None,
    as_json: bool,
) -> None:
    """Plan for SCENARIO, a layout file (TOML or CSV), or for a random town: tours, bound, first failure, repairs."""
    town = town_of(scenario, powered, connected, place)
    if not 1 <= width <= 100_000:
        fail(f"--width is {width}; give 1 to 100000 states")
    from uavmec_jax.training import host

    host.use_every_core()
    from rich.console import Console

    from uavmec_jax.planning.plan import look_ahead
    from uavmec_jax.reporting.plan import outlook_data, outlook_summary, outlook_tables, save_outlook
    from uavmec_jax.runs.results_folder import check_directory
    from uavmec_jax.scenarios.load import load_scenario

    inventory, keys = load_scenario(
        scenario,
        place=place,
        **town,
        seed=seed,
        draws=draws,
        settings=dict(assignment(setting) for setting in settings),
    )
    directory = out or new_folder("plan")
    check_directory(directory)
    outlook = look_ahead(inventory.params, inventory.layout, keys, width=width)
    save_outlook(outlook, inventory, directory, command_line())
    if as_json:
        click.echo(json.dumps(outlook_data(outlook, inventory.names, inventory.file.name), indent=1))
        return
    console = Console()
    print_tables(
        console, outlook_tables(outlook, inventory.names), outlook_summary(outlook, inventory.names), directory
    )


@click.command()
@click.argument("policy")
@click.option("--powered", type=int, help="Devices with grid power, of a random town (default: 8).")
@click.option("--connected", type=int, help="Devices with communication, of a random town (default: 8).")
@click.option("--place", help="Where the random town's devices stand: a simulated evacuation (see uavmec traffic).")
@click.option("--seed", type=int, default=0, help="Of the random town and of the task volumes.")
@click.option("--scenario", type=click.Path(path_type=Path), help="A layout file instead of a random town.")
@click.option("--draws", type=int, default=32, help="Volume draws that it is judged on (default: 32).")
@click.option("--weights", type=click.Choice(["best", "last"]), default="best", help="Of a run's agent.")
@click.option(
    "--agent", "agent", multiple=True, metavar="NAME=VALUE", help="Which agent of a run, e.g. --agent algorithm=ppo."
)
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="Change a number of Table 1.")
@click.option("--save", type=click.Path(path_type=Path), help="Write the agent's policy to a file of its own.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON on standard output.")
def evaluate(
    policy: str,
    powered: int | None,
    connected: int | None,
    place: str | None,
    seed: int,
    scenario: Path | None,
    draws: int,
    weights: str,
    agent: tuple[str, ...],
    settings: tuple[str, ...],
    save: Path | None,
    as_json: bool,
) -> None:
    """Judge POLICY on one scenario: a policy file, the folder of a run, or a name (generalist, oldest-first, rollout, ...).

    Of a run it is by default the agent that learned in the town asked for.
    """
    town = town_of(scenario, powered, connected, place)
    from rich.console import Console

    from uavmec_jax.reporting.compare import evaluation_table
    from uavmec_jax.scenarios.load import load_scenario
    from uavmec_jax.scenarios.policies import TrainedPolicy, draws_scenarios, load_policy
    from uavmec_jax.studies.policy_evaluation import evaluate as judge

    axes = dict(assignment(setting, "--agent") for setting in agent)
    here = town | {"seed": seed} | ({"place": place} if place else {})
    if Path(policy).is_dir() and scenario is None and not draws_scenarios(Path(policy)):
        axes = here | axes
    chosen = load_policy(policy, weights, **axes)
    inventory, keys = load_scenario(
        scenario,
        place=place,
        **town,
        seed=seed,
        draws=draws,
        settings=dict(assignment(setting) for setting in settings),
    )
    rows = judge(chosen, Path(policy).name, inventory, keys)
    trained = chosen if isinstance(chosen, TrainedPolicy) else None
    if save is not None:
        if trained is None:
            fail(f"--save {save}: {policy} is a rule; only trained policies are saved")
        trained.save(save)
    if as_json:
        learned = {"algorithm": trained.algorithm, "trained_on": dict(trained.trained_on)} if trained else {}
        click.echo(
            json.dumps(
                {"command": command_line(), "scenario": str(scenario or here)} | learned | {"policies": rows},
                indent=1,
            )
        )
        return
    console = Console()
    console.print(f"[bold]Lifetime over {draws} volume draws ± 95 %[/bold]")
    console.print(evaluation_table(rows))
    if trained is not None:
        known = ", ".join(f"{name} {value}" for name, value in trained.trained_on.items())
        console.print(f"Trained by {trained.algorithm.upper()} on {known}.", highlight=False)
        for line in trained.unlike_training(inventory.params, inventory.layout):
            console.print(f"Unlike its training: {line}.", highlight=False)
        one_town = trained.n_devices is not None
        if one_town and (
            scenario is not None or any(trained.trained_on.get(name) != here.get(name) for name in (*here, "place"))
        ):
            console.print(
                "This is another town: its observation names no places, so nothing it learned need hold here."
            )


def town_of(scenario: Path | None, powered: int | None, connected: int | None, place: str | None) -> dict[str, Any]:
    """How many devices of a random town have what; refuses counts and places beside a layout file."""
    if scenario is not None and (powered, connected, place) != (None, None, None):
        fail(
            f"{scenario}: says itself who has power and communication, and where; leave out --powered, --connected, --place"
        )
    return {"powered": 8 if powered is None else powered, "connected": 8 if connected is None else connected}
