"""Reads files by parsers of other projects in a process of their own, so that no file can end or fill this one."""

import atexit
import contextlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

import numpy as np

from vibrocast import memory
from vibrocast.extras import MissingExtraError
from vibrocast.textures.columns import Table
from vibrocast.textures.recording import Contents, TextureError, unusable

SECONDS = 60.0
"""A reader may take so long, and a second more for each _BYTES_PER_S of the file."""
_BYTES_PER_S = 1e6


def read(reader: str, path: Path, key: str | None, rate_hz: float | None) -> Contents | Table:
    """Return what `read(path, key, rate_hz)` of a module of this package returns, and raise as it does.

    Raises TextureError, too, where the module's parser crashes on the file, or takes too much time or memory.
    """
    seconds = SECONDS + path.stat().st_size / _BYTES_PER_S
    with tempfile.TemporaryDirectory() as folder:
        samples = Path(folder, "samples.npy")
        request = {"reader": reader, "path": str(path), "key": key, "rate_hz": rate_hz}
        request |= {"folder": os.getcwd(), "free_bytes": memory.available_bytes(), "samples": str(samples)}
        answer, timed_out = READERS.ask(request, seconds)
        if timed_out:
            raise unusable(path, f"reading it takes longer than {seconds:.0f} s", "save it as .npy or .wav")
        if answer is None:
            raise unusable(path, "its reader crashes, as at a damaged or hostile file", "save it again, or as .npy")
        if "error" in answer:
            raise _error(answer["error"])
        facts: dict[str, Any] = {
            name: tuple(fact) if isinstance(fact, list) else fact for name, fact in answer["facts"].items()
        }
        return (Table if answer["table"] else Contents)(np.load(samples), **facts)


class _ReaderProcess:
    """One process that serves requests in turn; a new one follows a process that has crashed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._owner = 0

    def ask(self, request: dict[str, Any], seconds: float) -> tuple[dict[str, Any] | None, bool]:
        """Return the answer, None if the process ended instead, and whether it took too long."""
        with self._lock:
            # A forked process starts its own.
            if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
                self._process, self._owner = _started(), os.getpid()
            process, late = self._process, threading.Event()

            def give_up() -> None:
                late.set()
                process.kill()

            timer = threading.Timer(seconds, give_up)
            timer.daemon = True
            timer.start()
            line = ""
            try:
                line = _line_for(process, request)
            finally:
                timer.cancel()
                # After Ctrl-C, too: the next request must not get the answer to this one.
                if late.is_set() or not line.endswith("\n"):
                    self.end()
            answer: dict[str, Any] | None = json.loads(line) if line.endswith("\n") else None
            return answer, late.is_set() and answer is None

    def end(self) -> None:
        """End the process, if there is one."""
        if self._process is not None and self._owner == os.getpid():
            self._process.kill()
            self._process.communicate()
        self._process = None


READERS = _ReaderProcess()
atexit.register(READERS.end)


def _started() -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import serve; serve()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def _line_for(process: subprocess.Popen[str], request: dict[str, Any]) -> str:
    """Return the line that answers a request; an unfinished one if the process has ended."""
    assert process.stdin is not None and process.stdout is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        return process.stdout.readline()
    return ""


def _error(told: dict[str, Any]) -> Exception:
    """Return the error of a reader."""
    if "extra" in told:
        return MissingExtraError(told["extra"])
    if "problem" in told:
        return TextureError(told["problem"], told["cause"], told["action"], tuple(told["parameter"]))
    return OSError(told["number"], told["text"]) if "number" in told else MemoryError()


def serve() -> None:
    """Answer each line of standard input by one of standard output, until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # no parser writes between the answers
    for line in sys.stdin:
        _answer(json.loads(line), answers)


def _answer(request: dict[str, Any], answers: IO[str]) -> None:
    memory.limit_bytes = request["free_bytes"]
    _limit_memory(request["free_bytes"])
    answer: dict[str, Any]
    try:
        os.chdir(request["folder"])  # the file's name is relative to it
        reader = importlib.import_module(f"{__package__}.{request['reader']}")
        found: Contents | Table = reader.read(Path(request["path"]), request["key"], request["rate_hz"])
        samples, *names = [each.name for each in fields(found)]
        np.save(request["samples"], getattr(found, samples))
        answer = {"table": isinstance(found, Table), "facts": {name: getattr(found, name) for name in names}}
    except TextureError as error:
        answer = {"error": {name: getattr(error, name) for name in ("problem", "cause", "action", "parameter")}}
    except MissingExtraError as error:
        answer = {"error": {"extra": str(error)}}
    except MemoryError:
        answer = {"error": {}}
    except OSError as error:
        answer = {"error": {"number": error.errno, "text": error.strerror or str(error)}}
    answers.write(json.dumps(answer) + "\n")
    answers.flush()


def _limit_memory(free_bytes: int) -> None:
    """Let this process take no more than is free, where the system can limit it."""
    with contextlib.suppress(ImportError):  # Windows
        import resource

        import psutil

        most_bytes = psutil.Process().memory_info().vms + free_bytes
        _, hard_bytes = resource.getrlimit(resource.RLIMIT_AS)
        if hard_bytes != resource.RLIM_INFINITY:
            most_bytes = min(most_bytes, hard_bytes)
        resource.setrlimit(resource.RLIMIT_AS, (most_bytes, hard_bytes))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
