"""The C library without a controller: the example, damaged files, headers, sizes, names, lists of files."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection
from numpy.typing import NDArray

from tests.firmware.boards import coded
from tests.firmware.native import ffi, native
from vibrocast import codec, models
from vibrocast.codec.stream import Stream
from vibrocast.firmware.build import FLAGS, ROOT, SHARED

ZIG = [sys.executable, "-m", "ziglang"]
PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "use_the_decoder.md"
CODECS = ("mdct", "dct", "slp", "eva", "parametric")
HEADERS = sorted((ROOT / "include" / "vibrocast").glob("*.h"))
CORE = [path for path in sorted((ROOT / "src" / "core").glob("*.c")) if not path.stem.endswith("_encoder")]
CONTROLLER = [
    *sorted((ROOT / "src" / "controller").glob("*.c")),
    ROOT / "ports" / "loop.c",
]


def run(*command: str | Path, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(part) for part in command], cwd=folder, capture_output=True, text=True)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the example, compiled from the sources alone, which stops at undefined behaviour."""
    built = tmp_path_factory.mktemp("example") / "decode"
    options = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-fsanitize=undefined", f"-I{ROOT / 'include'}"]
    done = run(*ZIG, "cc", *options, ROOT / "examples" / "decode.c", *CORE, "-o", built)
    assert done.returncode == 0, done.stderr
    return built


def expected(stream: Stream) -> NDArray[np.int16]:
    start = stream.delay_samples
    return stream.decode_integers()[start : start + stream.samples]


def decoded(program: Path, data: bytes, folder: Path, *image: Path) -> tuple[int, str, NDArray[np.int16]]:
    (folder / "a.vct").write_bytes(data)
    done = run(program, folder / "a.vct", folder / "a.pcm", *image)
    return done.returncode, done.stderr, np.fromfile(folder / "a.pcm", "<i2")


@pytest.mark.parametrize("name", CODECS)
def test_example_decodes_each_codec_to_the_same_bits(program: Path, tmp_path: Path, name: str) -> None:
    stream = coded(name)
    image: tuple[Path, ...] = ()
    if stream.image is not None:
        image = (tmp_path / "model.vcmi",)
        image[0].write_bytes(stream.image)
    status, said, samples = decoded(program, bytes(stream), tmp_path, *image)
    assert (status, said) == (0, "")
    np.testing.assert_array_equal(samples.reshape(-1, 2), expected(stream))


def test_each_cut_and_damaged_file_is_rejected(program: Path, tmp_path: Path) -> None:
    data = bytes(coded("mdct", 0.1))
    generator = np.random.default_rng(1)
    lengths = sorted({*range(0, 40, 3), *generator.integers(0, len(data), 8).tolist(), len(data) - 1})
    for length in lengths:
        status, said, _ = decoded(program, data[:length], tmp_path)
        assert status == 1 and said.endswith(("again\n", "copy it again\n")), (length, said)
    for at in generator.integers(1, len(data), 25).tolist():
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(generator.integers(8))
        assert decoded(program, bytes(damaged), tmp_path)[0] == 1, at
    assert decoded(program, data + b"\0", tmp_path)[0] == 1


def test_errors_say_what_to_do(program: Path, tmp_path: Path) -> None:
    assert "new file" in run(program).stderr
    assert decoded(program, b"RIFF", tmp_path)[1] == "no .vct file of this version: encode the recording again\n"
    eva = bytes(coded("eva", 0.1))
    assert "give that image" in decoded(program, eva, tmp_path)[1]
    other = tmp_path / "other.vcmi"
    other.write_bytes(models.find("mdct-textures").image)
    assert "give that image" in decoded(program, eva, tmp_path, other)[1]


def opened(data: bytes, memory_bytes: int = 1 << 18, packet_bytes: int = 65535, piece: int = 1 << 20) -> Any:
    """Return a vc_stream over bytes, its status of opening, and what keeps its memory."""
    left = bytearray(data)

    @ffi.callback("vc_stream_read")  # type: ignore[untyped-decorator, unused-ignore]
    def read(_: Any, to: Any, length: int) -> int:
        part = bytes(left[:length])
        ffi.memmove(to, part, len(part))
        del left[: len(part)]
        return len(part)

    memory, packet = ffi.new("int64_t[]", max(1, memory_bytes // 8)), ffi.new("uint8_t[]", packet_bytes)
    stream = ffi.new(
        "vc_stream *",
        {"read": read, "memory": memory, "memory_bytes": memory_bytes, "packet": packet, "packet_bytes": packet_bytes},
    )
    return stream, native.vc_stream_open(stream), (read, memory, packet)


def test_facts_of_a_stream_and_memory_that_is_too_small() -> None:
    source = coded("slp")
    stream, status, kept = opened(bytes(source))
    assert status == native.VC_OK and kept
    assert ffi.string(stream.codec) == b"slp"
    header = source.header
    assert (stream.rate_hz, stream.channels, stream.samples) == (header.rate_hz, header.channels, header.samples)
    assert stream.packet_samples == source.packet_samples
    assert stream.needed_bytes == native.vc_slp_decoder_size()
    little, status, _ = opened(bytes(source), stream.needed_bytes - 8)
    assert status == native.VC_TOO_SMALL and little.needed_bytes == stream.needed_bytes
    assert native.vc_stream_next(little) == native.VC_TOO_SMALL
    short, status, kept = opened(bytes(source), packet_bytes=20)
    assert status == native.VC_OK and kept
    assert native.vc_stream_next(short) == native.vc_stream_next(short) == native.VC_PACKET_TOO_LARGE


def test_packets_of_a_link_are_decoded_and_missing_ones_concealed() -> None:
    source = coded("mdct")
    stream, _, kept = opened(bytes(source))
    samples = ffi.new("int16_t[]", stream.packet_samples * stream.channels)
    known = codec.decoder(source.header.codec_identifier, source.header.configuration, 2)
    for number, packet in enumerate(source.packets):
        given = None if number == 2 else packet
        status = native.vc_stream_feed(stream, given or ffi.NULL, len(given or b""))
        concealed = number >= 2 and not (packet[0] & 1) and status == native.VC_CONCEALED
        assert status == native.VC_OK or given is None or concealed
        while native.vc_stream_poll(stream, samples) < stream.packet_samples:
            pass
        want = known.conceal() if given is None else known.decode(packet)
        np.testing.assert_array_equal(np.frombuffer(ffi.buffer(samples), "<i2").reshape(-1, 2), want)
    assert native.vc_stream_feed(stream, b"\x80", 1) == native.VC_BAD_PACKET
    assert kept


def test_every_status_has_a_sentence() -> None:
    text = (ROOT / "include" / "vibrocast" / "status.h").read_text(encoding="utf-8")
    names = re.findall(r"^    (VC_\w+) = ", text, re.MULTILINE)
    sentences = {ffi.string(native.vc_status_text(getattr(native, name))) for name in names}
    assert len(sentences) == len(names) > 10 and b"unknown status" not in sentences


@pytest.mark.parametrize("language", ["c", "c++"])
def test_each_public_header_compiles_alone(tmp_path: Path, language: str) -> None:
    standard = {"c": "-std=c99", "c++": "-std=c++11"}[language]
    sources: list[Path] = []
    for header in HEADERS:
        sources.append(tmp_path / f"{header.stem}.{'c' if language == 'c' else 'cpp'}")
        sources[-1].write_text(f'#include "vibrocast/{header.name}"\nint {header.stem}_is_there;\n')
    flags: list[str | Path] = [standard, "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{ROOT / 'include'}"]
    done = run(*ZIG, {"c": "cc", "c++": "c++"}[language], *flags, "-c", *sources, folder=tmp_path)
    assert done.returncode == 0, done.stderr


def symbols(path: Path) -> dict[str, int]:
    """Return the sizes of what an object file defines, by global name."""
    with path.open("rb") as file:
        table = ELFFile(file).get_section_by_name(".symtab")
        assert isinstance(table, SymbolTableSection)
        found = [symbol for symbol in table.iter_symbols() if symbol["st_info"]["bind"] != "STB_LOCAL"]
        return {symbol.name: symbol["st_size"] for symbol in found if symbol["st_shndx"] != "SHN_UNDEF"}


@pytest.mark.slow
def test_global_names_begin_with_vc(tmp_path: Path) -> None:
    flags = ["-target", "x86_64-linux-gnu", "-std=c99", "-O0", f"-I{ROOT / 'include'}"]
    done = run(*ZIG, "cc", *flags, "-c", *(path.resolve() for path in (*CORE, *CONTROLLER)), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    names = {name for path in tmp_path.glob("*.o") for name in symbols(path)}
    assert {name for name in names if not name.startswith("vc_")} == set()
    assert "vc_mdct_feed" in names


@pytest.mark.parametrize("target", ["x86_64-linux-gnu", "thumb-freestanding-eabi"])
@pytest.mark.parametrize("channels", [1, 2, 7, 16])
def test_decoder_words_hold_each_codec_and_little_more(tmp_path: Path, target: str, channels: int) -> None:
    # The size of an object is the number that the compiler gives for an expression.
    structures = [f"char state_{name}[sizeof(struct vc_{name}_decoder)];" for name in CODECS]
    words = [f"int64_t words_{name}[VC_{name.upper()}_WORDS];" for name in CODECS]
    source = tmp_path / "sizes.c"
    source.write_text(
        '#include "vc_decoder_memory.h"\nint64_t all[VC_DECODER_WORDS];\n' + "\n".join(structures + words)
    )
    flags = ["-target", target, f"-DVC_MAX_CHANNELS={channels}", f"-I{ROOT / 'include'}", f"-I{CORE[0].parent}"]
    done = run(*ZIG, "cc", *flags, "-std=c99", "-c", source, "-o", tmp_path / "sizes.o")
    assert done.returncode == 0, done.stderr
    sizes = symbols(tmp_path / "sizes.o")
    for name in CODECS:
        assert 0 <= sizes[f"words_{name}"] - sizes[f"state_{name}"] < 160
    assert sizes["all"] == max(sizes[f"words_{name}"] for name in CODECS)


def needed(folder: Path, name: str, processor: str = "cortex_m0plus") -> set[str]:
    """Return the sources that the linker takes for a decoder of one codec."""
    switches = [f"-DVC_WITH_{other.upper()}={int(other == name)}" for other in CODECS]
    target = ["-target", "thumb-freestanding-eabi", f"-mcpu={processor}", "-O", "ReleaseFast"]
    flags = [*FLAGS, "-ffreestanding", "-fno-builtin", *switches, f"-I{ROOT / 'include'}"]
    archive = folder / "libvibrocast.a"
    done = run(*ZIG, "build-lib", *target, f"-femit-bin={archive}", "-cflags", *flags, "--", *CORE)
    assert done.returncode == 0, done.stderr
    roots = [f"--undefined=vc_{function}" for function in ("stream_open", "stream_next", "stream_poll")]
    options = ["--trace", "--gc-sections", "--entry=0", "--unresolved-symbols=ignore-all", "-o", str(folder / "linked")]
    done = run(*ZIG, "ld.lld", *options, *roots, archive, folder=folder)
    assert done.returncode == 0, done.stderr
    return set(re.findall(r"\b(vc_\w+)\.o\)", done.stdout))


@pytest.mark.slow
@pytest.mark.parametrize("name", CODECS)
def test_the_page_lists_the_sources_of_each_codec(tmp_path: Path, name: str) -> None:
    text = PAGE.read_text(encoding="utf-8")
    shared = re.search(r"^\| all \| (.*) \|$", text, re.MULTILINE)
    own = re.search(rf"^\| `{name}` \| (.*) \|$", text, re.MULTILINE)
    assert shared and own
    listed = set(re.findall(r"`(vc_\w+)\.c`", shared[1] + own[1]))
    assert listed == needed(tmp_path, name)
    if name == "eva":
        more = re.search(r"^On a Cortex-M with DSP.*", text, re.MULTILINE)
        assert more
        assert listed | set(re.findall(r"`(vc_\w+)\.c`", more[0])) == needed(tmp_path, name, "cortex_m4")


def test_a_build_without_a_codec_offers_and_takes_the_others(tmp_path: Path) -> None:
    assert SHARED[0] == "include/vibrocast"
    options = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", f"-I{ROOT / 'include'}", "-DVC_WITH_MDCT=0"]
    done = run(*ZIG, "cc", *options, ROOT / "examples" / "decode.c", *CORE, "-o", tmp_path / "decode")
    assert done.returncode == 0, done.stderr
    assert "lacks the codec" in decoded(tmp_path / "decode", bytes(coded("mdct", 0.1)), tmp_path)[1]
    assert decoded(tmp_path / "decode", bytes(coded("slp", 0.1)), tmp_path)[0] == 0
    none = [f"-DVC_WITH_{name.upper()}=0" for name in CODECS]
    done = run(*ZIG, "cc", *options, *none, "-c", CORE[0].parent / "vc_codec.c", "-o", tmp_path / "codec.o")
    assert "there is no codec" in done.stderr
