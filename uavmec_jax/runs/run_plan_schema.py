"""The schema of run plans (``run_plan.json``)."""

from typing import Annotated, Any

import pydantic
from pydantic import Field

from uavmec_jax.errors import StudyError
from uavmec_jax.files.validation import StrictModel, validated
from uavmec_jax.runs.options import CheckpointKind
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.population import n_agents
from uavmec_jax.studies.results_schema import Digest, PartitionFacts, RunLabel
from uavmec_jax.studies.schema import Study

_MAX = 2**62
"""Largest number of agents, steps or bytes."""

_Count = Annotated[int, Field(ge=1, le=_MAX)]
_CountOrZero = Annotated[int, Field(ge=0, le=_MAX)]


class OptionsFacts(StrictModel):
    """How a run is checkpointed and logged."""

    checkpoint: CheckpointKind
    checkpoint_every_s: Annotated[float, Field(ge=0)]
    checkpoint_share: Annotated[float, Field(gt=0, le=1)]
    tensorboard: bool


class PlanFacts(StrictModel):
    """How a study is cut into shards; the agents of each shard follow those of the one before."""

    agents: _Count
    partitions: Annotated[dict[str, PartitionFacts], Field(min_length=1, max_length=10_000)]
    members: dict[str, _Count]
    steps: dict[str, _CountOrZero]
    free_bytes: _CountOrZero
    workers: int | None = None
    """Of versions whose workers held leases."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> "PlanFacts":
        for name in ("members", "steps"):
            if [*getattr(self, name)] != [*self.partitions]:
                raise ValueError(f"plan.{name} and plan.partitions should name the same parts in the same order")
        for part, partition in self.partitions.items():
            least = (partition.shards - 1) * partition.shard_size + 1
            if not least <= self.members[part] <= partition.shards * partition.shard_size:
                raise ValueError(
                    f"plan.partitions.{part} has {partition.shards} shards of {partition.shard_size} for "
                    f"{self.members[part]} agents; every shard should have agents, and every agent a shard"
                )
        if sum(self.members.values()) != self.agents:
            raise ValueError(f"plan.agents is {self.agents}; the parts have {sum(self.members.values())}")
        return self


class RunPlanFacts(StrictModel):
    """The contents of a run plan's file."""

    version: Annotated[int, Field(alias="schema")]
    label: RunLabel
    study_sha256: Digest
    code_sha256: Digest
    versions: Annotated[dict[str, str], Field(max_length=100)]
    options: OptionsFacts
    plan: PlanFacts
    sha256: Digest


def check_facts(facts: dict[str, Any], source: object) -> None:
    """Check the contents of a run plan's file, which ``source`` names in messages.

    Raises:
        StudyError: a value is missing, unknown or not what it should be, or two of them do not fit together.
    """
    validated(RunPlanFacts, facts, source, StudyError)


def check_study(plan: dict[str, Any], study: Study, source: object) -> None:
    """Check that a plan is one of this study.

    Raises:
        StudyError: it cuts other parts, or parts with other numbers of agents, or trains where the study does not.
    """
    parts = {part.name: part.study for part in split_study(study)}
    if [*plan["partitions"]] != [*parts]:
        raise StudyError(
            f"{source}: plan.partitions has {', '.join(plan['partitions'])}; the study has {', '.join(parts)}"
        )
    for name, part in parts.items():
        if plan["members"][name] != n_agents(part):
            raise StudyError(
                f"{source}: plan.members.{name} is {plan['members'][name]}; the study has {n_agents(part)} agents"
            )
        if (plan["steps"][name] > 0) != (part.algorithm != "none"):
            trains = "none" if part.algorithm == "none" else f"{part.steps} steps of each agent"
            raise StudyError(f"{source}: plan.steps.{name} is {plan['steps'][name]}; the study has {trains}")
