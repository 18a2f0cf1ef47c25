"""What a user can mend, told in one line. Imports nothing, so that the command line can catch it without loading JAX."""


class UserError(ValueError):
    """Something given is not usable; the message is one line that names it and says what would be right."""


class StudyError(UserError):
    """A study, a run folder or an option is not usable."""


class ScenarioError(UserError):
    """An named_scenario of devices is not usable."""


class PolicyError(UserError):
    """A saved policy, or what it is asked, is not usable."""


class StateError(UserError):
    """The state of a network does not fit its layout."""


class TrafficError(UserError):
    """A road network, a place, a device file or an evacuation is not usable, or SUMO is not there or failed."""
