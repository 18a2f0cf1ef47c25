"""Options that several commands share."""

import functools
from collections.abc import Callable
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
"""Devices with power, and with communication, of a random scenario."""


@dataclass(frozen=True)
class ScenarioChoice:
    """The scenario that the options of a command choose.

    Attributes:
        file: a scenario file, or ``None`` for a random scenario.
        powered, connected: devices with power and with communication, of a random scenario.
        place: where its devices are.
        seed: of the random scenario and the volume draws.
        settings: scenario parameters to change.
    """

    file: Path | None
    powered: int
    connected: int
    place: str | None
    seed: int
    settings: dict[str, Any] = field(default_factory=dict)

    def load(self, state: Path | None = None) -> Any:
        """Load the :class:`NamedScenario`."""
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
        """The values of a random scenario on the axes of studies."""
        axes = {"powered": self.powered, "connected": self.connected, "seed": self.seed}
        return axes | ({"place": self.place} if self.place else {})


def scenario_options(*, argument: bool) -> Callable[[Callable], Callable]:
    """Add the options that choose a scenario; the command gets them as ``scenario``, a :class:`ScenarioChoice`.

    Args:
        argument: whether the file is the argument SCENARIO, or the option ``--scenario``.
    """
    path = click.Path(path_type=Path)
    file = (
        click.argument("file", metavar="SCENARIO", required=False, type=path)
        if argument
        else click.option("--scenario", "file", type=path, help="A scenario file instead of a random scenario.")
    )
    options = (
        file,
        click.option("--powered", type=int, help="Devices with grid power, of a random scenario (default: 8)."),
        click.option("--connected", type=int, help="Devices with communication, of a random scenario (default: 8)."),
        click.option("--place", help="Where the devices of a random scenario are: an evacuation (see uavmec traffic)."),
        click.option("--seed", type=int, default=0, help="Of the random scenario and of the task volumes."),
        set_option(help="Change a number of Table 1."),
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
                    f"{file}: says itself which devices have power and communication, and where they are; leave out "
                    "--powered, --connected, --place"
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

        return functools.reduce(lambda made, option: option(made), reversed(options), with_scenario)

    return decorate


def run_options(command: Callable) -> Callable:
    """Add the options that say how a run is cut, checkpointed and logged."""
    default = RunOptions()
    options = (
        click.option(
            "--workers", type=click.IntRange(1, 256), default=1, help="Processes on this machine (default: 1)."
        ),
        click.option(
            "--shard-size", type=click.IntRange(1), help="Most agents in a shard (default: what caches hold)."
        ),
        click.option(
            "--checkpoint",
            type=click.Choice(CHECKPOINT_KINDS),
            default=default.checkpoint,
            help="Of a shard in training, save everything (it resumes from there) or only weights (it starts again).",
        ),
        click.option(
            "--checkpoint-every",
            "checkpoint_every_s",
            type=click.FloatRange(0),
            default=default.checkpoint_every_s,
            help=f"Least seconds between checkpoints (default: {default.checkpoint_every_s:g}).",
        ),
        click.option(
            "--checkpoint-share",
            type=click.FloatRange(0.001, 1),
            default=default.checkpoint_share,
            help=f"Largest share of the time for checkpoints (default: {default.checkpoint_share:g}): large ones come less often.",
        ),
        click.option(
            "--lease",
            "lease_s",
            type=click.FloatRange(1),
            default=default.lease_s,
            help=f"Seconds without a heartbeat until a worker on another machine counts as dead (default: {default.lease_s:g}).",
        ),
        click.option("--tensorboard", is_flag=True, help="Write TensorBoard event files too (needs tensorboardX)."),
    )
    return functools.reduce(lambda made, option: option(made), reversed(options), command)
