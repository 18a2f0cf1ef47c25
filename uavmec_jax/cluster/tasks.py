"""Fault-tolerant tasks on Ray: resubmitted without limit after node failures, a limited number of times after errors."""

import logging
import re
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from typing import Any

from uavmec_jax.cluster.connection import Cluster, first_line
from uavmec_jax.errors import StudyError, UserError

_LOGGER = logging.getLogger("uavmec_jax")

_MAX_IN_FLIGHT = 1000
"""Tasks that are submitted at the same time: enough for any cluster to see what is waiting."""

_WAIT_S = 0.2
"""Seconds of one look for finished tasks."""

_MAX_CRASHES = 10
"""Times in a row that the process of a task may die without getting further."""

_MAX_BACKOFF_S = 30.0
"""Most seconds between a crash and the next attempt, which doubles from one crash to the next."""

_LONELY_S = 5.0
"""Seconds without a node that can take a task after which that is reported."""

_SILENCE_S = 15.0
"""Seconds without an answer of the head after which the connection is lost. Ray itself ends the process after a minute."""

_SETTLE_S = 2.0
"""Seconds after its submission in which a task is not cancelled."""

GRACE_S = 120.0
"""Seconds that cancelled tasks have to save their work."""


class ClusterLostError(StudyError):
    """The head of the cluster does not answer any more."""


@dataclass(frozen=True)
class Task:
    """A piece of work.

    Attributes:
        key: what it is called in results and events.
        function: an importable function; it runs in a process on some node.
        arguments: called before each attempt; returns the function's arguments.
        position: how far the work has got, in any form that changes when it gets further; for a task that saves nothing,
            always the same.
    """

    key: Any
    function: Callable[..., Any]
    arguments: Callable[[], tuple[Any, ...]]
    position: Callable[[], Any] = lambda: None


@dataclass(frozen=True)
class TaskError:
    """Why a task has failed for good."""

    error: str
    trace: str = ""
    cause: BaseException | None = None


@dataclass
class _Failures:
    errors: int = 0
    crashes: int = 0
    position: Any = None
    not_before: float = 0.0
    """Time of the monotonic clock before which the task is not submitted again."""


def _log_event(event: str, *, error: str, task: Any = None) -> None:
    """Log an event as a warning."""
    _LOGGER.warning("Ray: %s%s: %s", "" if task is None else f"shard {task} is ", event, error)


@dataclass
class TaskRun:
    """Runs tasks on a cluster.

    Attributes:
        cluster: the cluster.
        on_wait: called several times a second while tasks run.
        on_event: called with ``(event, **facts)`` when a task is ``lost`` or ``retried``, or ``waiting`` for a node that can
            take it; by default, that is a warning of the logger ``uavmec_jax``.
        grace_s: seconds that cancelled tasks have to save their work.
    """

    cluster: Cluster
    on_wait: Callable[[], None] = lambda: None
    on_event: Callable[..., None] = _log_event
    grace_s: float = GRACE_S
    _answered: float = field(default_factory=time.monotonic)
    _asked: float = field(default_factory=time.monotonic)
    _submitted: float = field(default_factory=time.monotonic)
    _told: bool = False
    _lost: bool = False
    _remote: dict[Callable[..., Any], Any] = field(default_factory=dict)

    def results(self, tasks: Iterable[Task]) -> Generator[tuple[Any, Any], None, None]:
        """Yield ``(key, result)`` of every task as it finishes; the result is a :class:`TaskError` if it failed for good.

        If the generator is closed early or an exception passes through, tasks that run are cancelled and have time to save
        their work.

        Raises:
            ClusterLostError: the head of the cluster does not answer any more.
        """
        waiting = deque(tasks)
        running: dict[Any, Task] = {}
        failures: dict[Any, _Failures] = {}
        self._asked = self._answered = time.monotonic()
        try:
            while waiting or running:
                self._fill(running, waiting, failures)
                self.on_wait()
                self._check_head()
                for reference in self._finished(list(running)):
                    task = running.pop(reference)
                    done, result = self._resolve(reference, task, failures.setdefault(task.key, _Failures()))
                    if done:
                        yield task.key, result
                    else:
                        waiting.append(task)
        finally:
            self._cancel(list(running))

    def _fill(self, running: dict[Any, Task], waiting: deque[Task], failures: dict[Any, _Failures]) -> None:
        """Submit the tasks that wait and may be submitted."""
        now = time.monotonic()
        for _ in range(min(len(waiting), _MAX_IN_FLIGHT - len(running))):
            task = waiting.popleft()
            if task.key in failures and now < failures[task.key].not_before:
                waiting.append(task)
            else:
                running[self._submit(task)] = task

    def _submit(self, task: Task) -> Any:
        remote = self._remote.get(task.function)
        if remote is None:  # made once: each remote function is sent to the cluster anew
            gpus = self.cluster.options.gpus_per_shard
            # A process that has used GPUs keeps their memory, and would keep these when it is given others.
            decorate = self.cluster.ray.remote(num_gpus=gpus, max_calls=1) if gpus else self.cluster.ray.remote
            remote = self._remote[task.function] = decorate(task.function)
        options = {"max_retries": 0, "name": f"shard-{task.key}", **self.cluster.requirements}
        self._submitted = time.monotonic()
        return remote.options(**options).remote(*task.arguments())

    def _finished(self, references: list[Any]) -> list[Any]:
        if not references:
            time.sleep(_WAIT_S)
            return []
        return list(self.cluster.ray.wait(references, num_returns=len(references), timeout=_WAIT_S)[0])

    def _check_head(self) -> None:
        """Ask now and then whether the head is there, and whether some node can take a task.

        Raises:
            ClusterLostError: the head has not answered for some time.
        """
        now = time.monotonic()
        if now - self._asked < _LONELY_S:
            return
        self._asked = now
        if self.cluster.answers():
            if not self._told and not self.cluster.slots():
                self._told = True
                self.on_event("waiting", error=f"no node can take a shard, which needs {self.cluster.shortage()}")
            self._answered = now
        elif now - self._answered > _SILENCE_S:
            self._lost = True
            raise ClusterLostError(f"the head of the Ray cluster, {self.cluster.head}, does not answer any more")

    def _resolve(self, reference: Any, task: Task, failures: _Failures) -> tuple[bool, Any]:
        """Return ``(True, result)``, or ``(False, None)`` if the task is to be submitted again."""
        exceptions = self.cluster.ray.exceptions
        try:
            return True, self.cluster.ray.get(reference)
        except exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, BaseException) else error
            failures.errors += 1
            if failures.errors > self.cluster.options.retries or isinstance(cause, UserError):
                return True, TaskError(f"{type(cause).__name__}: {cause}", _without_colours(str(error)), cause)
            self.on_event("retried", task=task.key, error=f"{type(cause).__name__}: {first_line(cause)}")
        except (exceptions.NodeDiedError, exceptions.ObjectLostError) as error:
            self.on_event("lost", task=task.key, error=first_line(error))
        except (
            exceptions.TaskUnschedulableError,
            exceptions.RuntimeEnvSetupError,
            exceptions.AuthenticationError,
        ) as error:
            return True, TaskError(first_line(error), traceback.format_exc(), error)
        except exceptions.RayError as error:  # the process died: killed, out of memory, past its time limit
            position = task.position()
            failures.crashes = 1 if position != failures.position else failures.crashes + 1
            failures.position = position
            why = f"{type(error).__name__}: {first_line(error)}{self._time_limit}"
            if failures.crashes >= _MAX_CRASHES:
                return True, TaskError(f"its process died {failures.crashes} times in a row: {why}", "", error)
            failures.not_before = time.monotonic() + min(0.5 * 2**failures.crashes, _MAX_BACKOFF_S)
            self.on_event("lost", task=task.key, error=why)
        return False, None

    @property
    def _time_limit(self) -> str:
        """What may have ended a process, in words; Ray does not tell its exit code."""
        limit = self.cluster.options.time_limit_s
        return "" if limit is None else f" Attempts are ended after {limit:g} s (--time-limit)."

    def _cancel(self, references: list[Any]) -> None:
        """Cancel tasks, the latest first, and wait until they have saved their work.

        Ray 2.60 ends this process where it cancels a task at the moment in which it hands it to a worker. So tasks that were
        just submitted have a moment to get there, and no running one makes room while others still wait to be cancelled.
        """
        ray, deadline = self.cluster.ray, time.monotonic() + self.grace_s
        if not references or self._lost or not ray.is_initialized():
            return
        try:
            settled = self._submitted + _SETTLE_S - time.monotonic()
            references = ray.wait(references, num_returns=len(references), timeout=max(settled, 0.0))[1]
            for reference in reversed(references):
                ray.cancel(reference, force=False)
            while references and time.monotonic() < deadline:
                references = ray.wait(references, num_returns=len(references), timeout=1.0)[1]
        except (ray.exceptions.RayError, ConnectionError, ValueError):
            return


def _without_colours(text: str) -> str:
    """Return a text without the terminal's escape sequences, which Ray puts into tracebacks."""
    return re.sub(r"\x1b\[[0-9;]*m", "", text)
