"""First failures and the test of the paper's claim, on made-up results."""

import io

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from rich.console import Console
from scipy import stats

from uavmec_jax.reporting import canvas, figures
from uavmec_jax.reporting.tables import tables
from uavmec_jax.studies.first_failures import (
    first_failure_counts,
    first_failure_groups,
    high_traffic_share,
    place_frames,
    traffic_claims,
)
from uavmec_jax.studies.paper import TABLE7
from uavmec_jax.studies.places import describe_places
from uavmec_jax.studies.population import make_agent_ids
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.statistics import sign_test
from uavmec_jax.studies.study import load_study


@pytest.fixture(scope="module")
def results():
    """Results of ten seeds in which device 2 (high traffic in both places) fails first.

    With a penalty it is device 9, for one slot of lifetime, except for seed 0. The bonus has no effect.
    """
    study = load_study("table7", {"axes.seeds": 10})
    agents = pd.DataFrame(make_agent_ids(study))
    spared = (agents.traffic_penalty > 0) & (agents.seed > 0)
    share = np.zeros((len(agents), 3, 12), np.float32)
    share[np.arange(len(agents)), :, np.where(spared, 8, 1)] = 1
    evaluation, columns = {}, {}
    for policy in ("best", "last", "oldest_first"):
        columns |= {f"{policy}_lifetime": 20.0 - spared, f"{policy}_lifetime_fixed": 20.0}
        evaluation[f"{policy}/first_failure"] = share
    evaluation["rollout/first_failure"] = share[:, :1]
    return Results(
        study=study,
        run={"places": describe_places(study)},
        agents=agents.assign(**columns, rollout_planned=21.0),
        curves={"dqn": {}},
        evaluation=evaluation,
    )


def test_counts_add_up_to_the_scenarios(results):
    counts = first_failure_counts(results)
    assert set(counts["policy"]) == {"best", "last", "oldest_first", "rollout"}
    sums = counts.groupby(["place", "traffic_penalty", "traffic_bonus", "policy"])["count"].sum()
    assert len(sums) == 2 * 4 * 4
    assert_allclose(sums, 10)
    cell = counts.query("place == 'albany' and policy == 'best' and traffic_penalty == 300 and traffic_bonus == 0")
    assert cell.set_index("device")["count"].loc[[2, 9]].tolist() == [1, 9]
    assert cell.set_index("device")["high_traffic"].loc[[2, 9]].tolist() == [True, False]


def test_share_on_devices_in_high_traffic(results):
    share = high_traffic_share(results, "best")
    assert_allclose(share, np.where((results.agents.traffic_penalty > 0) & (results.agents.seed > 0), 0, 1))


def test_the_claim_is_tested_seed_by_seed(results):
    claims = traffic_claims(results).set_index(["policy", "place", "traffic_penalty", "traffic_bonus"])
    assert len(claims) == 2 * 3 * 3
    penalty = claims.loc[("best", "all places", 300.0, 0.0)]
    assert (penalty["fewer"], penalty["more"], penalty["same"]) == (9, 0, 1)
    assert_allclose(penalty["p_value"], 2 / 2**9)
    assert_allclose([penalty["share_without"], penalty["share"], penalty["difference"]], [1, 0.1, -0.9])
    assert penalty["low"] <= -0.9 <= penalty["high"]
    assert_allclose([penalty["g"], penalty["slots"]], [0.5, -0.9])
    bonus = claims.loc[("best", "albany", 0.0, 10.0)]
    assert (bonus["same"], bonus["p_value"], bonus["g"], bonus["difference"]) == (10, 1, 0, 0)


def test_no_claim_without_agents_to_compare_with(results):
    only_penalty = Results(
        study=load_study("table7", {"axes.seeds": 10, "axes.traffic_penalty": [300.0], "axes.traffic_bonus": [0.0]}),
        run=results.run,
        agents=results.agents.query("traffic_penalty > 0 and traffic_bonus == 0").reset_index(drop=True),
        evaluation={name: leaf[:20] for name, leaf in results.evaluation.items()},
    )
    assert traffic_claims(only_penalty).empty


def test_tables_like_the_papers(results):
    console = Console(width=160, record=True, file=io.StringIO())
    by_title = tables(results)
    assert len(by_title) == 4
    for table in by_title.values():
        console.print(table)
    text = console.export_text()
    for words in ("failure 300", "visit 10 + failure 300", "oldest", "paper", "9/0/1", "0.0039", "+0.50"):
        assert words in text
    high = next(line for line in text.splitlines() if line.startswith("│ high"))
    assert [word.strip() for word in high.strip("│").split("│")] == [
        "high", "", "10.0", "10.0", "1.0", "1.0", "10.0", "10.0", "0"
    ]  # fmt: skip


def test_every_cell_of_a_place_has_its_table(results):
    both = pd.concat([results.agents, results.agents.assign(powered=6)], ignore_index=True)
    study = load_study("table7", {"axes.seeds": 10, "axes.cells": [[8, 6], [6, 6]]})
    evaluation = {name: np.concatenate([leaf, leaf]) for name, leaf in results.evaluation.items()}
    twice = Results(study=study, run=results.run, agents=both, curves={"dqn": {}}, evaluation=evaluation)
    assert list(first_failure_groups(twice)) == [
        "round_lake, powered 8", "albany, powered 8", "round_lake, powered 6", "albany, powered 6"
    ]  # fmt: skip
    assert len(tables(twice)) == 1 + 4 + 1
    assert figures.run_figure(twice)
    assert len(place_frames(twice)["claims"]) == 2 * len(traffic_claims(results))
    assert place_frames(Results(study=study, run={})) == {}


def test_a_study_of_places_that_trains_nothing(results):
    study = load_study("table7", {"axes.seeds": 10, "algorithm": "none", "axes.traffic_penalty": [0.0]})
    agents = results.agents.drop(columns=[name for name in results.agents if name.startswith(("best", "last"))])
    evaluation = {name: leaf for name, leaf in results.evaluation.items() if name[:4] not in ("best", "last")}
    untrained = Results(study=study, run=results.run, agents=agents, evaluation=evaluation)
    assert len(tables(untrained)) == 3
    assert figures.run_figure(untrained)


def test_traffic_weights_are_named_where_they_are_no_axes(results):
    rows = (
        (results.agents.traffic_penalty > 0) & (results.agents.traffic_bonus == 0) & (results.agents.place == "albany")
    )
    study = load_study(
        "table7", {"place": "albany", "traffic_penalty": 300.0, "axes": {"cells": [[8, 6]], "seeds": 10}}
    )
    agents = results.agents[rows].drop(columns=["place", "traffic_penalty", "traffic_bonus"]).reset_index(drop=True)
    evaluation = {name: leaf[rows.to_numpy()] for name, leaf in results.evaluation.items()}
    without_axes = Results(study=study, run=results.run, agents=agents, evaluation=evaluation)
    assert set(first_failure_counts(without_axes)["traffic_penalty"]) == {300.0}
    console = Console(width=160, record=True, file=io.StringIO())
    for title, table in tables(without_axes).items():
        assert title.startswith(("Lifetime", "albany: first failures"))
        console.print(table)
    text = console.export_text()
    assert text.count("failure 300") == 2
    assert "none" not in text


def test_the_papers_counts():
    assert {name: sum(counts) for name, counts in TABLE7.items()} == {"round_lake": 30, "albany": 30}


def test_figure(results, tmp_path):
    canvas.save(figures.run_figure(results), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 50_000


def test_sign_test_is_the_exact_one():
    differences = np.array([-1, -1, -0.5, 0, 0.25, -2, 0, -1e-9])
    result = sign_test(differences)
    assert (result.fewer, result.more, result.same) == (4, 1, 3)
    assert_allclose(result.p_value, stats.binomtest(4, 5).pvalue)
    assert_allclose(result.g, 0.3)
    # Under the null hypothesis at most 5 % of exact p-values are below 0.05.
    rng = np.random.default_rng(0)
    p_values = [sign_test(rng.choice([-1.0, 0.0, 1.0], 30)).p_value for _ in range(400)]
    assert np.mean(np.array(p_values) < 0.05) <= 0.06
