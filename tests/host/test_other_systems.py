"""The command line on a system that lacks what Windows lacks: the modules, signals and functions of Unix are hidden."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Libraries choose by the system's name, so those that need Unix here are loaded first.
LACKING = """
import asyncio, click._termui_impl, multiprocessing.pool, os, psutil, serial
import shutil, signal, socket, subprocess, sys, tempfile

for name in ("fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty"):
    sys.modules[name] = None
for module, names in (
    (signal, ("SIGHUP", "SIGKILL", "SIGALRM", "SIGPIPE", "SIGUSR1", "setitimer", "pthread_sigmask")),
    (os, ("fork", "killpg", "openpty", "ttyname", "geteuid", "getuid", "mkfifo", "sched_getaffinity", "sysconf")),
):
    for name in names:
        delattr(module, name)
from vibrocast.host.cli.entry import main
main()
"""


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LACKING, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    "arguments", [["--help"], *(pytest.param([name], marks=pytest.mark.slow) for name in ("codecs", "devices"))]
)
def test_commands_start(arguments: list[str]) -> None:
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("device", ["sim", "sim-usb"])
def test_a_texture_plays_on_the_simulated_controller(device: str) -> None:
    done = run("play", "examples/taps.wav", "--device", device)
    assert done.returncode == 0, done.stderr
    assert "DAC as computed  yes" in done.stdout


@pytest.mark.slow
def test_the_simulated_controller_prints_the_address_of_its_socket() -> None:
    command = [sys.executable, "-c", LACKING, "simulate"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            assert address.startswith("serial:socket://127.0.0.1:")
            done = run("status", "--device", address)
            assert done.returncode == 0, done.stderr
        finally:
            process.terminate()


def test_a_controller_that_needs_a_pseudo_terminal_says_so() -> None:
    done = run("status", "--device", "host")
    assert done.returncode == 3
    assert done.stderr.count("\n") == 1
    assert "its serial port is a pseudo-terminal, which this system lacks" in done.stderr
