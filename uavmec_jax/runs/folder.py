"""The folder of a run: a plan that is checked, a folder per shard, and where each shard stands."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import LEASE_S, is_quiet, read_lease
from uavmec_jax.files.reading import read_facts, read_text
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.checkpoints import INTERVAL_S, SHARE, Kind
from uavmec_jax.runs.run_plan import Plan, Shard
from uavmec_jax.studies.results import RUN, STUDY
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import parse_study, study_toml
from uavmec_jax.training import host
from uavmec_jax.training.partition import Blocks

SCHEMA = 1
"""Version of a plan's file."""

PLAN, LOG, SHARDS = "plan.json", "log", "shards"

State = Literal["waiting", "running", "stopped", "failed", "done"]


@dataclass(frozen=True)
class Durability:
    """How a run is kept.

    Attributes:
        snapshot: what is kept of a shard in training: ``full`` or ``weights``.
        snapshot_every_s: least time between two snapshots.
        snapshot_share: most of the time that they may take; it is longer between them where they are large.
        lease_s: seconds without a sign after which a worker on another machine counts as dead.
        tensorboard: whether curves are also written as TensorBoard's event files.
    """

    snapshot: Kind = "full"
    snapshot_every_s: float = INTERVAL_S
    snapshot_share: float = SHARE
    lease_s: float = LEASE_S
    tensorboard: bool = False


class RunFolder:
    """A run on disk.

    Attributes:
        path: the folder.
        facts: what its plan says, checked.
    """

    def __init__(self, path: Path, facts: dict[str, Any]) -> None:
        self.path = path
        self.facts = facts

    @classmethod
    def create(cls, path: Path, study: Study, plan: Plan, durability: Durability, label: dict[str, Any]) -> "RunFolder":
        """Write study and plan into a folder that exists, the plan last."""
        text = study_toml(study)
        write_text(path / STUDY, text)
        facts = {
            "schema": SCHEMA,
            "label": label,
            "study_sha256": _sha256(text),
            "code_sha256": host.code_digest(),
            "versions": host.versions(),
            "durability": asdict(durability),
            "plan": asdict(plan),
        }
        facts["sha256"] = _digest(facts)
        write_text(path / PLAN, json.dumps(facts, indent=1) + "\n")
        return cls(path, facts)

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Read a run's plan.

        Raises:
            StudyError: the folder holds no run, its plan or its study is damaged or was altered, or it was written by a
                newer version.
        """
        file = path / PLAN
        if not file.is_file():
            raise StudyError(f"{path}: holds no run that can be resumed ({PLAN} is not there)")
        try:
            facts = json.loads(read_text(file, StudyError))
            schema, digest = facts["schema"], facts["sha256"]
        except (ValueError, KeyError, TypeError) as error:
            raise StudyError(f"{file}: cannot be read: {error!r}; plan the study anew in another folder") from None
        if schema != SCHEMA:
            raise StudyError(f"{file}: schema is {schema!r}; this version reads {SCHEMA}")
        if digest != _digest(facts):
            raise StudyError(f"{file}: was altered or damaged: it does not fit its SHA-256; plan the study anew")
        if _sha256(read_text(path / STUDY, StudyError)) != facts["study_sha256"]:
            raise StudyError(f"{path / STUDY}: was altered or damaged since the run was planned; run it as a new study")
        return cls(path, facts)

    @cached_property
    def study(self) -> Study:
        """The resolved study."""
        return parse_study(read_text(self.path / STUDY, StudyError), str(self.path / STUDY))

    @cached_property
    def plan(self) -> Plan:
        """How it is cut."""
        facts = dict(self.facts["plan"])
        facts["blocks"] = {name: Blocks(**cut) for name, cut in facts["blocks"].items()}
        return Plan(**facts)

    @cached_property
    def durability(self) -> Durability:
        """How it is kept."""
        return Durability(**self.facts["durability"])

    @property
    def fingerprint(self) -> str:
        """What everything in the folder must be of."""
        return str(self.facts["sha256"])

    def other_code(self) -> list[str]:
        """How code and libraries differ from those that planned the run; empty if they do not."""
        now = {"uavmec_jax's code": host.code_digest()} | host.versions()
        then = {"uavmec_jax's code": self.facts["code_sha256"]} | self.facts["versions"]
        return [f"{name} {then.get(name, '?')[:12]} -> {now[name][:12]}" for name in now if now[name] != then.get(name)]

    def check_code(self) -> None:
        """Bits are only the same from the same code.

        Raises:
            StudyError: the run was planned by other code or other versions of the libraries.
        """
        if differ := self.other_code():
            raise StudyError(
                f"{self.path}: was planned by other code ({', '.join(differ)}), with which its bits would be others; "
                "resume it with that code, or say --other-code"
            )

    def check_reward(self, given: Any) -> None:
        """A reward that is a function of Python is not in the plan.

        Raises:
            StudyError: the run was started with one and none is given, or the other way round.
        """
        wanted = self.facts["label"].get("reward_function")
        if (wanted is None) != (given is None):
            say = f"was started with the reward function {wanted}; give it to um.resume_run" if wanted else "had none"
            raise StudyError(f"{self.path}: reward: the run {say}")

    @property
    def complete(self) -> bool:
        """Whether the results have been put together, which is the last thing that is done."""
        return (self.path / RUN).exists()

    @property
    def shards_folder(self) -> Path:
        """Where the shards are until the run is complete; who holds it, started or resumed the run."""
        return self.path / SHARDS

    def shard_folder(self, shard: Shard) -> Path:
        """Where a shard is kept; made when it is claimed."""
        return self.shards_folder / f"{shard.number:05d}"

    def result(self, shard: Shard) -> Path:
        """The file of a shard that is finished."""
        return self.shard_folder(shard) / "result.npz"

    def failure(self, shard: Shard) -> Path:
        """The file that says why a shard could not be finished."""
        return self.shard_folder(shard) / "failed.json"

    def states(self) -> Iterator[tuple[Shard, State, dict[str, Any]]]:
        """Where every shard stands, and what its latest holder told."""
        complete = self.complete
        for shard in self.plan.shards:
            if complete or self.result(shard).exists():
                yield shard, "done", {}
            elif self.failure(shard).exists():
                yield shard, "failed", read_facts(self.failure(shard))
            elif lease := read_lease(self.shard_folder(shard)):
                yield shard, "stopped" if is_quiet(lease, self.durability.lease_s) else "running", lease
            else:
                yield shard, "waiting", {}


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _digest(facts: dict[str, Any]) -> str:
    return _sha256(json.dumps({name: value for name, value in facts.items() if name != "sha256"}, sort_keys=True))
