"""Hyperparameter search: spaces, successive halving, and searches that are stopped."""

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.runs.processes import TINY
from uavmec_jax.errors import StudyError
from uavmec_jax.reporting.search import history_figure, importance_figure, search_json, search_tables
from uavmec_jax.search.confirm import confirm
from uavmec_jax.search.folder import DATABASE
from uavmec_jax.search.halving import SuccessiveHalving
from uavmec_jax.search.search import run_search
from uavmec_jax.search.space import load_space, study_changes
from uavmec_jax.studies.compare import overall, pair
from uavmec_jax.studies.study import load_study
from uavmec_jax.training.training import Trainer

ROOT = Path(__file__).parents[2]
SPACE = """
study = "tiny.toml"
trials = 8
batch = 4
confirm_seeds = 2
[change]
steps = 1500
[validation]
seeds = 2
cells = [[12, 8]]
draws = 3
[halving]
rungs = [0.3]
[space]
learning_rate = { low = 1e-4, high = 1e-1, log = true }
hidden = { choices = [[8], [16, 16]] }
"reward.M" = { low = 0.0, high = 1.0 }
"""


@pytest.fixture
def space(tmp_path, monkeypatch):
    (tmp_path / "tiny.toml").write_text(TINY)
    (tmp_path / "space.toml").write_text(SPACE)
    monkeypatch.chdir(tmp_path)
    return load_space("space.toml")


def states(folder):
    """How many trials in the database of a search are in which state."""
    with closing(sqlite3.connect(folder / DATABASE)) as connection:
        return dict(connection.execute("SELECT state, COUNT(*) FROM trials GROUP BY state").fetchall())


def test_all_trials_of_the_committed_search_have_ended():
    assert states(ROOT / "results" / "search") == {"COMPLETE": 12, "PRUNED": 36, "FAIL": 16}


@pytest.mark.slow
def test_a_stopped_search_continues_to_the_same_result(space, tmp_path):
    whole = run_search(space, tmp_path / "whole", command="x")

    def stop(progress):
        assert progress.batch_trials in (2, 4)
        if progress.trials == 4 and progress.batch_share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_search(space, tmp_path / "stopped", command="x", on_progress=stop)
    again = run_search(space, tmp_path / "stopped", command="x")
    for name in ("trials.csv", "best.toml"):
        assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert again.best == whole.best
    trials = whole.trials
    assert trials["state"].value_counts().to_dict() == {"complete": 4, "pruned": 4}
    assert trials.loc[0, ["learning_rate", "reward.M"]].tolist() == [7e-4, 0.0]
    assert trials.groupby("batch")["hidden"].unique().map(list).tolist() == [["[8]"], ["[16, 16]"]]
    best = load_study(tmp_path / "whole" / "best.toml")
    assert best.a2c.learning_rate == whole.best["learning_rate"]
    assert best.reward == {"U": 1.0, "M": whole.best["reward.M"]}
    assert best.axes["seeds"] == 2  # the reported seeds, not those of the validation scenarios

    # a search that is to have fewer trials after a stop gives up those that were proposed; they can be proposed again
    with pytest.raises(KeyboardInterrupt):
        run_search(space, tmp_path / "fewer", command="x", on_progress=stop)
    fewer = run_search(space.model_copy(update={"trials": 4}), tmp_path / "fewer", command="x")
    assert fewer.trials.equals(trials[:4])
    assert states(tmp_path / "fewer") == {"COMPLETE": 2, "PRUNED": 2, "FAIL": 4}
    rest = run_search(space, tmp_path / "fewer", command="x").trials
    assert rest["number"].tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert rest.drop(columns="number").equals(trials.drop(columns="number"))
    assert states(tmp_path / "fewer") == {"COMPLETE": 4, "PRUNED": 4, "FAIL": 4}

    more = run_search(space.model_copy(update={"trials": 9}), tmp_path / "whole", command="x")
    assert more.trials[:8].equals(trials)
    assert len(search_tables(more)) in (1, 2)
    for figure in (history_figure(more), importance_figure(more)):
        assert figure.axes
    assert json.dumps(search_json(more))
    with pytest.raises(StudyError, match="holds another search"):
        run_search(space.model_copy(update={"batch": 3}), tmp_path / "whole")

    # on scenarios that the search has not seen
    baseline, best = confirm(more, tmp_path / "whole", command="x")
    assert baseline.results.agents["seed"].unique().tolist() == [0, 1]
    gains = best.results.agents["best_lifetime"] - baseline.results.agents["best_lifetime"]
    assert overall(*pair(baseline, best))["difference"][0] == pytest.approx(gains.mean())
    again, _ = confirm(more, tmp_path / "whole")
    assert again.results.agents.shape == baseline.results.agents.shape
    other = replace(more, best=more.best | {"reward.M": 0.123})  # as after more trials
    with pytest.raises(
        StudyError, match=r"best: holds a run of another study, perhaps of earlier settings; move it away$"
    ):
        confirm(other, tmp_path / "whole")

    (tmp_path / "whole" / "trials.db").write_bytes(b"SQLite no more" * 1000)
    with pytest.raises(StudyError, match=r"trials.db: cannot be used: file is not a database"):
        run_search(space, tmp_path / "whole")


@pytest.mark.slow
def test_pruned_trials_do_not_affect_the_others_and_nothing_is_compiled_twice(space, monkeypatch):
    compiled, compile_trainer = [], Trainer.compile
    monkeypatch.setattr(
        Trainer, "compile", lambda *arguments: compiled.append(arguments) or compile_trainer(*arguments)
    )
    trials = [{"learning_rate": rate, "reward.M": 0.0} for rate in (1e-4, 3e-4, 1e-3, 1e30)]
    halving = SuccessiveHalving(space)
    pruned = halving.run(trials)
    assert halving.run(trials) == pruned
    assert len(compiled) == 1  # for both rungs of both batches
    complete = SuccessiveHalving(space.model_copy(update={"halving": type(space.halving)()})).run(trials)
    assert [outcome.value is None for outcome in pruned].count(True) == 2
    assert pruned[3].value is None
    for outcome, reference in zip(pruned, complete, strict=True):
        assert outcome.value in (None, reference.value)
    assert len(pruned[0].rungs) in (1, 2)
    assert np.isfinite([outcome.value for outcome in complete]).all()


def test_the_shipped_space():
    space = load_space("dqn")
    assert space.base().name == "table5"
    assert SuccessiveHalving(space).n_scenarios == 20
    changes = study_changes(space, {"learning_rate": 0.001, "reward.U": 0.5})
    assert changes["dqn.learning_rate"] == 0.001
    assert changes["reward"] == {"U": 0.5, "log A": 1.0, "log O": -1.0}


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "learning_rate =",
            "learningrate =",
            "space.learningrate is not a setting of a2c; did you mean 'learning_rate'?",
        ),
        ('"reward.M"', '"reward.Z"', "space.reward.Z is not a setting of a2c; did you mean"),
        (
            "{ choices = [[8], [16, 16]] }",
            "{ low = 1, high = 5 }",
            "space.hidden has low and high, but shapes the program",
        ),
        ("low = 1e-4, high = 1e-1", "low = 1e-1, high = 1e-4", "space.learning_rate has low 0.1 and high 0.0001"),
        ("low = 1e-4", "low = 0.0", "space.learning_rate has low 0.0 and log = true; give low > 0"),
        ("low = 1e-4", "low = -1.0", "space.learning_rate has low -1.0 and log = true"),
        ("[[8], [16, 16]]", "[[8], [0]]", "space.hidden has [0]; it should be greater than or equal to 1"),
        ("[[8], [16, 16]]", "[[8]]", "space.hidden"),
        (
            "seeds = 2\ncells",
            "first_seed = 1\nseeds = 2\ncells",
            "validation.first_seed is 1: the study reports the scenarios of seed 1",
        ),
        ("[[12, 8]]", "[[13, 8]]", "validation.cells has [13, 8]; give counts from 0 to 12"),
        (
            "rungs = [0.3]",
            "rungs = [0.6, 0.3]",
            "space.toml: halving.rungs is [0.6, 0.3]; give rising shares, each once",
        ),
        ("rungs = [0.3]", "rungs = [0.3, 0.3]", "halving.rungs is [0.3, 0.3]; give rising shares, each once"),
        ("[[8], [16, 16]]", "[[8], [16], [8]]", "space.hidden has [8] twice among its choices; give each once"),
        (
            "high = 1e-1",
            "high = 1e300",
            "space.learning_rate has low 0.0001 and high 1e+300; give low < high, at most 1e+30",
        ),
        ("high = 1.0 }", f"high = 1{'0' * 400} }}", "space.toml: holds a whole number of more than 40 digits"),
        (
            "low = 0.0, high = 1.0",
            "choices = ['a', {b = 1}]",
            "space.reward.M has 'a'; give numbers from -1e+09 to 1e+09",
        ),
        ("low = 0.0, high = 1.0", "choices = [1.0, nan]", "space.reward.M has nan; give numbers from -1e+09 to 1e+09"),
        (SPACE[SPACE.index("learning_rate") :], "", "space.toml: space is empty; give at least one setting to search"),
        ("rungs = [0.3]", "rungs = [1.5]", "halving.rungs: item 1 is 1.5; it should be less than 1"),
        ('"tiny.toml"', '"table6"', "study 'table6' trains 3 algorithms; search one"),
        ('"tiny.toml"', '"none.toml"', "none.toml: neither a study file nor a shipped study"),
        ("trials = 8", "trails = 8", "space.toml: trails is not a setting; did you mean 'trials'?"),
        ("steps = 1500", "stepps = 1500", "stepps is not a setting"),
    ],
)
def test_bad_spaces_are_one_line(space, tmp_path, old, new, line):
    assert old in SPACE
    (tmp_path / "space.toml").write_text(SPACE.replace(old, new))
    with pytest.raises(StudyError) as refused:
        load_space("space.toml")
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


def test_folders_that_cannot_take_a_search(space, tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(StudyError, match="exists and is not an empty folder"):
        run_search(space, tmp_path / "notes")
    with pytest.raises(StudyError, match="exists and is not an empty folder"):
        run_search(space, tmp_path / "tiny.toml")
    with pytest.raises(StudyError, match=r"nowhere: neither a file of a search space nor a shipped one; known: dqn"):
        load_space("nowhere")
