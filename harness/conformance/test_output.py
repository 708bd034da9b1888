"""The output as its DAC codes tell: Stop and the watchdog, fades and gains, the power limit over several streams."""

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import Gain, Pause, Resume, Start, State, Status, Tap
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import ANSWER_S, Probe, describe, in_state, same_samples
from vibrocast.harness.conformance.streams import (
    constant,
    dac_samples,
    decoded,
    known_actuator,
    lasting_stream,
    loud,
    need_capture,
    play_on,
    stream_for,
)
from vibrocast.output.rendering import FADE_SECONDS, Dac, Drive, recording_end

# docs/reference/protocol.md, "Stop"
_STOP_S = 0.03
_FADE_IN_S = 0.2
_STEADY_S = 0.5
_MIN_LEVEL = 8
# Of a level that a codec keeps constant.
_RIPPLE = 0.1
_GAIN = 0.25
_PAUSES = 3
_RESTARTS = 12
_BURST_S = 0.1
_POWER_RIPPLE = 0.03


@pytest.fixture
def steady(probe: Probe) -> Stream:
    """A stream, set up and started, of one value: each change of its DAC codes is the controller's. It has faded in."""
    need_capture(probe.description)
    stream = lasting_stream(probe, 4, 1.0, "full scale", constant)
    if stream.seconds < _STEADY_S:
        pytest.skip("what the buffer holds has been played before something can happen to it")
    number = probe.configure(stream, compensation=False).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    probe.wait_for(lambda status: status.position > _FADE_IN_S * stream.header.rate_hz, "to play", ANSWER_S)
    return stream


def since(probe: Probe, begin: int) -> NDArray[np.int64]:
    """Return the DAC codes of the first channel from a sample on, of a stream that is at rest."""
    first, codes = probe.captured(Tap.DAC, 1)
    if begin < first:
        pytest.skip("the controller does not keep as many DAC codes")
    return np.abs(codes[begin - first :, 0].astype(np.int64))


@section("Playing: Stop")
def test_stop_reaches_the_output_at_once(probe: Probe, steady: Stream) -> None:
    """The output is on its way to rest within 30 ms after Stop, counted in DAC codes."""
    asked_s, asked_at = probe.link.clock(), dac_samples(probe)
    probe.stop()
    answered_s = probe.link.clock()
    probe.listen(0.1)
    codes = since(probe, asked_at - 1)
    level = codes[0]
    if level < _MIN_LEVEL:
        pytest.skip("a constant drive gives no DAC codes that could stop")
    falling = np.flatnonzero(codes < (1 - 2 * _RIPPLE) * level)
    played_on = (falling[0] if falling.size else len(codes)) / probe.description.actuator.dac_rate_hz
    late_s = played_on - (answered_s - asked_s)
    assert late_s <= _STOP_S, (
        f"expected a way to rest within {1000 * _STOP_S:g} ms, came one {1000 * late_s:.0f} ms late"
    )
    assert codes[-1] == 0, f"expected an output at rest, the last DAC code is {codes[-1]}"


@section("Playing: Pause, Resume, Loop and Gain")
def test_pause_brings_the_output_to_rest(probe: Probe, steady: Stream) -> None:
    """The controller brings the output to rest at Pause."""
    in_state(probe.expect(Pause(), Status), State.PAUSED, "Pause")
    probe.listen(0.1)
    last = since(probe, dac_samples(probe) - 1)[0]
    assert last == 0, f"expected an output at rest, the last DAC code is {last}"


@section("Playing: Pause, Resume, Loop and Gain")
def test_output_goes_on_where_it_paused(probe: Probe) -> None:
    """The controller gives exactly the expected DAC codes over three pauses: each fades, and no sample is lost."""
    need_capture(probe.description)
    actuator = known_actuator(probe.description.actuator)
    stream = lasting_stream(probe, 10, 1.0)
    number = probe.configure(stream).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    probe.wait_for(lambda status: status.position > _FADE_IN_S * stream.header.rate_hz, "to play", ANSWER_S)
    rests = []
    for _ in range(_PAUSES):
        in_state(probe.expect(Pause(), Status), State.PAUSED, "Pause")
        probe.listen(0.05)
        rests.append(dac_samples(probe))
        in_state(probe.expect(Resume(), Status), State.PLAYING, "Resume")
        probe.listen(0.05)
    probe.wait_for_state(State.FINISHED, ANSWER_S + 2 * stream.seconds)
    first, came = probe.captured(Tap.DAC, 1)
    delay_samples = stream.delay_samples
    drive = Drive(stream.header, actuator, compensation=True, decoder_delay_samples=delay_samples)
    played = drive.push(decoded(stream)[: recording_end(stream.header, delay_samples)])
    samples = np.concatenate([played, drive.finish()])

    def with_fades(fades: Sequence[int]) -> NDArray[np.int16]:
        """Return the DAC codes where the fades before the rests have so many samples."""
        dac = Dac(stream.header, actuator, 1.0, True, drive.drive_samples(delay_samples))
        pieces, begin = [], 0
        for end in (*(np.array(rests) - np.cumsum(fades)), len(samples)):
            pieces += [dac.play(samples[begin:end]), dac.ramp_down()]
            begin = end
        return np.concatenate(pieces)[first:]

    # The capture does not tell which sample was the last before a fade.
    fade_samples = round(FADE_SECONDS * actuator.dac_rate_hz)
    near = fade_samples, fade_samples - 1, fade_samples + 1
    if not any(np.array_equal(came, with_fades(fades)) for fades in product(near, repeat=_PAUSES)):
        same_samples(came, with_fades([fade_samples] * _PAUSES), "DAC codes of a stream that paused")


@section("Playing: Pause, Resume, Loop and Gain")
def test_gain_moves_along_a_ramp(probe: Probe, steady: Stream) -> None:
    """The controller moves to another gain over more than one DAC code, and reaches it."""
    begin = dac_samples(probe) - 1
    probe.expect(Gain(_GAIN), Status)
    probe.listen(0.1)
    end = dac_samples(probe)
    probe.stop()
    probe.listen(0.1)
    codes = since(probe, begin)[: end - begin]
    if codes[0] < _MIN_LEVEL:
        pytest.skip("a constant drive gives no DAC codes that could move")
    reached = codes[-1] / codes[0]
    assert abs(reached - _GAIN) <= _RIPPLE, f"expected {_GAIN:g} of the drive before, came {reached:.2f}"
    step = np.abs(np.diff(codes)).max()
    assert step <= (codes[0] - codes[-1]) / 2, f"expected a ramp from {codes[0]} to {codes[-1]}, came a step of {step}"


@long
@section("Playing: Limits of the output")
def test_power_is_limited_over_several_streams(probe: Probe) -> None:
    """The controller limits the mean power over streams that follow each other as it does within one."""
    need_capture(probe.description)
    stream = stream_for(probe.description, unit="full scale", seconds=1.5, make_signal=loud)
    status = probe.play(stream, compensation=False)
    rate_hz = probe.description.actuator.dac_rate_hz
    codes = since(probe, 0) ** 2
    if status.power_limited == 0 or len(codes) < rate_hz:
        pytest.skip("no power limit acts on what the buffer and the capture hold")
    sums = np.cumsum(np.concatenate([[0], codes]))
    most = float((sums[rate_hz:] - sums[:-rate_hz]).max()) / rate_hz
    energy, begun_us = 0.0, probe.status().device_time_us
    for _ in range(_RESTARTS):
        play_on(probe, stream, probe.configure(stream, compensation=False))
        probe.listen(_BURST_S)
        ended_us = probe.stop().device_time_us
        energy += float((since(probe, 0) ** 2).sum()) / rate_hz
    passed_s = (ended_us - begun_us) / 1e6
    mean = energy / max(1.0, passed_s)
    assert mean <= (1 + _POWER_RIPPLE) * most, (
        f"expected at most {most:.4g}, the highest mean square of the DAC codes over a second within a stream; came "
        f"{mean:.4g} over {_RESTARTS} streams in {passed_s:.2f} s"
    )


@long
@section("Session: Watchdog")
def test_silence_brings_the_output_to_rest(probe: Probe) -> None:
    """In PLAYING, the controller enters WATCHDOG when the host is silent beyond watchdog_ms, and the output rests."""
    watchdog_s = probe.description.limits.watchdog_ms / 1000
    stream = lasting_stream(probe, 3, 2 * watchdog_s)
    if stream.seconds < 1.5 * watchdog_s:
        pytest.skip("what the buffer holds has been played before the watchdog bites")
    number = probe.configure(stream).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    probe.link.sleep(1.1 * watchdog_s)
    status = in_state(probe.status(), State.WATCHDOG, f"after {1.1 * watchdog_s:g} s of silence")
    assert status.buffered_samples == 0, f"expected nothing buffered, came {describe(status)}"
    probe.listen(0.1)
    if probe.description.limits.capture_samples == 0:
        return
    end = dac_samples(probe)
    assert since(probe, end - 1)[0] == 0, "expected an output at rest, came another last DAC code"
    probe.listen(0.1)
    assert dac_samples(probe) == end, "expected an output at rest, came further DAC codes"
