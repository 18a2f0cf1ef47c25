"""Figures without a display, written whole or not at all."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavmec_jax.files.writing import whole


def save(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all; the ending says the format."""
    with whole(path) as partial:
        figure.savefig(partial, dpi=144, metadata={"Software": None} if path.suffix == ".png" else None)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure that needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
