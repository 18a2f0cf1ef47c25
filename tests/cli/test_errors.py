"""Errors of commands: one line on standard error, and an exit code that says what happened."""

import errno
import signal

import click
import pytest
from click.testing import CliRunner

from uavmec_jax.cli import UavmecGroup
from uavmec_jax.cli.common import InputError, Interrupt, assignment
from uavmec_jax.errors import ScenarioError, StudyError


def run(error: Exception):
    """Run a command that raises an error."""

    @click.group(cls=UavmecGroup)
    def group() -> None: ...

    @group.command()
    def fail() -> None:
        raise error

    return CliRunner().invoke(group, ["fail"])


@pytest.mark.parametrize(
    ("error", "exit_code", "line"),
    [
        (InputError("--draws is 0"), 2, "uavmec: --draws is 0"),
        (InputError("two\n  lines"), 2, "uavmec: two lines"),
        (StudyError("a.toml: steps is 0"), 2, "uavmec: a.toml: steps is 0"),
        (ScenarioError("b.csv: no devices"), 2, "uavmec: b.csv: no devices"),
        (OSError(errno.ENOSPC, "No space left on device", "c.npz"), 2, "uavmec: c.npz: No space left on device"),
        (OSError("closed"), 2, "uavmec: closed"),
        (Interrupt("resume with: x", signal.SIGINT), 130, "interrupted: resume with: x"),
        (Interrupt("resume with: x", signal.SIGTERM), 143, "interrupted: resume with: x"),
    ],
    ids=repr,
)
def test_an_expected_error_is_one_line(error, exit_code, line):
    done = run(error)
    assert (done.exit_code, done.stdout, done.stderr) == (exit_code, "", f"{line}\n")


def test_an_unexpected_error_is_not_hidden():
    assert isinstance(run(ZeroDivisionError("a bug")).exception, ZeroDivisionError)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("dqn.gamma=0.99", "dqn.gamma", 0.99),
        ("axes.powered=[8, 4]", "axes.powered", [8, 4]),
        ("algorithm=ppo", "algorithm", "ppo"),
        ("steps=1_000", "steps", 1000),
        (" name = a b ", "name", "a b"),
        ("reward=U+log(A)=x", "reward", "U+log(A)=x"),
    ],
)
def test_an_assignment_is_read_as_toml_or_a_word(text, name, value):
    assert assignment(text) == (name, value)


@pytest.mark.parametrize("text", ["nonsense", "=1", " =1", ""])
def test_an_assignment_needs_a_name_and_a_value(text):
    with pytest.raises(InputError, match=r"give NAME=VALUE, e\.g\. --set dqn\.gamma=0\.99$"):
        assignment(text)
