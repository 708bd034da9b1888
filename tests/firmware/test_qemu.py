"""The interrupt-driven images on QEMU, where it is installed: a short stream played over the serial link."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from tests.simulated_device.bench import stream
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.transports import SerialTransport
from vibrocast.firmware.build import build
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import PlaybackSettings, play

QEMU = shutil.which("qemu-system-arm")
pytestmark = pytest.mark.skipif(QEMU is None, reason="qemu-system-arm is not installed")

# The serial line's number, of those that the machine has; instructions of 2^5 ns, so that a run is like any other.
BOARDS = {
    "cortex-m4-interrupt": ("mps2-an386", 0),
    "cortex-m7-interrupt": ("mps2-an500", 0),
    "cortex-m33-interrupt": ("mps2-an505", 0),
    "stm32f405-qemu": ("netduinoplus2", 2),
}


@contextmanager
def machine(image: str) -> Iterator[str]:
    """Run an image; yield the serial port."""
    name, line = BOARDS[image]
    serial = [*["-serial", "null"] * line, "-serial", "pty"]
    command = [str(QEMU), "-M", name, "-kernel", str(build(image)), "-display", "none", "-monitor", "none", *serial]
    with subprocess.Popen([*command, "-icount", "shift=5"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split(" ")[4]  # "char device redirected to /dev/pts/4 (label serial0)"
        finally:
            process.terminate()


@pytest.mark.parametrize("image", BOARDS)
def test_stream_is_played_as_decoded_offline(image: str) -> None:
    played = stream(0.2)
    with machine(image) as port, SerialTransport(port) as transport:
        host = Host(transport)
        result = play(host, played, PlaybackSettings(capture=True))
    assert (result.state, result.underruns) == (State.FINISHED, 0)
    np.testing.assert_array_equal(result.decoded, played.decoded)
