"""How much traffic a device sees: per-lane density on the roads near it, scaled to [0, 1]."""

import numpy as np


def length_within(shape: np.ndarray, centres: np.ndarray, radius_m: float) -> np.ndarray:
    """Metres ``[n]`` of a road ``[k, 2]`` that lie within a radius of each of ``n`` centres ``[n, 2]``."""
    start, step = shape[:-1], np.diff(shape, axis=0)
    length = np.linalg.norm(step, axis=1)
    start, step, length = start[length > 0], step[length > 0], length[length > 0]
    # |start + t step - centre| <= radius on an interval of t: the roots of a quadratic, cut to [0, 1].
    away = start[None] - centres[:, None]
    a = length**2
    b = (away * step).sum(axis=-1)
    inside = b**2 - a * ((away**2).sum(axis=-1) - radius_m**2)
    half = np.sqrt(np.maximum(inside, 0.0))
    first, last = np.clip((-b - half) / a, 0.0, 1.0), np.clip((-b + half) / a, 0.0, 1.0)
    return np.where(inside > 0, (last - first) * length, 0.0).sum(axis=1)


def density_near(
    centres: np.ndarray, shapes: list[np.ndarray], lanes: np.ndarray, density: np.ndarray, radius_m: float
) -> np.ndarray:
    """Vehicles per km and lane ``[..., n]`` on the roads within a radius of each place; 0 where there is none.

    Args:
        centres: ``[n, 2]`` m.
        shapes: of ``R`` roads, each ``[k, 2]`` m.
        lanes: ``[R]``.
        density: ``[..., R]`` vehicles per km and lane.
        radius_m: of the circle.
    """
    near = np.stack([length_within(shape, centres, radius_m) for shape in shapes]) * lanes[:, None]
    total = near.sum(axis=0)
    return np.where(total > 0, density @ near / np.maximum(total, 1e-9), 0.0)


def scaled(density: np.ndarray) -> np.ndarray:
    """Densities divided by the highest of all; all 0 where nobody drives."""
    highest = density.max()
    return np.asarray(density / highest if highest > 0 else np.zeros_like(density), np.float32)
