"""The command `uavmec`: parse, call, print. The rest of the package does the work; JAX is imported only when needed."""

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from uavmec_jax.cli.advise import advise
from uavmec_jax.cli.common import InputError
from uavmec_jax.cli.machine import doctor
from uavmec_jax.cli.runs import resume, status
from uavmec_jax.cli.scenarios import evaluate, plan
from uavmec_jax.cli.search import search
from uavmec_jax.cli.studies import compare, run, show, validate
from uavmec_jax.cli.traffic import traffic
from uavmec_jax.errors import UserError
from uavmec_jax.files.locations import store_errors


class UavmecGroup(click.Group):
    """A group whose commands report wrong input and failures of the file system in one line."""

    def main(self, *arguments: Any, **options: Any) -> Any:
        """Run the command line; what a terminal or a pipe has no characters for is replaced in what is printed."""
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
                stream.reconfigure(errors="replace")
        return super().main(*arguments, **options)

    def make_context(self, *arguments: Any, **options: Any) -> click.Context:
        """Parse the options of the group itself.

        Raises:
            InputError: there is no such option.
        """
        with _one_line_each():
            return super().make_context(*arguments, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command.

        Raises:
            InputError: a UserError or an OSError ended it, or what an object store could not do; or its arguments are wrong.
        """
        try:
            with _one_line_each(), store_errors():
                return super().invoke(ctx)
        except UserError as error:
            raise InputError(str(error)) from error
        except OSError as error:
            raise InputError(f"{error.filename}: {error.strerror}" if error.filename else str(error)) from error


@contextmanager
def _one_line_each() -> Iterator[None]:
    """Turn click's own errors, which take several lines, into one line.

    Raises:
        InputError: arguments are missing, unknown or wrong.
    """
    try:
        yield
    except click.exceptions.NoArgsIsHelpError:  # a group without a command prints its help
        raise
    except click.UsageError as error:
        hint = f"; see {error.ctx.command_path} --help" if error.ctx else ""
        raise InputError(f"{error.format_message().rstrip('.')}{hint}") from error


@click.group(cls=UavmecGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="uavmec-jax")
def main() -> None:
    """Which device should a rescue UAV serve next, and which will fail first?

    \b
    uavmec run table5 --quick         the paper's Table 5 on this machine, in under a minute
    uavmec run my-study.toml          your own study
    uavmec resume runs/...            resume a run that was stopped or killed
    uavmec status runs/...            the progress of a run
    uavmec search dqn                 better hyperparameters: batches of trials, each batch one program
    uavmec advise my-scenario.toml    which device to visit next, what will fail first; no training needed
    uavmec plan my-scenario.toml      tours for your own devices, what fails first, what to repair
    uavmec show runs/...              the tables of a run
    uavmec traffic show albany        an evacuation, and how much traffic each device sees
    uavmec evaluate runs/...          a policy of a run on one scenario
    uavmec compare runs/a runs/b      two runs, seed by seed
    """


_COMMANDS = (
    *(run, resume, status, search),
    *(advise, plan, evaluate, show, compare, validate, traffic, doctor),
)

for _command in _COMMANDS:
    main.add_command(_command)
