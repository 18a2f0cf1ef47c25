"""What commands print: nothing that a terminal would obey, and what an encoding has no characters for is replaced."""

import io
import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from tests.scenarios.test_scenario_files import EXAMPLES
from uavmec_jax.cli import main
from uavmec_jax.cli.common import command_line, warn
from uavmec_jax.cli.console import new_console


def test_a_warning_is_one_line(capsys):
    warn("far\n\x1b[31m" + "x" * 1000)
    error = capsys.readouterr().err
    assert error.startswith(r"uavmec: warning: far \x1b[31mxxx")
    assert error.count("\n") == 1


def test_the_label_of_a_run_is_utf8(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["uavmec", "run", os.fsdecode(b"\xff")])
    assert command_line() == r"uavmec run \udcff"


def printed(print_on):
    """Return what a command's console prints on a terminal of 100 columns."""
    console = new_console()
    console.file, console.width = io.StringIO(), 100
    print_on(console)
    return console.file.getvalue()


NASTY = "[bold red]quay[/] :boom: [/nothing] \x1b[31m\x07 \N{RIGHT-TO-LEFT OVERRIDE}x"
SHOWN = r"[bold red]quay[/] :boom: [/nothing] \x1b[31m\x07 \u202ex"


def test_what_users_wrote_is_neither_markup_nor_an_order_to_the_terminal():
    from rich.table import Table

    table = Table(NASTY)
    table.add_row(NASTY)
    assert printed(lambda console: console.print(table)).count(SHOWN) == 2
    assert printed(lambda console: console.print(NASTY, style="bold")) == f"{SHOWN}\n"
    assert printed(lambda console: console.print_heading(NASTY, NASTY, soft_wrap=True)) == f"{SHOWN}: {SHOWN}\n"
    assert printed(lambda console: console.print("two\nlines", highlight=False)) == "two\nlines\n"


@pytest.mark.slow
def test_markup_in_the_names_of_a_scenario_is_printed_as_it_is(tmp_path):
    text = (EXAMPLES / "harbour.toml").read_text().replace('"quay"', '"[/q] :boom:"', 1)
    text = text if "[/q]" in text else text.replace('name = "', 'name = "[/q] ', 2)
    (tmp_path / "s.toml").write_text(text)
    command = ["plan", str(tmp_path / "s.toml"), "--draws", "1", "--width", "2", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "[/q]" in done.stdout
    advised = CliRunner().invoke(main, ["advise", str(tmp_path / "s.toml"), "--samples", "2", "--no-what-if"])
    assert advised.exit_code == 0, advised.output
    assert "[/q]" in advised.stdout


LODZ = """name,lon,lat,type,task,capacity_j,power,comms
Świętokrzyska cam,19.4560,51.7592,Firefly,HAAR,60000,no,no
Διόδια κάμερα,19.4590,51.7610,Firefly,DNN,60000,no,yes
plac Wolności,19.4550,51.7770,Firefly,HAAR,60000,no,no
"""


def in_encoding(encoding, *arguments, cwd):
    """Run the command with an output that is not UTF-8; return its output as bytes."""
    environment = os.environ | {"PYTHONIOENCODING": encoding, "COLUMNS": "160"}
    command = [sys.executable, "-m", "uavmec_jax", *arguments]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    return done.stdout


@pytest.mark.slow
def test_a_tour_is_printed_where_its_names_have_no_characters(tmp_path):
    (tmp_path / "lodz.csv").write_text(LODZ, encoding="utf-8")
    output = in_encoding("cp1252", "plan", "lodz.csv", "--draws", "1", "--width", "2", "--out", "p", cwd=tmp_path)
    assert "?wi?tokrzyska cam" in output.decode("cp1252")
    assert json.loads((tmp_path / "p" / "tour.json").read_text(encoding="utf-8"))


def test_an_evacuation_is_printed_in_ascii(tmp_path):
    assert "albany: Downtown Albany" in in_encoding("ascii", "traffic", "show", "albany", cwd=tmp_path).decode("ascii")


def test_what_a_refused_command_writes_has_no_bytes_that_cannot_be_shown(tmp_path):
    environment = os.environ | {"PYTHONIOENCODING": "ascii:strict"}
    command = [sys.executable, "-m", "uavmec_jax", "validate", "Świt"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(rb"uavmec: \u015awit: neither a study file nor a shipped study")
