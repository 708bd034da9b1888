"""Counts the bytes of the codecs' decoders for the benchmark's cost tables: `python -m studies.decoder_sizes`."""

import json
import platform
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

import click

from studies import page
from vibrocast import codec, extras
from vibrocast.evaluation.cost import DECODER_SIZES, DecoderSize
from vibrocast.evaluation.peers import measured_codecs
from vibrocast.files import atomic_write
from vibrocast.firmware.native_core import BuildError

_LIBRARIES = {"opus": "libopus", "amr-nb": "libopencore-amrnb"}
"""How the names of files in PyAV's wheel begin that hold the decoder of one codec alone."""
_CORE = Path(__file__).parents[1] / "firmware" / "src" / "core"
_TARGET = ("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp")
_FLAGS = (
    "-Os",
    f"-I{_CORE.parents[1] / 'include'}",
    "-std=c99",
    "-ffreestanding",
    "-fno-builtin",
    "-ffunction-sections",
    "-fdata-sections",
    "-g0",
)


def count_decoder_size(codec_name: str) -> DecoderSize:
    """Count the bytes of a codec's decoder: compiled where it is in the C core, else in PyAV's wheel.

    Raises BuildError where the core cannot be compiled.
    """
    if functions := _decoder_functions(codec_name):
        compiler = f"ziglang {metadata.version('ziglang')} {_FLAGS[0]}"
        note = f"for Cortex-M4 by {compiler}, without memcpy, memset and the compiler's arithmetic routines"
        return DecoderSize(_linked_bytes(functions), note)
    if codec_name not in _LIBRARIES:
        reason = "one of many in libavcodec" if codec_name in codec.PEERS else "not in the C core"
        return DecoderSize(None, f"decoder not counted: {reason}")
    library = _LIBRARIES[codec_name]
    files = [file for file in metadata.files("av") or () if file.name.startswith(library)]
    size = sum(Path(str(file.locate())).stat().st_size for file in files)
    note = f"{library} of PyAV {metadata.version('av')}, {platform.machine()}, encoder included"
    return DecoderSize(size or None, note)


def _decoder_functions(codec_name: str) -> list[str]:
    """Return the core's functions that decode for a codec, as its headers declare them; none for other codecs."""
    headers = "\n".join(path.read_text(encoding="utf-8") for path in _CORE.glob("*.h"))
    return sorted(set(re.findall(rf"\bvc_{re.escape(codec_name)}_(?:decode\w*|conceal)(?=\()", headers)))


def _linked_bytes(functions: list[str]) -> int:
    """Return the size of the image with these functions, all that they need, and nothing else."""
    zig = [sys.executable, "-m", "ziglang"]
    with tempfile.TemporaryDirectory() as folder:
        sources = sorted(str(path) for path in _CORE.glob("*.c"))
        _run([*zig, "cc", "-c", *_TARGET, *_FLAGS, "-fno-unwind-tables", *sources], folder)
        roots = [f"--undefined={name}" for name in functions]
        layout = ["--gc-sections", "--omagic", "--entry=0", "--oformat=binary", "--unresolved-symbols=ignore-all"]
        objects = sorted(path.name for path in Path(folder).glob("*.o"))
        _run([*zig, "ld.lld", *layout, *roots, *objects, "-o", "decoder.bin"], folder)
        return (Path(folder) / "decoder.bin").stat().st_size


def _run(command: list[str], folder: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise BuildError(f"the core cannot be compiled:\n{done.stderr}")


@click.command()
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), default=DECODER_SIZES, show_default="as shipped"
)
def main(out: Path) -> None:
    """Count the bytes of every codec's decoder and write them as JSON; needs ziglang."""
    with page.errors_in_one_line():
        extras.require("firmware", "ziglang")
        sizes = {name: asdict(count_decoder_size(name)) for name in measured_codecs()}
        with atomic_write(out) as path:
            path.write_text(json.dumps(sizes, indent=1) + "\n", encoding="utf-8")
    for name, size in sizes.items():
        click.echo(f"{name}: {size['bytes'] or 'no'} bytes ({size['note']})")


if __name__ == "__main__":
    main()
