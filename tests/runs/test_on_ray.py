"""Runs on Ray: the bits of a run in one process, whatever happens to nodes, processes and the driver."""

import json
import os
import signal
import time

import psutil
import pytest

from tests.clusters import CPUS, FORK, add_node, simulated_cluster
from tests.runs.processes import TINY, bits, events, start, uavmec
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.cluster.tasks import TaskError
from uavmec_jax.errors import StudyError
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.log import RunLog
from uavmec_jax.runs.on_ray import _give_up
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import parse_study

pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings(FORK)]

ALL = parse_study(
    TINY,
    "tiny",
    {"algorithm": "a2c", "axes.algorithm": ["dqn", "pqn", "ppo", "a2c"], "axes.powered": [8], "steps": 4096},
)
LONG = parse_study(TINY, "tiny", {"steps": 60_000})
OFTEN = RunOptions(checkpoint_every_s=0.0, checkpoint_share=0.5)


@pytest.fixture(scope="module")
def nodes():
    with simulated_cluster(2) as cluster:
        yield cluster


def on(nodes, **more):
    return RayOptions(address=nodes.address, cpus_per_shard=CPUS, **more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "run"
    run_study(LONG, directory, shard_size=2, command="x")
    return directory


def test_every_algorithm_has_the_bits_of_a_run_in_this_process(nodes, tmp_path):
    here = run_study(ALL, tmp_path / "here", command="x", shard_size=2)
    plans, seen = [], []
    there = run_study(
        ALL,
        tmp_path / "there",
        command="x",
        shard_size=2,
        ray=on(nodes),
        on_plan=plans.append,
        on_progress=seen.append,
    )
    assert bits(tmp_path / "there") == bits(tmp_path / "here")
    assert (plans[0].agents, len(plans[0].shards)) == (8, 4)
    assert seen[-1].steps == seen[-1].total_steps == there.run["environment_steps"]
    assert here.run["environment_steps"] == there.run["environment_steps"]
    assert there.run["seconds"]["wall"] < sum(event["seconds"]["wall"] for event in events(tmp_path / "there", "done"))
    for event in events(tmp_path / "there", "chunk"):
        assert event["node"].count("/") == 1
        assert event["attempt"].startswith("01-")
    assert len({event["node"] for event in events(tmp_path / "there", "started")}) == 2


def test_nothing_is_trained_on_ray_either(nodes, tmp_path):
    study = parse_study(TINY.replace('algorithm = "a2c"', 'algorithm = "none"').replace("steps = 4000", ""), "none")
    for name, ray in (("here", None), ("there", on(nodes))):
        run_study(study, tmp_path / name, command="x", shard_size=2, ray=ray)
    assert (tmp_path / "there" / "agents.csv").read_bytes() == (tmp_path / "here" / "agents.csv").read_bytes()


def test_a_node_dies_and_another_one_joins(nodes, whole, tmp_path):
    """The shard of the dead node goes on from its checkpoint on another."""
    removed, directory = [], tmp_path / "run"

    def on_progress(_):
        if not removed and len(events(directory, "checkpoint")) >= 2:
            node = events(directory, "checkpoint")[0]["node"].split("/")[1]
            (victim,) = [one for one in nodes.worker_nodes if one.node_id.startswith(node)]
            removed.append(nodes.remove_node(victim, allow_graceful=False))
            add_node(nodes)

    run_study(LONG, directory, command="x", shard_size=2, options=OFTEN, ray=on(nodes), on_progress=on_progress)
    assert removed
    assert bits(directory) == bits(whole)
    assert events(directory, "lost")
    assert events(directory, "restored")


def test_a_process_of_a_shard_is_killed(nodes, whole, tmp_path):
    killed, directory = [], tmp_path / "run"

    def on_progress(_):
        if not killed and len(events(directory, "checkpoint")) >= 2:
            reports = [json.loads(file.read_text()) for file in directory.glob("shards/*/progress-*.json")]
            running = [report for report in reports if report["state"] == "running"]
            if running and psutil.pid_exists(running[0]["pid"]):
                os.kill(running[0]["pid"], signal.SIGKILL)
                killed.append(running[0]["pid"])

    run_study(LONG, directory, command="x", shard_size=2, options=OFTEN, ray=on(nodes), on_progress=on_progress)
    assert killed
    assert bits(directory) == bits(whole)


def test_a_run_that_was_stopped_on_ray_goes_on_without_and_the_other_way_round(nodes, whole, tmp_path):
    directory = tmp_path / "run"

    def stop_after_a_checkpoint(_):
        if events(directory, "chunk"):
            raise KeyboardInterrupt

    def stop_again(_):
        if len(events(directory, "started")) > 2:
            raise KeyboardInterrupt

    results = run_study(LONG, directory, command="x", shard_size=2, ray=on(nodes), on_progress=stop_after_a_checkpoint)
    assert (results.run["complete"], results.run["stopped_by"]) == (False, 2)
    status = run_status(directory)
    assert status.shards["stopped"] == 2
    assert events(directory, "checkpoint")
    resume_run(directory, on_progress=stop_again)
    assert not run_status(directory).complete
    resume_run(directory, ray=on(nodes))
    assert events(directory, "restored")
    assert bits(directory) == bits(whole)


def test_other_code_on_the_nodes_is_named(nodes, tmp_path, monkeypatch):
    monkeypatch.setattr("uavmec_jax.runs.on_ray.host.code_digest", lambda: "0123456789abcdef")
    with pytest.raises(StudyError, match=r"has other code than the driver \(uavmec_jax's code 0123456789ab -> \w+\)"):
        run_study(LONG, tmp_path / "run", ray=on(nodes))
    assert not (tmp_path / "run").exists()


def test_a_failed_task_is_a_failed_shard_unless_it_is_not_the_shards_fault(whole, tmp_path):
    directory = tmp_path / "run"
    run_study(LONG, directory, command="x", shard_size=2, on_progress=interrupt)
    folder = RunFolder.open(directory)
    log, shard = RunLog(directory / "log"), folder.plan.shards[1]
    _give_up(folder, shard, TaskError("ZeroDivisionError: by zero", "trace", ZeroDivisionError("by zero")), log)
    assert run_status(directory).failures == {1: "ZeroDivisionError: by zero"}
    with pytest.raises(StudyError, match=r"00001: cannot be written: No space left on device; .*resume with"):
        _give_up(folder, shard, TaskError("OSError", "", OSError(28, "No space left on device")), log)
    with pytest.raises(StudyError, match="planned with other code"):
        _give_up(folder, shard, TaskError("StudyError", "", StudyError("planned with other code")), log)
    log.close()


def interrupt(_):
    raise KeyboardInterrupt


def test_the_command_starts_ray_is_stopped_and_killed_and_the_run_goes_on(whole, tmp_path):
    """From the command line, with a Ray of its own each time: SIGTERM saves the shards, SIGKILL loses a little."""
    (tmp_path / "tiny.toml").write_text(TINY)
    options = ["--set", "steps=60000", "--shard-size", "2", "--checkpoint-every", "0", "--checkpoint-share", "0.5"]
    process = start("run", "tiny.toml", *options, "--out", "run", "--ray", cwd=tmp_path)
    wait_for(lambda: events(tmp_path / "run", "chunk"), process)
    shown = json.loads(uavmec("status", "run", "--json", cwd=tmp_path).stdout)
    assert list(shown["nodes"].values()) == [1]
    assert shown["owner"].startswith(f"process {process.pid} on ")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 143, errors
    assert "resume with: uavmec resume run" in errors
    assert run_status(tmp_path / "run").shards["stopped"] == 1
    process = start("resume", "run", "--ray", "local", cwd=tmp_path)
    wait_for(lambda: len(events(tmp_path / "run", "started")) >= 2, process)
    process.kill()
    process.communicate()
    wait_for_the_end_of_ray()
    uavmec("resume", "run", cwd=tmp_path)
    assert bits(tmp_path / "run") == bits(whole)


def wait_for(condition, process, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "took too long"
        time.sleep(0.05)


def wait_for_the_end_of_ray(seconds=60):
    """Wait until no process of a killed driver works on: Ray ends them when it misses the driver."""
    deadline = time.monotonic() + seconds
    while any("attempt_shard" in " ".join(process.cmdline()) for process in psutil.process_iter() if _alive(process)):
        assert time.monotonic() < deadline
        time.sleep(0.2)


def _alive(process):
    try:
        return process.status() != psutil.STATUS_ZOMBIE and process.cmdline()
    except psutil.Error:
        return False
