"""Numbers that the paper reports (Azfar, Huang, Ke, arXiv 2501.15305), for tables that compare ours with them."""

from collections.abc import Mapping
from types import MappingProxyType

_ROWS = {
    12: (33, 33, 29, 29, 29),
    10: (25, 24.7, 18.7, 19, 17.7),
    8: (21.6, 19.3, 18.3, 18, 16.7),
    6: (18.6, 18, 18, 17.3, 17),
    4: (17, 17, 17.3, 18, 17.3),
}
_CONNECTED = (12, 10, 8, 6, 4)

TABLE5: Mapping[tuple[int, int], float] = MappingProxyType(
    {
        (powered, connected): float(slots)
        for powered, row in _ROWS.items()
        for connected, slots in zip(_CONNECTED, row, strict=True)
    }
)
"""Table 5: (powered, connected) -> average episode length in slots."""

_REWARDS = {
    "A": (16, 11, 11, 19, 19, 12, 18, 11, 11),
    "U": (15, 11, 11, 17, 11, 11, 13, 11, 11),
    "M": (12, 11, 11, 11, 13, 11, 23, 11, 16),
    "-O": (11, 11, 11, 14, 15, 11, 16, 11, 11),
    "A+U+M-O": (17, 11, 14, 16, 11, 11, 16, 11, 11),
    "log A": (13, 15, 11, 23, 15, 18, 11, 14, 11),
    "log U": (11, 15, 11, 19, 11, 11, 11, 14, 11),
    "log M": (11, 11, 11, 11, 11, 11, 11, 11, 11),
    "-log O": (11, 11, 11, 18, 11, 11, 28, 14, 11),
    "log A+log U+log M-log O": (17, 12, 11, 18, 11, 11, 14, 22, 11),
    "U+log(A/O)": (18, 15, 11, 28, 18, 12, 30, 21, 12),
}
_COLUMNS = [
    (powered, connected, algorithm)
    for powered, connected in ((6, 6), (8, 8), (10, 8))
    for algorithm in ("dqn", "ppo", "a2c")
]

TABLE6: Mapping[tuple[str, int, int, str], float] = MappingProxyType(
    {
        (reward, *column): float(slots)
        for reward, row in _REWARDS.items()
        for column, slots in zip(_COLUMNS, row, strict=True)
    }
)
"""Table 6: (reward, powered, connected, algorithm) -> maximum episode length in slots."""

TABLE7: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        "round_lake": (2, 0, 0, 0, 0, 3, 0, 0, 6, 0, 8, 11),
        "albany": (0, 0, 0, 3, 0, 1, 6, 10, 5, 3, 2, 0),
    }
)
"""Table 7: place -> number of tests, of 30, in which each of the devices 1 to 12 failed first."""
