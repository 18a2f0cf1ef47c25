"""What a user can mend. Imports nothing, so that the command line can catch it without loading JAX."""


class StudyError(ValueError):
    """A study, a run folder or an option is not usable; the message is one line for the user."""
