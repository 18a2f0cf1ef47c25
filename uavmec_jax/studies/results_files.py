"""Read results back from the files of a finished run."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import PolicyError, StudyError
from uavmec_jax.files.archives import load_arrays
from uavmec_jax.files.locations import reached
from uavmec_jax.files.reading import read_text
from uavmec_jax.scenarios.policy_files import WEIGHTS, read_policies
from uavmec_jax.studies.results import AGENTS, CURVES, EVALUATION, RUN, SCHEMA, STUDY, Results
from uavmec_jax.studies.study import parse_study

_MAY_BE_MISSING = ("_planned", "_first_device", "_first_share", "_service", "_censored")
"""Ends of the names of columns of numbers that not every agent has."""


def read_results(directory: Path) -> Results:
    """Read the results of a finished run, without its weights (see :func:`load_weights`).

    Raises:
        StudyError: the folder holds no finished run, one of its files is damaged, or another version wrote it.
    """
    run = _read_run(directory)
    _check_digests(directory, run)
    try:
        agents = _read_table(directory / AGENTS)
    except (OSError, ValueError) as error:
        raise StudyError(f"{directory}: cannot be read: {error}") from None
    study = parse_study(read_text(directory / STUDY, StudyError), str(directory / STUDY))
    curves = traverse_util.unflatten_dict(load_arrays(directory / CURVES), sep="/") if study.algorithms else {}
    return Results(study=study, run=run, agents=agents, curves=curves, evaluation=load_arrays(directory / EVALUATION))


def _read_run(directory: Path) -> dict[str, Any]:
    """Read ``run.json``."""
    path = directory / RUN
    if not path.exists():
        raise StudyError(f"{directory}: holds no run ({RUN} is missing)")
    try:
        run: dict[str, Any] = json.loads(read_text(path, StudyError))
        schema = run["schema"]
    except (ValueError, KeyError, TypeError) as error:
        raise StudyError(f"{directory}: cannot be read: {error}") from None
    if schema != SCHEMA:
        raise StudyError(f"{path}: schema is {schema}; this version reads {SCHEMA}")
    return run


def _check_digests(directory: Path, run: dict[str, Any]) -> None:
    """Check that the files are as the run wrote them."""
    for name, digest in run.get("sha256", {}).items():
        path = directory / name
        if path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise StudyError(f"{path}: cannot be read: was altered or damaged since the run wrote it")


def _read_table(path: Path) -> pd.DataFrame:
    """Read the tidy table; lists of device numbers stay text, also if they are empty or have one number.

    Numbers are missing (NaN) for agents for which a planner was not evaluated.
    """
    content = path.read_bytes()
    columns = pd.read_csv(io.BytesIO(content), nrows=0).columns
    lists = {name: str for name in columns if name.endswith("_devices_fixed")}
    missing = {name: [""] for name in columns if name.endswith(_MAY_BE_MISSING)}
    return pd.read_csv(io.BytesIO(content), dtype=lists, keep_default_na=False, na_values=missing)


def load_weights(directory: str | Path, which: str = "best", algorithm: str | None = None) -> dict[str, Any]:
    """Load trained weights of a run as the networks take them, leaves ``[A, ...]`` in the order of ``agents.csv``.

    Args:
        directory: folder of the run, a path or a URL.
        which: ``"best"`` or ``"last"``.
        algorithm: name of the algorithm; by default the first one of the run.

    Raises:
        PolicyError: there are no such weights, the file is damaged, or its object store cannot be reached.
    """
    with reached(directory, PolicyError) as path:
        return read_policies(path / WEIGHTS).weights_of(which, algorithm)
