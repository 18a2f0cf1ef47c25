"""Tasks on a cluster that outlive its nodes: what is lost is submitted again, what is wrong a few times only."""

import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from typing import Any

from uavmec_jax.cluster.connection import Cluster, first_line
from uavmec_jax.errors import StudyError, UserError

_IN_FLIGHT = 1000
"""Tasks that are submitted at the same time: enough for any cluster to see what is waiting."""

_WAIT_S = 0.2
"""Seconds of one look for finished tasks."""

_CRASHES = 10
"""Times in a row that the process of a task may die without getting further."""

_GRACE_S = 120.0
"""Seconds that cancelled tasks have to save their work."""


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
class _Tries:
    errors: int = 0
    crashes: int = 0
    position: Any = None


@dataclass
class TaskRun:
    """Runs tasks on a cluster.

    Attributes:
        cluster: the cluster.
        on_wait: called several times a second while tasks run.
        on_event: called with ``(event, **facts)`` when a task is ``lost`` or ``retried``.
    """

    cluster: Cluster
    on_wait: Callable[[], None] = lambda: None
    on_event: Callable[..., None] = lambda event, **facts: None
    _remote: dict[Callable[..., Any], Any] = field(default_factory=dict)

    def results(self, tasks: Iterable[Task]) -> Generator[tuple[Any, Any], None, None]:
        """Yield ``(key, result)`` of every task as it finishes; the result is a :class:`TaskError` if it failed for good.

        If the generator is closed early or an exception passes through, tasks that run are cancelled and have time to save
        their work.

        Raises:
            StudyError: the connection to the cluster is lost.
        """
        waiting = deque(tasks)
        running: dict[Any, Task] = {}
        tries: dict[Any, _Tries] = {}
        try:
            while waiting or running:
                while waiting and len(running) < _IN_FLIGHT:
                    task = waiting.popleft()
                    running[self._submit(task)] = task
                self.on_wait()
                for reference in self._finished(list(running)):
                    task = running.pop(reference)
                    done, result = self._take(reference, task, tries.setdefault(task.key, _Tries()))
                    if done:
                        yield task.key, result
                    else:
                        waiting.appendleft(task)
        finally:
            self._cancel(list(running))

    def _submit(self, task: Task) -> Any:
        remote = self._remote.get(task.function)
        if remote is None:  # made once: each remote function is sent to the cluster anew
            remote = self._remote[task.function] = self.cluster.ray.remote(task.function)
        options = {"max_retries": 0, "name": str(task.key), **self.cluster.requirements}
        return remote.options(**options).remote(*task.arguments())

    def _finished(self, references: list[Any]) -> list[Any]:
        try:
            return self.cluster.ray.wait(references, num_returns=len(references), timeout=_WAIT_S)[0]
        except (self.cluster.ray.exceptions.RaySystemError, ConnectionError) as error:
            raise StudyError(f"the connection to the Ray cluster is lost: {first_line(error)}") from None

    def _take(self, reference: Any, task: Task, tries: _Tries) -> tuple[bool, Any]:
        """Return ``(True, result)``, or ``(False, None)`` if the task is to be submitted again."""
        exceptions = self.cluster.ray.exceptions
        try:
            return True, self.cluster.ray.get(reference)
        except exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, BaseException) else error
            tries.errors += 1
            if tries.errors > self.cluster.options.retries or isinstance(cause, UserError):
                return True, TaskError(f"{type(cause).__name__}: {cause}", str(error), cause)
            self.on_event("retried", task=task.key, error=f"{type(cause).__name__}: {cause}")
        except exceptions.NodeDiedError as error:
            self.on_event("lost", task=task.key, error=first_line(error))
        except (
            exceptions.TaskUnschedulableError,
            exceptions.RuntimeEnvSetupError,
            exceptions.AuthenticationError,
        ) as error:
            return True, TaskError(first_line(error), traceback.format_exc(), error)
        except exceptions.RayError as error:  # the process died: killed, out of memory, past its time limit
            position = task.position()
            tries.crashes = 1 if position != tries.position else tries.crashes + 1
            tries.position = position
            if tries.crashes > _CRASHES:
                return True, TaskError(
                    f"its process died {tries.crashes} times in a row: {first_line(error)}", "", error
                )
            self.on_event("lost", task=task.key, error=first_line(error))
        return False, None

    def _cancel(self, references: list[Any]) -> None:
        """Cancel tasks, and wait until they have saved their work."""
        ray, deadline = self.cluster.ray, time.monotonic() + _GRACE_S
        if not references or not ray.is_initialized():
            return
        try:
            for reference in references:
                ray.cancel(reference, force=False)
            while references and time.monotonic() < deadline:
                references = ray.wait(references, num_returns=len(references), timeout=1.0)[1]
        except (ray.exceptions.RayError, ConnectionError, ValueError):
            return
