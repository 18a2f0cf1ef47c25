"""What attempts report while they run, read back: for the status and the progress bar, so what is damaged is left out."""

from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import ConfigDict, Field

from uavmec_jax.files.reading import read_json_or_empty
from uavmec_jax.files.validation import StrictModel

_Name = Annotated[str, Field(max_length=1000)]


class ProgressReport(StrictModel):
    """How far an attempt at a shard has got."""

    model_config = ConfigDict(extra="ignore")

    attempt: _Name = ""
    state: Literal["running", "stopped", "done"]
    node: _Name = "an unknown node"
    steps: Annotated[int, Field(ge=0, le=2**62)] = 0
    speed: Annotated[float, Field(ge=0, le=1e15)] = 0.0
    machine: _Name = "an unknown machine"
    pid: Annotated[int, Field(ge=1, lt=2**31)]
    born: _Name | None = None
    at: Annotated[float, Field(ge=0)] = 0.0


class FailureReport(StrictModel):
    """Why a shard failed."""

    model_config = ConfigDict(extra="ignore")

    error: Annotated[str, Field(max_length=2**20)] = "an unknown error"
    traceback: str = ""


def read_progress(path: Path) -> dict[str, Any]:
    """Read how far an attempt has got; empty if the report is missing or damaged."""
    return _read(path, ProgressReport)


def read_failure(path: Path) -> dict[str, Any]:
    """Read why a shard failed; empty if the file is missing or damaged."""
    return _read(path, FailureReport)


def _read(path: Path, model: type[StrictModel]) -> dict[str, Any]:
    try:
        return model.model_validate(read_json_or_empty(path)).model_dump(exclude_unset=True)
    except pydantic.ValidationError:
        return {}
