"""User-facing errors, one line each. Imports nothing, so that the command line can catch them without loading JAX."""


class UserError(ValueError):
    """Some input is not usable; the message is one line that names it and says what would be right."""


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
