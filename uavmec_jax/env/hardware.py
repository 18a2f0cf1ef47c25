"""The paper's hardware: device types, their standby power (Table 1), active power (Table 2) and rates (Table 3)."""

import numpy as np

DEVICE_TYPES: tuple[str, ...] = ("Raspberry Pi 4B", "Raspberry Pi 3B", "Firefly", "Jetson Nano", "NanoPC-T4")
"""Device types; an int ``device_type`` indexes this tuple and the columns of the tables below."""

TASKS: tuple[str, ...] = ("HAAR", "MMOD", "DNN", "Dlib", "YOLOv3")
"""Computer-vision tasks; an int ``task`` indexes this tuple and the rows of the tables below."""

UNLISTED = -1
"""``device_type`` and ``task`` of hardware that the tables do not list."""

STANDBY_POWER_W = np.array([2.65, 1.69, 4.87, 2.82, 1.88], np.float32)
"""Table 1: power drawn at all times, W, ``[types]``."""

ACTIVE_POWER_W = np.array(
    [
        [2.165, 1.287, 2.352, 1.36, 3.391],
        [1.335, 1.621, 1.124, 0.92, 1.582],
        [3.234, 1.9, 2.972, 2.421, 2.595],
        [1.91, 4.38, 2.54, 1.01, 5.06],
        [3.268, 1.925, 3.07, 1.35, 2.874],
    ],
    np.float32,
)
"""Table 2: power drawn in addition to standby while computing, W, ``[tasks, types]``."""

PROCESSING_RATE_BYTES_S = np.array(
    [
        [74536.25, 2758.14, 4734.16, 23867.61, 1854.59],
        [12318.36, 1114.03, 1183.72, 5277.71, 949.66],
        [71731.84, 3767.51, 949.36, 40294.21, 973.1],
        [65088.52, 87894.05, 13020.39, 65264.07, 6957.73],
        [69985.94, 7066.79, 2733.97, 22230.58, 8298.13],
    ],
    np.float32,
)
"""Table 3: local processing rate, bytes/s, ``[tasks, types]``."""

for _table in (STANDBY_POWER_W, ACTIVE_POWER_W, PROCESSING_RATE_BYTES_S):
    _table.setflags(write=False)
