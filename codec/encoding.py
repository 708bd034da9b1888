"""Encodes recordings: resamples, removes the lowest band, searches for the rate or the SNR, measures the result."""

import bisect
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar, overload

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec.stream import CodingQuality, Stream, check_length
from vibrocast.codec.threshold import PHYSICAL_UNITS, felt_error, read_threshold, skin_snr_db
from vibrocast.device_protocol.coded_stream import StreamHeader

Made = TypeVar("Made")
DEFAULT_SNR_DB = 14.8
"""With the default shape for touch, as many bytes as a flat error at 15 dB on average of the development recordings."""
DEFAULT_STREAM_RATE_HZ = 2800
BEGINNING_SAMPLES = 4096
"""In as many samples per channel, from all over a recording, the setting of a stream is found that plays at once."""


@dataclass(frozen=True)
class Encoding:
    """A coded recording. `recording`: the coder's input, at the stream's rate, without the band below the high-pass."""

    stream: Stream
    recording: textures.Recording

    @property
    def quality(self) -> CodingQuality:
        """How near the stream comes to the recording."""
        assert self.stream.quality is not None, "it has just been coded"
        return self.stream.quality


def encode_recording(  # noqa: PLR0913 - the options of the public `encode`, which passes them on by name
    recording: textures.Recording,
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ,
    codec_name: str | None = None,
    rate_bps: float | None = None,
    snr_db: float | None = None,
    setting: codec.Setting | None = None,
    model: models.Model | None = None,
    runtime: str | None = None,
    live: bool = False,
    progress: Callable[[float], None] | None = None,
    unit: str | None = None,
    highpass_hz: float | None = textures.HIGHPASS_HZ,
    touch: float | None = None,
    packet_s: float | None = None,
) -> Encoding:
    """Resample a recording to the stream's rate and code it to a rate or, without one, to an SNR (DEFAULT_SNR_DB).

    A codec that keeps no waveform has no SNR: without a rate, defaults complete its setting. The same holds for a model
    with one rate, if you give it.

    `codec_name`: None = the model's codec, or DEFAULT_CODEC. `rate_bps` counts the bits of the whole .vct file.
    `setting`: the part of the codec's setting that you fix; one that leaves nothing to search for is used as it is, and
    so is one that cannot reach DEFAULT_SNR_DB, as a threshold cut.
    `model`: None = the built-in tables. A codec without such takes the choice of `first_reachable` among the models
    that ship. `runtime`: as in `Stream`. `live` adds refreshes, for a link that may lose packets. `progress` is called
    with the finished part of the search, from 0 to 1. `unit`: the stream's, None = the recording's. `highpass_hz`:
    `textures.highpass` removes the band below it first; None = the whole band is coded. `touch`: strength by
    which the error is shaped for touch, 0 to 1; None = as `codec.shape_setting` says.
    `packet_s`: duration of packets, rounded up to whole blocks; None = the fewest bytes or, with `live`, 4 blocks.

    Raises CodecError (also when the target rate or SNR cannot be met), ModelError, StreamError or TextureError.
    """
    task = _Task.of(
        recording,
        stream_rate_hz,
        codec_name,
        rate_bps,
        snr_db,
        setting,
        model,
        live,
        unit,
        highpass_hz,
        touch,
        packet_s,
    )
    encoding = first_reachable(task.chosen, model, task.code, progress, task.choice)
    return replace(encoding, stream=replace(encoding.stream, runtime=runtime))


@dataclass(frozen=True)
class _Task:
    """A recording to be coded, and its target; the fields are as in `encode_recording`.

    `passed`: the recording after the high-pass; `resampled`: then at the stream's rate. `given`: the checked part of
    the setting. `by_default`: whether the SNR is DEFAULT_SNR_DB because no target was given.
    """

    passed: textures.HighPassed
    resampled: textures.Recording
    chosen: codec.Codec
    given: codec.Setting
    rate_bps: float | None
    snr_db: float | None
    by_default: bool
    unit: str
    live: bool
    shape: codec.Setting
    framing: codec.Framing | None

    @classmethod
    def of(  # noqa: PLR0913 - the options of `encode_recording`
        cls,
        recording: textures.Recording,
        stream_rate_hz: int,
        codec_name: str | None,
        rate_bps: float | None,
        snr_db: float | None,
        setting: codec.Setting | None,
        model: models.Model | None,
        live: bool,
        unit: str | None,
        highpass_hz: float | None,
        touch: float | None,
        packet_s: float | None,
    ) -> "_Task":
        """Filter and resample the recording, and check the choices. Raises as `encode_recording`."""
        if rate_bps is not None and snr_db is not None:
            raise codec.CodecError(
                "`rate_bps` and `snr_db` are both given", action="give one of them", parameter=("rate_bps", "snr_db")
            )
        passed = textures.highpass(recording, highpass_hz)
        resampled = textures.resample(passed.recording, stream_rate_hz)
        check_length(resampled.samples.size)
        chosen = chosen_codec(codec_name, model)
        given = chosen.checked(setting or {})
        by_default = rate_bps is None and snr_db is None
        if not chosen.leaves_open(given):
            if not by_default:
                raise codec.CodecError(
                    "the setting fixes the quality; leave out the rate or SNR, or that part of the setting"
                )
        elif by_default and chosen.keeps_waveform and not (model and chosen.one_rate_a_model):
            snr_db = DEFAULT_SNR_DB
        unit = unit or resampled.unit
        shape = codec.shape_setting(chosen, touch, stream_rate_hz, unit, given)
        framing = None if packet_s is None else codec.timed_framing(packet_s, stream_rate_hz)
        return cls(passed, resampled, chosen, given, rate_bps, snr_db, by_default, unit, live, shape, framing)

    def source(self, model: models.Model | None, tell: codec.Progress | None = None) -> codec.Source:
        """Return the signal, to be coded with a model."""
        samples, rate_hz = self.resampled.samples, round(self.resampled.rate_hz)
        return codec.Source(
            samples, rate_hz, self.chosen.name, self.unit, self.live, model, tell, self.framing, self.shape
        )

    def searched(self, signal: codec.Source) -> tuple[Stream, str | None]:
        """Return a signal coded to the target, and why the target was given up, if it was. Raises CodecError."""
        if self.rate_bps is not None:
            return codec.encode_to_rate(signal, self.rate_bps, self.given), None
        if self.snr_db is not None:
            try:
                return codec.encode_to_snr(signal, self.snr_db, self.given), None
            except codec.TargetUnreachable as error:
                if not (self.by_default and self.given) or self.chosen.needs_model:
                    raise
                return signal.encode(self.given), f"{error}; the rest of the setting has its defaults"
        return signal.encode(self.given), None

    def code(self, model: models.Model | None, tell: codec.Progress | None) -> Encoding:
        """Return the recording coded with a model, and measured. Raises CodecError."""
        stream, note = self.searched(self.source(model, tell))
        encoding = measure_encoding(self.resampled, stream, self.rate_bps, self.snr_db, self.passed)
        if note is None:
            return encoding
        return replace(encoding, stream=replace(encoding.stream, quality=replace(encoding.quality, note=note)))

    @property
    def choice(self) -> "FamilyChoice[Encoding] | None":
        """How a member of a family of models is chosen; None without a target."""
        if self.rate_bps is None and self.snr_db is None:
            return None

        def cost(encoding: Encoding) -> float:
            ratio_db = encoding.quality.snr_db
            return -ratio_db if self.rate_bps is not None and ratio_db is not None else encoding.stream.size_bytes

        return FamilyChoice(
            lambda model: unsearched_excess(self.source(model), self.given, self.rate_bps, self.snr_db), cost
        )


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


def begin_encoding(
    recording: textures.Recording,
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ,
    codec_name: str | None = None,
    snr_db: float | None = None,
    setting: codec.Setting | None = None,
    model: models.Model | None = None,
    highpass_hz: float | None = textures.HIGHPASS_HZ,
    touch: float | None = None,
    least_full_scale: float = 0.0,
) -> GrowingStream:
    """Begin to code a recording as a live stream, so that it can play at once.

    Without `snr_db`, the setting for DEFAULT_SNR_DB is found in an excerpt of BEGINNING_SAMPLES, so the whole may miss
    it by some tenths of a dB. `least_full_scale`: of each channel, in the recording's unit. The other parameters are
    those of `encode_recording`, and so are the errors. A codec without built-in tables needs a model.
    """
    task = _Task.of(
        recording, stream_rate_hz, codec_name, None, snr_db, setting, model, True, None, highpass_hz, touch, None
    )
    source = task.source(model).with_full_scale(least_full_scale)
    excerpt = source.excerpt(BEGINNING_SAMPLES) if snr_db is None else None
    stream, _ = task.searched(excerpt or source)
    assert stream.setting is not None, "it has just been coded"
    header, packets = source.begin(stream.setting)
    samples = len(task.resampled.samples)
    count = -(-(samples + stream.delay_samples) // stream.packet_samples)
    return GrowingStream(header, GrowingPackets(count, packets), stream.packet_samples, stream.image, task)


@dataclass(frozen=True)
class FamilyChoice(Generic[Made]):
    """How a member of a family of models is chosen for a target.

    `excess`: how far a member's own setting, without a search, lies above the target; it rises from member to member.
    `cost`: of a result made with a member; less is better.
    """

    excess: Callable[[models.Model], float]
    cost: Callable[[Made], float]


def unsearched_excess(
    source: codec.Source, setting: codec.Setting, rate_bps: float | None, snr_db: float | None
) -> float:
    """Return how far a setting lies above a rate, in nepers, or an SNR, in dB. Raises CodecError."""
    stream = source.encode(setting)
    if rate_bps is not None:
        return math.log(stream.bits_per_second / rate_bps)
    ratio_db = codec.snr_db(source.samples, stream.decode())
    assert snr_db is not None, "there is a rate or an SNR to meet"
    return math.inf if ratio_db is None else ratio_db - snr_db


def first_reachable(
    chosen: codec.Codec,
    model: models.Model | None,
    code: Callable[[models.Model | None, Callable[[float], None] | None], Made],
    progress: Callable[[float], None] | None,
    choice: FamilyChoice[Made] | None,
) -> Made:
    """Return the result of `code` with the model or, if the codec needs one, with a model that ships.

    Without a model, this takes the first of `families` that reaches the target. In it, it codes with the two members
    nearest to the target, one on each side, and returns the result of the lower cost. Without a target (`choice` is
    None), it takes the middle member. `code` is called with a model and a function that reports its progress. Raises
    the errors of `code` and of `models.shipped`.
    """
    if model or not chosen.needs_model:
        return code(model, progress)
    every = families(chosen)
    unreachable: codec.TargetUnreachable | None = None
    for number, members in enumerate(every):
        if choice is None:
            candidates = [middle(members)]
        else:
            above = bisect.bisect_left(members, 0.0, key=choice.excess)
            candidates = members[max(0, above - 1) : above + 1]
        made = []
        for trial, candidate in enumerate(candidates):
            share = 1 / (len(every) * len(candidates))
            begun = number / len(every) + trial * share
            tell = None if progress is None else partial(_tell_of_part, progress, begun, share)
            try:
                made.append(code(candidate, tell))
            except codec.TargetUnreachable as error:
                unreachable = error
        if made:
            return made[0] if choice is None else min(made, key=choice.cost)
    raise unreachable or _no_model(chosen)


def chosen_codec(codec_name: str | None, model: models.Model | None) -> codec.Codec:
    """Return the codec of this name; None = the model's, or DEFAULT_CODEC. Raises CodecError on a mismatch."""
    if codec_name is None:
        codec_name = codec.DEFAULT_CODEC if model is None else codec.codec_by_identifier(model.codec_identifier).name
    chosen = codec.codec_by_name(codec_name)
    if model is not None and model.codec_identifier != chosen.identifier:
        raise codec.CodecError(f"the model {model.name} is not for the codec {codec_name}; give another model or codec")
    return chosen


def families(chosen: codec.Codec) -> list[list[models.Model]]:
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


def default_model(chosen: codec.Codec) -> models.Model:
    """Return the model of a codec for a signal that is not known yet: the middle member of the first of `families`.

    Raises ModelError if none ships, and as `models.shipped`.
    """
    for members in families(chosen):
        return middle(members)
    raise _no_model(chosen)


def _no_model(chosen: codec.Codec) -> models.ModelError:
    return models.ModelError(
        f"no model for the codec {chosen.name} ships",
        action="train one, and give its folder as `model`",
        parameter="model",
    )


def brings_built_in_tables(model: models.Model) -> bool:
    """Return whether a model's tables equal its codec's built-in ones. Raises CodecError for an unknown codec."""
    built_in_tables = codec.codec_by_identifier(model.codec_identifier).built_in_tables
    return built_in_tables is not None and model.tables == built_in_tables()


def _tell_of_part(progress: Callable[[float], None], begun: float, share: float, done: float) -> None:
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
    each_db = tuple(map(_finite, codec.channel_snrs_db(recording.samples, decoded)))
    at_skin_db, weighted_db, felt = None, None, None
    if stream.header.unit in PHYSICAL_UNITS:
        judged = recording.samples, decoded, recording.rate_hz, stream.header.unit
        at_skin_db, weighted_db = skin_snr_db(*judged), skin_snr_db(*judged, read_threshold())
        felt = felt_error(*judged)
    quality = CodingQuality(
        snr_db=_finite(codec.snr_db(recording.samples, decoded)),
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
    if rate_bps is not None and stream.bits_per_second < rate_bps * (1 - codec.RATE_TOLERANCE):
        return f"{stream.bits_per_second:.0f} bit/s instead of {rate_bps:.0f}: no setting below it comes nearer"
    audible = [(ratio_db, number) for number, ratio_db in enumerate(each_db, 1) if ratio_db is not None]
    if snr_db is not None and audible:
        furthest_db, number = max(audible, key=lambda ratio: abs(ratio[0] - snr_db))
        if abs(furthest_db - snr_db) > codec.SNR_TOLERANCE_DB:
            where = f" in channel {number}" if len(each_db) > 1 else ""
            return f"{furthest_db:.2f} dB instead of {snr_db:g}{where}: no setting above it comes nearer"
    return None


def _finite(ratio_db: float | None) -> float | None:
    return ratio_db if ratio_db is not None and math.isfinite(ratio_db) else None
