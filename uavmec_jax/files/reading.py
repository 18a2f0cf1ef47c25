"""Text, JSON and TOML files from outside, read with one clear line for what is wrong."""

import json
import tomllib
from pathlib import Path
from typing import Any

from uavmec_jax.errors import UserError


def read_text(path: Path, error: type[UserError], encoding: str = "utf-8") -> str:
    """A text file.

    Raises:
        UserError: it cannot be read; of the type ``error``.
    """
    try:
        return path.read_text(encoding=encoding)
    except (OSError, UnicodeDecodeError) as problem:
        reason = problem.strerror if isinstance(problem, OSError) else str(problem)
        raise error(f"{path}: cannot be read: {reason}") from None


def read_json_or_empty(path: Path) -> dict[str, Any]:
    """What a small JSON file says that others may just be writing; nothing if it is not there, or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def parse_toml(text: str, source: object, error: type[UserError]) -> dict[str, Any]:
    """What a TOML file holds; ``source`` names it in messages.

    Raises:
        UserError: it is not TOML; of the type ``error``.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(f"{source}: not TOML: {problem}") from None
