"""Packages of the extras, imported when something needs them."""

import importlib
from typing import Any

from uavmec_jax.errors import StudyError


def optional(module: str, needed_by: str, extra: str) -> Any:
    """Import and return a module of a package that is only installed with an extra.

    Args:
        module: name of the module.
        needed_by: the command or option that needs it, for the message.
        extra: the extra of this package that installs it.

    Raises:
        StudyError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise StudyError(
            f"{needed_by} needs the package {module}, which is not installed: pip install 'uavmec-jax[{extra}]'"
        ) from None
