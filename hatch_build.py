"""Compiles core and controller into the libraries that firmware/native_core.py loads; run directly, in place."""

import argparse
import platform
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # run as a script where hatchling is not installed
    BuildHookInterface = object  # type: ignore[assignment, misc]

ROOT = Path(__file__).parent
sys.path.insert(0, str(ROOT))  # a build backend runs this file from elsewhere
from firmware.declarations import cffi_declarations  # noqa: E402

FOLDERS = (
    "firmware/include/vibrocast",
    "firmware/src/core",
    "firmware/src/controller",
    "firmware/ports/python",
)
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-sanitize=all", "-g0", "-shared")
DEFINES = ("-DVC_CHANNELS=16",)
"""The largest sizes of a simulated controller, where they are not those of firmware/include/vibrocast/sizes.h."""
SUFFIX = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
MACHINE = platform.machine()
PROCESSORS = ("baseline", "x86_64_v3") if MACHINE in ("x86_64", "AMD64") else ("baseline",)
"""The compiler's names of the processors that a library is compiled for; every processor of this machine's kind runs
the first."""
GLIBC = (2, 17)
"""The oldest glibc that the libraries run with."""
LINKS_GLIBC = sys.platform == "linux" and platform.libc_ver()[0] == "glibc" and MACHINE in ("x86_64", "aarch64")


def compile_core(output_folder: Path) -> list[Path]:
    """Compile core and controller with ziglang, once for each of PROCESSORS.

    Return the libraries, and the declarations that cffi reads. Raises CalledProcessError.
    """
    flags = [*FLAGS, *DEFINES, *(() if sys.platform == "win32" else ("-fPIC",)), "-Ifirmware/include"]
    if LINKS_GLIBC:
        flags += ["-target", f"{MACHINE}-linux-gnu.{GLIBC[0]}.{GLIBC[1]}"]
    sources = [str(path.relative_to(ROOT)) for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.c"))]
    libraries = [output_folder / f"vibrocast_core.{processor}{SUFFIX}" for processor in PROCESSORS]
    # The linker of Windows writes further files. A library is moved into place whole: programs may be running the old.
    with TemporaryDirectory(prefix="vibrocast_core.", dir=output_folder.absolute()) as temporary:
        for processor, library in zip(PROCESSORS, libraries, strict=True):
            linked = Path(temporary) / library.name
            command = [sys.executable, "-m", "ziglang", "cc", *flags, f"-mcpu={processor}", *sources]
            subprocess.run([*command, "-o", str(linked)], check=True, cwd=ROOT)
            linked.replace(library)
    declarations = output_folder / "vibrocast_core.cdef"
    declarations.write_text("".join(cffi_declarations(ROOT / folder) for folder in FOLDERS), encoding="utf-8")
    return [*libraries, declarations]


def platform_tag() -> str:
    """Return the platform tag of a wheel that holds the libraries."""
    if LINKS_GLIBC:
        return f"manylinux_{GLIBC[0]}_{GLIBC[1]}_{MACHINE}"
    from packaging.tags import platform_tags  # hatchling requires it

    return next(platform_tags())


class CompileCore(BuildHookInterface):  # type: ignore[type-arg, unused-ignore]
    """Build hook: a wheel holds the compiled core; an editable install finds it in firmware/."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the core. The wheel fits every Python, because cffi loads the libraries without Python's ABI."""
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform_tag()}"
        if version == "editable":
            check_links()
            compile_core(ROOT / "firmware")
            return
        self._compiled = TemporaryDirectory()
        for path in compile_core(Path(self._compiled.name)):
            build_data["force_include"][str(path)] = f"vibrocast/firmware/{path.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Delete the compiled files, which the wheel holds now."""
        if version != "editable":
            self._compiled.cleanup()


def check_links() -> None:
    """Raise RuntimeError if vibrocast/ lacks its links to the packages, without which an editable install is empty."""
    if not (ROOT / "vibrocast" / "codec").is_dir():
        raise RuntimeError(
            "vibrocast/codec is not a link to codec; an editable install needs a git checkout with links: "
            "clone with `git clone -c core.symlinks=true`, or install without --editable"
        )


if __name__ == "__main__":
    # Not click: the build may run where vibrocast's dependencies are not installed yet.
    argparse.ArgumentParser(description="Compile core and controller into firmware/.").parse_args()
    compile_core(ROOT / "firmware")
