"""Where the `vibrocast` command begins: however it is stopped, it ends in one line with the actuator at rest."""

import io
import os
import signal
import sys
import threading
from types import FrameType
from typing import NoReturn

from vibrocast.host.cli import interruption, json_option

# Windows has no SIGHUP.
STOPPING_SIGNALS: tuple[signal.Signals, ...] = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
HEED_S = 0.5
"""How long a signal may wait for the main thread. Only a computation in a library keeps that thread from it."""

_heeded = threading.Event()


def main() -> None:
    """Run the command line; Ctrl-C, a kill and a closed terminal end it in order, also while it is being loaded."""
    # Another program, such as nohup, may let this one ignore signals.
    heeded = [number for number in STOPPING_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    for number in heeded:
        signal.signal(number, _leave)
    from vibrocast.host.cli.command_line import main as command_line

    for number in heeded:
        signal.signal(number, _interrupt)
    sys.unraisablehook = _interrupt_again
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    threading.Thread(target=_end_where_unheeded, args=(read_end,), daemon=True).start()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The names of files may be no text at all.
        sys.stdout.reconfigure(errors="backslashreplace")
    command_line()


def _leave(number: int, _frame: FrameType | None) -> NoReturn:
    """Leave at once: nothing is under way yet, and libraries that are being loaded may swallow an exception."""
    _exit_at_once(number)


def _exit_at_once(number: int) -> NoReturn:
    """Tell that a signal ended the command, in JSON as well if that is wanted, and end the process."""
    exit_code = interruption.exit_code_of(number)
    os.write(2, b"error: interrupted\n")
    if json_option.is_given(sys.argv[1:]):
        os.write(1, b'{"error": "interrupted", "exit_code": %d}\n' % exit_code)
    os._exit(exit_code)


def _interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    """Interrupt what is under way. A closed terminal may signal twice; only Ctrl-C may cut the cleaning up short."""
    _heeded.set()
    for other in STOPPING_SIGNALS[1:]:
        signal.signal(other, signal.SIG_IGN)
    interruption.signalled = number
    raise KeyboardInterrupt


def _interrupt_again(unraisable: "sys.UnraisableHookArgs") -> None:
    """Send a signal once more that came while an object was finalised: Python drops exceptions there."""
    number = interruption.signalled
    if not issubclass(unraisable.exc_type, KeyboardInterrupt) or number is None:
        sys.__unraisablehook__(unraisable)
        return
    signal.signal(number, _interrupt)
    again = threading.Timer(HEED_S, os.kill, (os.getpid(), number))
    again.daemon = True  # a command that ends before does not wait for it
    again.start()


def _end_where_unheeded(read_end: int) -> None:
    """End the process HEED_S after a signal that the main thread has not heeded; no file is left half written.

    Python runs handlers of signals in the main thread only, between two of its own instructions. A library may compute
    there for long. A controller that plays then rests by its watchdog.
    """
    (number,) = os.read(read_end, 1)  # Python writes the number of each signal
    while signal.getsignal(number) is not _interrupt:  # the signal was for someone else
        (number,) = os.read(read_end, 1)
    if _heeded.wait(HEED_S):
        return
    from vibrocast.files import remove_partial

    remove_partial()
    if os.isatty(2):
        os.write(2, b"\x1b[?25h\n")  # a progress bar hides the cursor
    _exit_at_once(number)
