"""Heat maps of a quantity over the cells of a grid."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from uavmec_jax.reporting.canvas import literal, new_figure


def draw_heat_map(axis: Axes, table: pd.DataFrame, limits: tuple[float, float]) -> AxesImage:
    """Draw a table of numbers as a heat map, with each number in its cell.

    Args:
        axis: to draw on.
        table: index and columns label the rows and columns; cells may be NaN.
        limits: of the colour scale.
    """
    image = axis.imshow(table.to_numpy(), vmin=limits[0], vmax=limits[1], cmap="viridis")
    axis.set_xticks(range(table.shape[1]), [literal(name) for name in table.columns])
    axis.set_yticks(range(table.shape[0]), [literal(name) for name in table.index])
    middle = (limits[0] + limits[1]) / 2
    for (row, column), value in np.ndenumerate(table.to_numpy()):
        if np.isfinite(value):
            colour = "white" if value < middle else "black"
            axis.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color=colour)
    return image


def heat_map_figure(
    rows: Sequence[tuple[pd.DataFrame, Sequence[tuple[str, str]]]], limits: tuple[float, float], quantity: str
) -> Figure:
    """Draw rows of heat maps over powered x connected devices, on one colour scale.

    Args:
        rows: for each row of heat maps, its cells (one row per cell, with ``powered``, ``connected`` and the columns of the
            panels), and its panels: a column of the cells and a title for each heat map.
        limits: of the colour scale.
        quantity: label of the colour scale.
    """
    width = len(rows[0][1])
    figure = new_figure(3.3 * width, 3.6 * len(rows))
    axes = figure.subplots(len(rows), width, sharey="row", squeeze=False)
    for row, (cells, panels) in zip(axes, rows, strict=True):
        for axis, (column, title) in zip(row, panels, strict=True):
            table = cells.pivot(index="powered", columns="connected", values=column)
            table = table.sort_index(ascending=False).sort_index(axis=1, ascending=False)
            image = draw_heat_map(axis, table, limits)
            axis.set_title(literal(title), fontsize=10)
            axis.set_xlabel("connected devices")
        row[0].set_ylabel("powered devices")
    figure.colorbar(image, ax=axes, label=quantity, shrink=0.8)
    return figure
