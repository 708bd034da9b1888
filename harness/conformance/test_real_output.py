"""The real output, behind the call of the DAC function: as a port writes it down, or as a sensor feels it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrocast.device_protocol.messages import Start, State, Status, Tap
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import ANSWER_S, NotConforming, Probe, Undecided, same_samples
from vibrocast.harness.conformance.streams import dac_samples, known_actuator, lasting_stream, need_capture
from vibrocast.harness.sensors import AROUND_S, SensorError, TimedRecording
from vibrocast.host.playback import AlignmentError, align, displacement_above_20_hz
from vibrocast.textures import Recording

_OUTPUT_S = 0.03
# With the ways of a port, an actuator, a sensor and its sound card.
_FELT_S = 0.1
_SENSOR_SECONDS = 1.0


def written(path: Path, first: int) -> NDArray[np.int16]:
    """Return the DAC codes of one channel, int16 (samples, 1), in a file from a number on."""
    return np.fromfile(path, np.int16, offset=2 * first).reshape(-1, 1)


@section("Playing: DAC codes")
def test_port_puts_out_what_is_captured(probe: Probe) -> None:
    """The port puts out each DAC code of the capture within 30 ms, and no other."""
    path = probe.link.recorder
    if not isinstance(path, Path):
        pytest.skip("no recorder is a file with the DAC codes of the port")
    need_capture(probe.description)
    stream = lasting_stream(probe, 3)
    first = path.stat().st_size // 2
    number = probe.configure(stream).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    deadline_s = probe.link.clock() + ANSWER_S + 2 * stream.seconds
    while probe.status().state != State.FINISHED and probe.link.clock() < deadline_s:
        captured = dac_samples(probe)
        probe.listen(_OUTPUT_S)
        came = len(written(path, first))
        assert came >= captured, f"expected {captured} DAC codes within {1000 * _OUTPUT_S:g} ms, came {came}"
    begin, codes = probe.captured(Tap.DAC, 1)
    same_samples(written(path, first)[begin:], codes, "DAC codes at the output")


@long
@section("Playing: DAC codes")
def test_sensor_feels_the_dac_codes(probe: Probe, record_property: Callable[[str, object], None]) -> None:
    """A sensor feels the actuator move as the DAC codes say, in their direction and at most 100 ms later."""
    recorder = probe.link.recorder
    if recorder is None or isinstance(recorder, Path):
        pytest.skip("no recorder is a sensor")
    need_capture(probe.description)
    actuator = known_actuator(probe.description.actuator)
    stream = lasting_stream(probe, 2, _SENSOR_SECONDS, make_signal=noise)
    try:
        with recorder(stream.seconds + 2 * AROUND_S) as finish:
            probe.listen(AROUND_S)
            number = probe.configure(stream).stream
            probe.feed(number, stream)
            probe.expect(Start(), Status)
            started_s = probe.link.clock()
            probe.wait_for_state(State.FINISHED, ANSWER_S + 2 * stream.seconds)
            recording = finish()
    except SensorError as error:
        raise Undecided(str(error)) from error
    assert isinstance(recording, TimedRecording), "expected a sensor at an input of this computer, came another"
    first, codes = probe.captured(Tap.DAC, 1)
    rate_hz = actuator.dac_rate_hz
    moved = Recording(actuator.displacement_um(codes), rate_hz, "um", "DAC codes")
    try:
        felt_um = displacement_above_20_hz(recording, rate_hz)
        laid = align(displacement_above_20_hz(moved, rate_hz), felt_um, rate_hz, drifts=True)
    except AlignmentError as error:
        raise NotConforming(f"expected the movement of the DAC codes, came another: {error}") from error
    late_s = recording.began_s + laid.lag_s - started_s - first / rate_hz
    record_property("measured", f"{laid.gain:.2f} of the displacement, {1000 * late_s:.0f} ms late")
    assert laid.gain > 0, "expected the direction of the DAC codes, came the opposite; check how the sensor is mounted"
    assert late_s <= _FELT_S, f"expected a delay of at most {1000 * _FELT_S:g} ms, came {1000 * late_s:.0f} ms"


def noise(rate_hz: int, channels: int, unit: str, peak: float, seconds: float) -> Recording:
    """Return noise of about this peak in the unit, whose delay and direction can be told."""
    samples = np.random.default_rng(6).standard_normal((round(seconds * rate_hz), channels))
    return Recording(peak / 3 * samples, float(rate_hz), unit, "conformance")
