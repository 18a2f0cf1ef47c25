"""Figures without a display, written atomically."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavmec_jax.files.writing import atomic


def save(figure: Figure, path: Path) -> None:
    """Write a figure atomically; the ending of the path is its format."""
    with atomic(path) as partial:
        figure.savefig(partial, dpi=144, metadata={"Software": None} if path.suffix == ".png" else None)


def literal(text: object) -> str:
    """Return a user's text as matplotlib draws it as it is: between two dollars it would read a formula."""
    return str(text).replace("$", r"\$")


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure that needs no display; sides in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
