"""User-facing errors, one line each. Imports nothing, so that the command line can catch them without loading JAX."""

MAX_MESSAGE = 400
"""Longest message, in characters."""

_TAIL = 120
"""Characters that are kept of the end of a message that is too long: the end says what would be right."""


def one_line(message: object) -> str:
    """Return a message as one printable line of at most ``MAX_MESSAGE`` characters.

    Line breaks become spaces, characters that a terminal would obey or cannot show become escapes, and the middle of what is
    longer is left out.
    """
    text = str(message)
    if len(text) > MAX_MESSAGE:
        text = _shortened(text)
    text = " ".join(text.split())
    return _shortened(printable(text))


def printable(text: str, keep: str = "") -> str:
    """Return a text in which characters that a terminal would obey or cannot show are escapes, but for those to ``keep``."""
    return "".join(letter if letter.isprintable() or letter in keep else _escaped(letter) for letter in text)


def _shortened(text: str) -> str:
    """Return a text without what is too much in its middle."""
    gap = " ... "
    head = MAX_MESSAGE - _TAIL - len(gap)
    return text if len(text) <= MAX_MESSAGE else f"{text[:head]}{gap}{text[-_TAIL:]}"


def _escaped(letter: str) -> str:
    """Return a character that cannot be printed as Python writes it."""
    return letter.encode("unicode_escape").decode("ascii")


class UserError(ValueError):
    """Some input is not usable; the message is one line that names it and says what would be right."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))


class ArgumentError(UserError):
    """An argument of a function has the wrong type, shape or value."""


class StudyError(UserError):
    """A study, a run folder or an option is not usable."""


class ScenarioError(UserError):
    """A scenario, its file or its devices are not usable."""


class PolicyError(UserError):
    """A saved policy, or an observation given to it, is not usable."""


class StateError(UserError):
    """The present state of a network does not fit its scenario."""


class TrafficError(UserError):
    """A road network, a place, a device file or an evacuation is not usable, or SUMO is missing or failed."""
