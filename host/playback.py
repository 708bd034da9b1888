"""Plays a coded stream on a device, reads back what it did, compares with the same computed here, and reports."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec import CodecError
from vibrocast.codec.encoding import Encoding
from vibrocast.codec.stream import Stream
from vibrocast.codec.threshold import PHYSICAL_UNITS, felt_error, over_threshold_db, read_threshold
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.messages import ActuatorDescription, HelloResponse, Status
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import devices, player, uploader
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.event_loop import run_all
from vibrocast.host.limits import fitted
from vibrocast.host.picture import Trace
from vibrocast.host.report import SCHEMA, ActuatorUse, DeviceDescription, Latency, Provenance, Report, Touch
from vibrocast.host.skin_quality import compare_channels, limit_note
from vibrocast.output.actuator import (
    ACTUATORS,
    SKIN_OVERSAMPLING,
    Actuator,
    Codes,
    followed_band_hz,
    octave_gains_db,
)
from vibrocast.output.rendering import Drive, displacement_filter, render
from vibrocast.textures import Recording

_Key = TypeVar("_Key", bound=Hashable)

# Decoded samples of all channels and loops, positions that are not played included: 1.6 h at 2800 Hz. Computing the
# same here takes about 80 bytes for each.
MAX_COMPARED_SAMPLES = 2**24
# Of decoded int16 samples.
DECODED_FULL_SCALE = 32768


@dataclass(frozen=True)
class Outcome:
    """The result of playing: the report, the stream as it was sent, the signals of the picture and their origin."""

    report: Report
    stream: Stream
    caption: str
    traces: tuple[Trace, ...]


@dataclass(frozen=True)
class Member:
    """One of those who play a stream together: a session, and its address for the report.

    `actuator`: the one that the controller works with, None = as it describes it; `skin_model`: the one that moves the
    skin, None = the same.
    """

    controller: Controller
    address: str
    actuator: Actuator | None = None
    skin_model: Actuator | None = None


def member(controller: Controller, address: str, actuator: Actuator | None) -> Member:
    """Return who plays: a session, its address, and the actuator there; None = as the controller says.

    A controller that can be given any actuator drives this one itself; else it is the model of the skin alone.
    """
    if actuator is None:
        return Member(controller, address)
    model = devices.behind_dac(address, actuator, controller.description.actuator)
    return Member(controller, address, model if devices.takes_actuator(address) else None, model)


def known_actuator(member: Member) -> Actuator | None:
    """Return the actuator that a controller works with; None where no model fits what it says of it."""
    if member.actuator is not None:
        return member.actuator
    try:
        return actuator_model(member.controller.description.actuator)
    except ControllerError:
        return None


def play(
    controller: Controller,
    address: str,
    file_name: str,
    stream: Stream,
    encoding: Encoding | None = None,
    loops: int = 1,
    progress: Callable[[player.Progress], None] | None = None,
    actuator: Actuator | None = None,
    skin_model: Actuator | None = None,
) -> Outcome:
    """Play a stream on one controller, as `play_together` does. Raises CodecError, and as `player.play`."""
    member = Member(controller, address, actuator, skin_model)
    tell = None if progress is None else lambda _, now: progress(now)
    (outcome,) = play_together({None: member}, file_name, stream, encoding, loops, tell).values()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def play_together(
    members: Mapping[_Key, Member],
    file_name: str,
    stream: Stream,
    encoding: Encoding | None = None,
    loops: int = 1,
    progress: Callable[[_Key, player.Progress], None] | None = None,
) -> dict[_Key, Outcome | Exception]:
    """Play a stream to its end on all controllers at once; return by key what each did, or why it failed.

    Packets that are too long for a controller are split (`limits.fitted`). The decoded samples and the DAC codes are
    compared with those computed here. Both are read back from the controller, unless it captures nothing, or there
    would be more than MAX_COMPARED_SAMPLES: then nothing is compared, and the skin is computed from one pass. Nor is a
    capture compared that the controller overwrites before it is read. A simulated controller of this session gets the
    stream's model first.
    `encoding`: how the stream was made from a recording, None for a file that was coded before; the stream may have
    another level (`Stream.with_gain`). `file_name` is for the report. Raises CodecError.
    """
    outcomes: dict[_Key, Outcome | Exception] = {}
    works = {}
    sent: dict[_Key, Stream] = {}
    unread: dict[_Key, str | None] = {}
    underruns_before = {}
    for key, member in members.items():
        try:
            output_delay_s(stream.header, member.actuator or actuator_model(member.controller.description.actuator))
            fitting = fitted(member.controller, stream)
            if stream.image is not None:
                uploader.provide(member.controller, member.address, stream.image)
            sent[key] = fitting
        except (ControllerError, TransportError, StreamError) as error:
            outcomes[key] = error
            continue
        if member.controller.sound_card is not None:
            underruns_before[key] = member.controller.sound_card.underruns
        unread[key] = _unread_reason(member.controller, sent[key], loops)
        settings = player.PlaybackSettings(
            loops=loops,
            capture=unread[key] is None,
            progress=progress and partial(progress, key),
        )
        works[key] = (
            member.controller,
            player.play_steps(
                member.controller,
                sent[key].header,
                sent[key].packets,
                sent[key].decoder().packet_samples,
                settings,
            ),
        )
    offline = {each: each.decode_integers() for each in set(sent.values())}
    for key, result in run_all(works).items():
        outcomes[key] = (
            result
            if isinstance(result, Exception)
            else _compared(
                members[key],
                file_name,
                sent[key],
                encoding,
                loops,
                offline[sent[key]],
                result,
                unread[key],
                underruns_before.get(key, 0),
            )
        )
    return {key: outcomes[key] for key in members}


def _compared(
    member: Member,
    file_name: str,
    stream: Stream,
    encoding: Encoding | None,
    loops: int,
    offline: NDArray[np.int16],
    result: player.PlaybackResult,
    unread: str | None,
    underruns_before: int,
) -> Outcome:
    """Return what a controller did, compared with the same computed here.

    `offline`: one pass, decoded here. `unread`: why nothing was read back; None if it was. `underruns_before`: of the
    sound card, before it played.
    """
    header, decoder, hello = stream.header, stream.decoder(), member.controller.description
    actuator = member.actuator or actuator_model(hello.actuator)
    skin_model = member.skin_model or actuator
    drive_s = output_delay_s(header, actuator)
    codes, _ = render(header, offline, decoder.delay_samples, actuator, loops=1 if result.dac_codes is None else loops)
    # After a lost connection the controller begins in the middle; what it plays then has no simple counterpart here.
    comparable = result.captured_from == 0
    played = result.decoded if result.decoded is not None else offline
    played_codes = result.dac_codes if result.dac_codes is not None else codes
    source = "read back from the controller" if result.dac_codes is not None else "computed here"
    algorithmic_s = (decoder.packet_samples + decoder.delay_samples) / header.rate_hz
    quality = stream.quality
    card = member.controller.sound_card
    if card is not None:
        card = replace(card, underruns=card.underruns - underruns_before)
    card_s = card.latency_ms / 1e3 if card else 0.0
    report = Report(
        schema=SCHEMA,
        run=Provenance(),
        version=version("vibrocast"),
        file=file_name,
        codec=stream.codec_name,
        model=stream.model_name,
        channels=header.channels,
        stream_rate_hz=header.rate_hz,
        loops=loops,
        seconds=stream.seconds,
        stream_bytes=stream.size_bytes,
        wire_bytes=result.wire_bytes_sent,
        wire_bytes_back=result.wire_bytes_received,
        bits_per_second=stream.bits_per_second,
        bits_per_sample=stream.bits_per_second / header.rate_hz / header.channels,
        snr_db=quality.snr_db if quality else None,
        snr_db_per_channel=quality.snr_db_per_channel if quality else (None,) * header.channels,
        highpass_hz=quality.highpass_hz if quality else None,
        removed_below=quality.removed_below if quality else None,
        lowpass_hz=quality.lowpass_hz if quality else None,
        removed_above=quality.removed_above if quality else None,
        felt_error=None,
        quality_note=quality.note if quality else None,
        skin=None,
        skin_note=None,
        latency_ms=Latency(
            algorithmic=1e3 * algorithmic_s,
            buffered=1e3 * result.buffered_s,
            end_to_end=1e3 * (algorithmic_s + result.buffered_s + drive_s + card_s),
        ),
        underruns=result.underruns,
        packets=loops * len(stream.packets),
        lost_packets=result.lost_packets,
        bad_frames=result.bad_frames,
        bad_frames_back=result.bad_frames_back,
        reconnects=result.reconnects,
        device=device_description(member.address, hello),
        sound_card=card,
        actuator=actuator_use(actuator, skin_model, result.status),
        touch=touch_of(skin_model, played_codes),
        decoded_equals_offline=_equal(result.decoded, offline, loops) if comparable else None,
        dac_equals_offline=_equal(result.dac_codes, codes) if comparable else None,
        comparison_note=_comparison_note(member.controller, result, unread),
    )
    missed_s = result.captured_from * decoder.packet_samples / header.rate_hz
    delay_s = decoder.delay_samples / header.rate_hz
    decoded = _from_start(played, header.rate_hz, delay_s - missed_s, stream.seconds)
    skin = _skin_um(skin_model, played_codes, delay_s + drive_s, missed_s, stream.seconds)
    skin_rate_hz = SKIN_OVERSAMPLING * actuator.dac_rate_hz
    signals = {}
    if encoding:
        gain = np.array(header.gains) / np.array(encoding.stream.header.gains)
        signals["recording"] = encoding.recording.samples * gain
    signals["decoded"] = decoded * (np.array(header.gains) / DECODED_FULL_SCALE)
    traces = [
        Trace(
            name,
            values,
            header.rate_hz,
            header.unit,
            displacement_um(values, header.unit, header.rate_hz, actuator),
            header.rate_hz,
        )
        for name, values in signals.items()
    ]
    traces.append(Trace("skin", skin, skin_rate_hz, "um", skin, skin_rate_hz))
    caption = f"skin: the DAC's codes, {source}, through the model of the actuator {skin_model.name}"
    return Outcome(_with_skin(report, traces), stream, caption, tuple(traces))


def device_description(address: str, hello: HelloResponse) -> DeviceDescription:
    """Return what a report says of the controller at an address, as its Hello states."""
    return DeviceDescription(
        address,
        hello.build,
        hello.hardware,
        hello.serial_number,
        f"{hello.major}.{hello.minor}",
        tuple(devices.model_images(hello)),
    )


def actuator_use(actuator: Actuator, skin_model: Actuator, status: Status) -> ActuatorUse:
    """Return what a report says of the actuator that a controller with this status works with.

    `skin_model`: the one that moves the skin.
    """
    return ActuatorUse(
        name=skin_model.name,
        follows_hz=followed_band_hz(actuator, skin_model),
        gains_db=octave_gains_db(actuator, skin_model),
        clipped_samples=status.compensation_clipped,
        voltage_limited=status.voltage_limited,
        slew_limited=status.slew_limited,
        power_limited=status.power_limited,
    )


def _with_skin(report: Report, traces: Sequence[Trace]) -> Report:
    """Return a report with the error that is felt and, as the mean over its channels, the quality at the skin."""
    *asked, skin = (trace.displacement_um for trace in traces)
    if len(asked) > 1:
        unit = traces[0].unit
        sent, decoded = (each.values for each in traces[:2]) if unit in PHYSICAL_UNITS else asked
        unit = unit if unit in PHYSICAL_UNITS else "um"
        report = replace(report, felt_error=felt_error(sent, decoded, report.stream_rate_hz, unit))
    skin_quality = compare_channels(asked, report.stream_rate_hz, skin, traces[-1].displacement_rate_hz)
    if skin_quality is None:
        return report
    use = report.actuator
    return replace(report, skin=skin_quality, skin_note=limit_note(skin_quality, use.gains_db, use.limited_samples))


def _unread_reason(controller: Controller, stream: Stream, loops: int) -> str | None:
    """Return why nothing of a playback is read back; None if everything is."""
    if not controller.description.limits.capture_samples:
        return "the controller keeps no captures"
    decoder = stream.decoder()
    if loops * len(stream.packets) * decoder.packet_samples * decoder.channels > MAX_COMPARED_SAMPLES:
        return f"a comparison takes at most {MAX_COMPARED_SAMPLES} samples"
    return None


def _comparison_note(controller: Controller, result: player.PlaybackResult, unread: str | None) -> str | None:
    """Return why not everything was compared; None if it was."""
    if result.captured_from:
        return "the connection was lost, and the controller began again in the middle"
    if result.decoded is not None and result.dac_codes is not None:
        return None
    keeps = controller.description.limits.capture_samples
    return unread or (
        f"the controller keeps {keeps} samples of each capture, and overwrote some before they were read, because the "
        "link or this computer is too slow"
    )


def at_the_skin(stream: Stream, actuator: Actuator, loops: int = 1) -> Recording:
    """Return the displacement at the skin, um, aligned to the recording, at SKIN_OVERSAMPLING times the DAC's rate.

    The stream plays `loops` times without a gap. Raises ControllerError where the actuator's DAC cannot play the
    stream, StreamError for a height profile.
    """
    if stream.header.spatial:
        raise StreamError("a height profile moves the skin only under a hand; play it with --hand")
    decoder = stream.decoder()
    late_s = decoder.delay_samples / stream.header.rate_hz + output_delay_s(stream.header, actuator)
    codes, _ = render(stream.header, stream.decode_integers(), decoder.delay_samples, actuator, loops=loops)
    skin = _skin_um(actuator, codes, late_s, 0.0, loops * stream.seconds)
    return Recording(skin, SKIN_OVERSAMPLING * actuator.dac_rate_hz, "um", "skin")


def output_delay_s(header: StreamHeader, actuator: Actuator) -> float:
    """Return the delay of the output stage and the DAC. Raises ControllerError where they cannot play the stream.

    One DAC sample of it stands for the hold, which takes half a sample, and for the response with its inverse. At the
    sampling instants that is exact. Between them too, a first-order actuator takes 1 - d / 12 samples at low
    frequencies, where d = 2 pi corner_hz / rate is below 1. So the result is 16 us too long for PIEZO_STACK.
    """
    try:
        return float(Drive(header, actuator, compensation=True).delay_seconds) + 1 / actuator.dac_rate_hz
    except ValueError as error:
        raise ControllerError(f"{actuator.name}: {error}") from error


def _skin_um(actuator: Actuator, codes: Codes, late_s: float, missed_s: float, seconds: float) -> NDArray[np.float64]:
    """Return the displacement of one pass of DAC codes that begin `late_s` before, without the part that was missed."""
    one_pass = math.ceil((late_s + seconds) * actuator.dac_rate_hz)
    skin = actuator.displacement_um(codes[:one_pass], SKIN_OVERSAMPLING)
    return _from_start(skin, SKIN_OVERSAMPLING * actuator.dac_rate_hz, late_s - missed_s, seconds)


def touch_of(actuator: Actuator, codes: Codes) -> Touch:
    """Return how far DAC codes (n, channels) through an actuator exceed the detection threshold, where most."""
    moved_um, rate_hz = actuator.displacement_um(codes, SKIN_OVERSAMPLING), SKIN_OVERSAMPLING * actuator.dac_rate_hz
    frequencies_hz, levels_db = over_threshold_db(moved_um, rate_hz, read_threshold())
    loudest = int(np.argmax(levels_db))
    return Touch(float(levels_db[loudest]), float(frequencies_hz[loudest]))


def check_unit(stream_unit: str, unit: str | None) -> None:
    """Raise CodecError where nobody said how far a signal in this unit moves an actuator.

    `unit`: what the user says of it: "drive" for a signal in "full scale" that is the actuator's drive signal.
    """
    if stream_unit == "full scale" and unit != "drive":
        raise CodecError(
            "the signal does not state its unit, so how far it moves the actuator is unknown",
            action="encode it with its unit and full scale, or pass `unit` drive to play it as the actuator's drive "
            "signal",
            parameter="unit",
        )


def actuator_model(description: ActuatorDescription) -> Actuator:
    """Return the model of the actuator that a controller describes.

    Known by its name, with the controller's DAC and volts at full scale, or else built from its band: a low-pass,
    or a resonance where it does not reach down to rest. Raises ControllerError where no actuator can be such.
    """
    if description.name in ACTUATORS and 0 < description.volts < math.inf:
        known = ACTUATORS[description.name]
        # The shortest number of those that are sent as this one, which has seven digits.
        volts = float(str(np.float32(description.volts)))
        if volts != float(str(np.float32(known.volts))):
            known = known.with_full_scale(volts / 2)
        return replace(known, dac_bits=description.dac_bits, dac_rate_hz=description.dac_rate_hz)
    lower_hz, upper_hz = description.lower_hz, description.upper_hz
    if not (
        0 < description.stroke_um < math.inf
        and 0 < description.volts < math.inf
        and 0 <= description.slew_volts_per_second < math.inf
        and 0 <= lower_hz < upper_hz < math.inf
    ):
        raise ControllerError(f"the controller announces an impossible actuator ({description}); update its firmware")
    resonance_hz = math.sqrt(lower_hz * upper_hz)
    return Actuator(
        name=description.name,
        stroke_um=description.stroke_um,
        volts=description.volts,
        corner_hz=resonance_hz or upper_hz,
        quality=resonance_hz / (upper_hz - lower_hz) if resonance_hz else None,
        slew_volts_per_second=description.slew_volts_per_second or description.volts * description.dac_rate_hz,
        volts_limit=description.volts / 2,
        power_limit=1.0,
        dac_bits=description.dac_bits,
        dac_rate_hz=description.dac_rate_hz,
    )


def displacement_um(values: NDArray[np.float64], unit: str, rate_hz: float, actuator: Actuator) -> NDArray[np.float64]:
    """Return the displacement (n, channels) in um that a signal in one of the stream's units asks for.

    Full scale asks for the actuator's full excursion; acceleration is integrated twice above a stated high-pass.
    """
    if unit == "full scale":
        return values * actuator.excursion_um
    if unit == "m/s^2":
        from scipy.signal import lfilter

        return np.asarray(lfilter(*displacement_filter(round(rate_hz)), values, axis=0))
    return values


def _equal(read_back: NDArray[np.int16] | None, computed: NDArray[np.int16], passes: int = 1) -> bool | None:
    """Return whether the read-back repeats the computed values this often; None if nothing was read back."""
    if read_back is None:
        return None
    return len(read_back) == passes * len(computed) and np.array_equal(
        read_back.reshape(passes, *computed.shape), np.broadcast_to(computed, (passes, *computed.shape))
    )


def _from_start(values: NDArray[Any], rate_hz: float, late_s: float, seconds: float) -> NDArray[np.float64]:
    """Return the `seconds` of values (n, channels) from `late_s` on; zeros before (late_s < 0) and behind them."""
    # Seconds are a number of samples over a rate, so their product misses a whole number by rounding alone.
    first, count = round(late_s * rate_hz), math.ceil(round(seconds * rate_hz, 6))
    aligned = np.zeros((count, values.shape[1]))
    piece = values[max(0, first) : max(0, first + count)]
    start = max(0, -first)
    aligned[start : start + len(piece)] = piece[: max(0, count - start)]
    return aligned
