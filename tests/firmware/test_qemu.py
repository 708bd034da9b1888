"""Images on QEMU, where it is installed, compiled by zig and by GCC: a short stream played over the serial link."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.simulated_device.bench import stream
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.transports import SerialTransport
from vibrocast.firmware import build as building
from vibrocast.firmware.build import build
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import PlaybackSettings, play

QEMU, GCC = shutil.which("qemu-system-arm"), shutil.which("arm-none-eabi-gcc")
REQUIRED = "VIBROCAST_REQUIRE_EMULATORS"
"""Set in the environment, a missing program fails."""

# The serial line's number, of those that the machine has; instructions of 2^5 ns, so that a run is like any other.
BOARDS = {
    "cortex-m4-interrupt": ("mps2-an386", 0),
    "cortex-m7-interrupt": ("mps2-an500", 0),
    "cortex-m33-interrupt": ("mps2-an505", 0),
    "stm32f405-qemu": ("netduinoplus2", 2),
}
PROCESSORS = {
    "cortex-m0plus": ("mps2-an385",),  # a Cortex-M3, which has all its instructions
    "cortex-m3": ("mps2-an385",),
    "cortex-m4": ("mps2-an386", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
}
"""By GCC's name: the machine that runs it, and its flags."""
GCC_FLAGS = (
    *("-std=c99", "-Wall", "-Wextra", "-Werror", "-mthumb", "-ffunction-sections", "-fdata-sections"),
    *("-nostartfiles", "-nostdlib", "-Wl,--gc-sections", "-Wl,-e,Reset_Handler"),
)


def need(program: str | None, name: str) -> None:
    """Skip a test without a program, or fail where it is required."""
    if program is None:
        assert REQUIRED not in os.environ, f"{name} is not installed"
        pytest.skip(f"{name} is not installed")


def compiled(image: str, out: Path, *flags: str) -> Path:
    """Return an image of firmware.build, compiled by GCC without a C library."""
    need(GCC, "arm-none-eabi-gcc")
    target = building.TARGETS[image]
    script = target.flags[target.flags.index("-T") + 1]
    ours = [each for each in target.command() if each.startswith(("-D", "-I")) or each.endswith(".c")]
    command = [str(GCC), *GCC_FLAGS, *flags, *ours, "-T", script, "-lgcc", "-o", str(out)]
    done = subprocess.run(command, cwd=building.ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


@contextmanager
def machine(image: Path, name: str, line: int = 0) -> Iterator[str]:
    """Run an image; yield the serial port."""
    need(QEMU, "qemu-system-arm")
    serial = [*["-serial", "null"] * line, "-serial", "pty"]
    command = [str(QEMU), "-M", name, "-kernel", str(image), "-display", "none", "-monitor", "none", *serial]
    with subprocess.Popen([*command, "-icount", "shift=5"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split(" ")[4]  # "char device redirected to /dev/pts/4 (label serial0)"
        finally:
            process.terminate()


def check_that_it_plays(image: Path, name: str, line: int = 0) -> None:
    """Play a stream on an image; its samples are those computed here."""
    played = stream(0.2)
    with machine(image, name, line) as port, SerialTransport(port) as transport:
        host = Host(transport)
        result = play(host, played, PlaybackSettings(capture=True))
    assert (result.state, result.underruns) == (State.FINISHED, 0)
    np.testing.assert_array_equal(result.decoded, played.decoded)


@pytest.mark.parametrize("image", BOARDS)
def test_stream_is_played_as_decoded_offline(image: str) -> None:
    check_that_it_plays(build(image), *BOARDS[image])


@pytest.mark.parametrize("optimisation", ["-Os", "-O2"])
@pytest.mark.parametrize("processor", PROCESSORS)
def test_an_image_by_gcc_plays(tmp_path: Path, processor: str, optimisation: str) -> None:
    name, *flags = PROCESSORS[processor]
    check_that_it_plays(
        compiled("cortex-m4-interrupt", tmp_path / "image.elf", f"-mcpu={processor}", *flags, optimisation), name
    )


@pytest.mark.parametrize("optimisation", ["-Os", "-O2"])
def test_what_runs_while_flash_is_written_stays_in_ram(tmp_path: Path, optimisation: str) -> None:
    """By GCC on the board that executes from flash: code in RAM calls none in flash."""
    _, *flags = PROCESSORS["cortex-m4"]
    image = compiled("stm32f405", tmp_path / "image.elf", "-mcpu=cortex-m4", *flags, optimisation)
    tool = str(GCC).replace("gcc", "objdump")
    listing = subprocess.run([tool, "-d", str(image)], capture_output=True, text=True, check=True).stdout
    calls = re.findall(
        r"^ *(2[0-9a-f]{7}):.*\t(?:b|bl|b\w\w|b\.n|b\.w|cbn?z)\t.*?([0-9a-f]+) <(\S+)>$", listing, re.MULTILINE
    )
    assert calls, "there is code in RAM"
    assert {name for _, target, name in calls if not target.startswith("2") or "veneer" in name} == set()
