"""Readers of text, JSON and TOML files whose errors are one line that names the file."""

import errno
import json
import os
import tomllib
from pathlib import Path
from typing import Any

from uavmec_jax.errors import UserError
from uavmec_jax.files.locations import reason_of, store_errors


def read_text(path: Path, error: type[UserError], encoding: str = "utf-8") -> str:
    """Read a text file.

    Raises:
        UserError: the file cannot be read or decoded; of the type ``error``.
    """
    try:
        with store_errors():
            return path.read_text(encoding=encoding)
    except FileNotFoundError:  # stores give no reason
        raise error(f"{path}: cannot be read: {os.strerror(errno.ENOENT)}") from None
    except (OSError, UnicodeDecodeError) as problem:
        reason = reason_of(problem) if isinstance(problem, OSError) else str(problem)
        raise error(f"{path}: cannot be read: {reason}") from None


def read_json_or_empty(path: Path) -> dict[str, Any]:
    """Read a small JSON object that another process may be writing; empty if it is missing or damaged."""
    try:
        with store_errors():
            content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def parse_toml(text: str, source: object, error: type[UserError]) -> dict[str, Any]:
    """Parse the text of a TOML file; ``source`` names it in messages.

    Raises:
        UserError: the text is not TOML; of the type ``error``.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(f"{source}: not TOML: {problem}") from None
