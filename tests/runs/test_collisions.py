"""Folders of runs and of tours: each is refused, by its name, where the other is needed."""

import re

import pytest

from tests.runs.processes import TINY
from uavmec_jax.errors import StudyError
from uavmec_jax.files.output_folders import check_directory
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import parse_study

STUDY = parse_study(TINY, "tiny")


@pytest.fixture
def tour(tmp_path):
    """A folder with the files of a tour."""
    for name in ("tour.json", "tour.png", "scenario.toml"):
        (tmp_path / name).write_text("{}")
    return tmp_path


@pytest.mark.parametrize(
    ("use", "line"),
    [
        (resume_run, "holds no run that can be resumed (run_plan.json is missing); it holds a tour of `uavmec plan`"),
        (run_status, "holds no run that can be resumed (run_plan.json is missing); it holds a tour of `uavmec plan`"),
        (load_results, "holds no run; it holds a tour of `uavmec plan` (tour.json)"),
        (check_directory, "already holds a tour of `uavmec plan`; give another folder with --out"),
        (lambda folder: run_study(STUDY, folder), "already holds a tour of `uavmec plan`; give another folder"),
    ],
    ids=["resume", "status", "show", "plan", "run"],
)
def test_a_folder_with_a_tour_is_no_run(tour, use, line):
    files = sorted(tour.iterdir())
    with pytest.raises(StudyError, match=re.escape(f"{tour}: {line}")):
        use(tour)
    assert sorted(tour.iterdir()) == files


@pytest.mark.parametrize("name", ["run.json", "study.toml", "run_plan.json"])
def test_a_folder_with_any_file_of_a_run_is_taken(tmp_path, name):
    (tmp_path / name).write_text("{}")
    for use in (check_directory, lambda folder: run_study(STUDY, folder)):
        with pytest.raises(
            StudyError, match="already holds a run; resume it with `uavmec resume`, or give another folder with --out"
        ):
            use(tmp_path)


def test_a_folder_with_neither_is_named_as_such(tmp_path):
    for use in (resume_run, run_status, load_results):
        with pytest.raises(StudyError, match=r"holds no run") as refused:
            use(tmp_path)
        assert "tour" not in str(refused.value)
    (tmp_path / "notes.txt").write_text("mine")
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(StudyError, match="exists and is not an empty folder; give another one with --out"):
            check_directory(path)
    check_directory(tmp_path / "new")
