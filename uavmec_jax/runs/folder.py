"""The folder of a run: the run plan, one folder per shard, and the state of every shard."""

import hashlib
import json
import secrets
import time
from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import files_in_subfolders, files_matching, is_local, reached
from uavmec_jax.files.locks import is_known_dead
from uavmec_jax.files.reading import read_json_or_empty, read_text
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run_plan import RunPlan, Shard
from uavmec_jax.studies.results import RUN, STUDY
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import parse_study, study_toml
from uavmec_jax.training import host
from uavmec_jax.training.partition import Partition

SCHEMA = 2
"""Version of the run plan's file."""

_WITH_LEASES = 1
"""Version whose workers shared a run by leases; its finished runs are read, the others are not continued."""

_SILENCE_S = 600.0
"""Seconds without a report after which an attempt elsewhere is shown as stopped."""

RUN_PLAN, LOG, SHARDS, TOUR = "run_plan.json", "log", "shards", "tour.json"
CHECKPOINT, PROGRESS, RESULT, FAILURE = "checkpoint", "progress", "result", "failed.json"
"""What an attempt at a shard writes, under its own name, and why the shard failed."""

ShardState = Literal["waiting", "running", "stopped", "failed", "done"]


class RunFolder:
    """A run on disk.

    Attributes:
        path: the folder.
        facts: the checked contents of its run plan.
    """

    def __init__(self, path: Path, facts: dict[str, Any]) -> None:
        self.path = path
        self.facts = facts

    @classmethod
    def create(cls, path: Path, study: Study, plan: RunPlan, options: RunOptions, label: dict[str, Any]) -> "RunFolder":
        """Write the study and the run plan into an existing folder, the plan last."""
        text = study_toml(study)
        write_text(path / STUDY, text)
        facts = {
            "schema": SCHEMA,
            "label": label,
            "study_sha256": _sha256(text),
            "code_sha256": host.code_digest(),
            "versions": host.versions(),
            "options": asdict(options),
            "plan": asdict(plan),
        }
        facts["sha256"] = _digest(facts)
        write_text(path / RUN_PLAN, json.dumps(facts, indent=1) + "\n")
        return cls(path, facts)

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Read a run plan.

        Raises:
            StudyError: the folder holds no run; the run plan or the study was altered or is damaged; or another version
                wrote it; or its object store cannot be reached.
        """
        with reached(path):
            return cls(path, cls._read(path))

    @staticmethod
    def _read(path: Path) -> dict[str, Any]:
        """Read and check a run plan."""
        file = path / RUN_PLAN
        if not file.exists():
            tour = f"; it holds a tour of `uavmec plan` ({TOUR})" if (path / TOUR).exists() else ""
            raise StudyError(f"{path}: holds no run that can be resumed ({RUN_PLAN} is missing){tour}")
        try:
            facts: dict[str, Any] = json.loads(read_text(file, StudyError))
            schema, digest = facts["schema"], facts["sha256"]
        except (ValueError, KeyError, TypeError) as error:
            raise StudyError(f"{file}: cannot be read: {error!r}; plan the study anew in another folder") from None
        if schema == _WITH_LEASES and not (path / RUN).exists():
            raise StudyError(f"{path}: was started by a version whose workers held leases; finish it with that version")
        if schema not in (SCHEMA, _WITH_LEASES):
            raise StudyError(f"{file}: schema is {schema!r}; this version reads {SCHEMA}")
        if digest != _digest(facts):
            raise StudyError(f"{file}: was altered or damaged: it does not fit its SHA-256; plan the study anew")
        if _sha256(read_text(path / STUDY, StudyError)) != facts["study_sha256"]:
            raise StudyError(f"{path / STUDY}: was altered or damaged since the run was planned; run it as a new study")
        return facts

    @cached_property
    def study(self) -> Study:
        """The resolved study."""
        return parse_study(read_text(self.path / STUDY, StudyError), str(self.path / STUDY))

    @cached_property
    def plan(self) -> RunPlan:
        """How the study is partitioned."""
        facts = {name: value for name, value in self.facts["plan"].items() if name != "workers"}
        facts["partitions"] = {name: Partition(**fields) for name, fields in facts["partitions"].items()}
        return RunPlan(**facts)

    @cached_property
    def options(self) -> RunOptions:
        """How the run is checkpointed and logged."""
        return RunOptions(**self.facts["options"])

    @property
    def fingerprint(self) -> str:
        """Identity of the run, which its checkpoints carry."""
        return str(self.facts["sha256"])

    def other_code(self) -> list[str]:
        """List how code and libraries differ from those that the run was planned with."""
        return host.code_differences({"uavmec_jax's code": self.facts["code_sha256"]} | self.facts["versions"])

    def check_code(self) -> None:
        """Check that code and libraries are those of the run plan: only then are the results the same to the bit.

        Raises:
            StudyError: the run was planned with other code or other versions of the libraries.
        """
        if differ := self.other_code():
            raise StudyError(
                f"{self.path}: was planned with other code ({', '.join(differ)}), so the results could differ; "
                "resume it with that code, or give --other-code"
            )

    def check_reward(self, given: Any) -> None:
        """Check that a reward function is given if and only if the run was started with one: a file cannot hold it.

        Raises:
            StudyError: the run needs a reward function and none is given, or the other way round.
        """
        wanted = self.facts["label"].get("reward_function")
        if (wanted is None) != (given is None):
            reason = (
                f"was started with the reward function {wanted}; give it to um.runs.resume_run"
                if wanted
                else "was started without a reward function"
            )
            raise StudyError(f"{self.path}: reward: the run {reason}")

    @property
    def complete(self) -> bool:
        """Whether the results have been assembled, the last step of a run."""
        return (self.path / RUN).exists()

    @property
    def shards_folder(self) -> Path:
        """Where the shards are until the run is complete; whoever started or resumed the run holds its lock."""
        return self.path / SHARDS

    def shard_folder(self, shard: Shard) -> Path:
        """Return the folder of a shard, which is created with its first attempt."""
        return self.shards_folder / f"{shard.number:05d}"

    def failure(self, shard: Shard) -> Path:
        """Return the file that says why a shard failed."""
        return self.shard_folder(shard) / FAILURE

    def results(self, shard: Shard) -> list[Path]:
        """Return the results of a shard: one from each attempt that finished it, all with the same contents."""
        return files_matching(self.shard_folder(shard), f"{RESULT}-*.npz")

    def is_closed(self, shard: Shard) -> bool:
        """Return whether a shard is finished or has failed."""
        return self.complete or bool(self.results(shard)) or self.failure(shard).exists()

    def new_attempt(self, shard: Shard) -> str:
        """Return a name for another attempt at a shard, under which it writes: its number, and what makes it unique."""
        before = len(files_matching(self.shard_folder(shard), f"{PROGRESS}-*.json"))
        return f"{before + 1:02d}-{secrets.token_hex(3)}"

    def states(self) -> Iterator[tuple[Shard, ShardState, dict[str, Any]]]:
        """Yield every shard with its state and what its latest attempt last reported: progress, or why it failed."""
        complete = self.complete
        files: dict[str, list[Path]] = {}
        for file in () if complete else files_in_subfolders(self.shards_folder):
            files.setdefault(file.parent.name, []).append(file)
        for shard in self.plan.shards:
            present = sorted(files.get(f"{shard.number:05d}", ()), key=lambda file: file.name)
            reports = [file for file in present if file.name.startswith(f"{PROGRESS}-")]
            attempts = {"attempts": len(reports)}
            if complete or any(file.name.startswith(f"{RESULT}-") for file in present):
                yield shard, "done", attempts
            elif any(file.name == FAILURE for file in present):
                yield shard, "failed", attempts | read_json_or_empty(self.failure(shard))
            elif reports:
                report = read_json_or_empty(reports[-1]) | attempts
                yield shard, "running" if _is_running(report) else "stopped", report
            else:
                yield shard, "waiting", {}

    def remove_partial_files(self) -> None:
        """Remove what attempts that were killed have left of checkpoints; only where no other process works."""
        if is_local(self.shards_folder):
            for file in self.shards_folder.glob("*/.*.part.*"):
                file.unlink(missing_ok=True)


def _is_running(report: dict[str, Any]) -> bool:
    """Return whether an attempt goes on, as far as its last report tells; for display only."""
    silent = time.time() - report.get("at", 0) > _SILENCE_S
    return report.get("state") == "running" and not silent and not is_known_dead(report)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _digest(facts: dict[str, Any]) -> str:
    return _sha256(json.dumps({name: value for name, value in facts.items() if name != "sha256"}, sort_keys=True))
