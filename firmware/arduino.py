"""Writes the C library as an Arduino library, with an example: `python -m vibrocast.firmware.arduino`."""

import io
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click

from vibrocast.errors import InputError
from vibrocast.files import atomic_write
from vibrocast.firmware.build import ROOT, SHARED, Target
from vibrocast.firmware.native_core import BuildError, ffi, library

# The IDE finds a library by the headers at the top of its src/, which is the only include path.
_HEADER = '#include "vibrocast/decoder.h"\n#include "vibrocast/port.h"\n'
_PROPERTIES = """\
name=vibrocast
version={version}
author=the vibrocast authors
maintainer=the vibrocast authors
sentence=Decodes vibrotactile textures, and plays what a host streams.
paragraph=For processors of 32 bits.
category=Signal Input/Output
architectures=*
includes=vibrocast.h
dot_a_linkage=true
"""
_MOST_PACKET_BYTES = 65537
_PACKET_HEAD_BYTES = 5
"""A packet is read at once; the reader puts its number before it."""
_EXAMPLE = "examples/decode_array"


def write_library(stream: bytes, path: Path) -> None:
    """Write the .zip of a library whose example decodes a .vct file.

    Raises InputError if `stream` is none that a controller decodes without a model, OSError, and BuildError.
    """
    texts = {
        "library.properties": _PROPERTIES.format(version=version("vibrocast")),
        "src/vibrocast.h": _HEADER,
        f"{_EXAMPLE}/decode_array.ino": (ROOT / "examples" / "decode_array.ino").read_text(encoding="utf-8"),
        f"{_EXAMPLE}/stream.h": _array(stream),
    }
    paths = [ROOT / source for source in Target("", "", (), ("ports",)).sources()]
    paths += [
        path for folder in SHARED for kind in ("*.h", "*.inc", "*.txt") for path in sorted((ROOT / folder).glob(kind))
    ]
    for source in paths:
        place = source.relative_to(ROOT).as_posix().removeprefix("include/")
        texts[f"src/{place}"] = source.read_text(encoding="utf-8")
    with atomic_write(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(f"vibrocast/{name}", text)


def _array(stream: bytes) -> str:
    """Return a header in C with the bytes of a stream, and the memory that it needs."""
    core, file, largest = library(), io.BytesIO(stream), 0

    @ffi.callback("vc_stream_read")  # type: ignore[untyped-decorator, unused-ignore]
    def read(_: Any, to: Any, length: int) -> int:
        nonlocal largest
        part = file.read(length)
        ffi.memmove(to, part, len(part))
        largest = max(largest, len(part))
        return len(part)

    packet: Any = ffi.new("uint8_t[]", _MOST_PACKET_BYTES)
    opened: Any = ffi.new("vc_stream *", {"read": read, "packet": packet, "packet_bytes": _MOST_PACKET_BYTES})
    if core.vc_stream_open(opened) == core.VC_TOO_SMALL:  # which says how much memory the decoder needs
        file.seek(0)
        opened.memory_bytes = opened.needed_bytes
        memory = opened.memory = ffi.new("int64_t[]", -(-opened.needed_bytes // 8))  # noqa: F841 - keeps it
        core.vc_stream_open(opened)
    while (status := core.vc_stream_next(opened)) == core.VC_OK:
        pass
    if status != core.VC_END:
        text: Any = ffi.string(core.vc_status_text(status))
        raise InputError(text.decode())
    lines = [", ".join(map(str, stream[start : start + 20])) for start in range(0, len(stream), 20)]
    values = ",\n    ".join(lines)
    return (
        f"#define STREAM_DECODER_WORDS {-(-opened.needed_bytes // 8)}\n"
        f"#define STREAM_PACKET_BYTES {largest + _PACKET_HEAD_BYTES}\n"
        f"#define STREAM_SAMPLES {opened.packet_samples * opened.channels} /* of a packet, all channels together */\n"
        f"static const uint8_t stream_bytes[] = {{\n    {values}\n}};\n"
    )


@click.command()
@click.argument("stream", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("zip_path", metavar="ZIP", type=click.Path(dir_okay=False, path_type=Path))
def main(stream: Path, zip_path: Path) -> None:
    """Write the C library as ZIP, which the Arduino IDE adds. Its example decodes STREAM, a .vct file."""
    try:
        write_library(stream.read_bytes(), zip_path)
    except InputError as error:
        sys.exit(f"error: {stream}: {error}")
    except (BuildError, OSError) as error:
        sys.exit(f"error: {error}")
    click.echo(f"wrote {zip_path}")


if __name__ == "__main__":
    main()
