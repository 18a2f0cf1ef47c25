"""Read results back from the files of a finished run."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import PolicyError, StudyError
from uavmec_jax.files.archives import MAX_BYTES, load_arrays
from uavmec_jax.files.locations import reached
from uavmec_jax.files.parsing import MAX_COLUMNS, read_json_object
from uavmec_jax.files.reading import MAX_TABLE_BYTES, digest_of, read_bytes, read_text
from uavmec_jax.scenarios.policy_files import WEIGHTS, read_policies
from uavmec_jax.studies.population import n_agents
from uavmec_jax.studies.results import AGENTS, CURVES, EVALUATION, RUN, SCHEMA, STUDY, Results
from uavmec_jax.studies.results_checks import (
    MAY_BE_MISSING,
    TEXT_AXES,
    check_agents,
    check_curves,
    check_evaluation,
    evaluation_shapes,
)
from uavmec_jax.studies.results_schema import check_label, check_run
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import parse_study

_FILES = (STUDY, AGENTS, CURVES, EVALUATION, WEIGHTS)
"""Those whose SHA-256 ``run.json`` holds."""

_MAX_ROW = 64 * 2**10
"""Longest row of the table, in bytes: of all policies, it takes a few thousand."""

_MAX_POINTS = 2_000_000
"""Most points of one agent's curves: environment steps are fewer than 2,000,000,000, and a chunk has a thousand."""

_SPARE = 2**20
"""Bytes of names and headers of an archive."""

LOST = "lost"
"""Fact of a run of which a file is lost, which holds what the run cost and the SHA-256 of the others: its name."""


def read_results(directory: Path, label: dict[str, Any] | None = None) -> Results:
    """Read the results of a finished run, without its weights (see :func:`load_weights`).

    Args:
        directory: folder of the run.
        label: the label in its run plan, which stands in for ``run.json`` if that is lost.

    Raises:
        StudyError: the folder holds no finished run, one of its files is damaged, does not fit its study or the others, or
            another version wrote it.
    """
    run = _read_run(directory) if label is None else {}
    _check_digests(directory, run)
    study = parse_study(read_text(directory / STUDY, StudyError), str(directory / STUDY))
    if label is None:
        check_label(run, study, directory / RUN)
    agents = _read_agents(directory / AGENTS, study)
    if label is not None:
        run = label | {"complete": len(agents) == n_agents(study), "agents_done": len(agents)}
        run[LOST] = RUN
    elif run["agents_done"] != len(agents):
        raise StudyError(f"{directory / AGENTS}: has {len(agents)} rows; {RUN} counts {run['agents_done']} agents")
    evaluation = _read_evaluation(directory / EVALUATION, study, len(agents))
    return Results(
        study=study,
        run=run,
        agents=agents,
        curves=_read_curves(directory / CURVES, study, agents),
        evaluation=evaluation,
    )


def _read_run(directory: Path) -> dict[str, Any]:
    """Read ``run.json``."""
    path = directory / RUN
    if not path.exists():
        raise StudyError(f"{directory}: holds no run ({RUN} is missing)")
    run = read_json_object(path, StudyError)
    if "schema" not in run:
        raise StudyError(f"{path}: cannot be read: schema is missing")
    if run["schema"] != SCHEMA or isinstance(run["schema"], bool):
        raise StudyError(f"{path}: schema is {run['schema']!r}; this version reads {SCHEMA}")
    check_run(run, path)
    return run


def _check_digests(directory: Path, run: dict[str, Any]) -> None:
    """Check that the files are as the run wrote them."""
    for name, digest in run.get("sha256", {}).items():
        if name not in _FILES:
            raise StudyError(f"{directory / RUN}: sha256 names {name!r}; known: {', '.join(_FILES)}")
        path = directory / name
        if path.exists() and digest_of(path, StudyError) != digest:
            raise StudyError(f"{path}: cannot be read: was altered or damaged since the run wrote it")


def _read_agents(path: Path, study: Study) -> pd.DataFrame:
    """Read and check the tidy table."""
    expected = n_agents(study)
    try:
        agents = _parse_table(
            read_bytes(path, StudyError, max_bytes=min((expected + 1) * _MAX_ROW, MAX_TABLE_BYTES)), expected
        )
    except StudyError:
        raise
    except (ValueError, OverflowError, MemoryError, RecursionError) as error:  # pandas' own errors are ValueErrors
        raise StudyError(f"{path}: cannot be read: {str(error) or type(error).__name__}") from None
    check_agents(study, agents, path)
    return agents


def _parse_table(content: bytes, most: int) -> pd.DataFrame:
    """Parse the tidy table; lists of device numbers stay text, also if they are empty or have one number.

    Numbers are missing (NaN) for agents for which a planner was not evaluated.

    Raises:
        ValueError: it is no table, or has too many columns or rows.
    """
    columns = pd.read_csv(io.BytesIO(content), nrows=0).columns
    if len(columns) > MAX_COLUMNS:
        raise ValueError(f"it has {len(columns)} columns; at most {MAX_COLUMNS} are read")
    text = {name: str for name in columns if name in TEXT_AXES or name.endswith("_devices_fixed")}
    missing = {name: [""] for name in columns if name.endswith(MAY_BE_MISSING)}
    table = pd.read_csv(
        io.BytesIO(content), dtype=text, keep_default_na=False, na_values=missing, nrows=most + 1, low_memory=False
    )
    if not isinstance(table.index, pd.RangeIndex):  # pandas takes surplus cells for names of the rows
        raise ValueError("its rows have more cells than there are columns")
    if len(table) > most:
        raise ValueError(f"it has more rows than the study has agents, {most}")
    return table


def _read_evaluation(path: Path, study: Study, agents: int) -> dict[str, np.ndarray]:
    """Read and check the evaluation."""
    sizes = (int(np.prod(shape)) for _, shape in evaluation_shapes(study, agents).values())
    arrays = load_arrays(path, max_bytes=min(8 * sum(sizes) + _SPARE, MAX_BYTES))
    check_evaluation(study, agents, arrays, path)
    return arrays


def _read_curves(path: Path, study: Study, agents: pd.DataFrame) -> dict[str, dict[str, np.ndarray]]:
    """Read and check the curves; none if nothing was trained."""
    if not study.algorithms:
        return {}
    arrays = load_arrays(path, max_bytes=min(8 * (len(agents) + 1) * 2 * _MAX_POINTS + _SPARE, MAX_BYTES))
    counts = agents["algorithm"].value_counts() if "algorithm" in agents else {study.algorithms[0]: len(agents)}
    check_curves(study, {name: int(counts[name]) for name in study.algorithms if name in counts}, arrays, path)
    return traverse_util.unflatten_dict(arrays, sep="/")


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
        return read_policies(path / WEIGHTS, max_bytes=MAX_BYTES).weights_of(which, algorithm)
