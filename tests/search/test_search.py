"""Hyperparameter search: spaces, batches with halving, and searches that are stopped."""

import json

import numpy as np
import pytest

from tests.runs.processes import TINY
from uavmec_jax.errors import StudyError
from uavmec_jax.reporting.search import history_figure, importance_figure, search_json, search_tables
from uavmec_jax.search.confirm import confirm
from uavmec_jax.search.halving import SuccessiveHalving
from uavmec_jax.search.search import search
from uavmec_jax.search.space import load_space, settings_of
from uavmec_jax.studies.compare import overall, pair
from uavmec_jax.studies.study import load_study

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


@pytest.mark.slow
def test_a_search_that_is_stopped_ends_as_one_that_is_not(space, tmp_path):
    whole = search(space, tmp_path / "whole", command="x")

    def stop(news):
        if news.trials == 4 and news.share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(space, tmp_path / "stopped", command="x", on_progress=stop)
    again = search(space, tmp_path / "stopped", command="x")
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
    assert best.axes["seeds"] == 2  # those that are reported, not those of the search

    more = search(space.model_copy(update={"trials": 9}), tmp_path / "whole", command="x")
    assert more.trials[:8].equals(trials)
    assert len(search_tables(more)) in (1, 2)
    for figure in (history_figure(more), importance_figure(more)):
        assert figure.axes
    assert json.dumps(search_json(more))
    with pytest.raises(StudyError, match="holds another search"):
        search(space.model_copy(update={"batch": 3}), tmp_path / "whole")

    # on towns that the search has not seen
    own, best = confirm(more, tmp_path / "whole", command="x")
    assert own.results.agents["seed"].unique().tolist() == [0, 1]
    lives = [side.results.agents["best_lifetime"].to_numpy() for side in (own, best)]
    assert overall(*pair(own, best))["difference"][0] == pytest.approx((lives[1] - lives[0]).mean())
    again, _ = confirm(more, tmp_path / "whole")
    assert again.results.agents.shape == own.results.agents.shape

    (tmp_path / "whole" / "trials.db").write_bytes(b"SQLite no more" * 1000)
    with pytest.raises(StudyError, match=r"trials.db: cannot be read: file is not a database"):
        search(space, tmp_path / "whole")


@pytest.mark.slow
def test_those_that_go_on_are_not_changed_by_those_that_are_given_up(space):
    trials = [{"learning_rate": rate, "reward.M": 0.0} for rate in (1e-4, 3e-4, 1e-3, 1e30)]
    halved = SuccessiveHalving(space).run(trials)
    whole = SuccessiveHalving(space.model_copy(update={"halving": type(space.halving)()})).run(trials)
    assert [outcome.value is None for outcome in halved].count(True) == 2
    assert halved[3].value is None
    for one, other in zip(halved, whole, strict=True):
        assert one.value in (None, other.value)
    assert len(halved[0].rungs) in (1, 2)
    assert np.isfinite([outcome.value for outcome in whole]).all()


def test_the_shipped_space():
    space = load_space("dqn")
    assert space.base().name == "table5"
    assert SuccessiveHalving(space).towns == 20
    changes = settings_of(space, {"learning_rate": 0.001, "reward.U": 0.5})
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
        ("seeds = 2\ncells", "first_seed = 1\nseeds = 2\ncells", "validation.first_seed is 1: town 1 is one that"),
        ("[[12, 8]]", "[[13, 8]]", "validation.cells has [13, 8]; give counts from 0 to 12"),
        ("rungs = [0.3]", "rungs = [1.5]", "halving.rungs.0 is 1.5; it should be less than 1"),
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
    with pytest.raises(StudyError, match="is not empty and holds no search"):
        search(space, tmp_path / "notes")
    with pytest.raises(StudyError, match="exists and is not a folder"):
        search(space, tmp_path / "tiny.toml")
    with pytest.raises(StudyError, match=r"nowhere: neither a file of a search space nor a shipped one; known: dqn"):
        load_space("nowhere")
