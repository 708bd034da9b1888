"""examples/host.py reads back from a simulated controller the samples that `vibrocast decode` gives."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import vibrocast
from vibrocast.codec import Setting
from vibrocast.codec.stream import Stream
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.serial_port import has_pseudo_terminals, serial_port

HOST = Path(__file__).parents[2] / "examples/host.py"
RATE_HZ = 8000
SETTINGS: dict[str, Setting] = {"mdct": {"step": 0.5}, "slp": {"quality": 8}}
pytestmark = pytest.mark.skipif(not has_pseudo_terminals(), reason="the port is a pseudo-terminal")


def coded(codec: str) -> Stream:
    """Return 0.7 s of two channels, in several packets."""
    samples = np.random.default_rng(1).normal(0, 0.2, (7 * RATE_HZ // 10, 2))
    stream = vibrocast.encode(samples, RATE_HZ, "um", codec=codec, setting=SETTINGS[codec], stream_rate_hz=RATE_HZ)
    return stream.repacked(320) if codec == "mdct" else stream


@pytest.mark.parametrize(("codec", "lost"), [("mdct", 0.0), ("slp", 0.0), ("mdct", 0.1)])
def test_the_example_reads_back_the_decoded_signal(codec: str, lost: float, tmp_path: Path) -> None:
    stream = coded(codec)
    assert len(stream.packets) > 1
    stream.save(tmp_path / "texture.vct")
    wire = FaultyWire(Controller(), [Fault(lost=lost, direction="to_controller")], seed=4)
    with serial_port(wire) as port:
        arguments = [port.name, str(tmp_path / "texture.vct"), str(tmp_path / "decoded.raw")]
        played = subprocess.run([sys.executable, str(HOST), *arguments], capture_output=True, text=True, timeout=60)
    assert (played.returncode, played.stderr) == (0, "")
    samples = np.fromfile(tmp_path / "decoded.raw", "<i2").reshape(-1, 2)
    decoded = vibrocast.decode(tmp_path / "texture.vct").samples
    assert np.array_equal(samples * (np.array(stream.header.gains) / 32768), decoded)


def test_an_error_of_the_controller_is_shown(tmp_path: Path) -> None:
    stream = vibrocast.encode(np.ones((4000, 1)), RATE_HZ, "um", codec="eva", stream_rate_hz=RATE_HZ, highpass_hz=None)
    stream.save(tmp_path / "texture.vct")
    with serial_port(Controller()) as port:
        arguments = [port.name, str(tmp_path / "texture.vct"), str(tmp_path / "decoded.raw")]
        failed = subprocess.run([sys.executable, str(HOST), *arguments], capture_output=True, text=True, timeout=60)
    assert failed.returncode == 1
    assert failed.stderr.startswith("error 8: the stream needs model image ")
