"""Figures without a display, written atomically, in colours that can be told apart without red and green, and in grey."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavmec_jax.files.writing import atomic

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#7F7F7F")
"""Colours for lines and bars that people with any colour vision tell apart (Okabe and Ito, 2008)."""

_DASHES = ("-", "--", ":", "-.")


def line_style(number: int) -> dict[str, Any]:
    """Return the colour and the dashes of a line; the first 28 differ."""
    colours = len(PALETTE)
    return {"color": PALETTE[number % colours], "ls": _DASHES[number // colours % len(_DASHES)]}


def legend_beside(axis: Axes, **options: Any) -> None:
    """Draw the legend on the right of an axis, where it covers nothing."""
    axis.legend(loc="upper left", bbox_to_anchor=(1, 1), borderaxespad=0.3, **({"fontsize": 7} | options))


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


def pixels(figure: Figure) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a figure and return its pixels, RGB."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
