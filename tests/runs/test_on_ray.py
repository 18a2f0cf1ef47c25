"""Runs on Ray: the bits of a run in one process, whatever happens to nodes, processes and the driver."""

import json
import os
import signal
import threading
import time

import psutil
import pytest

from tests.clusters import CPUS, FORK, add_node, simulated_cluster
from tests.runs.processes import TINY, bits, events
from uavmec_jax.agents.registry import ALGORITHMS
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
    {
        "algorithm": "a2c",
        "axes.algorithm": sorted(ALGORITHMS),
        "axes.powered": [8],
        "steps": 131_072,
        "evaluation.validate_every": 8192,
    },
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


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A run of every algorithm in this process, and its results."""
    directory = tmp_path_factory.mktemp("here") / "run"
    return directory, run_study(ALL, directory, command="x", shard_size=2)


def test_every_algorithm_has_the_bits_of_a_run_in_this_process(nodes, here, tmp_path):
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
    directory, results = here
    assert bits(tmp_path / "there") == bits(directory)
    assert (plans[0].agents, len(plans[0].shards)) == (2 * len(ALGORITHMS), len(ALGORITHMS))
    assert seen[-1].steps == seen[-1].total_steps == there.run["environment_steps"]
    assert results.run["environment_steps"] == there.run["environment_steps"]
    assert there.run["seconds"]["wall"] < sum(event["seconds"]["wall"] for event in events(tmp_path / "there", "done"))
    for event in events(tmp_path / "there", "chunk"):
        assert event["node"].count("/") == 1
        assert event["attempt"].startswith("01-")
    assert len({event["node"] for event in events(tmp_path / "there", "started")}) == 2


def test_every_algorithm_keeps_its_bits_while_nodes_come_and_go(nodes, here, tmp_path):
    """A third node joins; then the node of each algorithm's shard is killed in the middle of it, and another one joins."""
    directory = tmp_path / "run"
    add_node(nodes)
    with Striker(nodes, directory, len(ALGORITHMS)) as striker:

        def on_progress(_):
            while striker.killed:
                nodes.remove_node(striker.killed.pop(), allow_graceful=False)
                add_node(nodes)

        run_study(ALL, directory, command="x", shard_size=2, options=OFTEN, ray=on(nodes), on_progress=on_progress)
    nodes.remove_node(next(iter(nodes.worker_nodes)), allow_graceful=False)
    assert bits(directory) == bits(here[0])
    assert striker.struck == set(range(len(ALGORITHMS)))
    lost = events(directory, "lost")
    assert {event["shard"] for event in lost} == striker.struck
    assert all(event["attempt"][:2].isdigit() for event in lost)
    assert any("node" in event for event in lost)
    assert len({event["node"] for event in events(directory, "started")}) >= 3


class Striker(threading.Thread):
    """Kills the node of every shard once, as soon as the shard has a checkpoint."""

    def __init__(self, nodes, directory, shards):
        super().__init__()
        self.nodes, self.directory, self.shards = nodes, directory, shards
        self.struck, self.killed, self.ended = set(), [], False

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.ended = True
        self.join()

    def run(self):
        while len(self.struck) < self.shards and not self.ended:
            victims = {}
            for event in events(self.directory, "checkpoint"):
                node = event["node"].split("/")[1]
                alive = [one for one in self.nodes.worker_nodes if one.node_id.startswith(node)]
                if event["shard"] not in self.struck and alive and alive[0] not in self.killed:
                    victims[event["shard"]] = alive[0]
            for victim in set(victims.values()):
                raylet = psutil.Process(victim.all_processes["raylet"][0].process.pid)
                for process in [*raylet.children(recursive=True), raylet]:  # a worker outlives its node by a second
                    process.kill()
                self.killed.append(victim)
            self.struck |= set(victims)
            time.sleep(0.02)


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


def test_a_resumed_run_has_the_cores_of_its_plan(nodes, tmp_path, monkeypatch):
    """So as many shards run at the same time as before, without the options of before."""
    directory, seen = tmp_path / "run", []
    one = RayOptions(address=nodes.address, cpus_per_shard=1)
    run_study(LONG, directory, shard_size=2, ray=one, on_progress=interrupt)
    monkeypatch.setattr("uavmec_jax.runs.run.run_on_ray", lambda folder, cluster, *_: seen.append(cluster.requirements))
    with pytest.raises(StudyError):
        resume_run(directory, ray=nodes.address)
    assert seen[0]["num_cpus"] == 1


def test_other_code_on_the_nodes_is_named(nodes, tmp_path, monkeypatch):
    monkeypatch.setattr("uavmec_jax.training.host.code_digest", lambda: "0123456789abcdef")
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
