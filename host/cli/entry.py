"""Where the `vibrocast` command begins: however it is stopped, it ends in one line with the actuator at rest."""

import io
import os
import signal
import sys
from types import FrameType
from typing import NoReturn

from vibrocast.host.cli.exit_codes import INTERRUPTED

# Windows has no SIGHUP.
STOPPING_SIGNALS: tuple[signal.Signals, ...] = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def main() -> None:
    """Run the command line; Ctrl-C, a kill and a closed terminal end it in order, also while it is being loaded."""
    # Another program, such as nohup, may let this one ignore signals.
    heeded = [number for number in STOPPING_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    for number in heeded:
        signal.signal(number, _leave)
    from vibrocast.host.cli.command_line import main as command_line

    for number in heeded:
        signal.signal(number, _interrupt)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The names of files may be no text at all.
        sys.stdout.reconfigure(errors="backslashreplace")
    command_line()


def _leave(_number: int, _frame: FrameType | None) -> NoReturn:
    """Leave at once: nothing is under way yet, and libraries that are being loaded may swallow an exception."""
    os.write(2, b"error: interrupted\n")
    os._exit(INTERRUPTED)


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    """Interrupt what is under way. A closed terminal may signal twice; only Ctrl-C may cut the cleaning up short."""
    for number in STOPPING_SIGNALS[1:]:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
