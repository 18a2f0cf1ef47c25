"""Commands about one scenario."""

from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import InputError, assignments, command_line, new_folder, print_json, print_tables
from uavmec_jax.cli.options import ScenarioChoice, json_option, out_option, scenario_options
from uavmec_jax.cli.types import Location, NameOrPath, WholeNumber, given, refuse_given

_MAX_DRAWS = 10_000


@click.command()
@scenario_options(argument=True)
@click.option(
    "--draws",
    type=WholeNumber(1, _MAX_DRAWS),
    default=8,
    help="Number of volume draws to evaluate lifetimes on (default: 8).",
)
@click.option(
    "--width",
    type=WholeNumber(1, 100_000),
    help="Width of the beam: the number of states it keeps (default: 256; with several UAVs or depots, 64).",
)
@out_option(help="Folder of the tour (default: runs/plan-<time>).")
@json_option
def plan(scenario: ScenarioChoice, draws: int, width: int | None, out: Path | None, as_json: bool) -> None:
    """Plan tours for SCENARIO, a file (TOML or CSV), or for a random scenario; bound, first failure, repairs."""
    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.files.output_folders import claimed
    from uavmec_jax.planning.plan import PLANNED_SLOTS, make_plan
    from uavmec_jax.reporting.plan import plan_data, plan_summary, plan_tables, save_plan

    named = scenario.load()
    if named.params.end == "horizon":
        refuse_given("is the beam's, which is only for end = 'first_failure'", "width")
    if "max_slots" not in scenario.settings:
        named = named.with_slot_limit(PLANNED_SLOTS)
    directory = out or new_folder("plan")
    with claimed(directory):
        result = make_plan(named.params, named.layout, named.draws(draws), width=width)
        save_plan(result, named, directory, command_line())
    if as_json:
        print_json(plan_data(result, named))
        return
    print_tables(new_console(), plan_tables(result, named), plan_summary(result, named), directory)


@click.command()
@click.argument("policy", type=NameOrPath())
@scenario_options(argument=False)
@click.option("--draws", type=WholeNumber(1, _MAX_DRAWS), default=32, help="Number of volume draws (default: 32).")
@click.option("--weights", type=click.Choice(["best", "last"]), default="best", help="Which weights of a run's agent.")
@click.option(
    "--agent",
    multiple=True,
    metavar="NAME=VALUE",
    help="Which agent of a run, by its axes, e.g. --agent algorithm=ppo.",
)
@click.option("--save", type=Location(), help="Save the trained policy to a file, a path or a URL.")
@json_option
def evaluate(
    policy: str,
    scenario: ScenarioChoice,
    draws: int,
    weights: str,
    agent: tuple[str, ...],
    save: Path | None,
    as_json: bool,
) -> None:
    """Evaluate POLICY on one scenario: a policy file, the folder of a run, or a name (generalist, oldest-first, ...).

    From a run, the policy is by default that of the agent trained on the chosen scenario.
    """
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.files.locations import to_path
    from uavmec_jax.reporting.compare import evaluation_table
    from uavmec_jax.scenarios.policies import TrainedPolicy, draws_scenarios, load_policy
    from uavmec_jax.studies.policy_evaluation import evaluate_policy

    axes = assignments(agent, "--agent")
    folder = to_path(policy)
    if folder.is_dir() and scenario.file is None and not draws_scenarios(folder):
        axes = scenario.axes | axes
    chosen = load_policy(policy, weights, **axes)
    trained = chosen if isinstance(chosen, TrainedPolicy) else None
    if trained is None:
        if save is not None:
            raise InputError(f"--save {save}: {policy} is a heuristic; only trained policies are saved")
        refuse_given(f"is only for the agents of a run, and {policy} is a heuristic", "weights", "agent")
    elif given("weights") and weights not in (kinds := {key.split("/")[1] for key in trained.collection.weights}):
        raise InputError(f"--weights {weights}: {policy} has only {' and '.join(sorted(kinds))} weights; leave it out")
    named = scenario.load()
    rows = evaluate_policy(chosen, folder.name, named, named.draws(draws))
    if save is not None and trained is not None:
        trained.save(save)
    if as_json:
        about = {"algorithm": trained.algorithm, "trained_on": dict(trained.trained_on)} if trained else {}
        head = {"command": command_line(), "scenario": str(scenario.file or scenario.axes | scenario.fleet)}
        print_json(head | about | {"policies": rows})
        return
    console = new_console()
    measured = "Share of the horizon in service" if "service" in rows[0] else "Lifetime"
    console.print(f"{measured} over {draws} volume draws ± 95 %", style="bold")
    console.print_table(evaluation_table(rows))
    if trained is not None:
        for line in _training_lines(trained, named, scenario):
            console.print(line, highlight=False)


def _training_lines(trained: Any, named: Any, scenario: ScenarioChoice) -> list[str]:
    """Say what the policy was trained on, and how the scenario differs from that."""
    axes = ", ".join(f"{name} {value}" for name, value in trained.trained_on.items())
    lines = [f"Trained by {trained.algorithm.upper()} on {axes}."]
    lines += [f"Out of distribution: {line}." for line in trained.out_of_distribution(named.params, named.layout)]
    lines += [f"{line[0].upper()}{line[1:]}." for line in trained.fleet_warnings(named.layout)]
    here = scenario.axes
    elsewhere = (
        scenario.file is not None
        or bool(scenario.fleet)
        or any(trained.trained_on.get(name) != here.get(name) for name in (*here, "place"))
    )
    if trained.n_devices is not None and elsewhere:
        lines.append(
            "This is another scenario: its observation has no positions, so the policy may not transfer to it."
        )
    return lines
