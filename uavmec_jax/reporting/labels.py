"""How devices, depots and times are written in tables and lines; devices and depots are numbered from 1."""

from uavmec_jax.scenarios.named_scenario import NamedScenario


def device_label(number: int, name: str) -> str:
    """Return number and name of a device; the number alone if the name repeats it."""
    return f"#{number}" if name == f"device {number}" else f"#{number} {name}"


def place_label(scenario: NamedScenario, place: int) -> str:
    """Return number and name of a place by its index from 0, e.g. ``#1 quay``, or for a depot ``D1 station``."""
    devices = len(scenario.device_names)
    if place < devices:
        return device_label(place + 1, scenario.device_names[place])
    number, name = place - devices + 1, scenario.place_names[place]
    return f"D{number}" if name == f"depot {number}" else f"D{number} {name}"


def hours(seconds: float) -> str:
    """Return a time as hours and minutes, e.g. ``5:07``."""
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d}"


def duration(seconds: float) -> str:
    """Return a time in words, e.g. ``50 min`` or ``2.5 h``."""
    number, unit = (seconds / 60, "min") if seconds < 5400 else (seconds / 3600, "h")
    return f"{number:.1f}".removesuffix(".0") + f" {unit}"
