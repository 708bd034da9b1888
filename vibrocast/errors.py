"""The base of all errors that a person may see, and the exit codes that they give a command."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

FAILED = 1
"""The device, or the command itself, failed."""
BAD_INPUT = 2
NO_DEVICE = 3
"""No controller answers at the address, or it was lost for good."""
LIMIT_MISSED = 4
"""The run ended, and missed one of its limits."""
REGRESSION = 5
"""The run is worse than the earlier one, or cannot be compared with it."""
HOST_BUSY = 6
"""This machine was too busy to decide."""


class VibrocastError(Exception):
    """An error that says what to do. As a text it is "problem: cause; action", of which cause and action may be empty.

    Attributes:
        problem: What went wrong.
        cause: Why.
        action: What to do about it.
        parameter: The parameters of a function that may be changed, or settings of them ("highpass_hz=None"). The texts
            have each in backticks.
    """

    exit_code = FAILED
    """Of a command that this error ends."""

    def __init__(self, problem: str, cause: str = "", action: str = "", parameter: str | tuple[str, ...] = ()) -> None:
        super().__init__(problem)
        self.problem = problem
        self.cause = cause
        self.action = action
        self.parameter = (parameter,) if isinstance(parameter, str) else parameter

    def __str__(self) -> str:
        return self.told({})

    def told(self, options: Mapping[str, str]) -> str:
        """Return the text with options of a command in place of the parameters that they set."""
        reason = ": ".join(filter(None, (self.problem, self.cause)))
        text = "; ".join(filter(None, (reason, self.action)))
        for name in self.parameter:
            text = text.replace(f"`{name}`", options.get(name, f"`{name}`"))
        return text


class InputError(VibrocastError, ValueError):
    """A file, a folder or a text that cannot be used; the message says why and what to do."""

    exit_code = BAD_INPUT


@contextmanager
def located(place: object) -> Iterator[None]:
    """Put `place` before the problem of an InputError of the block; any other ValueError becomes an InputError."""
    try:
        yield
    except InputError as error:
        error.problem = f"{place}: {error.problem}"
        raise
    except ValueError as error:
        raise InputError(f"{place}: {error}") from error
