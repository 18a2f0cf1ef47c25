"""Runs in object stores: one in memory, and one that speaks the S3 protocol, in a server on this machine."""

import json
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import uavmec_jax as um
from tests.runs.object_stores import BUCKET, memory_store, s3_server
from tests.runs.processes import FINAL, TINY, bits, environment, events, start, stop_after, uavmec
from uavmec_jax.cli import main
from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import to_path
from uavmec_jax.files.locks import OWNER, lock_folder
from uavmec_jax.files.writing import create_exclusively, write_text
from uavmec_jax.runs.folder import SHARDS
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.studies.results_files import load_weights
from uavmec_jax.studies.study import parse_study

STUDY = parse_study(TINY, "tiny")
server = pytest.fixture(scope="module")(s3_server)
memory = pytest.fixture(memory_store)


def in_other_process(code, *arguments):
    """Start Python code that prints a line when it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    assert process.stdout.readline() == "ready\n"
    return process


WRITE = """
import sys
from uavmec_jax.files.locations import to_path
from uavmec_jax.files.writing import write_text
write_text(to_path(sys.argv[1]), sys.argv[2])
print("ready")
"""

LOCK = """
import sys
from uavmec_jax.files.locations import to_path
from uavmec_jax.files.locks import lock_folder
path = to_path(sys.argv[1])
with lock_folder(path, path):
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_files_of_another_process_are_seen_at_once(server):
    """The package of the store keeps listings of folders unless it is told not to."""
    folder = to_path(f"s3://{BUCKET}/listed")
    write_text(folder / "shard" / "a", "1")
    seen = [(sorted(file.name for file in (folder / "shard").glob("*")), (folder / "shard" / "b").exists())]
    for name, text in (("b", "2"), ("a", "3")):
        with in_other_process(WRITE, str(folder / "shard" / name), text):
            pass
        seen.append((sorted(file.name for file in (folder / "shard").iterdir()), (folder / "shard" / "b").exists()))
    assert seen == [(["a"], False), (["a", "b"], True), (["a", "b"], True)]
    assert (folder / "shard" / "a").read_text(encoding="utf-8") == "3"


def test_two_processes_do_not_work_in_one_folder(server):
    folder = to_path(f"s3://{BUCKET}/locked")
    with in_other_process(LOCK, str(folder)) as other:
        refused = rf"^s3://{BUCKET}/locked: process {other.pid} on \S+ is working in it"
        with pytest.raises(StudyError, match=refused), lock_folder(folder, folder):
            pass
        assert not create_exclusively(folder / OWNER, b"")  # nor if both find the folder free
        other.kill()
    with lock_folder(folder, folder):  # its process is known to be dead
        assert (folder / OWNER).exists()
    assert not folder.exists()


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """A run in a folder of this machine, in this process."""
    directory = tmp_path_factory.mktemp("local") / "run"
    run_study(STUDY, directory, shard_size=2)
    return directory


@pytest.mark.slow
def test_a_run_in_memory_is_that_of_a_folder(memory, local, tmp_path, monkeypatch):
    events_seen = []
    stopped = run_study(STUDY, memory, shard_size=2, on_progress=stop_after(2))
    assert not stopped.run["complete"]
    status = um.runs.run_status(memory)
    assert (status.directory, status.complete, status.owner, status.shards["stopped"]) == (memory, False, "", 1)
    assert status.disk_bytes > 1000
    assert len(um.load_results(memory).agents) == 0
    results = resume_run(memory, on_event=lambda event, facts: events_seen.append(event))
    assert "restored" in events_seen
    assert bits(to_path(memory)) == bits(local)
    assert not (to_path(memory) / SHARDS).exists()
    assert um.runs.run_status(memory).shards["done"] == 2
    assert len(resume_run(memory).agents) == 4
    with pytest.raises(StudyError, match=f"^{memory}: already holds a run"):
        run_study(STUDY, memory)

    assert um.load_results(memory).agents.equals(um.load_results(local).agents)
    jax.tree.map(np.testing.assert_array_equal, load_weights(memory, "last"), load_weights(str(local), "last"))
    policy = um.load_policy(memory, powered=4, seed=1)
    policy.save("memory://tests/policy.npz")
    assert um.load_policy("memory://tests/policy.npz").trained_on == policy.trained_on
    results.save("memory://tests/copy")
    assert bits(to_path("memory://tests/copy")) == bits(local)

    monkeypatch.chdir(tmp_path)
    chosen = ["--powered", "4", "--connected", "8", "--draws", "2"]
    for arguments, text in (
        (["resume", memory], "Files: memory://tests/run"),
        (["show", memory], "Files: memory://tests/run"),
        (["status", memory], "complete"),
        (["compare", memory, str(local)], "seed by seed"),
        (["evaluate", memory, *chosen, "--save", "memory://tests/saved.npz"], "Trained by A2C on"),
        (["evaluate", "memory://tests/saved.npz", *chosen], "Trained by A2C on"),
    ):
        done = CliRunner().invoke(main, arguments)
        assert done.exit_code == 0, done.output
        assert text in done.stdout
    assert to_path(memory + "/figure.png").read_bytes().startswith(b"\x89PNG")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_store_that_fails_ends_the_run_and_no_shard(memory, local, monkeypatch):
    store = type(to_path(memory).fs)
    put, error = store.put_file, type("ConnectError", (Exception,), {"__module__": "botocore.exceptions"})

    def fail(self, local, path, **options):
        if "/00001/result-" in path:
            raise error("no route to the store")
        return put(self, local, path, **options)

    monkeypatch.setattr(store, "put_file", fail)
    with pytest.raises(StudyError) as failed:
        run_study(STUDY, memory, shard_size=2)
    monkeypatch.undo()
    assert str(failed.value) == (
        f"{memory}/shards/00001: cannot be written: no route to the store; earlier checkpoints are intact; when the store "
        f"can be reached, resume with: uavmec resume {memory}"
    )
    status = um.runs.run_status(memory)
    assert (status.shards["done"], status.shards["failed"], status.owner) == (1, 0, "")
    resume_run(memory)
    assert bits(to_path(memory)) == bits(local)


TRAINED_LONG = ["--set", "steps=60000", "--shard-size", "2", "--checkpoint-every", "0", "--checkpoint-share", "0.5"]
"""Two shards of a second or two, with checkpoints as often as they are cheap."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a study, and with a run of it in a process of its own."""
    folder = tmp_path_factory.mktemp("s3")
    (folder / "tiny.toml").write_text(TINY)
    uavmec("run", "tiny.toml", *TRAINED_LONG, "--out", "whole", cwd=folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.full), signal.SIGKILL])
def test_a_run_that_was_stopped_continues_in_another_process(server, folder, number):
    """Over the S3 protocol; the bits are those of a run in a folder."""
    url = f"s3://{BUCKET}/stopped-{number}"
    process = start("run", "tiny.toml", *TRAINED_LONG, "--out", url, cwd=folder)
    wait_for_checkpoint(process, to_path(url))
    process.send_signal(signal.SIGSTOP)  # it is alive, and does not finish while others look
    assert f"process {process.pid} on" in json.loads(uavmec("status", url, "--json", cwd=folder).stdout)["owner"]
    refused = uavmec("resume", url, cwd=folder, check=False)
    assert refused.returncode == 2
    assert f"{url}: process {process.pid} on" in refused.stderr
    process.send_signal(number)
    process.send_signal(signal.SIGCONT)
    _, errors = process.communicate(timeout=120)
    if number == signal.SIGTERM:
        assert process.returncode == 128 + signal.SIGTERM
        assert f"resume with: uavmec resume {url}" in errors
    else:
        assert process.returncode == -signal.SIGKILL
    status = json.loads(uavmec("status", url, "--json", cwd=folder).stdout)
    assert (status["complete"], status["owner"], status["shards"]["running"]) == (False, "", 0)
    assert "resumes from checkpoint" in uavmec("resume", url, cwd=folder).stdout
    assert bits(to_path(url)) == bits(folder / "whole")
    assert len(events(to_path(url), "restored")) >= 1
    names = {file.name for file in to_path(url).iterdir()}
    assert names == {*FINAL, "run.json", "run_plan.json", "figure.png", "log"}
    assert sorted(file.name for file in folder.iterdir()) == ["tiny.toml", "whole"]


def wait_for_checkpoint(process, path):
    until = time.monotonic() + 120
    while not list((path / SHARDS).glob("*/checkpoint-*")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.05)
