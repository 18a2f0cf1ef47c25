"""Tasks on a cluster: what is lost is repeated, what is wrong a few times only, and cancelled tasks save their work."""

import os
import signal
import time

import pytest

from tests.clusters import FORK, add_node, simulated_cluster
from uavmec_jax.cluster.connection import connect
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.cluster.tasks import Task, TaskError, TaskRun
from uavmec_jax.errors import StudyError

pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings(FORK)]

ONE = RayOptions(address="auto", cpus_per_shard=1, retries=2)


@pytest.fixture(scope="module")
def nodes():
    with simulated_cluster(1) as cluster:
        yield cluster


@pytest.fixture
def cluster(nodes):
    with connect(RayOptions(address=nodes.address, cpus_per_shard=1, retries=2)) as connected:
        yield connected


def double(number):
    return 2 * number


def fail(path, times, error):
    """Fail so many times, which a file counts."""
    count = int(path.read_text()) if path.exists() else 0
    path.write_text(str(count + 1))
    if count < times:
        raise error
    return count


def die(path, times):
    """Kill this process so many times."""
    try:
        return fail(path, times, RuntimeError())
    except RuntimeError:
        os.kill(os.getpid(), signal.SIGKILL)


def wait_for(path, name):
    """Wait for a file, or for the end."""
    try:
        (path / f"started-{name}").touch()  # from here on it may be cancelled
        while not (path / "go").exists():
            time.sleep(0.05)
    except KeyboardInterrupt:
        (path / f"saved-{name}").touch()
        raise
    return os.getpid()


def run(cluster, *tasks, **hooks):
    return dict(TaskRun(cluster, **hooks).results(tasks))


def test_results_come_with_their_keys(cluster):
    tasks = [Task(k, double, lambda k=k: (k,)) for k in range(20)]
    assert run(cluster, *tasks) == {k: 2 * k for k in range(20)}


def test_errors_of_the_program_are_repeated_as_often_as_set(cluster, tmp_path):
    events = []
    task = Task("a", fail, lambda: (tmp_path / "twice", 2, OSError("disk")))
    done = run(cluster, task, on_event=lambda event, **facts: events.append((event, facts["error"])))
    assert done == {"a": 2}
    assert events == [("retried", "OSError: disk")] * 2
    (failed,) = run(cluster, Task("b", fail, lambda: (tmp_path / "thrice", 3, OSError("disk")))).values()
    assert isinstance(failed, TaskError)
    assert (failed.error, type(failed.cause)) == ("OSError: disk", OSError)
    assert "in fail" in failed.trace


def test_a_users_error_is_not_repeated(cluster, tmp_path):
    (failed,) = run(cluster, Task("a", fail, lambda: (tmp_path / "count", 9, StudyError("other code")))).values()
    assert failed.error == "StudyError: other code"
    assert (tmp_path / "count").read_text() == "1"


def test_a_process_that_dies_is_replaced(cluster, tmp_path):
    events = []
    task = Task("a", die, lambda: (tmp_path / "count", 3))
    assert run(cluster, task, on_event=lambda event, **facts: events.append(event)) == {"a": 3}
    assert events == ["lost"] * 3


def test_a_process_that_dies_again_and_again_without_getting_further_is_given_up(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("uavmec_jax.cluster.tasks._MAX_CRASHES", 3)
    (failed,) = run(cluster, Task("a", die, lambda: (tmp_path / "stuck", 99))).values()
    assert failed.error.startswith("its process died 3 times in a row")
    position = iter(range(100)).__next__  # it gets further every time
    assert run(cluster, Task("b", die, lambda: (tmp_path / "slow", 6), position)) == {"b": 6}


def test_a_node_that_dies_is_replaced(nodes, cluster, tmp_path):
    lost = []

    def on_wait():
        if (tmp_path / "started-a").exists() and not lost:
            lost.append(nodes.remove_node(next(iter(nodes.worker_nodes)), allow_graceful=False))
            add_node(nodes)
            (tmp_path / "go").touch()

    assert run(cluster, Task("a", wait_for, lambda: (tmp_path, "a")), on_wait=on_wait)["a"]
    assert lost


def test_tasks_are_cancelled_and_save_their_work(cluster, tmp_path):
    def on_wait():
        if (tmp_path / "started-a").exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(cluster, Task("a", wait_for, lambda: (tmp_path, "a")), on_wait=on_wait)
    assert (tmp_path / "saved-a").exists()
