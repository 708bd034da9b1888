"""Compiles firmware/core into the shared library that codec/core.py loads; run directly, it recompiles in place."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # run as a script where hatchling is not installed
    BuildHookInterface = object  # type: ignore[assignment, misc]

ROOT = Path(__file__).parent
sys.path.insert(0, str(ROOT))  # a build backend runs this file from elsewhere
from firmware.declarations import cffi_declarations  # noqa: E402

LIBRARY = {"darwin": "vibrocast_core.dylib", "win32": "vibrocast_core.dll"}.get(sys.platform, "vibrocast_core.so")
FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-sanitize=all", "-shared"]


def compile_core(output_folder: Path) -> list[Path]:
    """Compile firmware/core/*.c with ziglang; return the library and the declarations that cffi reads.

    The library is for this machine's processor, or for what the environment variable VIBROCAST_CPU names.
    """
    core = ROOT / "firmware" / "core"
    library = output_folder / LIBRARY
    position_independent = [] if sys.platform == "win32" else ["-fPIC"]
    sources = sorted(str(path) for path in core.glob("*.c"))
    flags = [*FLAGS, *position_independent, f"-mcpu={os.environ.get('VIBROCAST_CPU', 'native')}"]
    command = [sys.executable, "-m", "ziglang", "cc", *flags, *sources, "-o", str(library)]
    subprocess.run(command, check=True)
    declarations = output_folder / "vibrocast_core.cdef"
    declarations.write_text(cffi_declarations(core))
    return [library, declarations]


class CompileCore(BuildHookInterface):  # type: ignore[type-arg, unused-ignore]
    """Build hook: a wheel holds the compiled core, an editable install finds it beside codec/core.py."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        outputs = compile_core(ROOT / "codec")
        build_data["artifacts"] += [str(path.relative_to(ROOT)) for path in outputs]
        build_data["pure_python"] = False
        build_data["infer_tag"] = True


if __name__ == "__main__":
    compile_core(ROOT / "codec")
