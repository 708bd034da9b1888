"""Encodes recordings and height profiles: resamples, removes the lowest band, searches for a target, measures."""

import bisect
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypedDict, Unpack, overload

import numpy as np

from vibrocast import models, textures
from vibrocast.codec.interface import Codec, CodecError, Setting, TargetUnreachable
from vibrocast.codec.metrics import channel_snrs_db
from vibrocast.codec.metrics import snr_db as mean_snr_db
from vibrocast.codec.rate_control import Outcome, RateTarget, encode_rate_controlled, outcome
from vibrocast.codec.registry import DEFAULT_CODEC, codec_by_identifier, codec_by_name
from vibrocast.codec.source import DEFAULT_STREAM_RATE_HZ as DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.source import Progress, Source, recording_format, timed_framing
from vibrocast.codec.stream import CodingQuality, Stream, check_length
from vibrocast.codec.target_search import RATE_TOLERANCE, SNR_TOLERANCE_DB, encode_to_rate, encode_to_snr
from vibrocast.codec.threshold import PHYSICAL_UNITS, felt_error, read_threshold, shape_setting, skin_snr_db
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ, PROFILE_UNIT, StreamError, StreamHeader

DEFAULT_SNR_DB = 14.8
"""With the default shape for touch, as many bytes as a flat error at 15 dB on average of the development recordings."""
BEGINNING_SAMPLES = 4096
"""In as many samples per channel, from all over a recording, the setting of a stream is found that plays at once."""
PROFILE_BAND_HZ = 400.0
"""What is worth coding of a profile at the slowest hand: up to here the DCT paper's display renders its textures."""
SLOWEST_MM_S = 10.0

# Parts of a profile's rate: up to where it is rendered exactly, and without images (vibrocast/profile.h).
_EXACT_PART, _BAND_PART = 0.34, 0.435
# The period of a rendered profile is a multiple of a power of two, at most this one (vibrocast/profile.h).
_PERIOD_SAMPLES = 128
_CROSSFADE_PART = 16


@dataclass(frozen=True)
class Encoding:
    """A coded recording.

    `recording`: the coder's input, at the stream's rate, without the band below the high-pass. `outcome`: how the
    stream met a target of rate control; None without one.
    """

    stream: Stream
    recording: textures.Recording
    outcome: Outcome | None = None

    @property
    def quality(self) -> CodingQuality:
        """How near the stream comes to the recording."""
        assert self.stream.quality is not None, "it has just been coded"
        return self.stream.quality


class EncodingOptions(TypedDict, total=False):
    """How a recording is coded; what is left out, or None, has its default.

    Attributes:
        model: By default the built-in tables. A codec without such takes a choice among the models that ship, as
            `_Task.encode` says.
        rate_bps: Target rate, which counts the bits of the whole .vct file.
        snr_db: Target SNR of every channel; without a rate, DEFAULT_SNR_DB. A codec that keeps no waveform has none:
            defaults complete its setting. The same holds for a model with one rate, if you give it.
        setting: The part of the codec's setting that you fix. One that leaves nothing to search for is used as it is,
            and so is one that cannot reach DEFAULT_SNR_DB, as a threshold cut.
        target: Target of rate control, in place of a rate and an SNR; the recording becomes a live stream.
        live: Whether to add refreshes, for a link that may lose packets.
        unit: The stream's; by default the recording's.
        highpass_hz: `textures.highpass` removes the band below it first; None = the whole band is coded.
        touch: Strength by which the error is shaped for touch, 0 to 1; by default as `shape_setting` says.
        packet_s: Duration of packets, rounded up to whole blocks; by default that of the fewest bytes or, with `live`,
            of 4 blocks.
    """

    model: models.Model | None
    rate_bps: float | None
    snr_db: float | None
    setting: Setting | None
    target: RateTarget | None
    live: bool
    unit: str | None
    highpass_hz: float | None
    touch: float | None
    packet_s: float | None


def encode_recording(
    recording: textures.Recording,
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ,
    codec_name: str | None = None,
    progress: Progress | None = None,
    **options: Unpack[EncodingOptions],
) -> Encoding:
    """Resample a recording to the stream's rate and code it to a rate or an SNR.

    `codec_name`: None = the model's codec, or DEFAULT_CODEC. `progress` is called with the finished part of the search,
    from 0 to 1. Raises CodecError (also when the target rate or SNR cannot be met), ModelError, StreamError or
    TextureError.
    """
    return _Task(recording, stream_rate_hz, codec_name, options).encode(progress)


def begin_encoding(
    recording: textures.Recording,
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ,
    codec_name: str | None = None,
    least_full_scale: float = 0.0,
    **options: Unpack[EncodingOptions],
) -> "GrowingStream":
    """Begin to code a recording as a live stream, so that it can play at once.

    Without `snr_db`, the setting for DEFAULT_SNR_DB is found in an excerpt of BEGINNING_SAMPLES, so the whole may miss
    it by some tenths of a dB. `least_full_scale`: of each channel, in the recording's unit. Raises as
    `encode_recording`. A codec without built-in tables needs a model.
    """
    task = _Task(recording, stream_rate_hz, codec_name, {**options, "live": True})
    source = task.source(task.model).with_full_scale(least_full_scale)
    excerpt = source.excerpt(BEGINNING_SAMPLES) if options.get("snr_db") is None else None
    stream, _ = task.searched(excerpt or source)
    assert stream.setting is not None, "it has just been coded"
    header, packets = source.begin(stream.setting)
    samples = len(task.resampled.samples)
    count = -(-(samples + stream.delay_samples) // stream.packet_samples)
    return GrowingStream(header, GrowingPackets(count, packets), stream.packet_samples, stream.image, task)


class _Task:
    """A recording to be coded, and its target.

    `passed`: the recording after the high-pass; `resampled`: then at the stream's rate. `given`: the checked part of
    the setting. `_by_default`: whether the SNR is DEFAULT_SNR_DB because no target was given.
    """

    def __init__(
        self, recording: textures.Recording, stream_rate_hz: int, codec_name: str | None, options: EncodingOptions
    ) -> None:
        """Filter and resample the recording, and check the choices. Raises as `encode_recording`."""
        if unknown := options.keys() - EncodingOptions.__annotations__.keys():
            known = ", ".join(EncodingOptions.__annotations__)
            raise TypeError(f"no option {', '.join(sorted(unknown))}; the options are {known}")
        self._rate_bps, self._snr_db = options.get("rate_bps"), options.get("snr_db")
        self._target = options.get("target")
        if self._rate_bps is not None and self._snr_db is not None:
            raise CodecError(
                "`rate_bps` and `snr_db` are both given", action="give one of them", parameter=("rate_bps", "snr_db")
            )
        self.passed = textures.highpass(recording, options.get("highpass_hz", textures.HIGHPASS_HZ))
        self.resampled = textures.resample(self.passed.recording, stream_rate_hz)
        check_length(self.resampled.samples.size)
        self.model = options.get("model")
        self.chosen = chosen_codec(codec_name, self.model)
        self.given = self.chosen.checked(options.get("setting") or {})
        self._by_default = self._rate_bps is None and self._snr_db is None and self._target is None
        if not self.chosen.leaves_open(self.given):
            if self._rate_bps is not None or self._snr_db is not None:
                raise CodecError(
                    "the setting fixes the quality; leave out the rate or SNR, or that part of the setting"
                )
        elif self._by_default and self.chosen.keeps_waveform and not (self.model and self.chosen.one_rate_a_model):
            self._snr_db = DEFAULT_SNR_DB
        self._unit = options.get("unit") or self.resampled.unit
        self._live = self._target is not None or options.get("live", False)
        self._shape = shape_setting(self.chosen, options.get("touch"), stream_rate_hz, self._unit, self.given)
        packet_s = options.get("packet_s")
        self._framing = None if packet_s is None else timed_framing(packet_s, stream_rate_hz)

    def source(self, model: models.Model | None, tell: Progress | None = None) -> Source:
        """Return the signal, to be coded with a model."""
        samples, rate_hz = self.resampled.samples, round(self.resampled.rate_hz)
        return Source.of(
            samples, rate_hz, self.chosen.name, self._unit, self._live, model, tell, self._framing, self._shape
        )

    def searched(self, signal: Source) -> tuple[Stream, str | None]:
        """Return a signal coded to the target, and why the target was given up, if it was. Raises CodecError."""
        if self._rate_bps is not None:
            return encode_to_rate(signal, self._rate_bps, self.given), None
        if self._snr_db is not None:
            try:
                return encode_to_snr(signal, self._snr_db, self.given), None
            except TargetUnreachable as error:
                if not (self._by_default and self.given) or self.chosen.needs_model:
                    raise
                return signal.encode(self.given), f"{error}; the rest of the setting has its defaults"
        return signal.encode(self.given), None

    def encode(self, progress: Progress | None) -> Encoding:
        """Return the recording coded with the model or, if the codec needs one and none is given, one that ships.

        This takes the first of `families` that reaches the target. In it, it codes with the two members nearest to the
        target, one on each side, and returns the better result. Without a target, it takes the middle member. Raises as
        `encode_recording`.
        """
        if self.model or not self.chosen.needs_model:
            return self._coded(self.model, progress)
        every = families(self.chosen)
        has_target = not self._by_default or self._snr_db is not None
        unreachable: TargetUnreachable | None = None
        for number, members in enumerate(every):
            candidates = [middle(members)]
            if has_target:
                above = bisect.bisect_left(members, 0.0, key=self._unsearched_excess)
                candidates = members[max(0, above - 1) : above + 1]
            made = []
            for trial, candidate in enumerate(candidates):
                share = 1 / (len(every) * len(candidates))
                begun = number / len(every) + trial * share
                tell = None if progress is None else partial(_tell_of_part, progress, begun, share)
                try:
                    made.append(self._coded(candidate, tell))
                except TargetUnreachable as error:
                    unreachable = error
            if made:
                return min(made, key=self._cost) if has_target else made[0]
        raise unreachable or _no_model(self.chosen)

    def _coded(self, model: models.Model | None, tell: Progress | None) -> Encoding:
        """Return the recording coded with a model, and measured. Raises CodecError."""
        source = self.source(model, tell)
        if self._target is not None:
            policy = self._target.policy(recording_format(self.resampled))
            stream = encode_rate_controlled(source, self.given, policy, self._target.framing(source.format.rate_hz))
            encoding = measure_encoding(self.resampled, stream, passed=self.passed)
            met = outcome(stream, self.resampled.samples, self._target.rate_bps, policy)
            return replace(encoding, outcome=met)
        stream, note = self.searched(source)
        encoding = measure_encoding(self.resampled, stream, self._rate_bps, self._snr_db, self.passed)
        if note is None:
            return encoding
        return replace(encoding, stream=replace(encoding.stream, quality=replace(encoding.quality, note=note)))

    def _unsearched_excess(self, model: models.Model) -> float:
        """Return how far the given setting lies above the target, a rate in nepers or an SNR in dB. Raises CodecError.

        It rises from member to member of a family of models.
        """
        source = self.source(model)
        stream = source.encode(self.given)
        rate_bps = self._rate_bps if self._target is None else self._target.rate_bps
        if rate_bps is not None:
            return math.log(stream.bits_per_second / rate_bps)
        ratio_db = mean_snr_db(source.samples, stream.decode())
        assert self._snr_db is not None, "there is a rate or an SNR to meet"
        return math.inf if ratio_db is None else ratio_db - self._snr_db

    def _cost(self, encoding: Encoding) -> float:
        """Return the cost of a result: the SNR lost or, where the SNR is the target, the bytes; less is better."""
        if encoding.outcome is not None:
            return -encoding.outcome.snr_db
        ratio_db = encoding.quality.snr_db
        return -ratio_db if self._rate_bps is not None and ratio_db is not None else encoding.stream.size_bytes


class GrowingPackets(Sequence[bytes]):
    """The packets of a stream of known length, coded as they are asked for."""

    def __init__(self, count: int, coded: Iterator[bytes]) -> None:
        """`coded`: yields the packets, at least `count`."""
        self._count, self._coded = count, coded
        self._packets: list[bytes] = []

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...

    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        wanted = range(self._count)[index]
        last = max(wanted, default=-1) if isinstance(wanted, range) else wanted
        self._packets += itertools.islice(self._coded, max(0, last + 1 - len(self._packets)))
        return self._packets[index]


@dataclass(frozen=True)
class GrowingStream:
    """A recording that is coded while it plays.

    `header`, `image`: as of the Stream that it becomes. `packet_samples`: samples per channel of each packet.
    """

    header: StreamHeader
    packets: Sequence[bytes]
    packet_samples: int
    image: bytes | None
    _task: _Task

    @property
    def recording(self) -> textures.Recording:
        """What is coded, at the stream's rate."""
        return self._task.resampled

    def finished(self) -> Encoding:
        """Return the whole, coded to its end. Raises CodecError."""
        stream = Stream(self.header, tuple(self.packets), self.image)
        return measure_encoding(self.recording, stream, passed=self._task.passed)


def chosen_codec(codec_name: str | None, model: models.Model | None) -> Codec:
    """Return the codec of this name; None = the model's, or DEFAULT_CODEC. Raises CodecError on a mismatch."""
    if codec_name is None:
        codec_name = DEFAULT_CODEC if model is None else codec_by_identifier(model.codec_identifier).name
    chosen = codec_by_name(codec_name)
    if model is not None and model.codec_identifier != chosen.identifier:
        raise CodecError(f"the model {model.name} is not for the codec {codec_name}; give another model or codec")
    return chosen


def families(chosen: Codec) -> list[list[models.Model]]:
    """Return the families of models that ship for a codec: those trained for SNR first, then by size.

    A family is as large as its largest image. Raises as `models.shipped`.
    """
    names = dict.fromkeys(
        model.family
        for model in models.shipped()
        if model.codec_identifier == chosen.identifier and not brings_built_in_tables(model)
    )
    return sorted(
        map(models.members, names),
        key=lambda members: (members[0].is_perceptual, max(len(model.image) for model in members)),
    )


def middle(members: Sequence[models.Model]) -> models.Model:
    """Return the member of a family that is used without a target."""
    return members[len(members) // 2]


def default_model(chosen: Codec) -> models.Model:
    """Return the model of a codec for a signal that is not known yet: the middle member of the first of `families`.

    Raises ModelError if none ships, and as `models.shipped`.
    """
    for members in families(chosen):
        return middle(members)
    raise _no_model(chosen)


def _no_model(chosen: Codec) -> models.ModelError:
    return models.ModelError(
        f"no model for the codec {chosen.name} ships",
        action="train one, and give its folder as `model`",
        parameter="model",
    )


def brings_built_in_tables(model: models.Model) -> bool:
    """Return whether a model's tables equal its codec's built-in ones. Raises CodecError for an unknown codec."""
    tables = codec_by_identifier(model.codec_identifier).tables
    return tables is not None and tables.built_in is not None and model.tables == tables.built_in()


def _tell_of_part(progress: Progress, begun: float, share: float, done: float) -> None:
    """Report the progress of a part that begins at `begun` and makes up `share` of the whole."""
    progress(begun + share * done)


def measure_encoding(
    recording: textures.Recording,
    stream: Stream,
    rate_bps: float | None = None,
    snr_db: float | None = None,
    passed: textures.HighPassed | None = None,
) -> Encoding:
    """Measure how near a stream comes to its recording, and whether it meets its target. Raises CodecError.

    `passed`: result of the high-pass before; None = the high-pass removed nothing.
    """
    decoded = stream.decode()
    narrower = passed is not None and recording.rate_hz < passed.recording.rate_hz
    each_db = tuple(map(_finite, channel_snrs_db(recording.samples, decoded)))
    at_skin_db, weighted_db, felt = None, None, None
    if stream.header.unit in PHYSICAL_UNITS:
        judged = recording.samples, decoded, recording.rate_hz, stream.header.unit
        at_skin_db, weighted_db = skin_snr_db(*judged), skin_snr_db(*judged, read_threshold())
        felt = felt_error(*judged)
    quality = CodingQuality(
        snr_db=_finite(mean_snr_db(recording.samples, decoded)),
        snr_db_per_channel=each_db,
        skin_snr_db=at_skin_db,
        weighted_skin_snr_db=weighted_db,
        note=_shortfall(stream, each_db, rate_bps, snr_db),
        highpass_hz=None if passed is None else passed.highpass_hz,
        removed_below=0.0 if passed is None else passed.removed_energy,
        lowpass_hz=recording.rate_hz / 2 if narrower else None,
        removed_above=_removed_above(passed.recording, recording) if passed and narrower else 0.0,
        felt_error=felt,
    )
    return Encoding(replace(stream, quality=quality), recording)


def _removed_above(before: textures.Recording, after: textures.Recording) -> float:
    """Return the part of a recording's energy that is gone since it was resampled to a lower rate, 0 to 1."""
    energy, kept = (float(np.sum(np.square(each.samples))) / each.rate_hz for each in (before, after))
    return min(1.0, max(0.0, 1 - kept / energy)) if energy > 0 else 0.0


def _shortfall(
    stream: Stream, each_db: Sequence[float | None], rate_bps: float | None, snr_db: float | None
) -> str | None:
    """Return why the target rate, or else SNR, was missed by more than its tolerance; None when it was met."""
    if rate_bps is not None and stream.bits_per_second < rate_bps * (1 - RATE_TOLERANCE):
        return f"{stream.bits_per_second:.0f} bit/s instead of {rate_bps:.0f}: no setting below it comes nearer"
    audible = [(ratio_db, number) for number, ratio_db in enumerate(each_db, 1) if ratio_db is not None]
    if snr_db is not None and audible:
        furthest_db, number = max(audible, key=lambda ratio: abs(ratio[0] - snr_db))
        if abs(furthest_db - snr_db) > SNR_TOLERANCE_DB:
            where = f" in channel {number}" if len(each_db) > 1 else ""
            return f"{furthest_db:.2f} dB instead of {snr_db:g}{where}: no setting above it comes nearer"
    return None


def _finite(ratio_db: float | None) -> float | None:
    return ratio_db if ratio_db is not None and math.isfinite(ratio_db) else None


def profile_recording(path: Path, **choices: Any) -> textures.Recording:
    """Read a height profile as `textures.load` does, form removed: um, its rate in samples per metre.

    Raises TextureError.
    """
    if choices.get("hand_speed_mm_s") is not None:
        raise textures.TextureError(
            f"{path}: a spatial stream is coded for every hand speed; leave out hand_speed_mm_s"
        )
    # A hand at 1 m/s passes as many samples in a second as there are in a metre.
    recording = textures.load(path, **{**choices, "hand_speed_mm_s": 1000.0})
    if recording.unit != "um":
        raise textures.TextureError(f"{path}: in {recording.unit}; a spatial stream needs a height profile")
    return recording


def encode_profile(
    recording: textures.Recording,
    slowest_mm_s: float = SLOWEST_MM_S,
    band_hz: float = PROFILE_BAND_HZ,
    crossfade: bool = False,
    **quality: Any,
) -> Encoding:
    """Code a height profile (`profile_recording`) as a spatial stream.

    The pitch is such that a hand at `slowest_mm_s` feels all up to `band_hz`, but no finer than the profile needs. It
    divides the profile's length, so every controller repeats the whole of it. `crossfade`: the end fades into the
    beginning over a sixteenth of the length, and the rest repeats. `options`: as of
    `encode_recording`, without a rate. Raises as that.
    """
    if crossfade:
        recording = _crossfaded(recording)
    wanted = band_hz / (slowest_mm_s / 1000) / _EXACT_PART
    samples_per_metre = math.ceil(min(wanted, recording.rate_hz / 2 / _EXACT_PART))
    if samples_per_metre > MAX_RATE_HZ:
        slowest_possible = 1000 * band_hz / (_EXACT_PART * MAX_RATE_HZ)
        raise StreamError(
            f"{samples_per_metre} samples per metre, at most {MAX_RATE_HZ} fit a stream: ask for a slowest hand speed "
            f"of {slowest_possible:.3g} mm/s or more, or a narrower band"
        )
    most = math.floor(recording.seconds * MAX_RATE_HZ / _PERIOD_SAMPLES)
    if most < 1:
        raise StreamError(
            f"{1000 * recording.seconds:.3g} mm are too short to repeat; give a profile of at least "
            f"{1000 * _PERIOD_SAMPLES / MAX_RATE_HZ:g} mm"
        )
    periods = min(most, math.ceil(recording.seconds * samples_per_metre / _PERIOD_SAMPLES))
    recording = _resampled(recording, periods * _PERIOD_SAMPLES)
    return encode_recording(
        recording,
        stream_rate_hz=round(recording.rate_hz),
        live=True,
        unit=PROFILE_UNIT,
        highpass_hz=None,
        **quality,
    )


def _crossfaded(recording: textures.Recording) -> textures.Recording:
    """Return a profile whose end fades into its beginning, so that it repeats without a step."""
    faded = max(1, len(recording.samples) // _CROSSFADE_PART)
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(faded) + 0.5) / faded)[:, None]
    samples = recording.samples[:-faded].copy()
    samples[:faded] = rise * samples[:faded] + (1 - rise) * recording.samples[-faded:]
    return replace(recording, samples=samples)


def _resampled(recording: textures.Recording, samples: int) -> textures.Recording:
    """Return a profile of the same length in other samples, band-limited so that no image of it is rendered.

    Its cosine series is the same up to there, so the ends keep their heights. Samples per metre are rounded.
    """
    from scipy.fft import dct, idct

    series = dct(recording.samples, axis=0, norm="ortho")[: round(2 * _BAND_PART * samples)]
    heights = idct(series, n=samples, axis=0, norm="ortho") * math.sqrt(samples / len(recording.samples))
    return replace(recording, samples=heights, rate_hz=float(round(samples / recording.seconds)))
