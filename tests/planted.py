"""Modules that a stranger has left in a folder; one that is imported leaves a trace there."""

from pathlib import Path

NAMES = (
    *(
        "click",
        "flax/__init__",
        "json",
        "jax",
        "libsumo",
        "logging",
        "numpy",
        "pandas",
        "pickle",
        "psutil",
        "ray",
        "scipy",
    ),
    *("setproctitle", "shutil", "sitecustomize", "socket", "subprocess", "sumo", "tomllib", "usercustomize"),
    *("uavmec_jax/__init__", "xml/__init__"),
)
"""Modules that processes of ours import, or Python by itself."""

TRACE = "imported"


def plant(folder: Path) -> Path:
    """Leave the modules in a folder; return the folder."""
    for name in NAMES:
        file = folder / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(
            f"with open({str(folder / TRACE)!r}, 'a') as trace:\n    trace.write({name!r} + '\\n')\n"
            f"raise ImportError('the planted {name} was imported')\n"
        )
    return folder


def imported_from(folder: Path) -> list[str]:
    """Return which of the modules in a folder were imported."""
    trace = folder / TRACE
    return sorted(set(trace.read_text().split())) if trace.exists() else []
