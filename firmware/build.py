"""Builds the firmware with ziglang, for this machine and for microcontrollers: `python -m vibrocast.firmware.build`."""

import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path

import click

from vibrocast import extras
from vibrocast.errors import VibrocastError
from vibrocast.firmware import rp2040
from vibrocast.firmware.declarations import cffi_declarations
from vibrocast.firmware.keys import read_public_key
from vibrocast.firmware.native_core import BuildError

ROOT = Path(__file__).parent
SHARED = ("include/vibrocast", "src/core", "src/controller")
"""Folders of every target: public headers, and C sources."""

FLAGS = (
    "-std=c99",
    "-O2",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-fno-sanitize=all",
    "-ffunction-sections",
    "-fdata-sections",
)
# Without a frame pointer, inner loops have one more register.
CORTEX_M_FLAGS = (
    *("-target", "thumb-freestanding-eabihf", "-ffreestanding", "-fno-builtin", "-fno-unwind-tables"),
    *("-fomit-frame-pointer", "-g0", "-Wl,--gc-sections", "-Wvla", "-Wframe-larger-than=2560"),
)
# A module without imports: the compiler's runtime has memcpy and memset. ports/wasm/module.c says what it exports.
WASM_FLAGS = (
    *("-target", "wasm32-freestanding", "-g0"),
    *("-Wl,--no-entry", "-Wl,--gc-sections", "-Wl,--export=__heap_base", "-Wl,--strip-all"),
)
M4F, M7, M33 = "cortex_m4+vfp4d16sp", "cortex_m7+fp_armv8d16", "cortex_m33+fp_armv8d16sp+dsp"
"""The compiler's names of processors with an FPU and DSP instructions."""
M0_PLUS, M3 = "cortex_m0plus", "cortex_m3"
"""And of two with neither."""
_IN_RAM = (".stack", ".core", ".data", ".bss")
_LIBRARY_SUFFIX = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


@dataclass(frozen=True)
class Target:
    """One build of the firmware.

    `folders`: of its port, below firmware/, whose C sources are compiled with those of `shared`. `defines`: sizes of
    vibrocast/sizes.h, and settings of its port. `finish`: called with the linked image. `verifier`: C sources of others
    that verify signatures; their warnings are no errors. `actuator`: a C source with the actuator, instead of the
    port's.
    """

    summary: str
    suffix: str
    flags: tuple[str, ...]
    folders: tuple[str, ...] = ()
    shared: tuple[str, ...] = SHARED
    defines: Mapping[str, int | str] = field(default_factory=dict)
    finish: Callable[[Path], None] | None = None
    verifier: tuple[Path, ...] = ()
    actuator: Path | None = None

    def sources(self) -> list[Path]:
        """Return its C sources, from ROOT on; a controller has no use for the core's encoders."""
        folders = [ROOT / folder for folder in (*self.shared, *self.folders)]
        found = [path.relative_to(ROOT) for folder in folders for path in sorted(folder.glob("*.c"))]
        return [path for path in found if not path.stem.endswith("_encoder")]

    def command(self) -> list[str]:
        """Return the compiler's arguments except the output; run it in ROOT."""
        includes = [f"-I{folder}" for folder in ("include", *self.folders)]
        texts = {name: f'"{value}"' if isinstance(value, str) else value for name, value in self.defines.items()}
        defines = [f"-D{name}={value}" for name, value in texts.items()]
        command = [*FLAGS, *self.flags, *defines, *includes, *map(str, self.sources())]
        if self.actuator is not None:
            command += ["-DVC_BOARD_ACTUATOR", str(self.actuator)]
        if self.verifier:
            command += ["-DVC_VERIFIER", "-Wno-error", *(f"-I{path.parent}" for path in self.verifier)]
        return [*command, *map(str, self.verifier)]


def cortex_m_flags(processor: str) -> tuple[str, ...]:
    """Return the compiler's flags for a Cortex-M."""
    general = [flag.removesuffix("hf") if processor in (M0_PLUS, M3) else flag for flag in CORTEX_M_FLAGS]
    return (*general, f"-mcpu={processor}")


def cortex_m(summary: str, processor: str, script: str, folders: tuple[str, ...], **defines: int | str) -> Target:
    """Return the target of a Cortex-M. `script`: its linker script, in the first of `folders`."""
    flags = (*cortex_m_flags(processor), "-T", f"{folders[0]}/{script}", "-Wl,-e,Reset_Handler")
    return Target(summary, ".elf", flags, ("ports", "ports/cortex_m", *folders), defines=defines)


def _mps2(core: str, processor: str, board: str, script: str = "mps2.ld", **defines: int | str) -> dict[str, Target]:
    """Return the two targets of an MPS2 board, polled and with interrupts."""
    return {
        f"{core}{suffix}": cortex_m(
            f"{core} on an MPS2 board ({board}), {kind}",
            processor,
            script,
            ("ports/mps2", f"ports/mps2/{kind}"),
            VC_HARDWARE=f"mps2-{board}",
            **_EMULATED,
            **defines,
        )
        for kind, suffix in (("polled", ""), ("interrupt", "-interrupt"))
    }


_POSITION_INDEPENDENT = () if sys.platform == "win32" else ("-fPIC",)
# Four channels, and captures of some 20 s, in 4 MiB.
_EMULATED = {
    "VC_CHANNELS": 4,
    "VC_MAX_CHANNELS": 4,
    "VC_BUFFER_BYTES": 1 << 18,
    "VC_CAPTURE_SAMPLES": 1 << 16,
    "VC_PROFILE_SAMPLES": 1 << 14,
}


def _stm32f405(summary: str, script: str) -> Target:
    return cortex_m(summary, M4F, script, ("ports/stm32f405",), VC_HARDWARE="feather-stm32f405", **LARGE_BOARD)


# The longest packets are those of files that no host can split: 4096 samples, and room for a codec's delay in whole
# blocks.
LARGE_BOARD: Mapping[str, int] = {
    "VC_CHANNELS": 2,
    "VC_MAX_CHANNELS": 2,
    "VC_BUFFER_SAMPLES": 16384,
    "VC_BUFFER_PACKETS": 128,
    "VC_BUFFER_BYTES": 24576,
    "VC_PACKET_SAMPLES": 4096 + 384,
    "VC_PROFILE_SAMPLES": 4096,
    "VC_CAPTURE_SAMPLES": 2048,
    "VC_MAX_PAYLOAD_BYTES": 2048,
    "VC_RATE_RATIO": 4,
}
"""Sizes for a board with 192 KiB of RAM: two channels, profiles, captures."""

SMALL_BOARD: Mapping[str, int] = {
    "VC_CHANNELS": 1,
    "VC_MAX_CHANNELS": 1,
    "VC_BUFFER_SAMPLES": 1024,
    "VC_BUFFER_PACKETS": 16,
    "VC_BUFFER_BYTES": 4 * 628,
    "VC_PACKET_SAMPLES": 128,
    "VC_PROFILE_SAMPLES": 0,
    "VC_CAPTURE_SAMPLES": 0,
    "VC_MAX_PAYLOAD_BYTES": 640,
    "VC_OUTGOING_BYTES": 2 * 632,
    "VC_RATE_RATIO": 1,
}
"""Sizes for a board with 32 KiB of RAM: one channel, buffered for 0.3 s at 2800 Hz, in packets of at most 128
samples."""
_CODECS = ("MDCT", "DCT", "SLP", "EVA", "PARAMETRIC")


def only(codec: str) -> dict[str, int]:
    """Return the switches that leave one codec of vibrocast/config.h: "MDCT"."""
    return {f"VC_WITH_{name}": int(name == codec) for name in _CODECS}


def for_size(target: Target) -> Target:
    """Return a target that is compiled to be small, with -Os."""
    # There, zig drops the names of functions, except with -g1.
    return replace(target, flags=(*target.flags, "-Os", "-g1"))


def _small(codec: str) -> Target:
    """Return a controller with one codec for small processors, on an emulated board."""
    target = cortex_m(
        f"one channel of {codec.lower()} for small processors, on an MPS2 board (an386)",
        M4F,
        "small.ld",
        ("ports/mps2", "ports/mps2/polled"),
        VC_HARDWARE="mps2-an386",
        **SMALL_BOARD,
        **only(codec),
    )
    return for_size(target)


def _rp2040(summary: str, output: str, channels: int, *drivers: str) -> Target:
    folders = ("ports/rp2040", f"ports/rp2040/{output}", *drivers)
    sizes = {**LARGE_BOARD, "VC_CHANNELS": channels, "VC_MAX_CHANNELS": channels}
    target = cortex_m(summary, M0_PLUS, "board.ld", folders, VC_HARDWARE=f"rp2040-{output}", **sizes)
    return replace(target, finish=rp2040.finish)


TEMPLATE = cortex_m(
    "a port to begin with, whose functions are missing",
    M4F,
    "board.ld",
    ("ports/template",),
    VC_HARDWARE="my-board",
    **LARGE_BOARD,
)
"""Built as `template`; not in TARGETS, because it cannot be linked."""


TARGETS: Mapping[str, Target] = {
    "native": Target(
        "shared library of core and controller, for cffi",
        _LIBRARY_SUFFIX,
        ("-shared", *_POSITION_INDEPENDENT, "-mcpu=native"),
    ),
    "host": Target(
        "program for this machine, behind a pseudo-terminal", "", ("-mcpu=native",), ("ports", "ports/host")
    ),
    "cycle-counter": Target(
        "library that counts the cycles of emulated processors",
        _LIBRARY_SUFFIX,
        ("-shared", *_POSITION_INDEPENDENT),
        ("emulator",),
        (),
    ),
    "wasm": Target("WebAssembly module of the decoders, for browsers", ".wasm", WASM_FLAGS, ("ports/wasm",)),
    **_mps2("cortex-m4", M4F, "an386"),
    **_mps2("cortex-m7", M7, "an500"),
    **_mps2("cortex-m33", M33, "an505", "an505.ld", VC_AN505=1),
    "small-slp": _small("SLP"),
    "small-mdct": _small("MDCT"),
    "stm32f405": _stm32f405("Adafruit Feather STM32F405 Express", "board.ld"),
    "stm32f405-qemu": _stm32f405("the same for QEMU, which lacks a memory", "qemu.ld"),
    "rp2040": _rp2040("board with an RP2040, such as a Raspberry Pi Pico; output by PWM", "pwm", 2),
    "rp2040-drv260x": _rp2040("the same with a haptic driver DRV260x on I2C", "haptic", 1, "ports/drv260x"),
    "rp2040-i2s": _rp2040("the same with an amplifier on I2S, such as a MAX98357", "i2s", 2),
}


def build(
    name: str,
    sizes: Mapping[str, int] | None = None,
    public_key: bytes | None = None,
    verifier: Sequence[Path] = (),
    actuator: Path | None = None,
) -> Path:
    """Build a target of TARGETS, or `template`, unless it is there already, and return its file.

    `sizes`: of vibrocast/sizes.h, in place of the target's. `public_key`: 32 bytes, of Ed25519; model images need its
    signature, None = they need none. `verifier`: C sources with vc_port_verify_signature of vibrocast/port.h, and what
    else that needs; a controller with a key does not start without one. `actuator`: a C source that `vibrocast actuator
    --c` wrote, None = the actuator of the port. A library's declarations for cffi lie next to
    it, with the suffix ".cdef". Builds are kept in firmware/build, or in the user's cache where that cannot be written,
    by a hash of all that they are made from. Raises BuildError and MissingExtraError.
    """
    target = TEMPLATE if name == "template" else TARGETS[name]
    key = {} if public_key is None else {"VC_PUBLIC_KEY": "".join(f"\\x{byte:02x}" for byte in public_key)}
    verifier_paths = tuple(path.resolve() for path in verifier)
    target = replace(
        target,
        defines={**target.defines, **(sizes or {}), **key},
        verifier=verifier_paths,
        actuator=actuator and actuator.resolve(),
    )
    extras.require("firmware", "ziglang")
    folder = _build_folder() / f"{name}-{_fingerprint(target)}"
    built = folder / f"{name}{target.suffix}"
    if not built.exists():
        # Build elsewhere and move the finished files, because others may build the same at the same time.
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f"{name}-") as temporary:
            made = Path(temporary) / "made"
            made.mkdir()
            _compile(target, made / built.name)
            if target.finish is not None:
                target.finish(made / built.name)
            if target.suffix == _LIBRARY_SUFFIX:
                parts = [cffi_declarations(ROOT / folder) for folder in target.shared]
                (made / built.with_suffix(".cdef").name).write_text("\n".join(parts))
            try:
                made.rename(folder)
            except OSError as error:
                if not built.exists():
                    raise BuildError(f"{folder}: cannot be written: {error.strerror}") from error
    return built


def _build_folder() -> Path:
    """Return the folder for builds: next to the sources, or in the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vibrocast"
    for folder in (ROOT / "build", cache):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise BuildError(f"neither {ROOT / 'build'} nor {cache} can be written; set XDG_CACHE_HOME to a folder that can")


def _fingerprint(target: Target) -> str:
    """Return a hash of the sources, the flags, the machine and the compiler."""
    digest = hashlib.sha256(repr((target.command(), sys.platform, platform.machine(), version("ziglang"))).encode())
    if target.finish is not None:
        digest.update(Path(rp2040.__file__).read_bytes())
    if target.actuator is not None:
        digest.update(target.actuator.read_bytes())
    folders = [ROOT / folder for folder in (*target.shared, *target.folders)]
    for folder in folders + [path.parent for path in target.verifier]:
        for path in sorted(folder.iterdir()):
            if path.suffix in (".c", ".h", ".ld"):
                digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def _compile(target: Target, output: Path) -> None:
    command = [sys.executable, "-m", "ziglang", "cc", *target.command(), "-o", str(output)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        if missing := _missing_functions(done.stderr):
            raise BuildError(
                f"the port lacks {', '.join(missing)}; write what is missing as docs/how-to/port_the_firmware.md says"
            )
        if lacking := _overflows(done.stderr):
            raise BuildError(
                f"the image is too large: the linker script's memory {' and '.join(lacking)}; take smaller sizes of "
                "vibrocast/sizes.h such as SMALL_BOARD, switch codecs off (VC_WITH_...), or compile with -Os, as "
                "docs/how-to/port_the_firmware.md says"
            )
        raise BuildError(f"the firmware cannot be compiled:\n{done.stderr}")


def _overflows(errors: str) -> list[str]:
    """Return each memory that is too small for an image, with the bytes that it lacks for the last section in it."""
    found = re.findall(r"section '\S+' will not fit in region '(\w+)': overflowed by (\d+) bytes", errors)
    return [f"{region} lacks {lacking} bytes" for region, lacking in dict(found).items()]


def _missing_functions(errors: str) -> list[str]:
    """Return the functions of a port that the linker lacks: all of port.h, and those that the template marks."""
    undefined = re.findall(r"undefined symbol: (\w+)", errors)
    parts = {name.removeprefix("vc_missing_") for name in undefined if name.startswith(("vc_missing_", "vc_port_"))}
    parts |= {name for name in undefined if name == "main"}
    return sorted(parts) if len(parts) == len(set(undefined)) else []


@dataclass(frozen=True)
class Size:
    """Bytes of an image: `flash` of code and constants, `ram` that it reserves, and the `stack`, a part of it."""

    flash: int
    ram: int
    stack: int


def size(name: str, sizes: Mapping[str, int] | None = None) -> Size:
    """Build an image for a microcontroller, as `build` does, and return its size. Raises as `build`."""
    extras.require("firmware", "elftools")
    from vibrocast.firmware.elf import Elf

    image = Elf(build(name, sizes))
    held = [image.sections[section].size_bytes for section in _IN_RAM if section in image.sections]
    return Size(sum(len(part.data) for part in image.segments), sum(held), image.sections[".stack"].size_bytes)


@click.command()
@click.argument("names", metavar="[TARGET]...", nargs=-1, type=click.Choice([*TARGETS, "template"]))
@click.option("--sizes", "with_sizes", is_flag=True, help="Print the bytes of each image instead.")
@click.option(
    "--json",
    "json_path",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the bytes of each image as JSON.",
)
@click.option(
    "--public-key",
    "key_path",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Let controllers take only model images that this key signed.",
)
@click.option(
    "--verifier",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    multiple=True,
    help="Compile this C source, for --public-key: it verifies signatures. Repeat it for each source.",
)
@click.option(
    "--actuator",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Compile this C source, which `vibrocast actuator --c` wrote, instead of the port's actuator.",
)
def main(
    names: tuple[str, ...],
    with_sizes: bool,
    json_path: Path | None,
    key_path: Path | None,
    verifier: tuple[Path, ...],
    actuator: Path | None,
) -> None:
    """Build targets of the firmware, and print the file of each.

    Without TARGET, all targets are built.
    """
    wanted = names or tuple(TARGETS)
    if key_path is not None and not verifier:
        raise click.UsageError("a controller with a key verifies signatures: give the C sources for that as --verifier")
    try:
        public_key = None if key_path is None else read_public_key(key_path)
        if not with_sizes and json_path is None:
            for name in wanted:
                click.echo(f"{name}: {build(name, public_key=public_key, verifier=verifier, actuator=actuator)}")
            return
        sizes = {name: asdict(size(name)) for name in wanted if TARGETS[name].suffix == ".elf"}
    except (VibrocastError, OSError) as error:
        sys.exit(f"error: {error}")
    click.echo(f"{'image':<24}{'flash':>10}{'RAM':>10}{'of it stack':>13}")
    for name, of in sizes.items():
        click.echo(f"{name:<24}{of['flash']:>10}{of['ram']:>10}{of['stack']:>13}")
    if json_path is not None:
        json_path.write_text(json.dumps(sizes, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
