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
from uavmec_jax.files.locations import check_no_link, files_in_subfolders, is_local, names_in, reached
from uavmec_jax.files.locks import LOCK, OWNER, is_known_dead
from uavmec_jax.files.parsing import read_json_object
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.file_names import (
    FAILURE,
    LOG,
    PROGRESS,
    RESULT,
    RUN_PLAN,
    SHARDS,
    TENSORBOARD,
    TOUR,
    is_named,
    is_ours,
    is_partial,
)
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.reports import read_failure, read_progress
from uavmec_jax.runs.run_plan import RunPlan, Shard
from uavmec_jax.runs.run_plan_schema import check_facts, check_study
from uavmec_jax.studies.parts import Part, split_study
from uavmec_jax.studies.population import AgentId, make_agent_ids
from uavmec_jax.studies.results import RUN, STUDY
from uavmec_jax.studies.results_schema import check_label
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
            StudyError: the folder holds no run; the run plan or the study was altered or is damaged, or they do not fit
                together; or another version wrote it; or its object store cannot be reached.
        """
        with reached(path):
            folder = cls(path, cls._read(path))
            file = path / RUN_PLAN
            check_study(folder.facts["plan"], folder.study, file)
            check_label(folder.facts["label"], folder.study, file)
            return folder

    @staticmethod
    def _read(path: Path) -> dict[str, Any]:
        """Read and check a run plan."""
        file = path / RUN_PLAN
        if not file.exists():
            tour = f"; it holds a tour of `uavmec plan` ({TOUR})" if (path / TOUR).exists() else ""
            raise StudyError(f"{path}: holds no run that can be resumed ({RUN_PLAN} is missing){tour}")
        facts = read_json_object(file, StudyError)
        schema = facts.get("schema")
        if schema not in (SCHEMA, _WITH_LEASES) or isinstance(schema, bool):
            raise StudyError(f"{file}: schema is {schema!r}; this version reads {SCHEMA}")
        if schema == _WITH_LEASES and not (path / RUN).exists():
            raise StudyError(f"{path}: was started by a version whose workers held leases; finish it with that version")
        if facts.get("sha256") != _digest(facts):
            raise StudyError(f"{file}: was altered or damaged: it does not fit its SHA-256; plan the study anew")
        check_facts(facts, file)
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

    def files(self, shard: Shard, kind: str) -> list[Path]:
        """Return a shard's files of a kind, such as ``CHECKPOINT``, sorted by name; strangers among them are left out."""
        folder = self.shard_folder(shard)
        return [folder / name for name in names_in(folder) if is_named(name, kind)]

    def results(self, shard: Shard) -> list[Path]:
        """Return the results of a shard: one from each attempt that finished it, all with the same contents."""
        return self.files(shard, RESULT)

    def strangers(self) -> list[str]:
        """Return what lies among the shards and was not written by a run, as paths inside the folder of all shards."""
        shards = {self.shard_folder(shard).name for shard in self.plan.shards}
        beside = [name for name in names_in(self.shards_folder) if name not in {LOCK, OWNER, *shards}]
        inside = [file for file in files_in_subfolders(self.shards_folder) if file.parent.name in shards]
        strange = [f"{file.parent.name}/{file.name}" for file in inside if not is_ours(file.name)]
        return sorted([name for name in beside if not is_partial(name)] + strange)

    def check_links(self) -> None:
        """Check that no folder in which a run writes is a link to a folder elsewhere.

        Raises:
            StudyError: one is.
        """
        folders = [self.path / name for name in (LOG, TENSORBOARD)]
        folders += [self.shards_folder, *(self.shard_folder(shard) for shard in self.plan.shards)]
        for folder in folders if is_local(self.path) else ():
            check_no_link(folder)

    def agent_ids(self, shard: Shard) -> list[AgentId]:
        """Return the identities of a shard's agents."""
        return self._agent_ids[shard.part][shard.first : shard.first + shard.agents]

    @cached_property
    def parts(self) -> dict[str, Part]:
        """The parts of the study by name."""
        return {part.name: part for part in split_study(self.study)}

    @cached_property
    def _agent_ids(self) -> dict[str, list[AgentId]]:
        """The identities of the agents of each part."""
        return {
            name: [agent_id | part.values for agent_id in make_agent_ids(part.study)]
            for name, part in self.parts.items()
        }

    def is_closed(self, shard: Shard) -> bool:
        """Return whether a shard is finished or has failed."""
        return self.complete or bool(self.results(shard)) or self.failure(shard).exists()

    def new_attempt(self, shard: Shard) -> str:
        """Return a name for another attempt at a shard, under which it writes: its number, and what makes it unique."""
        before = len(self.files(shard, PROGRESS))
        return f"{before + 1:02d}-{secrets.token_hex(3)}"

    def states(self) -> Iterator[tuple[Shard, ShardState, dict[str, Any]]]:
        """Yield every shard with its state and what its latest attempt last reported: progress, or why it failed."""
        complete = self.complete
        files: dict[str, list[Path]] = {}
        for file in () if complete else files_in_subfolders(self.shards_folder):
            files.setdefault(file.parent.name, []).append(file)
        for shard in self.plan.shards:
            present = sorted(files.get(f"{shard.number:05d}", ()), key=lambda file: file.name)
            reports = [file for file in present if is_named(file.name, PROGRESS)]
            attempts = {"attempts": len(reports)}
            if complete or any(is_named(file.name, RESULT) for file in present):
                yield shard, "done", attempts
            elif any(file.name == FAILURE for file in present):
                yield shard, "failed", attempts | read_failure(self.failure(shard))
            elif reports:
                report = read_progress(reports[-1]) | attempts
                yield shard, "running" if _is_running(report) else "stopped", report
            else:
                yield shard, "waiting", {}

    def remove_partial_files(self) -> None:
        """Remove what attempts that were killed have left of files; only where no other process works."""
        for shard in self.plan.shards if is_local(self.path) else ():
            for name in filter(is_partial, names_in(self.shard_folder(shard))):
                (self.shard_folder(shard) / name).unlink(missing_ok=True)


def _is_running(report: dict[str, Any]) -> bool:
    """Return whether an attempt goes on, as far as its last report tells; for display only."""
    silent = time.time() - report.get("at", 0) > _SILENCE_S
    return report.get("state") == "running" and not silent and not is_known_dead(report)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _digest(facts: dict[str, Any]) -> str:
    return _sha256(json.dumps({name: value for name, value in facts.items() if name != "sha256"}, sort_keys=True))
