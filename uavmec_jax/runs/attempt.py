"""One attempt at a shard: resume from its last checkpoint, train, evaluate, and write the result.

Attempts may be made on any machine, one after the other, and, if a machine is believed dead and is not, at the same time:
each writes under its own name, and whichever result is there first is as good as any other, since all are the same.
"""

import json
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from uavmec_jax.files.locations import make_folder, store_errors
from uavmec_jax.files.locks import this_process
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.checkpoints import Checkpoints
from uavmec_jax.runs.file_names import PROGRESS, RESULT
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.log import RunLog
from uavmec_jax.runs.run_plan import Shard
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.scenarios.policy_files import PolicyCollection
from uavmec_jax.studies.results import policy_collection
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.training.training import Training

_REPORT_EVERY_S = 5.0
"""Seconds between two reports of an attempt's progress."""


@dataclass
class Attempt:
    """An attempt at a shard.

    Attributes:
        folder: the run.
        shard: the shard.
        name: unique among all attempts, see :meth:`RunFolder.new_attempt`.
        runner: trains and evaluates shards.
        stop: checked between chunks.
        log: log of this process.
        on_chunk: called after every chunk with the environment steps of all agents of the shard so far, and the mean
            length of their episodes in slots.
        node: where it runs, for the status.
    """

    folder: RunFolder
    shard: Shard
    name: str
    runner: ShardRunner
    stop: StopSignal
    log: RunLog
    on_chunk: Callable[[int, float], None] = lambda steps, mean_episode_length: None
    node: str = field(default_factory=socket.gethostname)
    _steps: int = 0
    _speed: float = 0.0
    _reported: float = field(default=float("-inf"))

    def run(self) -> None:
        """Run the shard and write its result.

        Raises:
            Interrupted: a signal arrived; a checkpoint has been written, unless the shard was in evaluation.
            OSError, MemoryError: not the shard's fault; earlier checkpoints are intact.
            Exception: whatever else went wrong in training or evaluation.
        """
        started = time.monotonic()
        make_folder(self.folder.shard_folder(self.shard))
        self.log.event("started", shard=self.shard.number, attempt=self.name)
        self._report("running")
        try:
            with store_errors():
                result = self._train_and_evaluate()
                result.seconds["wall"] = time.monotonic() - started
                result.write(self.folder.shard_folder(self.shard) / f"{RESULT}-{self.name}.npz")
                self._checkpoints().remove()
        except BaseException as error:
            self.log.event(
                "stopped", shard=self.shard.number, attempt=self.name, error=f"{type(error).__name__}: {error}"
            )
            self._report("stopped")
            raise
        self.log.event(
            "done", shard=self.shard.number, attempt=self.name, agents=self.shard.agents, seconds=result.seconds
        )
        self._report("done")

    def _train_and_evaluate(self) -> ShardResult:
        if self.folder.plan.steps[self.shard.part] == 0:
            with self.stop.interruptible():
                result = self.runner.finish(self.shard, None)
            self.on_chunk(self.shard.agents, float("nan"))
            return result
        checkpoints = self._checkpoints()
        training = checkpoints.resume(self._start)
        try:
            self.stop.check()
            for _ in training.run():
                self._after_chunk(training)
                if checkpoints.is_due and not training.finished:
                    checkpoints.write(training)
                self.stop.check()
            with self.stop.interruptible():
                return self.runner.finish(self.shard, training)
        except KeyboardInterrupt:
            if training.consistent:
                checkpoints.write(training)
            raise

    def _start(self) -> Training:
        training = self.runner.start(self.shard)
        assert training is not None
        return training

    def _after_chunk(self, training: Training) -> None:
        self._steps = self.shard.agents * training.steps
        self._speed = self._steps / max(training.seconds["train"] + training.seconds["validate"], 1e-9)
        values = {"episode_length": training.mean_episode_length, "steps_per_second": self._speed}
        if training.validated:
            values["validation"] = float(training.scores[-1][: self.shard.agents].mean())
        self.log.curve(self.shard.number, training.steps, **values)
        if time.monotonic() - self._reported >= _REPORT_EVERY_S:
            self._report("running")
        self.on_chunk(self._steps, training.mean_episode_length)

    def _report(self, state: str) -> None:
        """Write how far the attempt is, for the status of the run; where it cannot be written, it is left out."""
        self._reported = time.monotonic()
        report: dict[str, Any] = {"attempt": self.name, "state": state, "node": self.node}
        report |= {"steps": self._steps, "speed": self._speed}
        try:
            path = self.folder.shard_folder(self.shard) / f"{PROGRESS}-{self.name}.json"
            write_text(path, json.dumps(report | this_process()))
        except OSError:
            return

    def _checkpoints(self) -> Checkpoints:
        options = self.folder.options

        def collect(weights: dict) -> PolicyCollection:
            algorithm, agent_ids = self.runner.algorithm(self.shard), self.runner.agent_ids(self.shard)
            return policy_collection(self.folder.study, {algorithm: agent_ids}, {algorithm: weights})

        size = self.folder.plan.partitions[self.shard.part].shard_bytes
        return Checkpoints(
            folder=self.folder.shard_folder(self.shard),
            kind=options.checkpoint,
            every_s=options.checkpoint_every_s,
            share=options.checkpoint_share,
            bytes=size if options.checkpoint == "full" else 0,
            identity={"run": self.folder.fingerprint, "shard": self.shard.number, "agents": self.shard.agents},
            attempt=self.name,
            log_event=lambda event, **facts: self.log.event(event, shard=self.shard.number, attempt=self.name, **facts),
            collect=collect,
        )
