"""What the paper reports, for the tables that stand beside ours (Azfar, Huang, Ke, arXiv 2501.15305)."""

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
