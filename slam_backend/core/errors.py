"""What can go wrong outside the data stream; trouble inside it is a Decision, not an exception."""


class SlamError(Exception):
    """Base of every error that a user can cause or mend; its text is one line that says what to do."""


class BadConfig(SlamError):
    """A setting that does not exist, has the wrong type or unit, or contradicts another."""


class BadFile(SlamError):
    """A file that is missing, damaged, or not what its name says; the text names the file and the place."""


class BadMessage(SlamError):
    """A message whose bytes or fields cannot be understood; becomes a Decision of stage `decode`."""


class MissingExtra(SlamError):
    """An optional dependency is not installed; the text names the extra that brings it."""


class SolverFailure(SlamError):
    """The solver refused a change. It is still usable: its state is the one before the change.

    guilty: ids of the factors without which the change can be solved.
    """

    def __init__(self, message: str, guilty: tuple[str, ...]) -> None:
        super().__init__(message)
        self.guilty = guilty
