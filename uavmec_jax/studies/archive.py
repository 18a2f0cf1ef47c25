"""Runs on disk: put together from their shards, and read back, whole or as far as they got."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import StudyError
from uavmec_jax.files import load_arrays
from uavmec_jax.studies.collection import WEIGHTS, read_collection
from uavmec_jax.studies.durable.folder import PLAN, RUN, SHARDS, STUDY, RunFolder
from uavmec_jax.studies.durable.leases import Leases, named
from uavmec_jax.studies.results import AGENTS, CURVES, EVALUATION, SCHEMA, Results
from uavmec_jax.studies.shard import Finished
from uavmec_jax.studies.study import cell_axes, load_study


def check_directory(directory: Path) -> None:
    """Refuse a folder that cannot take a run.

    Raises:
        StudyError: it holds a run or something else, somebody is at work in it, or it is a file.
    """
    if (holder := Leases().holder(directory / SHARDS)) is not None:
        raise StudyError(f"{directory}: {named(holder)} is at work in it{help_with(directory)}")
    check_empty(directory)


def check_empty(directory: Path) -> None:
    """Refuse a folder that holds anything but claims."""
    if holds_run(directory) or (directory / PLAN).exists():
        raise StudyError(
            f"{directory}: already holds a run; go on with it by `uavmec resume`, or give another folder with --out"
        )
    if directory.exists() and not directory.is_dir():
        raise StudyError(f"{directory}: exists and is not an empty folder; give another one with --out")
    if directory.exists() and any(file.name != SHARDS for file in directory.iterdir()):
        raise StudyError(f"{directory}: exists and is not an empty folder; give another one with --out")


def help_with(directory: Path) -> str:
    """What somebody may do who finds a run at work."""
    return f"; to help it, start `uavmec worker {directory}`"


def put_together(folder: RunFolder, shards: Iterable[Finished], **more: Any) -> Results:
    """The results of a run whose shards are all finished; the shards' own files are then no longer needed.

    However often and by whomever it is done, the files are the same. ``more`` is added to the run's label.

    Raises:
        StudyError: an agent is there twice, or missing.
    """
    results = Results.of(folder.study, folder.facts["label"] | more, shards, folder.plan.agents)
    _check_agents(folder, results)
    results.save(folder.path)
    shutil.rmtree(folder.shards_folder, ignore_errors=True)
    return results


def _check_agents(folder: RunFolder, results: Results) -> None:
    """No agent twice, none missing."""
    axes = [name for name in results.agents if name in ("seed", *cell_axes(folder.study))]
    if len(results.agents) != folder.plan.agents or results.agents.duplicated(axes).any():
        raise StudyError(
            f"{folder.path}: its shards hold {len(results.agents):,} agents, the plan has {folder.plan.agents:,}, each once"
        )


def finished_shards(folder: RunFolder) -> list[Finished]:
    """The shards that are finished by now.

    Raises:
        StudyError: the file of one is damaged.
    """
    return [Finished.read(folder.result(shard)) for shard, state, _ in folder.states() if state == "done"]


def partial_results(folder: RunFolder) -> Results:
    """The results of the shards that are finished by now."""
    return Results.of(folder.study, folder.facts["label"], finished_shards(folder), folder.plan.agents)


def sound_shards(folder: RunFolder, tell: Callable[..., None]) -> tuple[list[Finished], list[int]]:
    """The shards that are finished, and the numbers of those whose files are damaged.

    The damaged ones are named and set aside; they are no longer finished.
    """
    sound, damaged = [], []
    for shard in folder.plan.shards:
        path = folder.result(shard)
        if not path.exists():
            continue
        try:
            sound.append(Finished.read(path))
        except StudyError as error:
            tell("damaged", shard=shard.number, file=path.name, error=str(error))
            path.rename(path.with_suffix(".damaged"))
            damaged.append(shard.number)
    return sound, damaged


def holds_run(directory: Path) -> bool:
    """Whether a folder holds the results of a run, or a study."""
    return (directory / RUN).exists() or (directory / STUDY).exists()


def load_results(directory: str | Path) -> Results:
    """Read a run back (all but its weights, see :func:`load_weights`); one that goes on, or was stopped, as far as it is.

    Raises:
        StudyError: the folder holds no run, a file of it is damaged, or it was written by a newer version.
    """
    directory = Path(directory)
    if not (directory / RUN).exists() and (directory / PLAN).exists():
        return partial_results(RunFolder.open(directory))
    run = _read_run(directory)
    _check_manifest(directory, run)
    try:
        agents = _read_table(directory / AGENTS)
    except (OSError, ValueError) as error:
        raise StudyError(f"{directory}: cannot be read: {error}") from None
    study = load_study(directory / STUDY)
    return Results(
        study=study,
        run=run,
        agents=agents,
        curves=_nested_curves(directory / CURVES, run.get("schema", 1)) if study.algorithms else {},
        evaluation=load_arrays(directory / EVALUATION),
    )


def _read_run(directory: Path) -> dict[str, Any]:
    """What ``run.json`` holds."""
    path = directory / RUN
    if not path.is_file():
        raise StudyError(f"{directory}: holds no run ({RUN} is not there)")
    try:
        run: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StudyError(f"{directory}: cannot be read: {error}") from None
    if run.get("schema", SCHEMA) > SCHEMA:
        raise StudyError(f"{path}: schema is {run['schema']}; this version reads up to {SCHEMA}")
    return run


def _check_manifest(directory: Path, run: dict[str, Any]) -> None:
    """The files are those that the run left (runs of older versions do not say)."""
    for name, digest in run.get("sha256", {}).items():
        path = directory / name
        if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise StudyError(f"{path}: cannot be read: was altered or damaged since the run left it")


def _read_table(path: Path) -> pd.DataFrame:
    """The tidy table; lists of device numbers stay text, also where they are empty or one number."""
    lists = {name: str for name in pd.read_csv(path, nrows=0).columns if name.endswith("_devices_fixed")}
    return pd.read_csv(path, dtype=lists, keep_default_na=False)


def load_weights(directory: str | Path, which: str = "best", algorithm: str | None = None) -> dict[str, Any]:
    """Trained weights of a run as the networks take them, leaves ``[A, ...]`` in the order of ``agents.csv``.

    Args:
        directory: of the run.
        which: ``"best"`` or ``"last"``.
        algorithm: whose agents; by default the first algorithm of the run.

    Raises:
        PolicyError: there are none, or the file is damaged.
    """
    return read_collection(Path(directory) / WEIGHTS).weights_of(which, algorithm)


def _nested_curves(path: Path, schema: int) -> dict[str, Any]:
    """Curves by algorithm."""
    nested: dict[str, Any] = traverse_util.unflatten_dict(load_arrays(path), sep="/")
    return nested if schema > 1 else {"dqn": nested}
