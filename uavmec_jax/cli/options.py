"""Options that several commands share."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import InputError, assignments
from uavmec_jax.cli.types import MAX_SECONDS, FiniteRange, FolderOfRun, LocalPath, NameOrPath, WholeNumber
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.runs.options import CHECKPOINT_KINDS, RunOptions

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON on standard output.")


out_option = functools.partial(click.option, "--out", type=LocalPath())
run_folder_option = functools.partial(click.option, "--out", type=FolderOfRun())
directory_argument = click.argument("directory", type=FolderOfRun())
set_option = functools.partial(click.option, "--set", "settings", multiple=True, metavar="NAME=VALUE")

MAX_DEVICES, MAX_UAVS, MAX_SEED = 1000, 100, 2**31 - 1
"""Bounds of lower rooms, which are not imported for the sake of the start-up time; a test compares them."""

_DEFAULT_COUNT = 8
"""Default number of powered, and of connected, devices of a random scenario."""

_MAX_AMOUNT = 1e9
"""Largest amount of a custom resource."""


@dataclass(frozen=True)
class ScenarioChoice:
    """The scenario that the options of a command choose.

    Attributes:
        file: a scenario file, or ``None`` for a random scenario.
        axes: the random scenario on the axes of studies: ``powered``, ``connected``, ``seed`` and perhaps ``place``.
        fleet: what the random scenario has besides its devices: perhaps ``uavs`` and ``depot``.
        settings: scenario parameters to change, by name.
    """

    file: Path | None
    axes: dict[str, Any]
    fleet: dict[str, Any]
    settings: dict[str, Any]

    def check(self) -> None:
        """Refuse settings that would be ignored.

        Raises:
            InputError: a place gives what they would change.
        """
        for name in ("n_devices", "region_m"):
            if name in self.settings and "place" in self.axes:
                raise InputError(f"--set {name}: the place of --place gives it; leave it out")

    def load(self, state: Path | None = None) -> Any:
        """Load the :class:`NamedScenario`, in the state of a file or in its initial state.

        Raises:
            InputError: a setting would be ignored in this scenario.
        """
        from uavmec_jax.scenarios.load import load_scenario
        from uavmec_jax.scenarios.settings import unused_params

        scenario = load_scenario(self.file, state=state, settings=self.settings, **self.axes, **self.fleet)
        for name in sorted(unused_params(scenario.params) - {"end"}):
            if name in self.settings:
                raise InputError(f"--set {name}: is only for end = 'horizon'; leave it out, or add --set end=horizon")
        return scenario


def scenario_options(*, argument: bool) -> Callable[[Callable], Callable]:
    """Add the options that choose a scenario; the command receives a :class:`ScenarioChoice` as ``scenario``.

    Args:
        argument: whether the file is the argument SCENARIO or the option ``--scenario``.
    """
    path = LocalPath()
    file = (
        click.argument("file", metavar="[SCENARIO]", required=False, type=path)
        if argument
        else click.option(
            "--scenario", "file", type=path, help="Scenario file (TOML or CSV) instead of a random scenario."
        )
    )
    options = (
        file,
        click.option(
            "--powered",
            type=WholeNumber(0, MAX_DEVICES),
            help="Number of devices with grid power in a random scenario (default: 8).",
        ),
        click.option(
            "--connected",
            type=WholeNumber(0, MAX_DEVICES),
            help="Number of devices with communication in a random scenario (default: 8).",
        ),
        click.option(
            "--place", type=NameOrPath(), help="Evacuation whose devices a random scenario has (see uavmec traffic)."
        ),
        click.option("--uavs", type=WholeNumber(1, MAX_UAVS), help="Number of UAVs in a random scenario (default: 1)."),
        click.option(
            "--depot", metavar="KIND", help="Add a depot to a random scenario, at its corner: swap or charge."
        ),
        click.option(
            "--seed",
            type=WholeNumber(0, MAX_SEED),
            default=0,
            help="Seed of the random scenario and of the task volumes.",
        ),
        set_option(help="Change a parameter of Table 1, e.g. --set uav_battery_j=1e6."),
    )

    def decorate(command: Callable) -> Callable:
        @functools.wraps(command)
        def with_scenario(file: Path | None, settings: tuple[str, ...], seed: int, **others: Any) -> Any:
            given, fleet = (
                {name: value for name in names if (value := others.pop(name)) is not None}
                for names in (("powered", "connected", "place"), ("uavs", "depot"))
            )
            if file is not None and given:
                raise InputError(
                    f"{file}: a scenario file says which devices have power and communication, and where they are; leave "
                    "out --powered, --connected, --place"
                )
            if file is not None and fleet:
                raise InputError(
                    f"{file}: a scenario file says which UAVs and depots there are; leave out --uavs, --depot"
                )
            axes = {"powered": _DEFAULT_COUNT, "connected": _DEFAULT_COUNT, "seed": seed} | given
            choice = ScenarioChoice(file, axes, fleet, assignments(settings))
            choice.check()
            return command(scenario=choice, **others)

        return _add_options(with_scenario, options)

    return decorate


def _add_options(command: Callable, options: Sequence[Callable]) -> Callable:
    """Apply decorators in the order in which ``--help`` lists them."""
    return functools.reduce(lambda decorated, option: option(decorated), reversed(options), command)


def run_options(command: Callable) -> Callable:
    """Add the options that say how a run is partitioned, checkpointed and logged."""
    default = RunOptions()
    options = (
        click.option(
            "--shard-size", type=WholeNumber(1, 10**9), help="Most agents in a shard (default: as many as caches hold)."
        ),
        click.option(
            "--checkpoint",
            type=click.Choice(CHECKPOINT_KINDS),
            default=default.checkpoint,
            help="Save the full state of a shard in training, from which it resumes, or only its weights.",
        ),
        click.option(
            "--checkpoint-every",
            "checkpoint_every_s",
            type=FiniteRange(0, MAX_SECONDS),
            default=default.checkpoint_every_s,
            help=f"Least seconds between two checkpoints (default: {default.checkpoint_every_s:g}).",
        ),
        click.option(
            "--checkpoint-share",
            type=FiniteRange(0.001, 1),
            default=default.checkpoint_share,
            help=f"Largest share of the time spent on checkpoints (default: {default.checkpoint_share:g}).",
        ),
        click.option("--tensorboard", is_flag=True, help="Also write TensorBoard event files (needs tensorboardX)."),
    )
    return _add_options(command, options)


def ray_options(command: Callable) -> Callable:
    """Add the options that put the work on Ray; the command receives a :class:`RayOptions` or ``None`` as ``ray``."""
    default = RayOptions()
    options = (
        click.option(
            "--ray",
            "address",
            is_flag=False,
            flag_value="",
            metavar="[ADDRESS]",
            help="Put the shards on Ray: on the cluster at ADDRESS (host:port, ray://host:port, auto), else on that of "
            "RAY_ADDRESS, else on one that is started on this machine (local). Give it last, or with an address.",
        ),
        click.option(
            "--cpus-per-shard",
            type=WholeNumber(1, 4096),
            help="With --ray: cores of a shard (default: this machine's; of a run that is resumed, its plan's).",
        ),
        click.option("--gpus-per-shard", type=WholeNumber(0, 1024), help="With --ray: GPUs of a shard (default: 0)."),
        click.option(
            "--resource",
            "resources",
            multiple=True,
            metavar="NAME=AMOUNT",
            help="With --ray: a custom resource that a shard needs.",
        ),
        click.option(
            "--retries",
            type=WholeNumber(0, 1000),
            help="With --ray: how often a shard is retried after an application error; nodes that die do not count "
            f"(default: {default.retries}).",
        ),
        click.option(
            "--time-limit",
            "time_limit_s",
            type=FiniteRange(1, MAX_SECONDS),
            help="With --ray: kill an attempt at a shard after this many seconds; the next one resumes where it can.",
        ),
    )

    def decorate(address: str | None, resources: tuple[str, ...], **others: Any) -> Any:
        names = ("cpus_per_shard", "gpus_per_shard", "retries", "time_limit_s")
        needs = {name: value for name in names if (value := others.pop(name)) is not None}
        amounts = assignments(resources, "--resource")
        for name, amount in amounts.items():
            if isinstance(amount, bool) or not isinstance(amount, int | float) or not 0 < amount <= _MAX_AMOUNT:
                raise InputError(
                    f"--resource {name}={amount}: the amount must be a positive number, at most {_MAX_AMOUNT:g}"
                )
        ray = None if address is None else RayOptions(address=address or None, resources=amounts, **needs)
        if ray is None and (amounts or needs):
            raise InputError("--cpus-per-shard, --gpus-per-shard, --resource, --retries and --time-limit need --ray")
        return command(ray=ray, **others)

    return _add_options(functools.wraps(command)(decorate), options)
