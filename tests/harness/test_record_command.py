"""`vibrocast record` on a pseudo-terminal and on a sound server: files, meter, early ends and errors."""

import json
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests import command
from tests.command import started, succeeds
from tests.host.test_serial_sensor import line
from tests.sound_server import PAD, SoundServer
from vibrocast import textures
from vibrocast.output.actuator import Codes
from vibrocast.output.sound_card import Playback, find

needs_terminals = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
STEP = 20


run = partial(command.run, "record")


def lines(first: int) -> bytes:
    """Return lines of a tone of 50 Hz at 1 kHz, 9.80665 m/s^2 of amplitude on x alone."""
    numbers = range(first, first + STEP)
    return b"# rate_hz=1000 unit=g axes=xyz\n" * (first % 1000 == 0) + b"".join(
        line(1000 * number, np.array([np.sin(2 * np.pi * 0.05 * number), 0.0, 1.0])) for number in numbers
    )


@contextmanager
def sensor(sent: Callable[[int], bytes]) -> Iterator[str]:
    """Run a fast sensor behind a pseudo-terminal; yield its port."""
    ours, theirs = os.openpty()
    os.set_blocking(ours, False)
    ending = threading.Event()

    def send() -> None:
        import termios
        import tty

        tty.setraw(theirs, termios.TCSANOW)
        first = 0
        while not ending.is_set():
            data = sent(first)
            while data and not ending.is_set():
                try:
                    data = data[os.write(ours, data) :]
                except BlockingIOError:
                    time.sleep(0.002)
            first += STEP
            time.sleep(0.002)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield f"serial:{os.ttyname(theirs)}"
    finally:
        ending.set()
        thread.join()
        os.close(ours)
        os.close(theirs)


@needs_terminals
def test_a_serial_sensor_is_recorded_and_encoded(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    with sensor(lines) as address:
        result = run("--input", address, "--seconds", "2", str(path))
    assert result.exit_code == 0, result.output
    assert "2.000 s at 1000 Hz, 3 channel(s) (x, y, z)" in result.output
    assert "warning" not in result.output
    recording = textures.load(path)
    assert (recording.unit, recording.axes) == ("m/s^2", ("X", "Y", "Z"))
    assert np.abs(recording.samples[1000:, 0]).max() == pytest.approx(9.80665, rel=0.02)
    assert np.abs(recording.samples[1000:, 2]).max() < 0.05  # gravity is gone
    stated = json.loads((tmp_path / "out.json").read_text())
    assert stated["understood"].startswith("text: time in us")
    assert stated["lost"]["gaps"] == 0
    succeeds("encode", path, tmp_path / "out.vct", "--columns", "x")


@needs_terminals
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_ends_a_recording_and_keeps_it(tmp_path: Path, number: signal.Signals) -> None:
    path = tmp_path / "out.wav"
    with sensor(lines) as address:
        process = started("record", "--input", address, path)
        assert process.stderr is not None
        told = [process.stderr.readline()]
        while not told[-1].startswith("recording"):
            told.append(process.stderr.readline())
        process.send_signal(number)
        out, rest = process.communicate(timeout=60)
    killed = number == signal.SIGKILL
    assert process.returncode == (-number if killed else 0), rest
    assert told[0] == f"listening to {address}\n"
    assert re.fullmatch(r"  \d+,-?[\d.]+,0.000000,1.000000\n", told[2])
    assert told[-2] == "understood as text: time in us; x, y, z in g; 1000 Hz\n"
    assert re.match(r"recording \d+ s  x .* m/s\^2", told[-1])
    assert ("channel(s)" in out) != killed
    recording = textures.load(path)
    assert (recording.unit, recording.seconds > 0.5) == ("m/s^2", True)
    stated = json.loads(path.with_suffix(".json").read_text())
    assert (stated["unit"], any("was killed" in each for each in stated["warnings"])) == ("m/s^2", killed)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["out.json", "out.wav"]


def test_wrong_options_are_named(tmp_path: Path) -> None:
    path = str(tmp_path / "out.wav")
    for arguments, error in (
        (["--input", "card"], "give the sensor's --sensitivity in volts"),
        (["--input", "card", "--sensitivity", "10mV/g"], "give --volts-full-scale"),
        (["--input", "card", "--sensitivity", "10mV"], "'10mV' is no sensitivity"),
        (["--input", "card", "--sensitivity", "1/g"], "records volts"),
        (["--input", "card", "--axes", "xx"], "'xx' are no axes"),
        (["--input", "card:1,2", "--sensitivity", "1mV/g", "--volts-full-scale", "1", "--axes", "xyz"], "and 3 axes"),
        (["--input", "serial:PORT", "--volts-full-scale", "1"], "leave out --volts-full-scale"),
        (["--input", "serial:/nowhere"], "cannot open serial port"),
    ):
        result = run(*arguments, path)
        assert result.exit_code in (2, 3)
        assert error in result.output
    (tmp_path / "out.json").write_text("{}")
    assert "is another file than a sidecar" in run("--input", "card", path).output
    assert [each.name for each in tmp_path.iterdir()] == ["out.json"]


def test_a_sound_card_is_recorded_in_the_unit(tmp_path: Path, pulseaudio: SoundServer) -> None:
    path = tmp_path / "out.wav"
    at = 0

    def fill(frames: int) -> Codes:
        nonlocal at
        numbers = np.arange(at, at + frames)
        at += frames
        tone: Codes = np.rint(16384 * np.sin(2 * np.pi * 200 * numbers / 48_000)).astype(np.int16)[:, None]
        return tone

    with Playback(find(PAD), [3], fill) as playback:
        playback.wait_for_begin()
        sensitivity = ["--sensitivity", "100mV/(m/s^2)", "--volts-full-scale", "2"]
        result = run(
            "--input", f"Monitor of {PAD}:3", *sensitivity, "--axes", "z", "--keep-dc", "--seconds", "1.5", str(path)
        )
    assert result.exit_code == 0, result.output
    recording = textures.load_for_actuators(path)
    assert (recording.unit, recording.rate_hz, recording.channels) == ("m/s^2", 48_000, 1)
    # Half of 2 V, at 0.1 V for a m/s^2. A busy machine plays gaps, which leave the peaks as they are.
    assert np.percentile(np.abs(recording.samples), 99) == pytest.approx(10.0, rel=0.03)
    stated = json.loads((tmp_path / "out.json").read_text())
    assert (stated["axes"], stated["volts_full_scale"]) == ("z", 2.0)
