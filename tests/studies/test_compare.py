"""Comparisons of runs: pairs, intervals and the measures of rliable."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from uavmec_jax.errors import StudyError
from uavmec_jax.reporting.compare import comparison
from uavmec_jax.studies.compare import (
    Side,
    differences,
    interquartile_mean,
    overall,
    pair,
    probability_of_improvement,
)
from uavmec_jax.studies.population import make_agent_ids
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.study import parse_study

# Scores of two algorithms on four tasks; the tests expect the results of rliable 1.2.0 (metrics.py).
X = np.array([[18, 16, 15, 12], [13, 10, 10, 10], [11, 18, 16, 19], [15, 16, 19, 17], [16, 15, 15, 19]], float)
Y = np.array(
    [[14, 20, 18, 12], [15, 20, 17, 12], [19, 19, 20, 13], [12, 20, 12, 17], [12, 14, 16, 16], [16, 12, 12, 13]], float
)


def test_measures_are_those_of_rliable():
    assert_allclose(interquartile_mean(X.ravel()), 15.4)
    assert_allclose(interquartile_mean(Y.ravel()), 15.083333333333334)
    tasks = lambda a, b: np.mean([probability_of_improvement(a[:, k], b[:, k]) for k in range(4)])  # noqa: E731
    assert_allclose(tasks(X, Y), 0.44166666666666665)
    assert_allclose(tasks(Y, X), 0.5583333333333333)


def fake(text, lifetime, name="fake"):
    """Make results in which the agents have the lifetimes that a function of their identity returns."""
    study = parse_study(text, name)
    agents = pd.DataFrame(make_agent_ids(study))
    return Results(study=study, run={}, agents=agents.assign(best_lifetime=agents.apply(lifetime, axis=1)))


AXES = "[axes]\npowered = [8, 6]\nconnected = [8]\nseeds = 4\n"


def test_paired_differences_by_hand():
    a = fake(AXES, lambda agent: agent["powered"] + agent["seed"], "a")
    b = fake(AXES.replace("seeds = 4", "seeds = [3, 1, 2, 9]"), lambda agent: agent["powered"] + 2 * agent["seed"], "b")
    both, cells = pair(Side(a), Side(b))
    assert cells == ["powered", "connected"]
    assert sorted(both["seed"].unique()) == [1, 2, 3]
    table = differences(both, cells)
    assert table["difference"].tolist() == [2.0, 2.0]  # mean of the seeds 1, 2, 3
    assert ((table["low"] >= 1) & (table["high"] <= 3) & (table["low"] < table["high"])).all()
    aggregates = overall(both, cells)
    assert_allclose(aggregates["difference"][0], 2.0)
    assert aggregates["difference"][1] < 2 < aggregates["difference"][2]
    # 2, 4, 6 against 1, 2, 3: 2 is above 1 and ties with 2; 4 and 6 are above all three
    assert_allclose(aggregates["improvement"][0], (1.5 + 3 + 3) / 9)


def test_one_run_against_itself_by_algorithm():
    both = fake(
        "[axes]\nalgorithm = ['dqn', 'a2c']\npowered = [8]\nconnected = [8]\nseeds = 3\n",
        lambda agent: agent["seed"] + 5 * (agent["algorithm"] == "a2c"),
    )
    tables, data = comparison(Side(both, where={"algorithm": "dqn"}), Side(both, where={"algorithm": "a2c"}))
    assert data["overall"]["difference"]["value"] == 5.0
    assert data["overall"]["improvement"]["value"] == 1.0
    assert len(tables) == 2


def test_sides_that_cannot_be_compared_are_refused():
    a = fake(AXES, lambda agent: 1.0, "a")
    several = fake(AXES + "gamma = [0.9, 0.98]\n", lambda agent: 1.0, "several")
    with pytest.raises(StudyError, match="several agents fit one of the other run; say which of gamma"):
        pair(Side(a), Side(several))
    assert len(pair(Side(a), Side(several, where={"gamma": 0.98}))[0]) == 8
    for side, message in (
        (Side(a, "bset"), "has no policy 'bset'; it has best"),
        (Side(a, where={"colour": 1}), "has no axis 'colour'; it has seed, powered, connected"),
        (Side(a, where={"powered": 12}), "no agent is left"),
        (Side(a, where={"seed": []}), r"seed is \[\]; give one value of this axis"),
        (Side(a, where={"seed": [1, [2]]}), r"seed is \[1, \[2\]\]; give one value of this axis"),
        (Side(a, where={"seed": {"a": 1}}), r"seed is \{'a': 1\}; give one value of this axis"),
    ):
        with pytest.raises(StudyError, match=message):
            pair(a=side, b=Side(a))
    other = fake(AXES.replace("[8, 6]", "[12]"), lambda agent: 1.0, "other")
    with pytest.raises(StudyError, match="no agents in common on seed, powered, connected"):
        pair(Side(a), Side(other))
