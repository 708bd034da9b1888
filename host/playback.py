"""Plays coded streams on controllers, reads back what they did, compares with the same computed here, and reports."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrocast import textures
from vibrocast.codec import metrics
from vibrocast.codec.encoding import Encoding
from vibrocast.codec.stream import CodingQuality, Stream
from vibrocast.codec.threshold import (
    PHYSICAL_UNITS,
    felt_error,
    filtered,
    over_threshold_db,
    read_threshold,
    skin_filter,
    skin_snr_db,
)
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.messages import Status
from vibrocast.errors import InputError
from vibrocast.host import player, uploader
from vibrocast.host.controller import ControllerError
from vibrocast.host.devices import Session
from vibrocast.host.figures import Value
from vibrocast.host.picture import Trace
from vibrocast.host.report import (
    ActuatorUse,
    DeviceDescription,
    Provenance,
    Quality,
    Report,
    SkinQuality,
    Timing,
    Touch,
    Wire,
)
from vibrocast.host.stream_session import fitted
from vibrocast.output.actuator import FOLLOWED_DB, SKIN_OVERSAMPLING, Actuator, Codes, followed_band_hz, octave_gains_db
from vibrocast.output.rendering import HIGH_PASS_HZ, Drive, LimitCounts, displacement_filter, render
from vibrocast.output.sound_card import CardUse
from vibrocast.textures import Recording
from vibrocast.textures.resampling import resampled

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Samples = NDArray[np.float64]

# Decoded samples of all channels and loops, positions that are not played included: 1.6 h at 2800 Hz. Computing the
# same here takes about 80 bytes for each.
MAX_COMPARED_SAMPLES = 2**24
# Of decoded int16 samples.
DECODED_FULL_SCALE = 32768
COMPARED_S = 60
"""Of a signal: a longer comparison takes long, and would say the same."""
# The actuator's part counts where its error is at least a quarter of the power of the codec's.
_NOTICEABLE_DB = 6.0
# Cubic splines interpolate the recording between this many points per sample.
_OVERSAMPLING = 8
_ITERATIONS = 12
_HALVINGS = 5
_MIN_CORRELATION = 0.1
MAX_DRIFT_PPM = 500.0
"""Five times what the crystal of a cheap recorder is off; a larger drift is a wrong sample rate, or a wrong fit."""
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
    controller.watch_time()
    settings = player.PlaybackSettings(
        loops=loops, capture=_unread_reason(session, sent, loops) is None, progress=progress
    )
    result = controller.run(player.play_steps(controller, sent, settings))
    return compared(session, file_name, sent, encoding, loops, result, provenance or Provenance())


def compared(
    session: Session,
    file_name: str,
    stream: Stream,
    encoding: Encoding | None,
    loops: int,
    result: player.PlaybackResult,
    provenance: Provenance,
) -> Playback:
    """Return what a controller did, compared with the same computed here. Raises CodecError."""
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
    knows_codes = comparable and session.unknown_note is None
    at_end = at_the_device(session, result.status, traces)
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
        wire=Wire(result.wire_bytes_sent, result.wire_bytes_received, *result.wire_faults),
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
        dac_equals_offline=_equal(result, result.dac_codes, codes) if knows_codes else None,
        comparison_note=_comparison_note(session, stream, loops, result),
        doubt=session.controller.doubt(player.BUFFER_S),
    )
    return Playback(session, stream, report, caption(session, READ_BACK if read_back else COMPUTED), traces)


class AtTheDevice(NamedTuple):
    """The part of a report that says who played, and how it came out at the skin; None: not compared."""

    device: DeviceDescription
    sound_card: CardUse | None
    actuator: ActuatorUse
    skin: SkinQuality | None
    skin_note: str | None


def at_the_device(session: Session, status: Status, traces: Sequence[Trace]) -> AtTheDevice:
    """Return that part of a playback that ended with this status, of the last trace against the others."""
    hello = session.controller.description
    device = DeviceDescription(
        session.address,
        hello.build,
        hello.hardware,
        hello.serial_number,
        f"{hello.major}.{hello.minor}",
        tuple(hello.image_lines),
    )
    use = ActuatorUse(
        name=session.skin.name,
        follows_hz=followed_band_hz(session.driven, session.skin),
        gains_db=octave_gains_db(session.driven, session.skin),
        clipped_samples=status.compensation_clipped,
        voltage_limited=status.voltage_limited,
        slew_limited=status.slew_limited,
        power_limited=status.power_limited,
    )
    skin = None
    if traces:
        *asked, moved = traces
        asked_um, asked_rate_hz = [each.displacement_um for each in asked], round(asked[0].displacement_rate_hz)
        skin = compare_channels(asked_um, asked_rate_hz, moved.values, moved.rate_hz)
    note = None if skin is None else limit_note(skin, use.gains_db, use.limited_samples)
    return AtTheDevice(device, session.controller.sound_card, use, skin, note)


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


class AlignmentError(ValueError):
    """A recording that cannot be aligned with the sent signal; the message says what to do."""


@dataclass(frozen=True)
class Alignment:
    """How a recording lies over its reference.

    `lag_s`: from the recording's first sample to where the reference begins in it. `gain`: recorded over sent, negative
    for a sensor the other way round. `drift_ppm`: how much faster the recorder's clock runs.
    """

    lag_s: float
    gain: float
    drift_ppm: float

    def aligned(self, recorded: Samples, samples: int, rate_hz: float) -> Samples:
        """Return a recording (m,) at the first samples of the reference, divided by the gain: float64 (samples,)."""
        numbers = np.arange(samples, dtype=np.float64)
        at = self.lag_s * rate_hz + numbers * (1 + self.drift_ppm / 1e6)
        return np.asarray(_spline(recorded)(np.clip(at, 0, len(recorded) - 1)) / self.gain)


def align(reference: Samples, recorded: Samples, rate_hz: float, drifts: bool = False) -> Alignment:
    """Align a recording (m,) with its reference (n,), both at `rate_hz`; all of the reference lies in the recording.

    Begins at the peak of the cross-correlation; from there the least squared difference over lag and gain, by Gauss and
    Newton. `drifts`: the recorder has a clock of its own, whose drift is fitted too. Steps that raise the difference,
    or leave the peak for its neighbours, are shortened or left out.

    Raises AlignmentError where the two have too little in common, and for a drift of more than MAX_DRIFT_PPM.
    """
    from scipy import signal

    if len(recorded) < len(reference):
        raise AlignmentError("the recording is shorter than the texture; let the sensor's program record {seconds}")
    correlation = signal.correlate(recorded, reference, mode="valid", method="fft")
    peak = int(np.argmax(np.abs(correlation)))
    part = recorded[peak : peak + len(reference)]
    power = float(np.sqrt(np.sum(np.square(reference)) * np.sum(np.square(part))))
    if not power or abs(correlation[peak]) < _MIN_CORRELATION * power:
        raise AlignmentError("the recording does not contain the texture; check the sensor and its sensitivity")
    low, high = _lobe(correlation, peak)
    spline = _spline(recorded)
    slope = spline.derivative()
    numbers = np.arange(len(reference), dtype=np.float64)
    middle = float(np.mean(numbers))

    def values_at(lag: float, stretch: float) -> tuple[Samples, Samples]:
        at = np.clip(lag + numbers + stretch * (numbers - middle), 0, len(recorded) - 1)
        return at, spline(at)

    def difference(values: Samples) -> float:
        factor = np.dot(values, reference) / np.dot(values, values)
        return float(np.sum(np.square(reference - factor * values)))

    lag, stretch = float(peak), 0.0
    at, values = values_at(lag, stretch)
    least = difference(values)
    for _ in range(_ITERATIONS):
        # reference = a values + b slopes + c slopes (numbers - middle), to first order around this lag and stretch.
        slopes = slope(at)
        terms = np.column_stack((values, slopes, slopes * (numbers - middle))[: 3 if drifts else 2])
        factor, *moved = np.linalg.lstsq(terms, reference, rcond=None)[0]
        shift, stretched = (*(np.array(moved) / factor), 0.0)[:2]
        for halving in range(_HALVINGS):
            trial = lag + shift / 2**halving, stretch + stretched / 2**halving
            if low <= trial[0] <= high:
                at, values = values_at(*trial)
                if (now := difference(values)) < least:
                    (lag, stretch), least = trial, now
                    break
        else:
            break
    if abs(1e6 * stretch) > MAX_DRIFT_PPM:
        raise AlignmentError(
            f"the recorder's clock seems to be off by {1e6 * stretch:+.0f} ppm, and none is by more than "
            f"{MAX_DRIFT_PPM:g}; correct the sample rate of the recording"
        )
    _, values = values_at(lag, stretch)
    # Over the power of the sent signal, which has no noise.
    gain = float(np.dot(values, reference) / np.sum(np.square(reference)))
    return Alignment((lag - stretch * middle) / rate_hz, gain, 1e6 * stretch)


def _lobe(correlation: Samples, peak: int) -> tuple[int, int]:
    """Return the lags below and above a peak between which the correlation keeps the peak's sign."""
    other = np.flatnonzero(np.sign(correlation) != np.sign(correlation[peak]))
    behind = int(np.searchsorted(other, peak))
    low = int(other[behind - 1]) if behind > 0 else -1
    return low, int(other[behind]) if behind < len(other) else len(correlation)


def _spline(recorded: Samples) -> "CubicSpline":
    """Return a function of time in samples that interpolates a recording (m,)."""
    from scipy import interpolate, signal

    fine = signal.resample(recorded, _OVERSAMPLING * len(recorded))
    return interpolate.CubicSpline(np.arange(len(fine)) / _OVERSAMPLING, fine)


def compare_skin(
    sent_um: Samples | None,
    decoded_um: Samples,
    skin_um: Samples,
    rate_hz: int,
    perceptual: bool = True,
    drifts: bool = False,
) -> tuple[SkinQuality, Alignment, Samples]:
    """Compare displacement at the skin (m,) with the texture's and the decoded one, (n,), all at `rate_hz`.

    The skin is aligned with the decoded signal, which it follows: what the codec changed moves neither lag nor gain.
    Returns the skin at the samples of the decoded signal too, (n,), divided by the gain. `sent_um`: None where the
    texture is not known. `perceptual`: ST-SIM as well. `drifts`: a sensor with its own clock recorded the skin. Raises
    AlignmentError.
    """
    margin = np.zeros(rate_hz // 10)  # a model's skin has no time before and after
    padded = np.concatenate((margin, skin_um, margin))
    threshold = read_threshold()
    taps = skin_filter(rate_hz, "um", threshold, len(decoded_um))
    laid = align(filtered(decoded_um, taps), filtered(padded, taps), rate_hz, drifts)
    aligned_um = laid.aligned(padded, len(decoded_um), rate_hz)

    def snrs_db(reference_um: Samples | None, other_um: Samples) -> tuple[float | None, float | None]:
        """Return the SNR in dB, and the one that the threshold weights."""
        if reference_um is None:
            return None, None
        both = reference_um[:, None], other_um[:, None]
        return skin_snr_db(*both, rate_hz, "um"), skin_snr_db(*both, rate_hz, "um", threshold)

    st_sim = None
    if sent_um is not None and perceptual:
        st_sim = metrics.measure(sent_um[:, None], aligned_um[:, None], rate_hz).st_sim_2800
    (at_skin, weighted), (decoded, weighted_decoded), (playing, weighted_playing) = (
        snrs_db(sent_um, aligned_um),
        snrs_db(sent_um, decoded_um),
        snrs_db(decoded_um, aligned_um),
    )
    quality = SkinQuality(at_skin, decoded, playing, st_sim, laid.gain, weighted, weighted_decoded, weighted_playing)
    return quality, replace(laid, lag_s=laid.lag_s - len(margin) / rate_hz), aligned_um


def compare_channels(
    asked_um: Sequence[Samples], rate_hz: int, skin_um: Samples, skin_rate_hz: float
) -> SkinQuality | None:
    """Compare the beginning of displacements (n, channels) at the skin; return the mean over channels that move.

    `asked_um`: the texture's, if known, and the decoded one, at `rate_hz`. None where no channel can be aligned.
    """
    qualities = []
    for channel in range(skin_um.shape[1]):
        *sent, decoded = (high_passed(each[: COMPARED_S * rate_hz, channel], rate_hz) for each in asked_um)
        moved = resampled(skin_um[:, channel : channel + 1], skin_rate_hz, rate_hz)
        at_skin = high_passed(moved[: len(decoded), 0], rate_hz)
        with contextlib.suppress(AlignmentError):
            quality, *_ = compare_skin(sent[0] if sent else None, decoded, at_skin, rate_hz, perceptual=False)
            qualities.append(quality)
    if not qualities:
        return None
    known = {
        each.name: [value for quality in qualities if (value := getattr(quality, each.name)) is not None]
        for each in fields(SkinQuality)
    }
    return SkinQuality(**{name: float(np.mean(values)) if values else None for name, values in known.items()})


def displacement_above_20_hz(recorded: Recording, rate_hz: int) -> Samples:
    """Return what a sensor recorded as displacement in um, (n,) at `rate_hz`."""
    from scipy import signal

    # Resampled as they are, gravity, a sensor's distance and their drift would be steps at both ends.
    level = replace(recorded, samples=signal.detrend(recorded.samples, axis=0))
    samples = textures.resample(level, rate_hz).samples[:, 0]
    if recorded.unit == "m/s^2":
        return np.asarray(signal.lfilter(*displacement_filter(rate_hz), samples))
    return high_passed(samples, rate_hz)


def high_passed(displacement_um: Samples, rate_hz: int) -> Samples:
    """Return displacement through the high-pass that is in `displacement_filter`, so that the two can be compared."""
    from scipy import signal

    return np.asarray(signal.lfilter(*signal.butter(4, HIGH_PASS_HZ, "highpass", fs=rate_hz), displacement_um))


def limit_note(quality: SkinQuality, gains_db: Mapping[str, float], limited_samples: int) -> str | None:
    """Return in words how the actuator limits what is felt; None where the codec limits it more, or that is unknown.

    `gains_db`: of the displacement over the one asked for, by the frequency in Hz. `limited_samples`: DAC samples that
    the actuator's limits held back.
    """
    decoded_db, playing_db = quality.weighted_decoded_snr_db, quality.weighted_playing_snr_db
    if decoded_db is None or playing_db is None or playing_db >= decoded_db + _NOTICEABLE_DB:
        return None
    missed = {each: gain_db for each, gain_db in gains_db.items() if abs(gain_db) > FOLLOWED_DB}
    reasons = [f"{gain_db:+.0f} dB at {frequency} Hz" for frequency, gain_db in missed.items()]
    if limited_samples:
        reasons.append(f"its limits held back {limited_samples} DAC samples")
    return f"the actuator is the limit: {', '.join(reasons) or 'it begins and ends at rest'}"
