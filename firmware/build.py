"""Builds the firmware with ziglang, for this machine and for microcontrollers; `python -m firmware.build` does it."""

import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import click

from firmware.declarations import cffi_declarations

ROOT = Path(__file__).parent
SHARED = ("core", "controller")
"""Folders whose C sources are in every target."""

_FLAGS = (
    "-std=c99",
    "-O2",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-fno-sanitize=all",
    "-ffunction-sections",
    "-fdata-sections",
)
_BARE = ("-ffreestanding", "-fno-builtin", "-nostdlib", "-fno-unwind-tables", "-g0", "-Wl,--gc-sections")
_LIBRARY_SUFFIX = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


class BuildError(Exception):
    """What could not be built, why, and what to do."""


@dataclass(frozen=True)
class Target:
    """One build of the firmware.

    `folders`: of its port, below firmware/, whose C sources are compiled beside the shared ones. `limits`: the sizes of
    controller/sizes.h (and options of the port) that it sets.
    """

    summary: str
    suffix: str
    flags: tuple[str, ...]
    folders: tuple[str, ...] = ()
    limits: Mapping[str, int] = field(default_factory=dict)

    def sources(self) -> list[Path]:
        """Return its C sources."""
        return [path for folder in (*SHARED, *self.folders) for path in sorted((ROOT / folder).glob("*.c"))]

    def command(self) -> list[str]:
        """Return the compiler's arguments but for the output."""
        includes = [f"-I{ROOT / folder}" for folder in (*SHARED, *self.folders)]
        sizes = [f"-D{name}={value}" for name, value in self.limits.items()]
        return [*_FLAGS, *self.flags, *sizes, *includes, *map(str, self.sources())]


_NATIVE = Target(
    "shared library of core and controller, for cffi",
    _LIBRARY_SUFFIX,
    (*(() if sys.platform == "win32" else ("-fPIC",)), "-shared", f"-mcpu={os.environ.get('VIBROCAST_CPU', 'native')}"),
)
TARGETS: Mapping[str, Target] = {"native": _NATIVE}


def build(name: str, limits: Mapping[str, int] | None = None) -> Path:
    """Build a target of TARGETS, unless it is there already, and return its file.

    `limits`: further sizes of controller/sizes.h. A library's declarations for cffi lie beside it, with the suffix
    ".cdef". What is built is kept in firmware/build, or in the user's cache where that cannot be written, by a hash of
    all that it is made from. Raises BuildError.
    """
    target = TARGETS[name]
    target = replace(target, limits={**target.limits, **(limits or {})})
    if find_spec("ziglang") is None:
        raise BuildError('the firmware is compiled by ziglang: pip install "vibrocast[firmware]"')
    folder = _build_folder() / f"{name}-{_fingerprint(target)}"
    built = folder / f"{name}{target.suffix}"
    if not built.exists():
        # Made elsewhere and moved when it is whole: others may build the same at the same time.
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f"{name}-") as temporary:
            made = Path(temporary) / "made"
            made.mkdir()
            _compile(target, made / built.name)
            if target.suffix == _LIBRARY_SUFFIX:
                parts = [cffi_declarations(ROOT / shared) for shared in SHARED]
                (made / built.with_suffix(".cdef").name).write_text("\n".join(parts))
            try:
                made.rename(folder)
            except OSError as error:
                if not built.exists():
                    raise BuildError(f"{folder}: cannot be written: {error.strerror}") from error
    return built


def _build_folder() -> Path:
    """Return the folder for what is built: beside the sources, or in the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vibrocast"
    for folder in (ROOT / "build", cache):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise BuildError(f"neither {ROOT / 'build'} nor {cache} can be written: set XDG_CACHE_HOME to a folder that can")


def _fingerprint(target: Target) -> str:
    """Return a hash of the sources, the flags, the machine and the compiler."""
    digest = hashlib.sha256(repr((target.command(), sys.platform, platform.machine(), version("ziglang"))).encode())
    for folder in (*SHARED, *target.folders):
        for path in sorted((ROOT / folder).iterdir()):
            if path.suffix in (".c", ".h", ".ld"):
                digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def _compile(target: Target, output: Path) -> None:
    command = [sys.executable, "-m", "ziglang", "cc", *target.command(), "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise BuildError(f"the firmware cannot be compiled:\n{done.stderr}")


@click.command()
@click.argument("names", metavar="[TARGET]...", nargs=-1, type=click.Choice(list(TARGETS)))
def main(names: tuple[str, ...]) -> None:
    """Build targets of the firmware, all if none is named, and print the file of each."""
    for name in names or TARGETS:
        try:
            click.echo(f"{name}: {build(name)}")
        except BuildError as error:
            raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
