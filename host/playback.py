"""Plays coded streams on controllers, reads back what they did, compares with the same computed here, and reports."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.encoding import Encoding
from vibrocast.codec.stream import CodingQuality, Stream
from vibrocast.codec.threshold import PHYSICAL_UNITS, felt_error, over_threshold_db, read_threshold
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.messages import Status
from vibrocast.errors import InputError
from vibrocast.host import devices, player, uploader
from vibrocast.host.controller import ControllerError
from vibrocast.host.figures import Value
from vibrocast.host.limits import fitted
from vibrocast.host.picture import Trace
from vibrocast.host.report import ActuatorUse, DeviceDescription, Provenance, Quality, Report, Timing, Touch, Wire
from vibrocast.host.session import Session
from vibrocast.host.skin_quality import SkinQuality, compare_channels, limit_note
from vibrocast.host.verdict import doubt_of
from vibrocast.output.actuator import SKIN_OVERSAMPLING, Actuator, Codes, followed_band_hz, octave_gains_db
from vibrocast.output.rendering import Drive, LimitCounts, displacement_filter, render
from vibrocast.output.sound_card import CardUse
from vibrocast.textures import Recording

# Decoded samples of all channels and loops, positions that are not played included: 1.6 h at 2800 Hz. Computing the
# same here takes about 80 bytes for each.
MAX_COMPARED_SAMPLES = 2**24
# Of decoded int16 samples.
DECODED_FULL_SCALE = 32768
READ_BACK, COMPUTED = "read back from the controller", "computed here"
"""Where the DAC's codes of a picture come from."""


@dataclass(frozen=True)
class Playback:
    """What a controller has played: by which session, the stream as it was sent, and the figures.

    `stream`: None for a live stream that was too short to be decoded. `traces`: of the picture, all aligned: what is
    known of the texture, the decoded signal and, last, the skin. `given_samples`: as of `Track`.
    """

    session: Session
    stream: Stream | None
    report: Report
    caption: str
    traces: tuple[Trace, ...]
    given_samples: int = 0

    def figures(self) -> Iterator[Value]:
        """Yield the figures of the report."""
        return self.report.figures()


class Captured(NamedTuple):
    """What a controller captured: int16 (n, channels), from sample `first` on, counted from the stream's begin."""

    first: int
    samples: Codes

    def ends(self, computed: Codes) -> bool:
        """Return whether values computed for all of the stream end, bit for bit, with these."""
        return self.first + len(self.samples) == len(computed) and np.array_equal(self.samples, computed[self.first :])


def play(
    session: Session,
    file_name: str,
    stream: Stream,
    encoding: Encoding | None = None,
    loops: int = 1,
    progress: Callable[[player.Progress], None] | None = None,
    provenance: Provenance | None = None,
) -> Playback:
    """Play a stream to its end on one controller, and return what it did. Raises CodecError, and as `player.play`.

    Packets that are too long for the controller are split (`limits.fitted`). The decoded samples and the DAC codes are
    compared with those computed here. Both are read back from the controller, unless it captures nothing, or there
    would be more than MAX_COMPARED_SAMPLES: then nothing is compared, and the skin is computed from one pass. Nor is a
    capture compared that the controller overwrites before it is read. A simulated controller of this session gets the
    stream's model first.
    `encoding`: how the stream was made from a recording, None for a file that was coded before; the stream may have
    another level (`Stream.with_gain`). `file_name`, `provenance`: for the report.
    """
    controller = session.controller
    output_delay_s(stream.header, session.driven)
    sent = fitted(controller, stream)
    if stream.image is not None:
        uploader.provide(controller, session.address, stream.image)
    underruns_before = controller.sound_card.underruns if controller.sound_card else 0
    controller.watch_time()
    settings = player.PlaybackSettings(
        loops=loops, capture=_unread_reason(session, sent, loops) is None, progress=progress
    )
    result = controller.run(player.play_steps(controller, sent, settings))
    return compared(session, file_name, sent, encoding, loops, result, underruns_before, provenance or Provenance())


def compared(
    session: Session,
    file_name: str,
    stream: Stream,
    encoding: Encoding | None,
    loops: int,
    result: player.PlaybackResult,
    underruns_before: int,
    provenance: Provenance,
) -> Playback:
    """Return what a controller did, compared with the same computed here.

    `underruns_before`: of the sound card, before it played.
    """
    header, driven = stream.header, session.driven
    offline = stream.decode_integers()
    read_back = result.dac_codes is not None
    codes, _ = render(header, offline, stream.delay_samples, driven, loops=loops if read_back else 1)
    played_codes = result.dac_codes if result.dac_codes is not None else codes
    played = result.decoded if result.decoded is not None else offline
    drive_s, delay_s = output_delay_s(header, driven), stream.delay_samples / header.rate_hz
    missed_s = result.captured_from * stream.packet_samples / header.rate_hz
    signals = {}
    if encoding:
        signals["recording"] = encoding.recording.samples * (np.array(header.gains) / encoding.stream.header.gains)
    decoded = _from_start(played, header.rate_hz, delay_s - missed_s, stream.seconds)
    signals["decoded"] = decoded * (np.array(header.gains) / DECODED_FULL_SCALE)
    skin_um = _skin_um(session.skin, played_codes, delay_s + drive_s, missed_s, stream.seconds)
    traces = traces_of(signals, header, driven, skin_um)
    card = session.controller.sound_card
    algorithmic_s = stream.packet_samples / header.rate_hz + delay_s
    card_s = card.latency_ms / 1e3 if card else 0.0
    # After a lost connection the controller begins in the middle; what it plays then has no simple counterpart here.
    comparable = result.captured_from == 0 and not result.altered
    at_end = at_the_device(session, result.status, traces, underruns_before)
    quality = stream.quality or CodingQuality(snr_db=None, snr_db_per_channel=(None,) * header.channels)
    report = Report(
        run=provenance,
        file=file_name,
        device=at_end.device,
        sound_card=at_end.sound_card,
        actuator=at_end.actuator,
        codec=stream.codec_name,
        model=stream.model_name,
        channels=header.channels,
        stream_rate_hz=header.rate_hz,
        loops=loops,
        seconds=stream.seconds,
        stream_bytes=stream.size_bytes,
        wire=Wire(result.wire_bytes_sent, result.wire_bytes_received, result.bad_frames, result.bad_frames_back),
        bits_per_second=stream.bits_per_second,
        bits_per_sample=stream.bits_per_second / header.rate_hz / header.channels,
        quality=Quality(
            snr_db=quality.snr_db,
            snr_db_per_channel=quality.snr_db_per_channel,
            highpass_hz=quality.highpass_hz,
            removed_below=None if stream.quality is None else quality.removed_below,
            lowpass_hz=quality.lowpass_hz,
            removed_above=None if stream.quality is None else quality.removed_above,
            felt_error=_felt_error(traces, header) if encoding else None,
            note=quality.note,
            skin=at_end.skin,
            skin_note=at_end.skin_note,
            touch=touch_of(session.skin, played_codes),
        ),
        timing=Timing(
            algorithmic_ms=1e3 * algorithmic_s,
            buffered_ms=1e3 * result.buffered_s,
            end_to_end_ms=1e3 * (algorithmic_s + result.buffered_s + drive_s + card_s),
        ),
        underruns=result.underruns,
        packets=loops * len(stream.packets),
        lost_packets=result.lost_packets,
        reconnects=result.reconnects,
        decoded_equals_offline=_equal(result, result.decoded, offline, loops) if comparable else None,
        dac_equals_offline=_equal(result, result.dac_codes, codes) if comparable and session.is_known else None,
        comparison_note=_comparison_note(session, stream, loops, result),
        doubt=doubt_of(session.controller, player.BUFFER_S),
    )
    return Playback(session, stream, report, caption(session, READ_BACK if read_back else COMPUTED), traces)


class AtTheDevice(NamedTuple):
    """The part of a report that says who played, and how it came out at the skin; None: not compared."""

    device: DeviceDescription
    sound_card: CardUse | None
    actuator: ActuatorUse
    skin: SkinQuality | None
    skin_note: str | None


def at_the_device(
    session: Session, status: Status, traces: Sequence[Trace], card_underruns_before: int = 0
) -> AtTheDevice:
    """Return that part of a playback that ended with this status, of the last trace against the others."""
    use = actuator_use(session, status)
    skin = None
    if traces:
        *asked, moved = traces
        asked_um, asked_rate_hz = [each.displacement_um for each in asked], round(asked[0].displacement_rate_hz)
        skin = compare_channels(asked_um, asked_rate_hz, moved.values, moved.rate_hz)
    card = session.controller.sound_card
    return AtTheDevice(
        device=device_description(session),
        sound_card=card and replace(card, underruns=card.underruns - card_underruns_before),
        actuator=use,
        skin=skin,
        skin_note=None if skin is None else limit_note(skin, use.gains_db, use.limited_samples),
    )


def traces_of(
    signals: Mapping[str, NDArray[np.float64]], header: StreamHeader, driven: Actuator, skin_um: NDArray[np.float64]
) -> tuple[Trace, ...]:
    """Return the traces of signals (n, channels) in the unit and at the rate of a stream, and of the skin."""
    rate_hz, skin_rate_hz = header.rate_hz, SKIN_OVERSAMPLING * driven.dac_rate_hz
    asked = [
        Trace(name, values, rate_hz, header.unit, displacement_um(values, header.unit, rate_hz, driven), rate_hz)
        for name, values in signals.items()
    ]
    return (*asked, Trace("skin", skin_um, skin_rate_hz, "um", skin_um, skin_rate_hz))


def caption(session: Session, source: str) -> str:
    """Return the caption of a picture whose DAC codes come from this source."""
    return f"skin: the DAC's codes, {source}, through the model of the actuator {session.skin.name}"


def device_description(session: Session) -> DeviceDescription:
    """Return what a report says of a controller, as its Hello states."""
    hello = session.controller.description
    return DeviceDescription(
        session.address,
        hello.build,
        hello.hardware,
        hello.serial_number,
        f"{hello.major}.{hello.minor}",
        tuple(devices.model_images(hello)),
    )


def actuator_use(session: Session, status: Status) -> ActuatorUse:
    """Return what a report says of the actuator of a controller with this status."""
    return ActuatorUse(
        name=session.skin.name,
        follows_hz=followed_band_hz(session.driven, session.skin),
        gains_db=octave_gains_db(session.driven, session.skin),
        clipped_samples=status.compensation_clipped,
        voltage_limited=status.voltage_limited,
        slew_limited=status.slew_limited,
        power_limited=status.power_limited,
    )


def _felt_error(traces: Sequence[Trace], header: StreamHeader) -> Any:
    """Return the error that is felt of the second of two traces, which was decoded, against the first."""
    if header.unit in PHYSICAL_UNITS:
        return felt_error(traces[0].values, traces[1].values, header.rate_hz, header.unit)
    return felt_error(traces[0].displacement_um, traces[1].displacement_um, header.rate_hz, "um")


def _equal(result: player.PlaybackResult, read_back: Codes | None, computed: Codes, passes: int = 1) -> bool | None:
    """Return whether all that was read back repeats what was computed this often.

    None if nothing was read back, and where they differ and packets were lost or came too late.
    """
    if read_back is None:
        return None
    if Captured(0, read_back).ends(np.tile(computed, (passes, 1))):
        return True
    return None if result.lost_packets or result.underruns else False


def _unread_reason(session: Session, stream: Stream, loops: int) -> str | None:
    """Return why nothing of a playback is read back; None if everything is."""
    if not session.controller.description.limits.capture_samples:
        return "the controller keeps no captures"
    if loops * len(stream.packets) * stream.packet_samples * stream.header.channels > MAX_COMPARED_SAMPLES:
        return f"a comparison takes at most {MAX_COMPARED_SAMPLES} samples"
    return None


def _comparison_note(session: Session, stream: Stream, loops: int, result: player.PlaybackResult) -> str | None:
    """Return why not everything was compared; None if it was."""
    if result.captured_from:
        return "the connection was lost, and the controller began again in the middle"
    if result.altered:
        return "it was paused, stopped or changed in level while it played"
    if result.decoded is not None and result.dac_codes is not None:
        late = result.lost_packets or result.underruns
        return "packets were lost or came too late" if late else session.unknown_note
    keeps = session.controller.description.limits.capture_samples
    return _unread_reason(session, stream, loops) or (
        f"the controller keeps {keeps} samples of each capture, and overwrote some before they were read, because the "
        "link or this computer is too slow"
    )


def at_the_skin(stream: Stream, driven: Actuator, skin: Actuator | None = None, loops: int = 1) -> Recording:
    """Return the displacement at the skin, um, aligned to the recording, at SKIN_OVERSAMPLING times the DAC's rate.

    `driven`: the actuator by which the codes are computed; `skin`: the one that moves, None = the same. The stream
    plays `loops` times without a gap. Raises ControllerError where the actuator's DAC cannot play the stream,
    StreamError for a height profile.
    """
    if stream.header.spatial:
        raise StreamError("a height profile moves the skin only under a hand; play it with --hand")
    late_s = stream.delay_samples / stream.header.rate_hz + output_delay_s(stream.header, driven)
    codes, _ = render(stream.header, stream.decode_integers(), stream.delay_samples, driven, loops=loops)
    skin_um = _skin_um(skin or driven, codes, late_s, 0.0, loops * stream.seconds)
    return Recording(skin_um, SKIN_OVERSAMPLING * driven.dac_rate_hz, "um", "skin")


def drive_signal(stream: Stream, actuator: Actuator, name: str) -> tuple[Recording, LimitCounts]:
    """Return the codes of an actuator's DAC for a stream, as parts of its full scale, and what its limits held back.

    `name`: of the recording. Raises InputError where the actuator's DAC cannot play the stream, and CodecError.
    """
    try:
        codes, limited = render(stream.header, stream.decode_integers(), stream.delay_samples, actuator)
    except (ValueError, OverflowError) as error:
        place = f"{actuator.name} at {actuator.dac_rate_hz} Hz"
        raise InputError(f"{name}: cannot be rendered for {place}: {error}") from error
    return Recording(codes / actuator.full_scale, actuator.dac_rate_hz, "full scale", name), limited


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


def _from_start(values: NDArray[Any], rate_hz: float, late_s: float, seconds: float) -> NDArray[np.float64]:
    """Return the `seconds` of values (n, channels) from `late_s` on; zeros before (late_s < 0) and behind them."""
    # Seconds are a number of samples over a rate, so their product misses a whole number by rounding alone.
    first, count = round(late_s * rate_hz), math.ceil(round(seconds * rate_hz, 6))
    aligned = np.zeros((count, values.shape[1]))
    piece = values[max(0, first) : max(0, first + count)]
    start = max(0, -first)
    aligned[start : start + len(piece)] = piece[: max(0, count - start)]
    return aligned
