"""A small part of the fuzz campaign, and its parts: mutations, seals and verdicts that are known."""

import json
from random import Random

import fuzz_judge
import fuzz_mutations
import numpy as np
import pytest
from fuzz_archives import mutate_archive
from fuzz_judge import ReachedError, judge

from tests.experiments.scripts import run
from uavmec_jax.errors import UserError
from uavmec_jax.files.archives import read_checked, write_checked


def raises(error):
    def load():
        raise error

    return load


@pytest.mark.parametrize(
    ("load", "outcome", "what"),
    [
        (lambda: {"a": [1.0, np.ones(2)]}, "accepted", ""),
        (lambda: {"pads": float("inf")}, "accepted", ""),
        (lambda: {"a": np.array([1.0, float("nan")])}, "failure", "not finite"),
        (lambda: {"weight": float("inf")}, "failure", "not finite"),
        (lambda: np.ones(2, complex), "failure", "not finite"),
        (raises(ReachedError(1.0)), "accepted", ""),
        (raises(UserError("x.toml: a is 1; give 2")), "refused", ""),
        (raises(ValueError("x")), "failure", "traceback"),
        (raises(fuzz_judge.Refused("a\nb")), "failure", "message"),
        (raises(fuzz_judge.Refused("a" * 401)), "failure", "message"),
        (raises(fuzz_judge.Refused("a\x1b")), "failure", "message"),
    ],
)
def test_verdicts(tmp_path, load, outcome, what):
    verdict = judge(load, tmp_path)
    assert (verdict.outcome, verdict.what) == (outcome, what)


def test_a_refusal_that_writes_is_a_failure(tmp_path):
    def load():
        (tmp_path / "half").write_text("x")
        raise UserError("no")

    assert judge(load, tmp_path).what == "written"


def test_a_hang_is_a_failure(tmp_path):
    def load():
        while True:
            pass

    assert judge(load, tmp_path, hang_s=0.2).what == "hang"


def test_what_must_be_refused_and_is_not_is_a_failure(tmp_path):
    assert judge(lambda: 1.0, tmp_path, must_refuse="speed is -1").what == "nonsense"


def test_an_input_is_made_of_its_number_alone(tmp_path):
    seeds = [b'[a]\nb = [1.0, 2.0]\nc = "x"\n']
    first, again = ([fuzz_mutations.mutate_toml(Random(f"0/{k}"), seeds) for k in range(50)] for _ in range(2))
    assert first == again
    assert len(set(first)) > 30


def test_an_archive_that_is_changed_is_sealed_again(tmp_path):
    path = tmp_path / "a.npz"
    write_checked(path, 1, {"names": ["x"]}, {"a": np.ones(3), "b": np.zeros((2, 2))})
    mutate, seeds, read = mutate_archive(tmp_path / "sealed.npz"), [path.read_bytes()], 0
    for number in range(60):
        path.write_bytes(mutate(Random(number), seeds))
        try:
            read_checked(path, 1, "a test", UserError)
            read += 1
        except UserError:
            pass
    assert read > 15


def test_numbers_that_no_json_has_are_written():
    text = fuzz_mutations.write({"a": [float("nan"), float("-inf"), 10**41]}, "json")
    assert text == f'{{"a": [NaN, -Infinity, {10**41}]}}'
    assert json.loads(text)["a"][1] == float("-inf")


@pytest.mark.slow
def test_a_small_campaign(tmp_path):
    quick = (
        "TOML",
        "CSV",
        "XML",
        "JSON",
        "evacuation",
        "policy",
        "result of",
        "agents",
        "command",
        "of make",
        "of load",
    )
    run("fuzz.py", "--inputs", 250, "--calls", 12, "--kinds", *quick, "--out", tmp_path)
    report = json.loads((tmp_path / "fuzz.json").read_text())
    assert report["all"]["inputs"] > 250
    assert "calls" in report["kinds"]
    assert report["failures"] == []
    assert "| **all** |" in (tmp_path / "README.md").read_text()
