"""Options and arguments: what is out of bounds, cannot be read or would be ignored is refused in one line."""

import json
import os
import re
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from tests.scenarios.test_scenario_files import EXAMPLES
from uavmec_jax.cli import main, options
from uavmec_jax.cli.common import InputError, assignment, assignments
from uavmec_jax.env.fleet import MAX_UAVS
from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.errors import MAX_MESSAGE
from uavmec_jax.scenarios.settings import ParamsSettings

HARBOUR = str(EXAMPLES / "harbour.toml")
SIMULATE = ("run", "table5", "--simulate")


@pytest.fixture
def refused(tmp_path, monkeypatch):
    """A function that runs a command in an empty folder; it returns the only line, and nothing is written."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        done = CliRunner().invoke(main, list(arguments))
        assert (done.exit_code, done.stdout) == (2, ""), done.output
        assert not list(tmp_path.iterdir())
        line = done.stderr.removesuffix("\n")
        assert len(line) <= MAX_MESSAGE
        assert line.isprintable()
        return line.removeprefix("uavmec: ")

    return run


@pytest.mark.parametrize("speed", ["0", "nan", "inf", "1e-320", "-1", "1e300"])
def test_a_speed_is_a_number_within_bounds(refused, speed):
    assert refused(*SIMULATE, "--speed", speed) == f"--speed is {speed}; give a number from 0.001 to 1e+12"


@pytest.mark.parametrize("devices", ["0", "-3", "1000001"])
def test_devices_are_counted_from_1(refused, devices):
    line = f"--devices is {devices}; give a whole number from 1 to 1000000"
    assert refused(*SIMULATE, "--speed", "1000", "--devices", devices) == line


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("run", "table5", "--checkpoint-every", "nan"), "--checkpoint-every is nan; give a number from 0 to 31,536,000"),
        (("run", "table5", "--checkpoint-every", "inf"), "--checkpoint-every is inf; give a number from 0 to 31,536,000"),
        (("run", "table5", "--checkpoint-share", "nan"), "--checkpoint-share is nan; give a number from 0.001 to 1"),
        (("run", "table5", "--shard-size", "0"), "--shard-size is 0; give a whole number from 1 to 1000000000"),
        (("run", "table5", "--ray", "local", "--time-limit", "nan"), "--time-limit is nan; give a number from 1 to"),
        (("run", "table5", "--ray", "local", "--retries", "-1"), "--retries is -1; give a whole number from 0 to 1000"),
        (("run", "table5", "--resource", "a=inf", "--ray"), "--resource a=inf: the amount must be a positive number"),
        (("run", "table5", "--resource", "a=nan", "--ray"), "--resource a=nan: the amount must be a positive number"),
        (("run", "table5", "--seeds", "1.5"), "--seeds is '1.5'; give a whole number from 1 to 2147483647"),
        (("run", "table5", "--steps", "2000000001"), "--steps is 2000000001; give a whole number from 1 to 2000000000"),
        (("search", "dqn", "--trials", "0"), "--trials is 0; give a whole number from 1 to 100000"),
        (("advise", "--price", "nan"), "--price is nan; give a number from 0 to 1,000,000,000"),
        (("advise", "--samples", "1"), "--samples is 1; give a whole number from 2 to 100000"),
        (("plan", "--seed", "-1"), "--seed is -1; give a whole number from 0 to 2147483647"),
        (("plan", "--uavs", "101"), "--uavs is 101; give a whole number from 1 to 100"),
        (("plan", "--width", "x"), "--width is 'x'; give a whole number from 1 to 100000"),
        (("traffic", "build", "albany", "--vehicles", "0"), "--vehicles is 0; give a whole number from 1 to 1000000"),
        (("traffic", "build", "albany", "--seeds", "-1"), "--seeds is -1; give a whole number from 1 to 1000"),
        (("traffic", "show", "albany", "--powered", "1001"), "--powered is 1001; give a whole number from 0 to 1000"),
    ],
    ids=lambda value: " ".join(value[1:]) if isinstance(value, tuple) else "",
)  # fmt: skip
def test_a_number_out_of_bounds_is_refused(refused, arguments, line):
    assert refused(*arguments).startswith(line)


def test_bounds_of_lower_rooms():
    assert (options.MAX_DEVICES, options.MAX_UAVS) == (MAX_DEVICES, MAX_UAVS)


PATHS = [
    ("run", "{}"),
    ("run", "table5", "--out", "{}"),
    ("resume", "{}"),
    ("status", "{}"),
    ("show", "{}"),
    ("compare", "{}", "b"),
    ("validate", "{}"),
    ("search", "{}"),
    ("search", "dqn", "--out", "{}"),
    ("plan", "{}"),
    ("plan", "--out", "{}"),
    ("plan", "--place", "{}"),
    ("advise", "{}"),
    ("advise", "--state", "{}"),
    ("advise", "--policy", "{}"),
    ("advise", "--place", "{}"),
    ("evaluate", "{}"),
    ("evaluate", "random", "--scenario", "{}"),
    ("evaluate", "random", "--save", "{}"),
    ("evaluate", "random", "--place", "{}"),
    ("traffic", "build", "{}"),
    ("traffic", "build", "--osm", "{}"),
    ("traffic", "build", "--net", "{}"),
    ("traffic", "build", "albany", "--devices", "{}"),
    ("traffic", "build", "albany", "--out", "{}"),
    ("traffic", "show", "{}"),
    ("traffic", "show", "albany", "--figure", "{}"),
    ("traffic", "show", "albany", "--animation", "{}"),
    ("traffic", "show", "albany", "--animation", "x.gif", "--policy", "{}"),
]
"""Every argument and option that names a file."""


@pytest.mark.parametrize("arguments", PATHS, ids=" ".join)
def test_what_cannot_be_a_path_is_refused(refused, arguments):
    def line(path):
        return refused(*(path if argument == "{}" else argument for argument in arguments))

    assert line("a\0b.toml").endswith(r"is 'a\x00b.toml'; it contains a NUL character, which no path can contain")
    assert line("").endswith("is empty; give a path or a name")
    assert "it has 100,000 bytes; a path has at most 4,095" in line("x" * 100_000)
    assert "and each name in it at most 255" in line("ä" * 128)
    assert "holds bytes that are not UTF-8" in line(os.fsdecode(b"\xff.toml"))


def test_every_option_that_names_a_file_is_tested():
    """No option has a type that takes NaN, numbers without bounds, or paths that are none."""

    def params(command, path):
        for name, inner in getattr(command, "commands", {}).items():
            yield from params(inner, (*path, name))
        yield from ((path, param) for param in command.params)

    bounded = (click.IntRange, click.FloatRange, options.LocalPath, options.NameOrPath, options.FolderOfRun)
    for path, param in params(main, ()):
        assert type(param.type) not in (click.Path, *map(type, (click.INT, click.FLOAT))), (path, param)
        assert type(param.type) not in bounded[:2], (path, param)
        if isinstance(param.type, bounded[2:]):
            known = [command for command in PATHS if command[: len(path)] == path]
            assert any(not isinstance(param, click.Option) or param.opts[0] in command for command in known), (
                path,
                param,
            )


IGNORED = [
    (("run", "table5", "--speed", "1000"), "--speed is only for --simulate; leave it out"),
    (("run", "table5", "--devices", "2"), "--devices is only for --simulate; leave it out"),
    ((*SIMULATE, "--speed", "9", "--out", "x"), "--out has no meaning with --simulate, which runs nothing; leave it out"),
    ((*SIMULATE, "--speed", "9", "--tensorboard"), "--tensorboard has no meaning with --simulate, which runs nothing"),
    ((*SIMULATE, "--ray", "local", "--retries", "1"), "--retries has no meaning with --simulate, which runs nothing"),
    ((*SIMULATE, "--ray", "local", "--time-limit", "9"), "--time-limit has no meaning with --simulate"),
    ((*SIMULATE, "--ray", "local", "--resource", "a=1"), "--resource has no meaning with --simulate"),
    (("run", "planning", "--steps", "9"), "--steps is about training, and planning trains nothing; leave it out"),
    (("run", "planning", "--checkpoint", "weights"), "--checkpoint is about training, and planning trains nothing"),
    (("run", "planning", "--checkpoint-every", "9"), "--checkpoint-every is about training, and planning trains nothing"),
    (("run", "planning", "--checkpoint-share", "0.1"), "--checkpoint-share is about training, and planning trains"),
    (("run", "planning", "--tensorboard"), "--tensorboard is about training, and planning trains nothing"),
    (("run", "planning", "--simulate", "--speed", "9"), "--speed is about training, and planning trains nothing"),
    (("run", "table5", "--seeds", "2", "--set", "axes.seeds=3"), "--seeds is 2, and --set axes.seeds is given too; leave"),
    (("run", "table5", "--steps", "2", "--set", "steps=3"), "--steps is 2, and --set steps is given too; leave one of them"),
    (("run", "table5", "--set", "steps=2", "--set", "steps=3"), "--set steps: is given twice; give it once"),
    (("run", "table5", "--ray", "--resource", "a=1", "--resource", "a=2"), "--resource a: is given twice; give it once"),
    (("resume", "x", "--gpus-per-shard", "1"), "--cpus-per-shard, --gpus-per-shard, --resource, --retries and --time-limit"),
    (("compare", "a", "b", "--a", "seed=1", "--a", "seed=2"), "--a seed: is given twice; give it once"),
    (("evaluate", "random", "--weights", "best"), "--weights is only for the agents of a run, and random is a heuristic"),
    (("evaluate", "rollout", "--agent", "seed=1"), "--agent is only for the agents of a run, and rollout is a heuristic"),
    (("evaluate", "generalist", "--weights", "last"), "--weights last: generalist has only best weights; leave it out"),
    (("plan", "--place", "albany", "--set", "n_devices=5"), "--set n_devices: the place of --place gives it; leave it out"),
    (("plan", "--place", "albany", "--set", "region_m=[9.0,9.0]"), "--set region_m: the place of --place gives it"),
    (("plan", HARBOUR, "--uavs", "2"), f"{HARBOUR}: a scenario file says which UAVs and depots there are; leave out"),
    (("plan", "--set", "end=horizon", "--width", "9"), "--width is the beam's, which is only for end = 'first_failure'"),
    (("plan", "--set", "horizon_s=9.0"), "--set horizon_s: is only for end = 'horizon'; leave it out, or add --set end="),
    (("advise", HARBOUR, "--set", "end_share=0.5"), "--set end_share: is only for end = 'horizon'; leave it out"),
    (("traffic", "show", "albany", "--policy", "random"), "--policy is only for --animation; leave it out"),
    (("traffic", "show", "albany", "--powered", "3"), "--powered is only for --animation; leave it out"),
    (("traffic", "show", "albany", "--connected", "3"), "--connected is only for --animation; leave it out"),
    (("traffic", "show", "albany", "--seed", "3"), "--seed is only for --animation; leave it out"),
    (("traffic", "build", "albany", "--bbox", "1,1,2,2"), "--bbox 1,1,2,2: cuts an OpenStreetMap extract; give --osm too"),
    (
        ("traffic", "build", "albany", "--vehicles", "9", "--set", "demand.vehicles=8"),
        "--set demand.vehicles: an option gives it too; leave one of them out",
    ),
    (("traffic", "build", "albany", "--exit", "a=1", "--exit", "a=2"), "--exit a: is given twice; give it once"),
    (("traffic", "build", "--osm", "x.osm", "--set", "network.net=y"), "--set network.net: --osm gives the network; leave"),
    (("traffic", "build", "albany", "--set", "devices.count=3"), "--set devices.count: is for devices that no file lists"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "line"), IGNORED, ids=lambda value: value if isinstance(value, str) else "")
def test_an_option_that_would_be_ignored_is_refused(refused, arguments, line):
    assert refused(*arguments).startswith(line)


def test_a_study_without_training_is_simulated_without_a_speed():
    done = CliRunner().invoke(main, ["run", "planning", "--simulate", "--json"])
    assert json.loads(done.stdout)["training_s"] == 0


def test_the_table_of_a_set_is_one_of_the_place(refused):
    line = refused("traffic", "build", "albany", "--set", "name.x=1")
    assert line.startswith(
        "--set name.x: name a table and a setting, e.g. demand.vehicles=2000; tables: network, demand"
    )
    assert refused("run", "table5", "--set", "name.x=1").startswith("table5: name is {'x': 1}; it should be text")


@pytest.mark.parametrize(
    "value",
    ["[" * 20_000, "[" * 20_000 + "]" * 20_000, "9" * 5000, "{x=" * 500 + "1" + "}" * 500, "{" + ".".join("x" * 500) + "=1}"],
    ids=["brackets", "closed brackets", "digits", "tables", "dotted"],
)  # fmt: skip
@pytest.mark.parametrize("option", ["--set", "--agent", "--resource", "--a"])
def test_a_value_that_is_too_deep_or_too_long_is_refused(option, value):
    with pytest.raises(InputError) as caught:
        assignment(f"steps={value}", option)
    assert re.match(rf"{option} steps: the value: (is nested too deep|.*more than 40 digits$)", caught.value.message)


@pytest.mark.parametrize("text", ["x" * 1_000_000 + "=1", "steps=" + "x" * 1_000_000, ".".join("a" * 20_000) + "=1"])
def test_a_huge_setting_is_refused(refused, text):
    line = refused("run", "table5", "--set", text)
    assert "is too long; a name has at most 200 characters" in line or "characters; give at most 100000" in line


def test_a_setting_that_is_not_utf8_is_refused(refused):
    text = os.fsdecode(b"description=\xff")
    assert refused("run", "table5", "--set", text) == (
        r"--set description=\udcff: holds bytes that are not UTF-8; give it in UTF-8"
    )


def test_a_value_cannot_bring_other_settings():
    assert assignment("steps=1\nseeds = 2") == ("steps", "1\nseeds = 2")
    assert assignments(["a=1", "b=[2, {c = 3}]"]) == {"a": 1, "b": [2, {"c": 3}]}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("x" * 100_000,), "No such command 'xxx"),
        (("\x1b]0;title\x07",), r"No such command '\x1b]0;title\x07'; see uavmec --help"),
        (("--" + "x" * 100_000,), "No such option '--xxx"),
        (("run", "table5", "--\x1b[31m\nx"), r"No such option '--\x1b[31m\nx'; see uavmec run --help"),
        (("run", "table5", "\x1b[2J" * 1000), "Got unexpected extra argument"),
        (("run", "\x1b[2J"), r"\x1b[2J: neither a study file nor a shipped study"),
        (("run",), "Missing argument 'STUDY'; see uavmec run --help"),
        (("run", "table5", "--checkpoint", "\x1b" * 5000), "Invalid value for '--checkpoint'"),
        (("show", "x" * 200 + "/" + "y" * 200), "holds no run"),
        (("traffic", "frob"), "No such command 'frob'; see uavmec traffic --help"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_a_usage_error_is_one_short_printable_line(refused, monkeypatch, arguments, words):
    monkeypatch.setattr(main, "name", "uavmec")
    assert words in refused(*arguments)


def test_help_without_a_command_is_whole():
    done = CliRunner().invoke(main, ["traffic"])
    assert "Simulate evacuations" in done.output
    assert done.output.count("\n") > 10


def test_a_file_error_of_the_system_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir(mode=0o500)
    monkeypatch.setattr(
        Path, "is_file", lambda path: (_ for _ in ()).throw(OSError(36, "File name too long", "y" * 9000))
    )
    done = CliRunner().invoke(main, ["validate", "x"])
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert len(done.stderr) <= MAX_MESSAGE + 1


def impossible_parameters():
    """Yield every parameter with every value that it cannot have."""
    none = {"1e-300", "0.0"}
    may = {"noise_power_dbm": none | {"-1.0"}, "reference_gain_db_at_1m": none | {"-1.0"}}  # in dB
    may |= {"uav_flying_power_w": none, "uav_altitude_m": none, "result_message_bytes": none, "end_share": none}
    may |= {"uplink_rate_bit_s": {"1e300", "inf"}, "region_m": none}
    for name, field in ParamsSettings.model_fields.items():
        for value in ("1e-300", "1e300", "nan", "inf", "0.0", "-1.0"):
            if value not in may.get(name, ()):
                yield name, f"[{value}, {value}]" if isinstance(field.default, tuple) else value


@pytest.mark.parametrize(("name", "value"), list(impossible_parameters()))
def test_a_parameter_beyond_float32_is_refused_before_there_is_a_folder(refused, name, value):
    line = refused("run", "table5", "--set", f"params.{name}={value}", "--out", "x")
    assert line.startswith(f"table5: params.{name}")


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("evaluation.planner_draws=33", "evaluation.planner_draws is 33; give at most evaluation.draws, which is 32"),
        ("reward={U = 1e300}", "reward.U is 1e+300; give a number from -1e+09 to 1e+09"),
        ("axes.traffic_bonus=[1e300]", "axes.traffic_bonus has 1e+300; give numbers from 0 to 1e+09"),
        ("slot_reward=1e300", "slot_reward is 1e+300; it should be less than or equal to 1000000000"),
        ("place_scale_m=1e-300", "place_scale_m is 1e-300; it should be greater than or equal to 1"),
        ("dqn.target_interval=99999999999", "dqn.target_interval is 99999999999; it should be less than or equal to"),
        ("dqn.learning_starts=99999999999", "dqn.learning_starts is 99999999999; it should be less than or equal to"),
        ("axes.algorithm=[{a = 1}]", "axes.algorithm has {'a': 1}; known: dqn"),
        ("axes.guard=[[1]]", "axes.guard has [1]; known: clamp"),
        ("axes.learning_rate=[{}]", "axes.learning_rate has {}; it should be a number"),
        ("axes.cells=[[[1], 2]]", "axes.cells is given, and axes.powered"),
    ],
)
def test_a_setting_of_a_study_that_cannot_be_is_refused(refused, setting, line):
    assert refused("run", "table5", "--set", setting).startswith(f"table5: {line}")
