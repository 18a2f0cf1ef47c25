"""Options that several commands share."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import InputError, assignment
from uavmec_jax.runs.options import CHECKPOINT_KINDS, RunOptions

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON on standard output.")
out_option = functools.partial(click.option, "--out", type=click.Path(path_type=Path))
set_option = functools.partial(click.option, "--set", "settings", multiple=True, metavar="NAME=VALUE")

_DEFAULT_COUNT = 8
"""Default number of powered, and of connected, devices of a random scenario."""


@dataclass(frozen=True)
class ScenarioChoice:
    """The scenario that the options of a command choose.

    Attributes:
        file: a scenario file, or ``None`` for a random scenario.
        powered: number of devices with grid power, of a random scenario.
        connected: number of devices with communication, of a random scenario.
        place: a simulated evacuation whose devices' positions the random scenario has.
        seed: seed of the random scenario and of the volume draws.
        settings: scenario parameters to change, by name.
    """

    file: Path | None
    powered: int
    connected: int
    place: str | None
    seed: int
    settings: dict[str, Any] = field(default_factory=dict)

    def load(self, state: Path | None = None) -> Any:
        """Load the scenario.

        Args:
            state: file of its current state; by default it starts from the initial one.

        Returns:
            The :class:`NamedScenario`.
        """
        from uavmec_jax.scenarios.load import load_scenario

        return load_scenario(
            self.file,
            state=state,
            place=self.place,
            powered=self.powered,
            connected=self.connected,
            seed=self.seed,
            settings=self.settings,
        )

    @property
    def axes(self) -> dict[str, Any]:
        """The random scenario's values on the axes of a study."""
        axes = {"powered": self.powered, "connected": self.connected, "seed": self.seed}
        return axes | ({"place": self.place} if self.place else {})


def scenario_options(*, argument: bool) -> Callable[[Callable], Callable]:
    """Add the options that choose a scenario; the command receives a :class:`ScenarioChoice` as ``scenario``.

    Args:
        argument: whether the file is the argument SCENARIO or the option ``--scenario``.
    """
    path = click.Path(path_type=Path)
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
            "--powered", type=int, help="Number of devices with grid power in a random scenario (default: 8)."
        ),
        click.option(
            "--connected", type=int, help="Number of devices with communication in a random scenario (default: 8)."
        ),
        click.option("--place", help="Evacuation whose devices a random scenario has (see uavmec traffic)."),
        click.option("--seed", type=int, default=0, help="Seed of the random scenario and of the task volumes."),
        set_option(help="Change a parameter of Table 1, e.g. --set uav_battery_j=1e6."),
    )

    def decorate(command: Callable) -> Callable:
        @functools.wraps(command)
        def with_scenario(
            file: Path | None,
            powered: int | None,
            connected: int | None,
            place: str | None,
            seed: int,
            settings: tuple[str, ...],
            **others: Any,
        ) -> Any:
            if file is not None and (powered, connected, place) != (None, None, None):
                raise InputError(
                    f"{file}: a scenario file says which devices have power and communication, and where they are; leave "
                    "out --powered, --connected, --place"
                )
            choice = ScenarioChoice(
                file=file,
                powered=_DEFAULT_COUNT if powered is None else powered,
                connected=_DEFAULT_COUNT if connected is None else connected,
                place=place,
                seed=seed,
                settings=dict(assignment(setting) for setting in settings),
            )
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
            "--workers",
            type=click.IntRange(1, 256),
            default=1,
            help="Number of processes on this machine (default: 1).",
        ),
        click.option(
            "--shard-size", type=click.IntRange(1), help="Most agents in a shard (default: as many as caches hold)."
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
            type=click.FloatRange(0),
            default=default.checkpoint_every_s,
            help=f"Least seconds between two checkpoints (default: {default.checkpoint_every_s:g}).",
        ),
        click.option(
            "--checkpoint-share",
            type=click.FloatRange(0.001, 1),
            default=default.checkpoint_share,
            help=f"Largest share of the time spent on checkpoints (default: {default.checkpoint_share:g}).",
        ),
        click.option(
            "--lease",
            "lease_s",
            type=click.FloatRange(1),
            default=default.lease_s,
            help=f"Seconds until a worker without heartbeat counts as dead (default: {default.lease_s:g}).",
        ),
        click.option("--tensorboard", is_flag=True, help="Also write TensorBoard event files (needs tensorboardX)."),
    )
    return _add_options(command, options)
