"""Every option of the command line with hostile values; a mark that it was reached stands in for the heavy work."""

import contextlib
import io
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import click
from fuzz_judge import ReachedError, Refused
from fuzz_mutations import NUMBERS, WORDS

from uavmec_jax.cli import main

_HEAVY = (
    "uavmec_jax.runs.run.run_study",
    "uavmec_jax.runs.run.resume_run",
    "uavmec_jax.planning.plan.make_plan",
    "uavmec_jax.scenarios.advice.advise_on",
    "uavmec_jax.studies.policy_evaluation.evaluate_policy",
    "uavmec_jax.search.search.continue_search",
    "uavmec_jax.reporting.compare.overall",
    "uavmec_jax.traffic.build.build_evacuation",
    "uavmec_jax.training.environment_speed.environment_speed",
    "uavmec_jax.reporting.road_map.map_figure",
    "uavmec_jax.reporting.animation.save_animation",
)
"""Functions that train, search, simulate or draw."""

BASE: dict[str, list[list[str]]] = {
    "run": [["tiny.toml"], ["tiny.toml", "--simulate", "--speed", "1e4"], ["table5", "--quick"]],
    "resume": [["young"], ["finished"]],
    "status": [["young"], ["finished", "--json"]],
    "search": [["space.toml"], ["dqn", "--trials", "4"]],
    "advise": [
        ["harbour.toml"],
        ["harbour.toml", "--state", "harbour_state.json"],
        ["--powered", "8"],
        ["village.csv"],
    ],
    "plan": [["harbour.toml"], ["--seed", "3"], ["harbour_fleet.toml"]],
    "evaluate": [
        ["oldest-first"],
        ["weights.npz", "--agent", "seed=0", "--agent", "powered=12"],
        ["finished", "--powered", "12"],
    ],
    "show": [["finished"], ["young"]],
    "compare": [["finished", "finished", "--policy-b", "oldest-first"]],
    "validate": [["tiny.toml"], ["table6", "--json"]],
    "traffic build": [["round_lake.toml"], ["--osm", "osm.xml"], ["--net", "net.xml", "--devices", "devices.toml"]],
    "traffic show": [["albany"], ["round_lake.npz", "--figure", "map.png"], ["albany", "--animation", "a.gif"]],
    "doctor": [[]],
}
"""Valid command lines, by command."""

_WEIGHTS = {"compare": 1, "show": 1, "doctor": 1, "evaluate": 3, "search": 3}
_FILES = (
    *("tiny.toml", "harbour.toml", "village.csv", "space.toml", "devices.toml", "round_lake.toml", "albany.npz"),
    *("weights.npz", "harbour_state.json", "young", "finished", "osm.xml", "net.xml", "new", "new/deeper", "."),
    *("tiny.toml/x", "new.npz", "new.png"),
)
_NAMES = (
    *(
        "steps",
        "axes.seeds",
        "axes.powered",
        "axes.learning_rate",
        "dqn.gamma",
        "a2c.hidden",
        "evaluation.draws",
        "name",
    ),
    *(
        "name.x",
        "params.uav_speed_m_s",
        "params.max_slots",
        "uav_battery_j",
        "uav_speed_m_s",
        "demand.vehicles",
        "seed",
    ),
    *(
        "simulation.seeds",
        "reward",
        "algorithm",
        "powered",
        "network.osm",
        "device",
        "max_slots",
        "n_devices",
        "bigmem",
    ),
)
_VALUES = (
    *("9.68,50.85,9.74,50.885", "nan,nan,nan,nan", "1,2,3", "1,1,1,1", "[" * 20_000, "9" * 5000, "A" * 100_000, "swap"),
    *("auto", "full", "local"),
)
_SETTINGS = (
    *("[1, nan]", "[[1]]", "[" * 20_000, "{a=1}", "[{a=1}]", "[1,1]", '"x"', "true", "[]", "1979-05-27", "a.b.c"),
    *("[0.1, [2]]", "{a.a.a=1}", "1\nb = 2"),
)


def option_names() -> list[str]:
    """Return every option and argument of every command."""
    return [f"{path} {name}" for path, command in _commands(main, "") for name in _parameters(command)]


def _commands(group: click.Group, prefix: str) -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _commands(command, f"{name} ")
        else:
            yield f"{prefix}{name}", command


def _parameters(command: click.Command) -> dict[str, click.Parameter]:
    return {max(parameter.opts, key=len): parameter for parameter in command.params}


def command_line(rng: Random) -> list[str]:
    """Return a mutated command line."""
    commands = dict(_commands(main, ""))
    path = rng.choices(list(commands), [_WEIGHTS.get(name, 6) for name in commands])[0]
    arguments = list(rng.choice(BASE.get(path, [[]])))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name, parameter = rng.choice([*_parameters(commands[path]).items(), ("--no-such", click.Option(["--no-such"]))])
        what = rng.random()
        if what < 0.08 and arguments:
            del arguments[rng.randrange(len(arguments))]
        elif what < 0.2 and arguments:
            arguments[rng.randrange(len(arguments))] = _text(rng, name)
        elif isinstance(parameter, click.Argument):
            arguments.insert(rng.randrange(len(arguments) + 1), _text(rng, name))
        elif getattr(parameter, "is_flag", False) and rng.random() < 0.9:
            arguments.append(name)
        else:
            arguments += [name, _text(rng, name)] if rng.random() < 0.8 else [f"{name}={_text(rng, name)}"]
    return [*path.split(), *arguments]


def _text(rng: Random, name: str) -> str:
    """Return a value for an option."""
    what = rng.random()
    if name in ("--set", "--agent", "--a", "--b", "--resource", "--exit") and what < 0.8:
        return f"{rng.choice(_NAMES)}={_setting(rng)}"
    if what < 0.45:
        return str(rng.choice(NUMBERS))
    if what < 0.75:
        return rng.choice(WORDS)
    if what < 0.9:
        return rng.choice(_FILES)
    return rng.choice(_VALUES)


def _setting(rng: Random) -> str:
    what = rng.random()
    if what < 0.4:
        return str(rng.choice(NUMBERS))
    if what < 0.6:
        return rng.choice(WORDS)
    return rng.choice(_SETTINGS)


def make_options_folder(corpus: Path, folder: Path) -> None:
    """Make the folder in which commands run: single files, a run that is finished and one that is not."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(corpus / "tables", folder)
    for run in ("young", "finished"):
        shutil.copytree(corpus / run, folder / run)


def _reached(name: str) -> Callable[..., Any]:
    def reach(*arguments: Any, **named: Any) -> Any:
        raise ReachedError(name, arguments, {key: part for key, part in named.items() if not callable(part)})

    return reach


def run_command(arguments: list[str]) -> None:
    """Run a command as a shell would.

    Raises:
        Refused: it ended with exit code 2; the argument is its line.
        ReachedError: it came to where the heavy work begins.
        AssertionError: it ended otherwise, or printed something that is no line of its own.
    """
    out, err, code = io.StringIO(), io.StringIO(), None
    with ExitStack() as stack:
        for name in _HEAVY:
            stack.enter_context(mock.patch(name, _reached(name)))
        stack.enter_context(
            mock.patch("uavmec_jax.cluster.connection.connected", return_value=contextlib.nullcontext())
        )
        stack.enter_context(mock.patch.object(sys, "argv", ["uavmec", *arguments]))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        try:
            main(arguments, prog_name="uavmec")
        except SystemExit as ended:
            if ended.code == 2:
                raise Refused(_line(err.getvalue())) from ended.__context__
            code = ended.code
    assert not code, f"exit code {code}: {err.getvalue()[:200]}"


def _line(text: str) -> str:
    """Return the line that says why, without click's reminder of the usage, warnings and the program's name."""
    start = text.find("\nError: ")
    if text.startswith("Usage: ") and start >= 0:
        return text[start + len("\nError: ") :].removesuffix("\n")
    lines = [line for line in text.splitlines() if not line.startswith("uavmec: warning: ")]
    return "\n".join(lines).removeprefix("uavmec: ")
