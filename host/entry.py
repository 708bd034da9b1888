"""Where the `vibrocast` command begins: whenever and however it is stopped, it ends in one line, the tactor at rest."""

import signal
import sys
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130
STOPPING_SIGNALS = (signal.SIGTERM, signal.SIGHUP)


def main() -> None:
    """Run the command line; Ctrl-C, a kill and a closed terminal end it in order, also while it is being loaded."""
    for number in STOPPING_SIGNALS:
        # nohup has told this program to live on.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    try:
        from host.command_line import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.stderr.write("error: interrupted\n")
        sys.exit(INTERRUPTED)


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    """Interrupt as Ctrl-C does, but once: a closed terminal may signal again while the actuator is being stopped."""
    for number in STOPPING_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
