"""The signal that interrupted the command, and its exit code."""

import signal

signalled: int | None = None
"""The signal that has interrupted the command."""


def exit_code_of(number: int | None) -> int:
    """Return the exit code that a shell gives for a signal: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP.

    None: at a prompt, the end of the input counts as Ctrl-C.
    """
    return 128 + (signal.SIGINT if number is None else number)
