"""Folders that commands write: created for one command alone, held while it works, and never overwritten."""

import json
from concurrent.futures import ThreadPoolExecutor

import pytest

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locks import OWNER, this_process
from uavmec_jax.files.output_folders import KINDS, WORK, check_directory, claimed, create_new_folder
from uavmec_jax.runs.folder import RUN_PLAN, SHARDS, TOUR
from uavmec_jax.search.folder import DATABASE, FACTS
from uavmec_jax.studies.results import RUN, STUDY


def test_the_names_are_those_of_the_rooms_that_write_them():
    assert WORK == SHARDS
    assert set(KINDS) == {RUN_PLAN, RUN, STUDY, TOUR, FACTS, DATABASE}


def test_new_folders_are_distinct(tmp_path):
    with ThreadPoolExecutor(8) as threads:
        folders = list(threads.map(lambda _: create_new_folder(tmp_path / "runs", "plan"), range(40)))
    assert {folder.name for folder in folders} == {"plan", *(f"plan-{number}" for number in range(2, 41))}


def test_a_link_to_nowhere_is_not_a_new_folder(tmp_path):
    (tmp_path / "plan").symlink_to(tmp_path / "nowhere")
    assert create_new_folder(tmp_path, "plan").name == "plan-2"
    assert not (tmp_path / "nowhere").exists()


def test_a_claimed_folder_is_held_and_holds_the_files_alone_afterwards(tmp_path):
    folder = tmp_path / "a" / "b"
    with claimed(folder):
        for refused in (lambda: check_directory(folder), lambda: claimed(folder).__enter__()):
            with pytest.raises(StudyError, match=rf"b: process {this_process()['pid']} on \S+ is working in it$"):
                refused()
        (folder / "tour.json").write_text("{}")
    assert [file.name for file in folder.iterdir()] == ["tour.json"]
    with pytest.raises(StudyError, match="already holds a tour of `uavmec plan`; give another folder"), claimed(folder):
        pass


def test_a_claimed_folder_that_stays_empty_is_removed_unless_it_was_there(tmp_path):
    (tmp_path / "old").mkdir()
    for name in ("old", "new"):
        with pytest.raises(RuntimeError), claimed(tmp_path / name):
            raise RuntimeError
    assert [file.name for file in tmp_path.iterdir()] == ["old"]
    assert list((tmp_path / "old").iterdir()) == []


@pytest.mark.parametrize(("name", "kind"), [("run.json", "a run"), ("tour.json", "a tour"), ("trials.db", "a search")])
def test_what_a_folder_holds_is_named_and_left_alone(tmp_path, name, kind):
    (tmp_path / name).write_text("mine")
    with pytest.raises(StudyError, match=f"already holds {kind}"), claimed(tmp_path):
        pass
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_shards_whose_run_plan_is_lost_are_not_removed(tmp_path):
    shard = tmp_path / WORK / "00000"
    shard.mkdir(parents=True)
    with pytest.raises(StudyError, match="exists and is not an empty folder"), claimed(tmp_path):
        pass
    assert shard.exists()


def test_a_process_that_was_killed_holds_nothing(tmp_path):
    (tmp_path / WORK).mkdir()
    (tmp_path / WORK / OWNER).write_text(json.dumps(this_process() | {"pid": 2**22 + 1, "token": "t"}))
    with claimed(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_dead_owner_elsewhere_is_freed_by_the_way_that_the_message_names(tmp_path):
    (tmp_path / WORK).mkdir()
    (tmp_path / WORK / OWNER).write_text(json.dumps({"machine": "elsewhere 1", "pid": 3, "token": "t"}))
    line = rf"process 3 on elsewhere is working in it; if that process is dead, remove {tmp_path / WORK}$"
    with pytest.raises(StudyError, match=line), claimed(tmp_path):
        pass
    (tmp_path / "run_plan.json").write_text("{}")
    with pytest.raises(StudyError, match=r"working in it$"):  # of a run, that folder holds more than the lock
        check_directory(tmp_path)
