"""Work with many controllers in threads: an interruption waits until every one has been stopped."""

import subprocess
import sys

INTERRUPTED_WORK = """
import os, signal, sys, threading, time
from contextlib import nullcontext
from vibrocast.host.concurrency import Interrupted, run_concurrently

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it


def work(name, session, check):
    try:
        while True:
            check()
            time.sleep(0.01)
    except Interrupted:
        time.sleep(0.3)
        os.write(1, b"stopped\\n")  # at once: print writes the line and its end apart, and both threads write
        raise

threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    run_concurrently(dict.fromkeys(("one", "other"), lambda: nullcontext(None)), work)
except KeyboardInterrupt:
    print("interrupted", flush=True)
os._exit(0)
"""


def test_interrupted_it_waits_until_every_controller_has_been_stopped() -> None:
    run = subprocess.run([sys.executable, "-c", INTERRUPTED_WORK], capture_output=True, text=True, timeout=30)
    assert run.stdout.split() == ["stopped", "stopped", "interrupted"], run.stderr
