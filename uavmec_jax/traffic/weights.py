"""Traffic weights: the density per lane on the roads near each device, scaled to [0, 1]."""

import numpy as np
from jaxtyping import Float, Int, Num


def length_within(
    shape: Float[np.ndarray, "k 2"], centres: Float[np.ndarray, "n 2"], radius_m: float
) -> Float[np.ndarray, " n"]:
    """Measure how many metres ``[n]`` of a road lie within a radius of each centre.

    Args:
        shape: ``[k, 2]`` m, corners of the road.
        centres: ``[n, 2]`` m.
        radius_m: of the circles.
    """
    start, step = shape[:-1], np.diff(shape, axis=0)
    length = np.linalg.norm(step, axis=1)
    start, step, length = start[length > 0], step[length > 0], length[length > 0]
    # |start + t step - centre| <= radius holds on an interval of t: the roots of a quadratic, clipped to [0, 1].
    away = start[None] - centres[:, None]
    a = length**2
    b = (away * step).sum(axis=-1)
    discriminant = b**2 - a * ((away**2).sum(axis=-1) - radius_m**2)
    half = np.sqrt(np.maximum(discriminant, 0.0))
    first, last = np.clip((-b - half) / a, 0.0, 1.0), np.clip((-b + half) / a, 0.0, 1.0)
    return np.where(discriminant > 0, (last - first) * length, 0.0).sum(axis=1)


def density_near(
    centres: Float[np.ndarray, "n 2"],
    shapes: list[np.ndarray],
    lanes: Int[np.ndarray, " R"],
    density: Num[np.ndarray, "*batch R"],
    radius_m: float,
) -> Float[np.ndarray, "*batch n"]:
    """Average the densities of the roads within a radius of each centre, weighted by lanes and metres.

    Args:
        centres: ``[n, 2]`` m.
        shapes: corners of ``R`` roads, each ``[k, 2]`` m.
        lanes: ``[R]``.
        density: ``[..., R]`` vehicles per km and lane.
        radius_m: of the circles.

    Returns:
        ``[..., n]`` vehicles per km and lane; 0 where no road is near.
    """
    lane_metres = np.stack([length_within(shape, centres, radius_m) for shape in shapes]) * lanes[:, None]
    total = lane_metres.sum(axis=0)
    return np.where(total > 0, density @ lane_metres / np.maximum(total, 1e-9), 0.0)


def divide_by_maximum(density: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Scale densities to [0, 1] by the highest of all; all are 0 where there is no traffic."""
    highest = density.max()
    return np.asarray(density / highest if highest > 0 else np.zeros_like(density), np.float32)
