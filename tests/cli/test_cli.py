"""The command line, as a user meets it: a subprocess."""

import json
import subprocess
import sys

import pandas as pd
import pytest
from click.testing import CliRunner

from uavmec_jax.cli import main

TOML = """
steps = 400
[axes]
powered = [12, 8]
connected = [8]
seeds = 2
[evaluation]
draws = 4
planners = []
baselines = ["stay-put", "oldest-first"]
"""


def uavmec(*arguments, cwd=None, check=True):
    done = subprocess.run(
        [sys.executable, "-m", "uavmec_jax", *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=300
    )
    assert not check or done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def run_directory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli")
    (folder / "my.toml").write_text(TOML)
    done = uavmec("run", "my.toml", "--out", "out", "--set", "dqn.gamma=0.9", "--steps", "200", cwd=folder)
    return folder / "out", done


HELP = """
import sys
from uavmec_jax.cli import main

def print_help(*path):
    try:
        main([*path, "--help"], prog_name="uavmec")
    except SystemExit as exit:
        assert exit.code == 0

print_help()
for name, command in main.commands.items():
    print_help(name)
    for sub_command in getattr(command, "commands", ()):
        print_help(name, sub_command)
print("imported:", *sorted({name.partition(".")[0] for name in sys.modules}))
"""


def test_help_imports_neither_jax_nor_numpy_nor_pydantic():
    output = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, timeout=60, check=True).stdout
    assert "run table5 --quick" in output
    for command in ("run", "resume", "search", "advise", "plan", "evaluate", "traffic build", "traffic show", "doctor"):
        assert f"Usage: uavmec {command} " in output
    imported = set(output.splitlines()[-1].removeprefix("imported: ").split())
    assert {"click", "uavmec_jax"} <= imported
    assert not imported & {"jax", "jaxlib", "numpy", "pydantic", "pydantic_core", "pandas", "rich", "flax", "optax"}


def test_run_prints_the_tables_and_leaves_the_files(run_directory):
    directory, done = run_directory
    assert "4 agents x 200 steps in 1 shard" in done.stdout
    for words in (
        "Lifetime in slots, `best` weights",
        "`last` weights",
        "First to fail",
        "Mean over 2 cells",
        "Files: out",
    ):
        assert words in done.stdout
    names = {file.name for file in directory.iterdir()}
    assert names == {
        "study.toml", "run.json", "agents.csv", "curves.npz", "evaluation.npz", "weights.npz", "figure.png",
        "run_plan.json", "log",
    }  # fmt: skip
    run = json.loads((directory / "run.json").read_text())
    assert run["command"] == "uavmec run my.toml --out out --set dqn.gamma=0.9 --steps 200"
    assert "gamma = 0.9\n" in (directory / "study.toml").read_text()


def test_show_prints_the_same_tables(run_directory):
    directory, done = run_directory
    shown = CliRunner().invoke(main, ["show", str(directory)])
    table = done.stdout[done.stdout.index("Lifetime") : done.stdout.index("Files:")]
    assert table in shown.stdout
    cells = json.loads(CliRunner().invoke(main, ["show", str(directory), "--json"]).stdout)["cells"]
    assert [(cell["powered"], cell["connected"], cell["seeds"]) for cell in cells] == [(12, 8, 2), (8, 8, 2)]
    assert {"best", "best_low", "best_high", "last", "oldest_first", "best_first_device"} <= cells[0].keys()


@pytest.mark.slow
def test_resolved_study_runs_again(run_directory, tmp_path):
    directory, _ = run_directory
    done = uavmec("run", directory / "study.toml", "--out", tmp_path / "again", "--json")
    first = json.loads(CliRunner().invoke(main, ["show", str(directory), "--json"]).stdout)
    again = json.loads(done.stdout)
    assert again["cells"] == first["cells"]


def test_validate():
    assert (
        "table5: a valid study: 250 agents x 1,000,000 steps" in CliRunner().invoke(main, ["validate", "table5"]).stdout
    )
    assert json.loads(CliRunner().invoke(main, ["validate", "table5", "--json"]).stdout)["steps"] == 1_000_000


@pytest.mark.slow
def test_doctor():
    facts = json.loads(uavmec("doctor", "--json").stdout)
    assert facts["environment_steps_per_second"] > 10_000
    assert facts["devices"]
    assert "libsumo" in facts["versions"]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["run", "tabel5"], "uavmec: tabel5: neither a study file nor a shipped study; did you mean 'table5'?"),
        (["run", "table5", "--seeds", "0"], "uavmec: --seeds is 0; give a whole number from 1"),
        (["run", "table5", "--set", "axes.powered=[13]"], "uavmec: table5: axes.powered has 13; give whole numbers"),
        (
            ["run", "table5", "--set", "reward=U+log(A/0)"],
            "uavmec: table5: reward is 'U+log(A/0)', which is not a reward",
        ),
        (["run", "table5", "--set", "dqn.learning_rate=nan"], "uavmec: table5: dqn.learning_rate is nan"),
        (["run", "table5", "--set", "params.uav_battery_j=-1"], "uavmec: table5: params.uav_battery_j is -1"),
        (["run", "table5", "--set", "nonsense"], "uavmec: --set nonsense: give NAME=VALUE"),
        (
            ["run", "table5", "--set", "steps=2000000000", "--set", "dqn.replay_capacity=2000000000"],
            "uavmec: table5: steps",
        ),
        (["validate", "broken.toml"], "uavmec: broken.toml: not TOML"),
        (["show", "."], "uavmec: .: holds no run"),
        (["evaluate", "oldest-frist"], "uavmec: oldest-frist: neither a file nor a policy by name; did you mean 'old"),
        (["evaluate", "broken.toml"], "uavmec: broken.toml: cannot be read: "),
        (["evaluate", "."], "uavmec: weights.npz: cannot be read: "),
        (["evaluate", "random", "--powered", "13"], "uavmec: powered is 13; give 0 to 12, the number of devices"),
        (
            ["evaluate", "random", "--save", "p.npz", "--draws", "2"],
            "uavmec: --save p.npz: random is a heuristic; only",
        ),
        (["evaluate", "random", "--agent", "seed"], "uavmec: --agent seed: give NAME=VALUE, e.g. algorithm=dqn"),
        (["compare", ".", "."], "uavmec: .: holds no run"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, arguments, line):
    (tmp_path / "broken.toml").write_text("steps = = 1")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith(line)
    assert done.stderr.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["broken.toml"]  # nothing was written


@pytest.mark.slow
def test_bad_input_from_a_subprocess(tmp_path):
    done = uavmec("run", "table5", "--set", "axes.connected=[13]", cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == (
        "uavmec: table5: axes.connected has 13; give whole numbers from 0 to 12, the number of devices\n"
    )
    assert not list(tmp_path.iterdir())


def test_folder_with_a_run_is_refused(run_directory):
    directory, _ = run_directory
    done = CliRunner().invoke(main, ["run", "table5", "--out", str(directory)])
    assert (done.exit_code, done.stderr) == (
        2,
        f"uavmec: {directory}: already holds a run; resume it with `uavmec resume`, or give another folder with --out\n",
    )


def test_evaluate_an_agent_of_a_run(run_directory, tmp_path):
    directory, _ = run_directory
    scenario = ["--powered", "12", "--connected", "8", "--seed", "1", "--draws", "4"]
    saved = ["--save", str(tmp_path / "policy.npz")]
    data = json.loads(CliRunner().invoke(main, ["evaluate", str(directory), *scenario, *saved, "--json"]).stdout)
    assert data["trained_on"] == {"seed": 1, "powered": 12, "connected": 8}
    trained, oldest, _ = data["policies"]
    agents = pd.read_csv(directory / "agents.csv").query("seed == 1 and powered == 12")
    assert trained["mean"] == agents["best_lifetime"].item()
    assert oldest["mean"] == agents["oldest_first_lifetime"].item()
    again = CliRunner().invoke(main, ["evaluate", str(tmp_path / "policy.npz"), *scenario]).stdout
    assert "Trained by DQN on seed 1, powered 12, connected 8." in again
    assert "another scenario" not in again
    elsewhere = CliRunner().invoke(main, ["evaluate", str(tmp_path / "policy.npz"), "--draws", "4"]).stdout
    assert "another scenario" in elsewhere
    missing = CliRunner().invoke(main, ["evaluate", str(directory), "--seed", "9"])
    assert missing.exit_code == 2
    assert missing.stderr.endswith("none of the 4 agents has powered=8, connected=8, seed=9\n")


def test_compare_a_run_with_itself(run_directory):
    directory = str(run_directory[0])
    data = json.loads(CliRunner().invoke(main, ["compare", directory, directory, "--json"]).stdout)
    assert data["overall"]["difference"]["value"] == 0
    assert data["overall"]["improvement"]["value"] == 0.5
    shown = CliRunner().invoke(main, ["compare", directory, directory, "--policy-b", "oldest-first"]).stdout
    assert "probability that B lives longer than A" in shown
    bad = CliRunner().invoke(main, ["compare", directory, directory, "--policy-b", "bset"])
    assert (bad.exit_code, bad.stderr) == (
        2,
        "uavmec: my: has no policy 'bset'; it has best, last, stay-put, oldest-first\n",
    )
