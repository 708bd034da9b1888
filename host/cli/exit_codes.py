"""Exit codes of the `vibrocast` command."""

import signal

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

signalled: int | None = None
"""The signal that has interrupted the command."""


def interrupted_by(number: int | None) -> int:
    """Return the exit code that a shell gives for a signal: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP.

    None: at a prompt, the end of the input counts as Ctrl-C.
    """
    return 128 + (signal.SIGINT if number is None else number)
