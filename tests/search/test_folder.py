"""The folder of a search: a second search is refused, a locked database is waited for, and a swapped one is one line."""

import json
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing

import pytest

from tests.runs.processes import environment
from tests.search.test_search import space  # noqa: F401  (a fixture)
from uavmec_jax.errors import StudyError
from uavmec_jax.files.locks import this_process
from uavmec_jax.search import folder as search_folders
from uavmec_jax.search.folder import BATCH, DATABASE, FACTS, opened_trials, search_folder
from uavmec_jax.search.search import continue_search, run_search

HOLD = """
import sys, time
from uavmec_jax.search.folder import search_folder
from uavmec_jax.search.space import load_space
with search_folder("s", load_space("space.toml")):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def begun(space, tmp_path):  # noqa: F811
    """The folder of a search whose first trial is proposed."""
    with search_folder(tmp_path / "s", space) as path, opened_trials(path, space) as trials:
        trials.enqueue_trial({"learning_rate": 0.01, "hidden": "[8]", "reward.M": 0.5})  # what `other_choices` replaces
        trial = trials.ask()
        trial.suggest_float("learning_rate", 1e-4, 1e-1, log=True)
        trial.suggest_categorical("hidden", ["[8]", "[16, 16]"])
        trial.suggest_float("reward.M", 0.0, 1.0)
        trial.set_user_attr(BATCH, 0)
    return tmp_path / "s"


def refusal(space, path):  # noqa: F811
    """The line with which a search in a folder is refused."""
    with pytest.raises(StudyError) as refused, search_folder(path, space), opened_trials(path, space):
        pass
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_a_begun_search_is_continued_and_only_its_files_stay(space, begun):  # noqa: F811
    assert sorted(file.name for file in begun.iterdir()) == [FACTS, DATABASE]
    with search_folder(begun, space) as path, opened_trials(path, space) as trials:
        assert [trial.user_attrs[BATCH] for trial in trials.get_trials()] == [0]


@pytest.mark.slow
def test_a_second_search_in_a_folder_is_told_who_works_there(space, tmp_path):  # noqa: F811
    holder = subprocess.Popen(
        [sys.executable, "-P", "-c", HOLD], cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=environment()
    )
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(StudyError, match=rf"s: process {holder.pid} on \S+ is working in it$"):
            run_search(space, tmp_path / "s")
    finally:
        holder.kill()
        holder.communicate()
    with search_folder(tmp_path / "s", space):  # its death frees the folder
        pass


def test_a_second_search_in_one_process_is_refused(space, begun):  # noqa: F811
    with (
        search_folder(begun, space),
        pytest.raises(StudyError, match=rf"process {this_process()['pid']} on \S+ is working in it"),
    ):
        run_search(space, begun)


def locked_for(seconds, database):
    """Lock a database for some seconds, in a thread."""
    ready = threading.Event()

    def lock():
        with closing(sqlite3.connect(database)) as connection:
            connection.execute("BEGIN EXCLUSIVE")
            ready.set()
            time.sleep(seconds)

    thread = threading.Thread(target=lock)
    thread.start()
    assert ready.wait(10)
    return thread


def test_a_locked_database_is_waited_for(space, begun):  # noqa: F811
    thread = locked_for(1.0, begun / DATABASE)
    with search_folder(begun, space) as path, opened_trials(path, space) as trials:
        assert not thread.is_alive()
        assert len(trials.get_trials()) == 1
    thread.join()


@pytest.mark.parametrize("when", ["before", "inside"])
def test_a_database_that_stays_locked_is_one_line(space, begun, monkeypatch, when):  # noqa: F811
    monkeypatch.setattr(search_folders, "_WAIT_S", 0.2)
    before, threads = (begun / DATABASE).read_bytes(), []

    def search():
        with search_folder(begun, space) as path:
            if when == "before":
                threads.append(locked_for(2.0, begun / DATABASE))
            with opened_trials(path, space) as trials:
                threads.append(locked_for(2.0, begun / DATABASE))
                trials.tell(0, 1.0)

    line = "trials.db: another program has kept it locked for 0.2 s; end that, and give the same command again"
    with pytest.raises(StudyError, match=line):
        search()
    (thread,) = threads
    thread.join()
    assert (begun / DATABASE).read_bytes() == before


def another_programs(path):
    path.unlink()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE cookies (name TEXT)")


def after(*statements):
    """Return a function that makes changes to a database."""

    def change(path):
        with closing(sqlite3.connect(path)) as connection, connection:
            for statement in statements:
                connection.execute(statement)

    return change


another_name = after("UPDATE studies SET study_name = 'other'")
another_space = after("UPDATE study_user_attributes SET value_json = '\"x\"'")
without_batches = after("UPDATE trials SET state = 'COMPLETE'", "DELETE FROM trial_user_attributes")
another_optuna = after("UPDATE alembic_version SET version_num = 'v99'")
outside_a_range = after("UPDATE trial_params SET param_value = -7e-177 WHERE param_name = 'learning_rate'")
other_choices = after("UPDATE trial_params SET distribution_json = replace(distribution_json, '[8]', '[9]')")
nonsense_inside = after("UPDATE trials SET state = 'WON'")
other_columns = after("ALTER TABLE studies RENAME COLUMN study_name TO title")


def a_folder(path):
    path.unlink()
    path.mkdir()


OTHERS = "trials.db: holds the trials of something other than space; give another folder with --out"


@pytest.mark.parametrize(
    ("swap", "line"),
    [
        (lambda path: path.write_bytes(b""), "trials.db: is missing or empty although the search has begun"),
        (lambda path: path.unlink(), "trials.db: is missing or empty although the search has begun"),
        (lambda path: path.write_bytes(b"SQLite no more" * 1000), "trials.db: cannot be used: file is not a database"),
        (a_folder, "trials.db: is not a file"),
        (another_programs, OTHERS),
        (another_name, OTHERS),
        (another_space, OTHERS),
        (without_batches, OTHERS),
        (outside_a_range, OTHERS),
        (other_choices, OTHERS),
        (another_optuna, "trials.db: cannot be used: "),
        (nonsense_inside, "trials.db: cannot be used: "),
        (other_columns, "trials.db: cannot be used: "),
    ],
)
def test_a_database_that_was_emptied_or_swapped_is_one_line_and_left_alone(space, begun, swap, line):  # noqa: F811
    database = begun / DATABASE
    swap(database)
    before = database.read_bytes() if database.is_file() else None
    assert line in refusal(space, begun)
    assert (database.read_bytes() if database.is_file() else None) == before


@pytest.mark.parametrize("content", ["", "[]", "1", "{", '{"space": 1}', '{"space": {"study": "x"}}'])
def test_a_label_that_is_of_another_type_or_emptied_is_one_line(space, begun, content):  # noqa: F811
    (begun / FACTS).write_text(content)
    assert "search.json: is missing, damaged or not of a search; give another folder" in refusal(space, begun)
    assert (begun / FACTS).read_text() == content


def test_a_label_of_another_search_is_one_line(space, begun):  # noqa: F811
    other = space.model_copy(update={"batch": 3})
    assert refusal(other, begun) == f"{begun}: holds another search; give another folder with --out"
    (begun / FACTS).write_text(json.dumps({"space": other.model_dump(mode="json"), "begun": True}))
    assert OTHERS in refusal(other, begun)


def test_a_lost_label_is_one_line(space, begun):  # noqa: F811
    (begun / FACTS).unlink()
    assert "search.json: is missing" in refusal(space, begun)


@pytest.mark.parametrize(("name", "kind"), [("run_plan.json", "a run"), ("tour.json", "a tour"), ("a.txt", "")])
def test_a_folder_of_another_kind_is_refused_and_left_alone(space, tmp_path, name, kind):  # noqa: F811
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / name).write_text("mine")
    assert (f"already holds {kind}" if kind else "is not an empty folder") in refusal(space, tmp_path / "x")
    assert [file.name for file in (tmp_path / "x").iterdir()] == [name]


def test_scores_that_a_stopped_search_has_stored_are_not_stored_twice(space, begun, recwarn):  # noqa: F811
    from uavmec_jax.search.halving import TrialOutcome
    from uavmec_jax.search.search import _record

    optuna = search_folders.import_optuna()
    with search_folder(begun, space) as path, opened_trials(path, space) as trials:
        optuna.trial.Trial(trials, trials.get_trials()[0]._trial_id).report(1.0, 500)
    with search_folder(begun, space) as path, opened_trials(path, space) as trials:
        _record(optuna, trials, trials.get_trials()[0], TrialOutcome(2.0, {500: 1.0, 1000: 1.5}))
        assert trials.get_trials()[0].intermediate_values == {500: 1.0, 1000: 1.5}
        assert trials.best_value == 2.0


def test_a_search_in_a_held_folder_needs_no_second_lock(space, tmp_path, monkeypatch):  # noqa: F811
    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("uavmec_jax.search.search._run_batches", stop)
    with pytest.raises(KeyboardInterrupt), search_folder(tmp_path / "s", space) as path:
        continue_search(space, path)
    assert json.loads((tmp_path / "s" / FACTS).read_text())["begun"] is True
