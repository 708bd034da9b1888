"""Serial sensors: lines of text, lost samples, and devices that send something else."""

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.host import serial_sensor
from vibrocast.host.serial_sensor import (
    MAX_LINE_BYTES,
    Clock,
    Description,
    Lines,
    SerialSensor,
    TimedSamples,
)
from vibrocast.textures import TextureError
from vibrocast.textures.recording import Signal
from vibrocast.textures.sensitivity import parse

RATE_HZ = 1000
G = 9.80665
HEADER = b"# rate_hz=1000 unit=g axes=xyz\n"
TRUE_TIMES = partial(Clock, [1000.0 * step for step in range(32)], 1.0, "PORT", None)


class Port(Closing):
    """Bytes that come in pieces, then nothing, and at last a broken cable. `now_s`: the time that passes meanwhile."""

    def __init__(self, data: bytes, size: int = 1000, silence: int = 0, byte_s: float = 1 / 40_000) -> None:
        self.pieces = [data[start : start + size] for start in range(0, len(data), size)] + [b""] * silence
        self.now_s, self._byte_s = 0.0, byte_s

    def write(self, data: bytes) -> None:
        raise AssertionError("a sensor is not written to")

    def read(self, timeout_s: float) -> bytes:
        if not self.pieces:
            raise TransportError("serial port broke off")
        piece = self.pieces.pop(0)
        self.now_s += len(piece) * self._byte_s if piece else timeout_s
        return piece

    def reopen(self) -> None:
        raise AssertionError("a sensor is not opened again")

    def close(self) -> None:
        self.closed = True


def opened(data: bytes, size: int = 1000, line_s: float = 1e-3, silence: int = 0, **options: Any) -> SerialSensor:
    """Open a sensor that sends a line in so many seconds."""
    port = Port(data, size, silence, line_s * data.count(b"\n") / max(1, len(data)) or 1e-4)
    return SerialSensor("PORT", open_port=lambda name, baud: port, clock=lambda: port.now_s, **options)


def heard(sensor: SerialSensor, ends_as: str = "broke off") -> Signal:
    """Return all samples until the cable breaks, or what else ends the recording."""
    pieces = []
    with pytest.raises(TransportError, match=ends_as):
        while True:
            pieces.append(sensor.read(0.1))
    return np.concatenate(pieces)


def line(time_us: int, values: Signal) -> bytes:
    return (f"{time_us}," + ",".join(f"{value:.6f}" for value in values) + "\n").encode()


def signal(times_s: Signal) -> Signal:
    """Three axes of some g: slow against the rate, so that a cubic polynomial is near."""
    phases = np.outer(times_s, 2 * np.pi * np.array([20.0, 31.0, 43.0]))
    return np.asarray(np.sin(phases) + np.array([0.0, 0.0, 1.0]))


def text(times_us: list[int], header: bytes = HEADER) -> bytes:
    return header + b"".join(
        line(time_us, values) for time_us, values in zip(times_us, signal(np.array(times_us) / 1e6), strict=True)
    )


def test_lines_become_samples_in_the_unit() -> None:
    times_us = list(range(5_000_000, 9_000_000, 1000))
    sensor = opened(b"rubbish of a start\n" + text(times_us))
    assert (sensor.rate_hz, sensor.unit, sensor.axes, sensor.channels) == (1000, "m/s^2", "xyz", 3)
    samples = heard(sensor)
    expected = G * signal(np.array(times_us) / 1e6)
    at = len(expected) - len(samples)  # the lines by which the format was known
    assert 0 < at < 1000
    first = int(np.argmin([np.abs(expected[start : start + 500] - samples[:500]).max() for start in range(at)]))
    assert samples == pytest.approx(expected[first : first + len(samples)], abs=1e-4)
    assert sensor.losses.gaps == 0
    assert sensor.warnings() == []


def test_times_with_jitter_become_a_uniform_grid() -> None:
    jitter_us = np.random.default_rng(1).integers(-150, 151, 4000)
    times_us = (1000 * np.arange(4000) + jitter_us + 1000).tolist()
    timed = TimedSamples(Lines(), RATE_HZ, TRUE_TIMES())
    timed._samples = np.zeros((0, 3))
    samples = timed.place(list(zip(times_us, map(tuple, signal(np.array(times_us) / 1e6).tolist()), strict=True)))
    grid_s = times_us[0] / 1e6 + np.arange(len(samples)) / RATE_HZ
    assert len(samples) > 3990
    error = samples - signal(grid_s)
    assert np.sqrt(np.mean(np.square(error))) < 1e-3  # taken as uniform, the samples would be off by 0.03
    assert timed.losses.gaps == 0
    assert 50 < timed.jitter_us < 200
    assert timed.worst_jitter_us <= 300


def test_lost_lines_are_counted_and_interpolated_after_the_clock_of_a_board_overflowed() -> None:
    kept = [number for number in range(3000) if number not in range(2000, 2020)]
    first_us = 2**32 - 1_500_000
    lines = b"".join(line((first_us + 1000 * number) % 2**32, np.full(3, float(number))) for number in kept)
    sensor = opened(HEADER + lines)
    assert np.diff(heard(sensor)[:, 0]) == pytest.approx(G, rel=1e-6)
    assert (sensor.losses.gaps, sensor.losses.samples) == (1, 20)


def test_a_rate_that_is_not_stated_comes_from_the_times() -> None:
    times_us = [round(number * 1e6 / 833.3) for number in range(2000)]
    sensor = opened(text(times_us, b"# unit=m/s^2\n"))
    assert sensor.rate_hz == 833
    assert sensor.axes == "xyz"
    assert 0 < float(str(sensor.facts()["worst_jitter_us"])) < 1.1  # whole us


@pytest.mark.parametrize(
    ("data", "options", "error"),
    [
        (text(list(range(0, 2_000_000, 500))), {}, "its times say 2000.0 Hz"),
        (text(list(range(0, 2_000_000, 1000))), {"sensitivity": parse("1/g")}, "states its unit, g; leave out"),
        (text(list(range(0, 2_000_000, 1000)), b"# rate_hz=1000\n"), {}, "does not state its unit; give `sensitivity`"),
        (text(list(range(0, 2_000_000, 1000)), b""), {"sensitivity": parse("1mV/g")}, "sends numbers, not volts"),
        (text(list(range(0, 2_000_000, 1000))), {"rate_hz": 500}, "states 1000 Hz; leave out `rate_hz`=500"),
        (text(list(range(0, 2_000_000, 1000)), b"# unit=g axes=xy\n"), {}, "sends 3 channels, and 2 axes"),
        (text(list(range(0, 2_000_000, 1000)), b"# unit=g rate_hz=nan\n"), {}, "rate_hz=nan, which cannot be"),
        (text(list(range(0, 2_000_000, 1000)), HEADER + b"# unit=um\n"), {}, "states unit=g, and then unit=um"),
        (text([5] * 30_000), {}, "its times do not rise"),
        (b"x" * 100_000, {}, "sends no lines of samples; check the @BAUD"),
        (bytes(range(256)) * 400, {}, "sends no lines of samples; check the @BAUD"),
        (b"nan,nan,nan\n1,inf,nan,3\n" * 5000, {}, "lines that hold no samples: '1,inf,nan,3'"),
        (b"1,,3\n" * 20_000, {}, "lines that hold no samples"),
        (b"sensor not found\n" * 20_000, {}, "lines that hold no samples: 'sensor not found'"),
        (b"1 2 3 4 5 6\n" * 3000, {}, "no axis is known: '1 2 3 4 5 6'"),
        (b"volume: 1 tone: 2\n" * 3000, {}, "no axis is known"),
        (b"ax:1 ay:2\nx:1 y:2\n" * 3000, {}, "several kinds of lines: 'x:1 y:2', 'ax:1 ay:2', 'x:1 y:2'; let it"),
        (b"# unit=g\n" + b"1.5 2.5\n" * 3000, {}, "sends no time: '# unit=g', '1.5 2.5'"),
    ],
)
def test_a_wrong_sensor_is_rejected(
    data: bytes, options: dict[str, Any], error: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_sensor, "_STATED_WITHIN_S", 0.0)
    with pytest.raises((TransportError, TextureError), match=error):
        opened(data, **options)


def test_a_sensor_that_is_silent_or_slow_is_rejected() -> None:
    for data, error in (
        (b"", "sends nothing"),
        (b"# unit=g\n" + b"1 2 3\n" * 100, r"only 1\.\d lines a second.*: '# unit=g', '1 2 3'"),
    ):
        with pytest.raises(TransportError, match=error):
            opened(data, size=6, line_s=0.6, silence=1000)


def test_a_sensor_that_begins_to_send_rubbish_ends_the_recording() -> None:
    rubbish = b"1,2,what,4\n" * 1000
    heard(opened(text(list(range(0, 2_000_000, 1000))) + rubbish), "lines in a row that hold no sample")


def test_a_lost_port_is_opened_again_for_a_live_stream(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    sent = text(list(range(1000, 2_000_000, 1000)))
    port = Port(sent, size=500)
    reopened = 0

    def reopen() -> None:
        nonlocal reopened
        reopened += 1
        port.now_s += 0.3
        if reopened < 3:
            raise TransportError("cannot open")
        port.pieces = [sent[start : start + 500] for start in range(7, len(sent), 500)] if reopened == 3 else []

    port.reopen = reopen  # type: ignore[method-assign]
    sensor = SerialSensor("PORT", open_port=lambda name, baud: port, clock=lambda: port.now_s, reconnect_s=2.0)
    samples = []
    while reopened < 3:
        samples.append(sensor.read(0.01))
        port.now_s += 0.01
    before = sum(map(len, samples))
    while port.pieces:
        samples.append(sensor.read(0.01))
    assert sum(map(len, samples)) - before > 0.8 * before
    assert sensor.losses.gaps == 0
    told = [record.getMessage() for record in caplog.records]
    assert told[0].startswith("serial:PORT was lost after ")
    assert told[0].endswith(" s; trying to open it again for 2 s")
    assert told[1] == "serial:PORT is back"
    reopened = -100  # it stays away
    with pytest.raises(TransportError, match=r"serial:PORT was lost after .* s: cannot open"):
        while True:
            sensor.read(0.01)
            port.now_s += 0.1


def test_some_axes_may_be_chosen_and_are_put_in_order() -> None:
    times_us = list(range(0, 2_000_000, 1000))
    values = b"".join(line(time_us, np.array([3.0, 2.0, 1.0])) for time_us in times_us)
    header = b"# rate_hz=1000 unit=m/s^2 axes=zyx\n"
    assert heard(opened(header + values))[100] == pytest.approx([1.0, 2.0, 3.0])
    assert heard(opened(header + values, axes="z"))[100] == pytest.approx([3.0])


def arduino(form: str, header: str = "# unit=g axes=xyz\n", burst: int = 1) -> bytes:
    """Return 4 s of lines of a form at 800 Hz, read in bursts of so many samples, 60 us apart."""
    times_us = np.asarray(1_000_000 + 1250.0 * np.arange(3200), np.float64)
    read_us = times_us[np.arange(3200) // burst * burst] + np.arange(3200) % burst * 60 * (burst > 1)
    facts = {"us": read_us, "ms": read_us // 1000, "s": read_us / 1e6, "ns": read_us * 1000, "count": np.arange(3200)}
    x, y, z = signal(times_us / 1e6).T
    rows = [
        form.format(x=x[at], y=y[at], z=z[at], **{key: each[at] for key, each in facts.items()}) for at in range(3200)
    ]
    return (header + "\r\n".join(rows) + "\r\n").encode()


@pytest.mark.parametrize(
    ("form", "options", "understood"),
    [
        # millis()
        ("{ms:.0f},{x:.4f},{y:.4f},{z:.4f}", {}, "time in ms of few digits, taken as evenly spaced; x, y, z in g"),
        ("{ms:.0f} {x:.4f} {y:.4f} {z:.4f}", {"rate_hz": 800}, "time in ms"),
        ("t={ms:.0f} ms, x={x:.4f}, y={y:.4f}, z={z:.4f}", {}, "time in ms"),
        ("{s:.3f}, {x:.4f}, {y:.4f}, {z:.4f}", {}, "time in s of few digits"),
        # separators
        ("{us:.0f}\t{x:.4f}\t{y:.4f}\t{z:.4f}", {}, "time in us; x, y, z in g"),
        ("{us:.0f}; {x:.4f}; {y:.4f}; {z:.4f};", {}, "time in us"),
        ("{s:.6f}  {x:.4f}  {y:.4f}  {z:.4f}", {}, "time in s;"),
        ("{ns:.0f} | {x:.4f} | {y:.4f} | {z:.4f}", {}, "time in ns;"),
        ("[{us:.0f}, {x:.4f}, {y:.4f}, {z:.4f}]", {}, "time in us"),
        # labels
        ("x:{x:.4f},y:{y:.4f},z:{z:.4f}", {"rate_hz": 800}, "no time, taken as evenly spaced; x, y, z in g"),
        ("X: {x:.4f}  Y: {y:.4f}  Z: {z:.4f}  g ", {"rate_hz": 800}, "no time"),
        ("temp:20.5\taz:{z:.4f}\tay:{y:.4f}\tax:{x:.4f}\tgx:{y:.4f}\tmillis:{ms:.0f}", {}, "left out: temp, gx"),
        ('{{"time_us":{us:.0f},"x":{x:.4f},"y":{y:.4f},"z":{z:.4f}}}', {}, "time in us"),
        (
            "Acceleration X: {x:.4f}, Y: {y:.4f}, Z: {z:.4f} g\nRotation X: {z:.4f}, Y: 1, Z: 2 rad/s\nLux: 7",
            {"rate_hz": 800},
            "no time",
        ),
        # no time
        ("{x:.4f},{y:.4f},{z:.4f}", {"rate_hz": 800}, "no time"),
        ("({x:.4f}, {y:.4f}, {z:.4f})", {"rate_hz": 800}, "no time"),
        ("{count},{x:.4f},{y:.4f},{z:.4f}", {"rate_hz": 800}, "no time"),
    ],
)
def test_usual_output_of_boards_is_read(form: str, options: dict[str, Any], understood: str) -> None:
    data = arduino(form)
    sensor = opened(data, line_s=4 / data.count(b"\n"), **options)
    assert (sensor.rate_hz, sensor.unit, sensor.axes) == (800, "m/s^2", "xyz")
    assert understood in sensor.understood
    assert "# unit=g axes=xyz" in sensor.introduction()[0]
    samples = heard(sensor)
    assert len(samples) > 3000
    assert sensor.losses.gaps == 0
    assert_is_the_signal(samples)


@pytest.mark.parametrize("separator", [";", "; ", "\t"])
def test_decimal_commas_and_numbers_that_are_none(separator: str) -> None:
    data = arduino(separator.join(("{us:.0f}", "{x:.4f}", "{y:.4f}", "{z:.4f}"))).replace(b".", b",")
    lines = data.splitlines(keepends=True)
    lines[2000:2000] = [separator.join(("7", "nan", "0,1", "0,2")).encode() + b"\r\n"]
    sensor = opened(b"".join(lines), line_s=1 / 800)
    assert sensor.axes == "xyz"
    assert_is_the_signal(heard(sensor))
    assert sensor.warnings() == ["1 line(s) without a sample"]


@pytest.mark.parametrize("burst", [5, 25, 32])
@pytest.mark.parametrize("form", ["{us:.0f},{x:.4f},{y:.4f},{z:.4f}", "{ms:.0f} {x:.4f} {y:.4f} {z:.4f}"])
def test_a_memory_of_samples_that_is_read_at_once_has_the_rate_of_its_samples(burst: int, form: str) -> None:
    sensor = opened(arduino(form, burst=burst), line_s=1 / 800)
    assert (sensor.rate_hz, sensor.axes) == (800, "xyz")
    assert "taken as evenly spaced" in sensor.understood
    samples = heard(sensor)
    assert sensor.losses.gaps == 0
    assert_is_the_signal(samples)


def test_samples_that_are_lost_between_times_in_ms_are_counted() -> None:
    lines = arduino("{ms:.0f},{x:.4f},{y:.4f},{z:.4f}").splitlines(keepends=True)
    sensor = opened(b"".join(lines[:2000] + lines[2040:]), line_s=1 / 800)
    heard(sensor)
    assert sensor.losses.gaps == 1
    assert sensor.losses.samples == pytest.approx(40, abs=1)


def test_a_header_that_a_board_prints_names_the_columns() -> None:
    sensor = opened(
        arduino("{ms:.0f},20.5,{x:.4f},{y:.4f},{z:.4f}", "boot\nmillis,temp,ax,ay,az\n# unit=g\n"), line_s=1 / 800
    )
    assert "time in ms" in sensor.understood
    assert sensor.understood.endswith("x, y, z in g; 800 Hz; left out: temp")


def test_a_unit_behind_the_numbers_is_taken_and_a_missing_rate_is_asked_for() -> None:
    form = "X: {x:.2f}  Y: {y:.2f}  Z: {z:.2f}  m/s^2 "
    assert opened(arduino(form, ""), line_s=1 / 800, rate_hz=800).description.unit == "m/s^2"
    with pytest.raises(TextureError, match=r"give `rate_hz`; about 8\d\d lines came in a second"):
        opened(arduino(form, ""), line_s=1 / 800)
    with pytest.raises(TransportError, match=r"gives its rate as 1600 Hz, and its lines say 8\d\d"):
        opened(arduino(form, ""), line_s=1 / 800, rate_hz=1600)


def assert_is_the_signal(samples: Signal) -> None:
    """Assert that samples at 800 Hz are those of `signal`, in m/s^2, up to where they begin."""
    times_s = np.arange(len(samples) - 400) / 800
    tones = np.concatenate([f(2 * np.pi * np.outer(times_s, [20.0, 31.0, 43.0])) for f in (np.sin, np.cos)], axis=1)
    design = np.column_stack([tones, np.ones(len(tones))])
    recorded = samples[400:] / G
    fitted = design @ np.linalg.lstsq(design, recorded, rcond=None)[0]
    assert np.sqrt(np.mean(np.square(recorded - fitted))) < 0.02
    assert np.abs(fitted[:, 0]).max() == pytest.approx(1.0, abs=0.03)


@given(st.lists(st.one_of(st.binary(max_size=400), st.sampled_from([b"\n", HEADER, b"1,2,3,4\n", b"9,1e5\n"]))))
def test_lines_survive_anything(pieces: list[bytes]) -> None:
    lines = Lines()
    whole = Lines()
    try:
        found = [sample for piece in pieces for sample in lines.feed(piece)]
        assert found == whole.feed(b"".join(pieces))
    except TransportError:
        return
    assert len(lines._pending) <= MAX_LINE_BYTES + 1
    for _, values in found:
        assert 1 <= len(values) <= 3
        assert np.isfinite(values).all()


@given(st.binary(max_size=200))
def test_a_description_is_known_or_rejected(data: bytes) -> None:
    try:
        stated = Description().with_facts(data.decode("ascii", "replace"))
    except TransportError:
        return
    assert stated.rate_hz is None or stated.rate_hz >= 1


@given(st.lists(st.integers(1, 60_000), min_size=8, max_size=60), st.integers(1, 9))
def test_timed_samples_do_not_depend_on_the_pieces(steps_us: list[int], size: int) -> None:
    times_us = np.cumsum(steps_us).tolist()
    samples: list[tuple[float, tuple[float, ...]]] = [
        (time_us, (float(index % 7),)) for index, time_us in enumerate(times_us)
    ]

    def placed(parts: list[int]) -> Signal:
        timed = TimedSamples(Lines(), RATE_HZ, TRUE_TIMES())
        timed._samples = np.zeros((0, 1))
        return np.concatenate([timed.place(samples[start:stop]) for start, stop in pairwise(parts)])

    whole = placed([0, len(samples)])
    pieces = placed([*range(0, len(samples), size), len(samples)])
    assert len(whole) == 1 + (times_us[-2] - times_us[0]) * RATE_HZ // 1_000_000
    assert pieces == pytest.approx(whole, abs=1e-6)
