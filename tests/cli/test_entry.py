"""Tests of the entry: an interruption while it loads, and the modules that it need not load."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest

from vibrocast.host.cli.command_line import main
from vibrocast.host.cli.commands import subcommands

ROOT = Path(__file__).parents[2]

# A command line that is interrupted while it is being imported.
INTERRUPTED_IMPORT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "vibrocast.host.cli.command_line":
            os.kill(os.getpid(), {number})

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupting())
from vibrocast.host.cli.entry import main
main()
"""


def run(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_while_loading(number: signal.Signals) -> None:
    heard = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # nohup ignores it
    result = run(heard + INTERRUPTED_IMPORT.format(number=int(number)))
    assert (result.returncode, result.stdout, result.stderr) == (128 + number, "", "error: interrupted\n")


# A command line that a library's computation keeps from heeding signals; each signal starts such a computation again.
COMPUTING = """
import hashlib, os, pathlib, signal, sys, threading
from vibrocast import files
from vibrocast.host.cli import command_line, entry

def compute():
    folder = pathlib.Path(sys.argv[1])
    with files.atomic_write(folder / "a.wav") as file, files.atomic_folder(folder / "b") as into:
        file.write_text("half")
        (into / "c").write_text("half")
        threading.Timer(0.2, os.kill, (os.getpid(), {number})).start()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # takes half an hour

for number in entry.STOPPING_SIGNALS:
    signal.signal(number, signal.default_int_handler)
command_line.main = compute
entry.main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_while_a_library_computes(number: signal.Signals, tmp_path: Path) -> None:
    result = run(COMPUTING.format(number=int(number)), str(tmp_path))
    assert (result.returncode, result.stdout, result.stderr) == (128 + number, "", "error: interrupted\n")
    assert list(tmp_path.iterdir()) == []


# A command that hears the signal itself, and one that cleans up for longer than a computation may go on.
HEARING = """
    heard = []
    signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(3 * entry.HEED_S)
    print(heard == [signal.SIGTERM])
"""
CLEANING_UP = """
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        time.sleep(3 * entry.HEED_S)
        print("at rest")
"""


@pytest.mark.parametrize(("work", "printed"), [(HEARING, "True\n"), (CLEANING_UP, "at rest\n")])
def test_a_command_that_deals_with_a_signal_is_left_to_it(work: str, printed: str) -> None:
    code = f"""
import os, signal, time
from vibrocast.host.cli import command_line, entry

def work():
{work}
command_line.main = work
entry.main()
"""
    assert run(code).stdout == printed


# Where the interruption of a command comes while a library is being loaded, or while an object is finalised.
LOADING = """
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        raise ImportError("cannot be initialised")
"""
FINALISING = """
    class Finalised:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)
    Finalised()
    time.sleep(60)
"""


@pytest.mark.parametrize("work", [LOADING, FINALISING])
def test_an_interruption_that_is_swallowed_ends_the_command(work: str) -> None:
    code = f"""
import os, signal, time
import click
from vibrocast.host.cli import command_line, entry

@click.command()
def work():
{work}
command_line.VibrocastCommand.get_command = lambda *_: work
entry.main()
"""
    result = run(code, "devices")
    assert (result.returncode, result.stderr.strip()) == (128 + signal.SIGTERM, "error: interrupted")


def test_a_hangup_that_is_to_be_ignored_is() -> None:
    code = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    result = run(code + INTERRUPTED_IMPORT.format(number=int(signal.SIGHUP)), "--version")
    assert result.returncode == 0
    assert "version" in result.stdout


# Each takes as long to load as numpy, or longer.
SLOW = {"av", "distributed", "matplotlib", "onnxruntime", "pytest", "scipy", "torch", "vibromaf"}
# Needed only for encoding, playing, listing devices or an error.
LIBRARIES = SLOW | {"cffi", "urllib.request", "libusb_package", "numpy", "rich", "serial", "soundfile", "soxr", "usb"}
COMMAND = """
import sys
from vibrocast.host.cli.entry import main
try:
    main()
finally:
    print(*sys.modules, file=sys.stderr)
"""


def loaded(code: str, *arguments: str) -> set[str]:
    """Return the modules that a program has loaded when it ends."""
    result = run(code, *arguments)
    assert result.returncode == 0, result.stderr
    return set(result.stderr.split())


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_load_no_library_but_click(option: str) -> None:
    modules = loaded(COMMAND, option)
    assert "vibrocast.host.cli.command_line" in modules
    assert modules.isdisjoint(LIBRARIES)


def test_importing_vibrocast_loads_no_library() -> None:
    assert loaded("import sys, vibrocast; print(*sys.modules, file=sys.stderr)").isdisjoint(LIBRARIES | {"click"})


def test_the_api_loads_no_slow_library() -> None:
    modules = loaded("import sys; from vibrocast import encode; print(*sys.modules, file=sys.stderr)")
    assert "numpy" in modules
    assert modules.isdisjoint(SLOW)


def test_the_help_of_subcommands_and_lists_load_no_slow_library() -> None:
    code = """
import sys
from click.testing import CliRunner
from vibrocast.host.cli.command_line import main
from vibrocast.host.cli.commands import subcommands
for arguments in [*([name, "--help"] for name in subcommands()), ["codecs"], ["devices"], ["models"]]:
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
print(*sys.modules, file=sys.stderr)
"""
    modules = loaded(code)
    assert "vibrocast.export.cli.train" in modules
    assert modules.isdisjoint(SLOW)


@pytest.mark.parametrize("name", subcommands())
def test_the_list_of_subcommands_shows_the_first_paragraph_of_each_help(name: str) -> None:
    command = main.get_command(click.Context(main), name)
    assert command is not None and command.name == name
    assert " ".join((command.help or "").split("\n\n")[0].split()) == subcommands()[name].summary


def test_prints_names_that_are_no_text(tmp_path: Path) -> None:
    out = tmp_path / "\udcff.vct"
    arguments = "encode", str(ROOT / "examples" / "taps.wav"), str(out)
    result = run("from vibrocast.host.cli.entry import main; main()", *arguments)
    assert result.returncode == 0 and "error" not in result.stderr
    assert "\\udcff.vct: " in result.stdout
    assert out.exists()
