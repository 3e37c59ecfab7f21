"""What can go wrong, as full sentences: what, where, and what would be accepted.

Only the command line turns these into exit codes; every other module raises them.
"""


class CausticError(Exception):
    """Something this program could not do; the message is one line for the user (exit status 1)."""


class InputError(CausticError, ValueError):
    """Bad usage or bad input: the user can put it right (exit status 2)."""


class Interrupted(CausticError):
    """A signal asked the program to stop; the last state is on disk.

    Attributes:
        status: the exit status to leave with (130 for SIGINT, 143 for SIGTERM).
    """

    def __init__(self, message: str, status: int):
        super().__init__(message)
        self.status = status
