"""The folder of a search: one process at a time works in it, and its database holds the trials of this very search."""

import hashlib
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavmec_jax.errors import StudyError
from uavmec_jax.files.extras import optional
from uavmec_jax.files.locations import local_path, remove_folder
from uavmec_jax.files.locks import lock_folder
from uavmec_jax.files.output_folders import WORK, check_empty, remove_if_empty
from uavmec_jax.files.reading import read_json_or_empty
from uavmec_jax.files.writing import write_text
from uavmec_jax.search.space import Choices, Range, Space, contains, identity
from uavmec_jax.training import host

if TYPE_CHECKING:
    import optuna

DATABASE, TRIALS, BEST, FACTS = "trials.db", "trials.csv", "best.toml", "search.json"

BATCH, SPACE = "batch", "space"
"""What the database calls the number of a trial's batch, and the digest of the space."""

_WAIT_S = 60.0
"""Seconds in which another program that has locked the database must let go of it."""

_OPTUNAS = ("studies", "version_info")
"""Tables that Optuna creates before all others."""

_NEW_FOLDER = "give another folder with --out"


@contextmanager
def search_folder(directory: str | Path, space: Space, command: str = "") -> Iterator[Path]:
    """Hold the folder of a search, new or begun, in which nobody else works meanwhile; yield its path.

    Args:
        directory: the folder, on this machine; it is created if it is missing.
        space: of the search.
        command: the command line, for the label.

    Raises:
        StudyError: Optuna is not installed, another process works in the folder, or it holds another search or something
            else.
    """
    import_optuna()
    path = local_path(directory, "the database of a search")
    existed = path.exists()
    _begun(path, space)
    try:
        with lock_folder(path / WORK, path, if_dead=f"if that process is dead, remove {path / WORK}"):
            try:
                if begun := _begun(path, space):  # asked again: whoever held the lock may have written
                    with opened_trials(path, space):  # before anything is written
                        pass
                facts = {"space": space.model_dump(mode="json"), "command": command} | host.describe()
                write_text(path / FACTS, json.dumps(facts | {"begun": begun}))
                yield path
            finally:
                remove_folder(path / WORK)
    finally:
        if not existed:
            remove_if_empty(path)


def import_optuna() -> Any:
    """Import Optuna, which is an extra.

    Raises:
        StudyError: it is not installed.
    """
    optuna = optional("optuna", "search", "search")
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # of what it finds in a damaged database, our error is enough
    return optuna


def _begun(path: Path, space: Space) -> bool:
    """Return whether a folder holds trials of this very search; ``False`` for one that is empty or missing.

    Raises:
        StudyError: it holds something else.
    """
    facts, database = path / FACTS, path / DATABASE
    if not facts.exists() and not database.exists():
        check_empty(path)
        return False
    before = read_json_or_empty(facts)
    try:
        same = identity(Space.model_validate(before["space"], strict=True)) == identity(space)
    except (ValueError, KeyError):
        raise StudyError(f"{facts}: is missing, damaged or not of a search; {_NEW_FOLDER}") from None
    if not same:
        raise StudyError(f"{path}: holds another search; {_NEW_FOLDER}")
    if database.is_symlink() or (database.exists() and not database.is_file()):
        raise StudyError(f"{database}: is not a file; {_NEW_FOLDER}")
    begun = before.get("begun") is True
    if begun and not (database.exists() and database.stat().st_size):
        raise StudyError(f"{database}: is missing or empty although the search has begun; {_NEW_FOLDER}")
    return begun


@contextmanager
def opened_trials(path: Path, space: Space) -> Iterator["optuna.Study"]:
    """Yield the trials in the database of a search; the first one of a new database is up to the caller.

    Another program that has locked the database is waited for.

    Raises:
        StudyError: the database is not of this search, is locked by another program for too long, or cannot be read or
            written to, here or inside; what was stored before remains.
    """
    optuna, database = import_optuna(), path / DATABASE
    with _one_line(optuna, database):
        trials = _open(optuna, database, space)
        facts = read_json_or_empty(path / FACTS)
        if facts.get("begun") is False:
            write_text(path / FACTS, json.dumps(facts | {"begun": True}))
        yield trials


def _open(optuna: Any, database: Path, space: Space) -> "optuna.Study":
    """Open or create the database, and check that it holds this search."""
    from sqlalchemy import URL
    from sqlalchemy.exc import SQLAlchemyError

    url = URL.create("sqlite", database=str(database)).render_as_string()
    digest = hashlib.sha256(identity(space).encode()).hexdigest()
    others = StudyError(f"{database}: holds the trials of something other than {space.name}; {_NEW_FOLDER}")
    if (tables := _tables(database)) and tables.isdisjoint(_OPTUNAS):
        raise others
    try:
        storage = optuna.storages.RDBStorage(url, {"connect_args": {"timeout": _WAIT_S}})
        if (names := optuna.get_all_study_names(storage)) and space.name not in names:
            raise others
        trials = optuna.create_study(storage=storage, study_name=space.name, direction="maximize", load_if_exists=True)
        ours = trials.user_attrs.get(SPACE, digest) == digest and trials.direction.name == "MAXIMIZE"
        if not ours or not all(_is_ours(trial, space) for trial in trials.get_trials(deepcopy=False)):
            raise others
    except (optuna.exceptions.StorageInternalError, SQLAlchemyError, StudyError):
        raise
    except (RuntimeError, LookupError, ValueError, TypeError, AttributeError, AssertionError) as error:
        # Optuna trusts what it finds in a database: other versions of its tables, and values that it would not write
        raise StudyError(f"{database}: cannot be used: {str(error) or type(error).__name__}") from None
    if SPACE not in trials.user_attrs:
        trials.set_user_attr(SPACE, digest)
    return trials


def _tables(database: Path) -> set[str]:
    """Return the names of a database's tables; none if there is no database."""
    if not database.exists():
        return set()
    # not read-only: what a killed process has left of a transaction is undone first
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=rw", uri=True, timeout=_WAIT_S)) as connection:
        connection.text_factory = lambda name: name.decode(errors="replace")  # of a damaged database
        return {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}


def _is_ours(trial: "optuna.trial.FrozenTrial", space: Space) -> bool:
    """Return whether a trial has what we store; one that no batch has taken yet has nothing, and is not finished."""
    if BATCH not in trial.user_attrs:
        return not trial.state.is_finished()
    batched = isinstance(trial.user_attrs[BATCH], int) and set(trial.params) == set(space.space)
    return batched and all(_searched(values, trial.params[key]) for key, values in space.space.items())


def _searched(values: Range | Choices, stored: Any) -> bool:
    """Return whether a stored value is one of those that are searched."""
    if isinstance(values, Choices):
        return stored in [to_optuna(value) for value in values.choices]
    return isinstance(stored, int | float) and contains(values, stored)


def to_optuna(value: Any) -> Any:
    """Convert a setting for Optuna, which stores lists as text."""
    return json.dumps(value) if isinstance(value, list) else value


@contextmanager
def _one_line(optuna: Any, database: Path) -> Iterator[None]:
    """Turn errors of the database into a user's error.

    Raises:
        StudyError: it says whether another program has locked the database.
    """
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except UnicodeDecodeError:  # SQLite quotes what it finds in a damaged schema
        raise StudyError(f"{database}: cannot be used: its schema is damaged") from None
    except (optuna.exceptions.StorageInternalError, SQLAlchemyError, sqlite3.Error) as error:
        problem = error.__cause__ if isinstance(error, optuna.exceptions.StorageInternalError) else error
        reason = getattr(problem, "orig", None) or problem or error
        if getattr(reason, "sqlite_errorname", "").startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
            raise StudyError(
                f"{database}: another program has kept it locked for {_WAIT_S:g} s; end that, and give the same command "
                "again: nothing is lost"
            ) from None
        raise StudyError(f"{database}: cannot be used: {reason}") from None
