"""Read, check, change and write study files."""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import tomli_w

from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.errors import StudyError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import is_file, read_resource, read_text
from uavmec_jax.files.validation import suggest, validated
from uavmec_jax.scenarios.settings import unused_params
from uavmec_jax.studies.schema import Study

_LIBRARY = resources.files("uavmec_jax.studies") / "library"


def shipped_studies() -> dict[str, Any]:
    """Return the studies that ship with the package: name -> file."""
    return {Path(file.name).stem: file for file in _LIBRARY.iterdir() if file.name.endswith(".toml")}


def load_study(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> Study:
    """Read a study that ships with the package, or a file, and apply overrides.

    Args:
        name_or_path: ``"table5"``, or the path of a ``.toml`` file.
        overrides: dotted names to values, e.g. ``{"steps": 20000, "axes.seeds": 3, "dqn.gamma": 0.99}``.

    Raises:
        StudyError: the file is missing, is not TOML, or has a wrong setting; one line.
    """
    library = shipped_studies()
    if str(name_or_path) in library:
        source, text = str(name_or_path), read_resource(library[str(name_or_path)])
    else:
        path = Path(name_or_path)
        source = str(path)
        if not is_file(path):
            hint = suggest(path.stem, library) if path.suffix != ".toml" else "no such file"
            raise StudyError(f"{source}: neither a study file nor a shipped study; {hint}")
        text = read_text(path, StudyError)
    return parse_study(text, source, overrides)


def parse_study(text: str, source: str, overrides: Mapping[str, Any] | None = None) -> Study:
    """Make a :class:`Study` from the text of a study file.

    Args:
        text: TOML.
        source: name of the file, for messages.
        overrides: as in :func:`load_study`.

    Raises:
        StudyError: the text is not TOML, or has a wrong setting; one line.
    """
    data = parse_toml(text, source, StudyError)
    for dotted, value in (overrides or {}).items():
        *parents, last = dotted.split(".")
        table = data
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise StudyError(f"{source}: {dotted} cannot be set: {parent} is not a table")
        table[last] = value
    data.setdefault("name", Path(source).stem)
    return validated(Study, data, source, StudyError)


def study_toml(study: Study) -> str:
    """Return the text of a study file with every setting resolved, from which an equal study is read back."""
    unused: dict[str, Any] = dict.fromkeys(set(ALGORITHMS) - set(study.algorithms), True)
    unused["params"] = unused_params(study.params)
    # Settings of fleets are left out where there is none, so that the files of other studies stay as they were.
    unused |= {name: True for name, default in (("uavs", 1), ("depot", ())) if getattr(study, name) == default}
    return tomli_w.dumps(study.model_dump(exclude=unused, exclude_none=True))
