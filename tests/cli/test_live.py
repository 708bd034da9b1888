"""`vibrocast live`: a generated texture, and raw samples from standard input."""

import contextlib
import io
import json
import re
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile

from studies.faulty_bench import Misreading, at_half_gain
from tests import command
from tests.command import answer, run, succeeds
from tests.conftest import session
from tests.harness.test_record_command import lines, needs_terminals, sensor
from tests.sound_server import PAD, SoundServer
from vibrocast import textures
from vibrocast.errors import LIMIT_MISSED
from vibrocast.host import live_playback, sources
from vibrocast.host.controller import Controller as Session
from vibrocast.host.report import Minute
from vibrocast.host.sources import StandardInput
from vibrocast.output.actuator import Codes
from vibrocast.output.sound_card import Playback, find
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink

ROOT = Path(__file__).parents[2]
PATIENT = ("--playout-delay-ms", 300)
"""No busy machine disturbs such a stream."""
live = partial(run, "live")
fails = partial(command.fails, 2, "live")


Put = Callable[[Callable[[], Device]], None]


@pytest.fixture(autouse=True)
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    """Stream to a controller in simulated time, where no packet is late; the function puts another in its place."""

    def put(make: Callable[[], Device]) -> None:
        @contextlib.contextmanager
        def connect(*_: object, **__: object) -> Iterator[Session]:
            yield session(MemoryLink(make()))

        monkeypatch.setattr("vibrocast.host.devices.connect", connect)

    put(Controller)
    return put


def raw(samples: int, channels: int = 1) -> bytes:
    """Return noise as raw samples."""
    return (0.2 * np.random.default_rng(1).standard_normal((samples, channels))).astype("<f4").tobytes()


@pytest.mark.parametrize("model", [(), pytest.param(("--model", "eva-16-4"), marks=pytest.mark.slow)])
def test_a_generated_texture_is_streamed(model: tuple[str, ...]) -> None:
    result = live("rough", "--seconds", 0.3, *PATIENT, *model)
    assert result.exit_code == 0, result.output
    assert re.search(r"^underruns +0, lost packets 0 of \d+$", result.output, re.M)


@pytest.mark.parametrize(
    ("source", "line"),
    [
        (["rough", "--seconds", "0.3"], r"streaming \d+ % 0\.\d of 0\.3 s  \d+\.\d\d kbit/s  underruns \d+"),
        (["-", "--unit", "um"], r"streaming 0\.\d s  \d+\.\d\d kbit/s  underruns \d+"),
    ],
)
def test_progress_has_a_percentage_where_the_end_is_known(
    source: list[str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.progress.LINE_INTERVAL_S", 0.0)
    result = live(*source, *PATIENT, data=bytes(4 * 800))
    assert result.exit_code == 0, result.output
    lines = result.stderr.splitlines()
    assert all(re.fullmatch(line, each) for each in lines if each.startswith("streaming"))
    last = re.search(r" (\d\.\d) ", lines[-1])
    assert last is not None and float(last[1]) == 0.3


def test_raw_samples_are_streamed_to_their_end() -> None:
    data = raw(800, 2) + b"\0"  # half a sample at the end is no sample
    streamed = answer("live", "-", "--channels", 2, "--unit", "um", "--full-scale", 20, *PATIENT, data=data)
    assert (streamed["channels"], streamed["seconds"]) == (2, pytest.approx(800 / 2800, abs=0.02))


def sound_file(kind: str, subtype: str, endian: str = "FILE", channels: int = 1) -> bytes:
    """Return noise as a file of soundfile's names."""
    file = io.BytesIO()
    samples = 0.1 * np.random.default_rng(1).standard_normal((800, channels))
    soundfile.write(file, samples, 2000, format=kind, subtype=subtype, endian=endian)
    return file.getvalue()


def changed(data: bytes, at: bytes, size: bytes) -> bytes:
    """Return a file with another size of a chunk."""
    place = data.index(at) + 4
    return data[:place] + size + data[place + len(size) :]


WAV = sound_file("WAV", "PCM_16")


@pytest.mark.parametrize(
    ("data", "channels"),
    [
        (WAV, 1),
        (sound_file("WAV", "PCM_24", channels=2), 2),
        (sound_file("WAV", "FLOAT"), 1),
        (sound_file("WAV", "PCM_16", "BIG"), 1),
        (sound_file("WAVEX", "PCM_16", channels=3), 3),
        (sound_file("RF64", "PCM_16"), 1),
        (sound_file("WAV", "ULAW"), 1),
        (sound_file("AU", "PCM_16"), 1),
        (sound_file("AU", "FLOAT", "LITTLE", 2), 2),
        (sound_file("CAF", "PCM_16", "LITTLE"), 1),
        (sound_file("CAF", "DOUBLE"), 1),
        (changed(WAV, b"data", bytes(4)), 1),  # of programs that write into a pipe
        (changed(WAV, b"data", b"\xff\xff\xff\xff"), 1),
        (WAV + b"LIST\x04\0\0\0INFO", 1),
    ],
)
def test_a_file_with_a_header_is_streamed_as_it_says(data: bytes, channels: int) -> None:
    streamed = answer("live", "-", "--unit", "um", "--full-scale", 20, *PATIENT, data=data)
    assert (streamed["channels"], streamed["stream_rate_hz"]) == (channels, 2000)
    assert streamed["seconds"] == pytest.approx(0.4, abs=0.02)
    assert streamed["live"]["pauses"] == 0
    assert (streamed["decoded_equals_offline"], streamed["quality"]["snr_db"] is None) == (True, True)


def test_samples_behind_a_header_have_their_values(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, subtype, endian in (("WAV", "PCM_24", "FILE"), ("AU", "PCM_16", "FILE"), ("CAF", "FLOAT", "LITTLE")):
        data = sound_file(kind, subtype, endian, 2)
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
        given = StandardInput(None, None, "mm", 2.0, 2800)
        blocks = []
        while (block := given.read(0.1)) is not None:
            blocks.append(block)
        expected = 2000 * soundfile.read(io.BytesIO(data))[0]
        np.testing.assert_allclose(np.concatenate(blocks), expected, rtol=1e-12)
        assert max(map(len, blocks)) == 20


@pytest.mark.parametrize(
    ("is_file", "unit", "full_scale", "highest"),
    [(True, None, None, 1000.0), (False, "um", None, 1000.0), (False, "um", 20.0, 20.0), (False, "drive", None, 1.0)],
)
def test_floats_of_a_quantity_go_beyond_one_unless_a_full_scale_is_given(
    is_file: bool,
    unit: str | None,
    full_scale: float | None,
    highest: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "noise.wav"
    textures.save(path, textures.Recording(np.full((800, 1), 27.0), 2800.0, "um", "noise"))
    data = path.read_bytes() if is_file else np.full(800, 0.5, "<f4").tobytes()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
    given = StandardInput(None, None, unit, full_scale, 2800)
    assert sources.format_of(given).gains == pytest.approx([highest], rel=0.01)


def test_a_recording_that_states_its_unit_needs_no_option(tmp_path: Path) -> None:
    path = tmp_path / "noise.wav"
    textures.save(path, textures.Recording(np.ones((800, 1)), 2800.0, "um", "noise"))
    assert answer("live", "-", *PATIENT, data=path.read_bytes())["stream_rate_hz"] == 2800
    assert "states its unit, um; leave out --unit" in fails("-", "--unit", "um", data=path.read_bytes())


@needs_terminals
def test_a_serial_sensor_is_streamed_and_the_lines_are_shown() -> None:
    def paced(first: int) -> bytes:
        time.sleep(0.018)
        return lines(first)

    with sensor(paced) as address:
        result = live(address, "--seconds", 1, *PATIENT, "--json")
        assert "states its unit, g; leave out --unit and --full-scale" in fails(address, "--unit", "g")
    assert result.exit_code == 0, result.output
    assert result.stderr.startswith(f"listening to {address}\n  ")
    assert "understood as text: time in us; x, y, z in g; 1000 Hz\n" in result.stderr
    streamed = json.loads(result.stdout)
    assert (streamed["channels"], streamed["stream_rate_hz"], streamed["seconds"]) == (3, 1000, 1.0)
    assert streamed["quality"]["snr_db"] > 10


class Microphone:
    """A sound card with a tone of 200 Hz at -20 dB of full scale; Ctrl-C comes after `ends_s`."""

    def __init__(self, rate_hz: int, channels: int, ends_s: float) -> None:
        self.rate_hz, self.overruns = rate_hz, 0
        self._channels, self._left = channels, round(100 * ends_s)

    def __enter__(self) -> "Microphone":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def wait_for_begin(self) -> None:
        pass

    def read(self, timeout_s: float) -> Any:
        if not timeout_s:
            return np.zeros((0, self._channels), np.float32)
        self._left -= 1
        if self._left < 0:
            raise KeyboardInterrupt
        times_s = np.arange(round(self.rate_hz / 100)) / self.rate_hz
        return np.repeat(0.1 * np.sin(2 * np.pi * 200 * times_s)[:, None], self._channels, 1).astype(np.float32)


@pytest.fixture
def microphone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A card of two channels, which ends after 0.7 s."""
    card = SimpleNamespace(name="Microphone", channels=2)
    monkeypatch.setattr("vibrocast.output.sound_card.find", lambda name, recording: card)
    monkeypatch.setattr(
        "vibrocast.output.sound_card.Capture", lambda card, channels, rate_hz: Microphone(rate_hz, len(channels), 0.7)
    )


@pytest.mark.usefixtures("microphone")
def test_sound_is_streamed_as_a_drive_signal_until_ctrl_c() -> None:
    result = live("audio:Microphone", *PATIENT)
    assert result.exit_code == 0, result.output
    assert "Microphone: sound from 40 to 800 Hz, compressed 4:1, 1 channel(s)\n" in result.stderr
    assert re.search(r"^played +audio:Microphone, 0\.70 s, 1 channel, live$", result.stdout, re.M)


def test_what_a_computer_plays_is_streamed_from_the_monitor_of_its_card(pulseaudio: SoundServer) -> None:
    at = 0

    def fill(frames: int) -> Codes:
        nonlocal at
        numbers = np.arange(at, at + frames)
        at += frames
        tone: Codes = np.rint(3276 * np.sin(2 * np.pi * 200 * numbers / 48_000)).astype(np.int16)[:, None]
        return tone

    with Playback(find(PAD), [1], fill) as playback:
        playback.wait_for_begin()
        streamed = answer("live", f"audio:Monitor of {PAD}", "--seconds", 1, *PATIENT)
    assert (streamed["channels"], streamed["stream_rate_hz"], streamed["seconds"]) == (1, 2800, 1.0)
    assert streamed["quality"]["snr_db"] > 10


@pytest.mark.usefixtures("microphone")
def test_a_sensor_on_a_card_is_streamed_in_its_unit() -> None:
    given = ("audio:Microphone:2", "--unit", "m/s^2", "--full-scale", 80, "--seconds", 0.5, *PATIENT)
    streamed = answer("live", *given)
    assert (streamed["channels"], streamed["seconds"]) == (1, 0.5)
    assert streamed["quality"]["snr_db"] > 10
    assert "needs the physical unit" in fails("audio:Microphone", "--full-scale", 80)
    assert "--channels is for raw samples" in fails("audio:Microphone", "--channels", 1)


def test_low_delay_means_blocks_of_2_ms() -> None:
    given = ("rough", "--seconds", 0.3, "--low-delay")
    assert answer("live", *given, *PATIENT)["packets"] == pytest.approx(0.3 * 8000 / 16, abs=2)


@pytest.mark.parametrize(
    ("arguments", "data", "told"),
    [
        (("-", "--unit", "drive"), b"", "ended before its first sample"),
        (("-", "--unit", "drive"), WAV[:44], "ended before its first sample"),
        (("-", "--unit", "drive"), WAV[:20], "ends in the header"),
        (("-", "--unit", "drive"), b"caff\0\1\0\0free" + b"\xff" * 8, "header on standard input is damaged"),
        (("-", "--unit", "drive"), b"caff\0\1\0\0free" + bytes(3) + b"\x7f" + bytes(4), "ends in the header"),
        (("-", "--unit", "drive"), b".snd" + b"\xff" * 40, "ends in the header"),
        (("-", "--unit", "drive", "--rate-hz", 2800), WAV, "states --rate-hz 2000: --rate-hz is 2800; leave it out"),
        (("-", "--unit", "drive", "--channels", 2), WAV, "states --channels 1"),
        (("-", "--unit", "g"), WAV, "give --full-scale too"),
        (("-", "--unit", "drive"), sound_file("WAV", "MS_ADPCM"), "holds MS_ADPCM; convert it"),
        (("-", "--unit", "drive"), sound_file("AIFF", "PCM_16"), "is an AIFF file; convert it"),
        (("-", "--unit", "drive"), sound_file("FLAC", "PCM_16"), "is a FLAC file"),
        (("-", "--unit", "drive"), (ROOT / "tests/codec/golden_mdct.vct").read_bytes(), "play it with `vibrocast play"),
        (("-", "--unit", "drive"), WAV[44:], "no 32-bit floats: read as such, a sample is"),
        (("-", "--unit", "drive"), bytes(range(256)) * 9, "no 32-bit floats"),
        (("-", "--unit", "drive"), sound_file("WAV", "DOUBLE")[90:], "no 32-bit floats"),
        (("-",), bytes(16), "does not state its unit; give --unit"),
        (("-", "--unit", "m/s^2"), np.full(800, np.nan, "<f4").tobytes(), "NaN"),
        (("nothing",), b"", "no texture nothing; `vibrocast generate --help` lists them"),
        (("rough", "--low-delay", "--rate-bps", 8000), b"", "sends each block at once"),
        (("rough", "--snr-db", 12), b"", "add --rate-bps"),
        (("rough", "--rate-bps", 20), b"", "choose 264 bit/s or more"),
    ],
)
def test_what_cannot_be_streamed_is_rejected(arguments: tuple[object, ...], data: bytes, told: str) -> None:
    assert told in fails(*arguments, data=data)


def test_a_source_that_is_not_live_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # it is too fast for the time of this computer
    assert "the source is not live" in fails("-", "--unit", "g", data=bytes(4 * 2800 * 120))


def test_a_rate_is_streamed_and_reported() -> None:
    figures = answer("live", "rough", "--seconds", 0.6, "--rate-bps", 4000, *PATIENT)
    part = figures["live"]
    assert part["payload_bits_per_second"] < part["wire_bits_per_second"]
    assert part["playout_delay_ms"] == 300
    assert figures["underruns"] == part["dropped_packets"] == 0


def bench_file(folder: Path, address: str, limits: str = "") -> Path:
    """Write a bench file with a controller named "it"."""
    path = folder / "bench.toml"
    path.write_text(f'[[controllers]]\nname = "it"\naddress = "{address}"\n[limits]\n{limits}\n')
    return path


def damaged() -> FaultyWire:
    """Return a controller behind a wire that damages one in ten frames to it."""
    return FaultyWire(Controller(), [Fault(flipped=0.1, direction="to_controller")], seed=1)


@pytest.fixture
def idle_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests that run beside this one make no figure undecided."""
    monkeypatch.setattr("vibrocast.host.controller._queued_s", lambda: 0.0)


@pytest.mark.usefixtures("idle_machine")
def test_lost_packets_and_damaged_frames_fail_and_are_named(put: Put) -> None:
    put(damaged)
    result = live("rough", "--seconds", 2, "--json")
    written = json.loads(result.stdout)
    assert written["lost_packets"] > 0.01 * written["packets"]
    assert written["wire"]["bad_frames"] > 0
    assert result.exit_code == LIMIT_MISSED
    assert "warning: frames were damaged on the wire; check cable" in result.stderr
    assert re.search(r"error: limits missed: live: lost_percent = [\d.]+, max_lost_percent = 1;", result.stderr)


def test_a_bench_file_gives_controller_and_limits(tmp_path: Path, put: Put) -> None:
    bench = bench_file(tmp_path, "sim", "max_lost_percent = 100")
    assert live("rough", "--seconds", 0.5, "--bench", bench).exit_code == 0
    put(damaged)
    bench = bench_file(tmp_path, "sim-usb", "max_lost_percent = 100\nmax_bad_frames = 0")
    result = live("rough", "--seconds", 1, "--bench", bench, "--device", "it")
    assert result.exit_code == LIMIT_MISSED
    assert re.search(r"error: limits missed: live: bad_frames = \d+, max_bad_frames = 0;", result.output)


def test_the_quality_of_the_codec_stands_next_to_that_at_the_skin() -> None:
    told = r"coded +SNR [\d.]+ dB\nactuator .*\n +weighted SNR [\d.]+ dB with the codec"
    assert re.search(told, succeeds("live", "wood", "--seconds", 1.5, *PATIENT))
    report = answer("live", "wood", "--seconds", 1.5, *PATIENT, "--rate-bps", 6000, "--snr-db", 12)
    quality = report["quality"]
    assert quality["skin"]["weighted_snr_db"] > quality["skin"]["snr_db"]


@pytest.mark.usefixtures("idle_machine")
@pytest.mark.parametrize(
    ("limit", "seconds", "told"),
    [
        ("min_snr_db = 40", 1.5, r"live: snr_db = [\d.]+, min_snr_db = 40"),
        ("max_latency_ms = 1", 1.5, "live: latency_ms"),
        ("min_gain = 0", 0.2, "gain is not known, min_gain = 0;"),
    ],
)
def test_figures_are_judged_and_one_that_a_short_stream_does_not_show_misses_its_limit(
    limit: str, seconds: float, told: str, tmp_path: Path
) -> None:
    bench = bench_file(tmp_path, "sim", f"{limit}\nmax_lost_percent = 100")
    result = live("rough", "--seconds", seconds, *PATIENT, "--bench", bench)
    assert result.exit_code == LIMIT_MISSED
    assert re.search(told, result.output)


def test_a_controller_that_plays_something_else_fails(tmp_path: Path, put: Put) -> None:
    put(lambda: Misreading(Controller, at_half_gain))
    bench = bench_file(tmp_path, "sim", "max_gain = 1.1\nmax_lost_percent = 100")
    result = live("rough", "--seconds", 1, *PATIENT, "--bench", bench)
    assert result.exit_code == 1
    assert re.search(r"decoded as sent +yes\nDAC as computed +NO", result.output)
    assert "played something else than was sent" in result.output


@pytest.mark.parametrize(
    ("counts", "cause"),
    [
        ({}, None),
        ({"bad_frames": 3}, None),
        ({"lost_packets": 28, "late_packets": 3, "host_late_ms": 90.0}, "wire"),
        ({"lost_packets": 28, "late_packets": 28}, "host"),
        ({"lost_packets": 1, "late_packets": 1, "bad_frames": 1}, "wire"),
        ({"underruns": 1, "output_gaps": 1, "late_packets": 1}, "device"),
        ({"restarts": 1}, "wire"),
        ({"restarts": 1, "device_restarts": 1, "late_packets": 3}, "device"),
        ({"restarts": 1, "pauses": 1}, "source"),
        ({"restarts": 1, "pauses": 1, "late_packets": 3}, "host"),
        ({"restarts": 1, "pauses": 1, "bad_frames": 1}, "wire"),
        ({"underruns": 1, "pauses": 1, "repeated_frames": 1}, "wire"),
        ({"lost_packets": 1, "late_packets": 1, "reordered_frames": 1}, "wire"),
    ],
)
def test_a_minute_names_what_made_it_lose_something(counts: dict[str, float], cause: str | None) -> None:
    assert live_playback.cause(Minute(0.0, **counts)) == cause  # type: ignore[arg-type]
