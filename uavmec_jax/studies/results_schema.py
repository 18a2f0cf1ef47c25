"""The schema of ``run.json``, and of the label in a run plan that it begins as."""

import re
from typing import Annotated, Any

import pydantic
from pydantic import ConfigDict, Field

from uavmec_jax.errors import StudyError
from uavmec_jax.files.validation import PrintableText, StrictModel, validated
from uavmec_jax.studies.places import places_of
from uavmec_jax.studies.population import n_agents, n_seeds, seeds_of
from uavmec_jax.studies.schema import Study

Digest = Annotated[str, Field(pattern=re.compile(r"\A[0-9a-f]{64}\Z"))]
"""A SHA-256."""

_Count = Annotated[int, Field(ge=0, le=2**62)]
_Share = Annotated[float, Field(ge=0)]


class PartitionFacts(StrictModel):
    """How the agents of a part of a study are cut into shards and groups."""

    shards: Annotated[int, Field(ge=1, le=10_000_000)]
    shard_size: Annotated[int, Field(ge=1, le=2**31)]
    groups: Annotated[int, Field(ge=1, le=2**31)]
    shard_bytes: _Count

    @pydantic.model_validator(mode="after")
    def _check(self) -> "PartitionFacts":
        if self.shard_size % self.groups:
            raise ValueError(
                f"shard_size is {self.shard_size}; it should be a multiple of groups, which is {self.groups}"
            )
        return self


class PlaceFacts(StrictModel):
    """A place of a study: its network, and its devices' names and traffic."""

    place: PrintableText
    network_sha256: Annotated[str, Field(max_length=100)]
    name: list[PrintableText]
    weight: list[Annotated[float, Field(ge=0)]]
    high_traffic: list[bool]


class RunLabel(StrictModel):
    """What is known of a run before it starts. Facts about machine and versions, from which nothing is computed, are free."""

    model_config = ConfigDict(extra="allow")

    version: Annotated[int, Field(alias="schema")]
    study: Annotated[str, Field(max_length=80)]
    command: str
    started: str
    complete: bool
    agents: _Count
    seeds: list[_Count]
    places: dict[str, PlaceFacts] = Field(default_factory=dict)
    partitions: dict[str, PartitionFacts]
    reward_function: str | None = None


class RunFacts(RunLabel):
    """The contents of ``run.json``."""

    agents_done: _Count
    seconds: dict[str, Annotated[float, Field(ge=0)]]
    diverged: _Count | None = None
    environment_steps: _Count | None = None
    training_steps_per_second: _Count | None = None
    validation_share: _Share | None = None
    checkpoint_share: _Share | None = None
    sha256: dict[str, Digest] = Field(default_factory=dict)

    @pydantic.model_validator(mode="after")
    def _check(self) -> "RunFacts":
        if "wall" not in self.seconds:
            raise ValueError("seconds.wall is missing")
        if self.training_steps_per_second is not None and self.environment_steps is None:
            raise ValueError("environment_steps is missing, and training_steps_per_second is given")
        if self.complete and self.agents_done != self.agents:
            raise ValueError(f"complete is true, but agents_done is {self.agents_done} of {self.agents} agents")
        return self


def check_run(run: dict[str, Any], source: object) -> None:
    """Check the contents of ``run.json``.

    Raises:
        StudyError: a value is missing or not what it should be.
    """
    validated(RunFacts, run, source, StudyError)


def check_label(run: dict[str, Any], study: Study, source: object) -> None:
    """Check that a label, or ``run.json``, is one of this study.

    Raises:
        StudyError: it names another study, other agents, seeds or places.
    """
    facts = {"study": study.name, "agents": n_agents(study)}
    for name, expected in facts.items():
        if run[name] != expected:
            raise StudyError(f"{source}: {name} is {run[name]!r}; the study file beside it has {expected!r}")
    if len(run["seeds"]) != n_seeds(study) or run["seeds"] != seeds_of(study):
        raise StudyError(f"{source}: seeds differ from those of the study file beside it")
    places = run.get("places", {})
    if set(places) != set(places_of(study)):
        raise StudyError(
            f"{source}: places are {sorted(places)}; the study file beside it has {sorted(places_of(study))}"
        )
    for name, place in places.items():
        for field in ("name", "weight", "high_traffic"):
            if len(place[field]) != study.params.n_devices:
                raise StudyError(
                    f"{source}: places.{name}.{field} has {len(place[field])} values; the study has "
                    f"{study.params.n_devices} devices"
                )
