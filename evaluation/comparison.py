"""Tables that compare codecs over all traces, one for each chart, computed from measured rows alone."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from statistics import fmean, median

import numpy as np

from vibrocast import codec as codecs
from vibrocast.evaluation.bd_rate import (
    PSNR,
    SCALES,
    SNR,
    SPQI,
    ST_SIM_2800,
    BdRate,
    Curve,
    Scale,
    Summary,
    bd_rates,
    bits_per_sample_at,
    monotone_envelope,
    quality_at,
    summary,
)
from vibrocast.evaluation.cost import CodecCost
from vibrocast.evaluation.kinds import TraceKind
from vibrocast.evaluation.points import IMPORTED, MEASURED, Failure, Point, Timing, by_codec_and_trace
from vibrocast.evaluation.speed import BITS_PER_SAMPLE, RATES, Speed

MEAN = "(mean)"
ANCHORS = ("mdct", "slp", "vcpwq")
"""What others are compared with: the project's own codec, one of the kind that the EVA paper compares with, and the
reference of IEEE 1918.1.1."""
REFERENCE = "slp"
"""The anchor of the EVA paper's kind, which learned codecs are held against."""
LEARNED_SCALES = (PSNR, ST_SIM_2800, SPQI)
EQUAL_SNR_DB = 12.0
NEEDED_SNR_DB = 10.0
NEAR_FEWEST = (1.1, 2.0)
COPY_SNR_DB = 60.0
"""SNR of a copy; rounding to 16 bits leaves some 80 dB."""
SPREAD_PERCENT = (10.0, 90.0)
TIMES = ("encode_s_per_megasample", "decode_s_per_megasample")
TABLES = {
    "points": Point,
    "timings": Timing,
    "costs": CodecCost,
    "failures": Failure,
    "speeds": Speed,
    "kinds": TraceKind,
}
"""The rows of each of Measurements' fields, which lie in a CSV file of this name."""
_RATE_GRID = tuple(2 ** (eighth / 8) for eighth in range(-40, 41))


@dataclass(frozen=True)
class MeanPoint:
    """Quality at a rate: mean over the traces, with the 10 and 90 % points of their spread.

    Of a codec with one point for each trace, the rate is a mean as well.
    """

    codec: str
    source: str
    bits_per_sample: float
    mean: float
    low: float
    high: float
    traces: int


@dataclass(frozen=True)
class RatioPoint:
    """Quality at a compression ratio against 16 bits per sample: a trace's point, or of trace MEAN the mean curve."""

    quality: str
    codec: str
    source: str
    trace: str
    compression_ratio: float
    value: float


@dataclass(frozen=True)
class Mark:
    """A codec at a fixed rate: its mean quality, what that costs, and whether no other measured one beats it in both.

    `cost`: a field of CurveCost. `flash_bytes`: of decoder and model.
    """

    bits_per_sample: float
    codec: str
    source: str
    quality: float
    cost: str
    value: float
    flash_bytes: int | None
    on_front: bool


@dataclass(frozen=True)
class Excess:
    """Bits per sample of a trace at EQUAL_SNR_DB, and their excess over those of the codec that needs the fewest."""

    trace: str
    codec: str
    source: str
    bits_per_sample: float
    excess_percent: float


@dataclass(frozen=True)
class _Pair:
    """Whose rate is compared with whose, at which quality."""

    quality: str
    anchor: str
    codec: str
    source: str


@dataclass(frozen=True)
class TraceBdRate(BdRate, _Pair):
    """The BD-rate of a codec relative to an anchor on one trace."""

    trace: str


@dataclass(frozen=True)
class MeanBdRate(Summary, _Pair):
    """The BD-rate of a codec relative to an anchor over the traces of a kind, "" for all of them.

    `won`: the traces of which the codec needs fewer bits.
    """

    won: int
    kind: str = ""


@dataclass(frozen=True)
class CurveCost:
    """What a curve's codec costs near a rate, by a runtime that it has. None where not measured.

    Times of codecs measured here are of one signal made of all traces, of others medians over the traces.
    `real_time_factor`: seconds of encoding and decoding for each second of one channel.
    """

    codec: str
    source: str
    runtime: str
    settings: int
    setting: str
    bits_per_sample: float | None
    snr_db: float | None
    encode_s_per_megasample: float | None
    decode_s_per_megasample: float | None
    real_time_factor: float | None
    delay_ms: float | None
    decoder_bytes: int | None
    model_bytes: int | None
    flash_bytes: int | None
    peak_memory_bytes: int | None
    width: int | None
    note: str


@dataclass(frozen=True)
class Price:
    """What one more decibel costs a measured codec near BITS_PER_SAMPLE.

    `snr_db`: mean over the traces at that rate. `bytes_percent`: more bytes for one decibel more by a finer setting.
    The others: for each decibel that it gains over `than`, the best of those that decode faster; None where it gains
    none.
    """

    codec: str
    runtime: str
    snr_db: float
    bytes_percent: float | None
    than: str
    gained_db: float | None
    encode_s_per_megasample: float | None
    decode_s_per_megasample: float | None
    flash_bytes: float | None


@dataclass(frozen=True)
class Advice:
    """Which measured codec to take for a need, and what it costs."""

    need: str
    codec: str
    bits_per_sample: float
    encode_s_per_megasample: float | None
    decode_s_per_megasample: float | None
    delay_ms: float | None
    flash_bytes: int | None


@dataclass(frozen=True)
class Measurements:
    """All that was measured or imported: points, times, costs of codecs, failures, speeds, kinds of textures."""

    points: Sequence[Point]
    timings: Sequence[Timing]
    costs: Sequence[CodecCost]
    failures: Sequence[Failure]
    speeds: Sequence[Speed] = ()
    kinds: Sequence[TraceKind] = ()

    @cached_property
    def curves(self) -> dict[str, dict[str, list[Point]]]:
        """The points by codec and trace. Imported ones only of codecs not measured here, and of traces that are.

        PSNR of an imported one that lacks it follows from its SNR: on one trace they differ by its crest factor.
        """
        measured = [point for point in self.points if point.source != IMPORTED]
        traces, names = {point.trace for point in measured}, {point.codec for point in measured}
        crests_db = {
            point.trace: point.psnr_db - point.snr_db
            for point in measured
            if point.psnr_db is not None and point.snr_db is not None and math.isfinite(point.snr_db)
        }
        imported = [
            replace(point, psnr_db=point.snr_db + crests_db[point.trace])
            if point.psnr_db is None and point.snr_db is not None and point.trace in crests_db
            else point
            for point in self.points
            if point.source == IMPORTED and point.codec not in names and (point.trace in traces or not measured)
        ]
        return by_codec_and_trace([*measured, *imported])

    @cached_property
    def traces(self) -> list[str]:
        """The names of all traces."""
        return sorted({trace for by_trace in self.curves.values() for trace in by_trace})

    @cached_property
    def compared(self) -> list[str]:
        """The traces that count in means and BD-rates: those with a block that is long and loud enough for ST-SIM.

        A few samples, or a constant, have a file but no curve. Without any such trace, or figure of it, all count.
        """
        points = [point for by_trace in self.curves.values() for some in by_trace.values() for point in some]
        with_blocks = {point.trace for point in points if point.st_sim_8000 is not None}
        return sorted(with_blocks) or self.traces

    def source(self, codec: str) -> str:
        """Return where a codec's points come from: MEASURED, PROGRAM or IMPORTED."""
        return next(iter(self.curves[codec].values()))[0].source

    @cached_property
    def anchors(self) -> list[str]:
        """Those of ANCHORS that have points; without any, the first codec that has."""
        return [name for name in ANCHORS if name in self.curves] or list(self.curves)[:1]

    @cached_property
    def kind_of(self) -> dict[str, str]:
        """The kinds of textures by trace."""
        return {row.trace: row.kind for row in self.kinds}

    @cached_property
    def learned(self) -> list[str]:
        """The curves of trained models."""
        with_models = {cost.codec for cost in self.costs if cost.model_bytes is not None}
        return [codec for codec in self.curves if codec in with_models]

    def of(self, codec: str, scale: Scale) -> dict[str, Curve]:
        """Return a codec's rate and quality by trace, of the compared traces on which it has that quality."""
        curves = {trace: scale.curve(self.curves[codec].get(trace, [])) for trace in self.compared}
        return {trace: curve for trace, curve in curves.items() if curve}

    def everywhere(self, codec: str, scale: Scale) -> list[Curve] | None:
        """Return a codec's curves of all traces on which any has that quality; None where it lacks one."""
        curves = self.of(codec, scale)
        return list(curves.values()) if curves and set(curves) == self._traces_with[scale] else None

    @cached_property
    def _traces_with(self) -> dict[Scale, set[str]]:
        return {scale: {trace for codec in self.curves for trace in self.of(codec, scale)} for scale in SCALES}

    def cost(self, codec: str) -> CodecCost | None:
        """Return the cost of the codec that a curve belongs to: the one of that name, or the one with that set of rate
        points.
        """
        by_name = {cost.codec: cost for cost in self.costs}
        return by_name.get(codec) or by_name.get(self.owner(codec))

    def owner(self, codec: str) -> str:
        """Return the codec whose set of rate points or family of models a curve is; "" for others' curves."""
        owners = [cost.coder for cost in self.costs if cost.codec == codec and cost.coder]
        return next(
            iter([*owners, *(name for name, known in codecs.CODECS.items() if codec in known.rate_point_sets)]), ""
        )

    def delay_ms(self, codec: str) -> float | None:
        """Return the median delay of a codec's points; None where none says."""
        return _median(point.delay_ms for points in self.curves[codec].values() for point in points)

    def timings_near(self, codec: str, bits_per_sample: float) -> dict[str, Timing]:
        """Return for each timed trace of a codec the timing at the rate nearest to this one."""
        bits = {
            (point.trace, point.setting): point.bits_per_sample
            for points in self.curves[codec].values()
            for point in points
        }
        nearest: dict[str, tuple[float, Timing]] = {}
        for timing in self._timings.get((codec, self.source(codec)), []):
            if (timing.trace, timing.setting) in bits:
                distance = abs(math.log2(bits[timing.trace, timing.setting] / bits_per_sample))
                if timing.trace not in nearest or distance < nearest[timing.trace][0]:
                    nearest[timing.trace] = distance, timing
        return {trace: timing for trace, (_, timing) in nearest.items()}

    @cached_property
    def _timings(self) -> dict[tuple[str, str], list[Timing]]:
        timings: dict[tuple[str, str], list[Timing]] = {}
        for timing in self.timings:
            timings.setdefault((timing.codec, timing.source), []).append(timing)
        return timings


def mean_curves(measurements: Measurements, scale: Scale) -> list[MeanPoint]:
    """Return the mean curve of each codec over the rates at which it has a value for every trace.

    A codec that reaches an exact copy of every trace has a last point there, of infinite SNR.
    """
    rows = []
    for codec in measurements.curves:
        curves = measurements.everywhere(codec, scale)
        if curves is not None:
            source = measurements.source(codec)
            rows += [MeanPoint(codec, source, *row, len(curves)) for row in _mean_curve(curves)]
    return rows


def _mean_curve(curves: Sequence[Curve]) -> list[tuple[float, float, float, float]]:
    """Return rates with mean, low and high quality."""
    envelopes = [monotone_envelope(curve) for curve in curves]
    rows = []
    if all(len(envelope) == 1 for envelope in envelopes):
        rates, values = zip(*(envelope[0] for envelope in envelopes), strict=True)
        rows.append((fmean(rates), *_mean_and_spread(values)))
    elif all(envelopes):
        lowest, highest = max(envelope[0][0] for envelope in envelopes), min(envelope[-1][0] for envelope in envelopes)
        grid = sorted({lowest, highest, *(rate for rate in _RATE_GRID if lowest < rate < highest)})
        columns = np.transpose([quality_at(curve, grid) for curve in curves])
        rows += [
            (rate, *_mean_and_spread(values))
            for rate, values in zip(grid, columns, strict=True)
            if np.all(np.isfinite(values))
        ]
    copies = [[bits for bits, quality in curve if quality == math.inf] for curve in curves]
    if all(copies):
        rows.append((fmean(map(min, copies)), math.inf, math.inf, math.inf))
    return rows


def _mean_and_spread(values: Sequence[float]) -> tuple[float, float, float]:
    low, high = np.percentile(values, SPREAD_PERCENT)
    return float(np.mean(values)), float(low), float(high)


def ratio_points(measurements: Measurements, scales: Iterable[Scale]) -> list[RatioPoint]:
    """Return qualities over the compression ratio, of anchors and learned codecs: of every trace, and in the mean."""
    rows = []
    for scale in scales:
        means = mean_curves(measurements, scale)
        for codec in dict.fromkeys([*measurements.anchors, *measurements.learned]):
            source = measurements.source(codec)
            pairs = [
                *((trace, *pair) for trace, curve in measurements.of(codec, scale).items() for pair in curve),
                *((MEAN, row.bits_per_sample, row.mean) for row in means if row.codec == codec),
            ]
            rows += [
                RatioPoint(scale.field, codec, source, trace, 16 / bits, value)
                for trace, bits, value in pairs
                if math.isfinite(value)
            ]
    return rows


def cost_marks(measurements: Measurements, scale: Scale, names: Sequence[str]) -> list[Mark]:
    """Return each codec's mean quality at each of RATES with these of its costs, by each runtime that it has."""
    rows = []
    for rate in RATES:
        costs, means = curve_costs(measurements, rate), _means_at(measurements, scale, rate)
        marks = [
            Mark(rate, with_runtime(cost), cost.source, means[cost.codec], name, value, cost.flash_bytes, False)
            for cost in costs
            if cost.codec in means
            for name in names
            if (value := getattr(cost, name)) is not None
        ]
        rows += [replace(mark, on_front=_on_front(mark, marks)) for mark in marks]
    return rows


def with_runtime(row: CurveCost | Price) -> str:
    """Return the name of a curve, with what decodes it where there is a choice."""
    return f"{row.codec} ({row.runtime})" if row.runtime else row.codec


def _means_at(measurements: Measurements, scale: Scale, rate: float) -> dict[str, float]:
    """Return the mean quality of the codecs that have one for every trace at this rate."""
    means = {}
    for codec in measurements.curves:
        values = [float(quality_at(curve, rate)) for curve in measurements.everywhere(codec, scale) or [()]]
        if all(map(math.isfinite, values)):
            means[codec] = fmean(values)
    return means


def _on_front(mark: Mark, marks: Sequence[Mark]) -> bool:
    rivals = (other for other in marks if other.cost == mark.cost and other.source != IMPORTED)
    return mark.source != IMPORTED and not any(
        other.value <= mark.value
        and other.quality >= mark.quality
        and (other.value, other.quality) != (mark.value, mark.quality)
        for other in rivals
    )


def excesses(measurements: Measurements) -> list[Excess]:
    """Return what each codec needs on each trace at EQUAL_SNR_DB, compared with the trace's best codec."""
    rows = []
    for trace in measurements.traces:
        bits = {
            codec: float(bits_per_sample_at(SNR.curve(by_trace.get(trace, [])), EQUAL_SNR_DB))
            for codec, by_trace in measurements.curves.items()
        }
        bits = {codec: value for codec, value in bits.items() if math.isfinite(value)}
        rows += [
            Excess(trace, codec, measurements.source(codec), value, 100 * (value / min(bits.values()) - 1))
            for codec, value in bits.items()
        ]
    return rows


def trace_bd_rates(measurements: Measurements) -> list[TraceBdRate]:
    """Return the BD-rate of every codec relative to each anchor on every trace at every quality."""
    return [
        row
        for anchor in measurements.anchors
        for scale in SCALES
        for codec in measurements.curves
        if codec != anchor
        for row in pair_bd_rates(measurements, anchor, codec, scale)
    ]


def pair_bd_rates(measurements: Measurements, anchor: str, codec: str, scale: Scale) -> list[TraceBdRate]:
    """Return the BD-rate of one codec relative to another on every trace at one quality."""
    pair = scale.field, anchor, codec, measurements.source(codec)
    rates = bd_rates(measurements.of(anchor, scale), measurements.of(codec, scale), scale)
    return [TraceBdRate(*pair, **asdict(rate), trace=trace) for trace, rate in rates.items()]


def mean_bd_rates(rows: Iterable[TraceBdRate], kinds: Mapping[str, str] | None = None) -> list[MeanBdRate]:
    """Sum up BD-rates over the traces, and over those of each kind, fewest bits first for each anchor and quality."""
    groups: dict[tuple[str, str, str, str, str], list[TraceBdRate]] = {}
    for row in rows:
        for kind in ("", kinds[row.trace]) if kinds and row.trace in kinds else ("",):
            groups.setdefault((row.quality, row.anchor, row.codec, row.source, kind), []).append(row)
    scales = {scale.field: scale for scale in SCALES}
    means = []
    for (quality, anchor, codec, source, kind), rates in groups.items():
        figures = asdict(summary(rates, scales[quality]))
        won = sum(rate.percent < 0 for rate in rates)
        means.append(
            MeanBdRate(quality=quality, anchor=anchor, codec=codec, source=source, won=won, kind=kind, **figures)
        )
    order = {(row.anchor, row.quality): index for index, row in reversed(list(enumerate(means)))}
    return sorted(means, key=lambda row: (order[row.anchor, row.quality], row.kind, row.mean))


def rival_bd_rates(measurements: Measurements) -> list[MeanBdRate]:
    """Return the BD-rate of every learned codec relative to every other curve, over all traces and of each kind."""
    rows = [
        row
        for scale in LEARNED_SCALES
        for learned in measurements.learned
        for rival in measurements.curves
        if rival != learned
        for row in pair_bd_rates(measurements, rival, learned, scale)
    ]
    return mean_bd_rates(rows, measurements.kind_of)


def curve_costs(measurements: Measurements, rate: float = BITS_PER_SAMPLE) -> list[CurveCost]:
    """Return what each curve's codec costs near a rate, a row for each runtime that it has."""
    rows = []
    for codec in measurements.curves:
        cost = _curve_cost(measurements, codec, rate)
        speeds = [speed for speed in measurements.speeds if (speed.codec, speed.rate) == (codec, rate)]
        rows += [_at_speed(measurements, cost, speed) for speed in speeds] or [cost]
    return rows


def _at_speed(measurements: Measurements, cost: CurveCost, speed: Speed) -> CurveCost:
    rates_hz = [point.rate_hz for points in measurements.curves[cost.codec].values() for point in points]
    seconds = speed.encode_s_per_megasample + speed.decode_s_per_megasample
    return replace(
        cost,
        runtime=speed.runtime,
        setting=speed.setting,
        bits_per_sample=speed.bits_per_sample,
        snr_db=speed.snr_db,
        encode_s_per_megasample=speed.encode_s_per_megasample,
        decode_s_per_megasample=speed.decode_s_per_megasample,
        real_time_factor=seconds * rates_hz[0] / 1e6 if rates_hz and rates_hz[0] else None,
    )


def _curve_cost(measurements: Measurements, codec: str, rate: float) -> CurveCost:
    points = [point for points in measurements.curves[codec].values() for point in points]
    timings = measurements.timings_near(codec, rate)
    timed = {(timing.trace, timing.setting) for timing in timings.values()}
    cost = measurements.cost(codec)
    encode_s, decode_s = (_median(getattr(timing, name) for timing in timings.values()) for name in TIMES)
    return CurveCost(
        codec,
        measurements.source(codec),
        "",
        len({point.setting for point in points}),
        "",
        _median(point.bits_per_sample for point in points if (point.trace, point.setting) in timed),
        None,
        encode_s,
        decode_s,
        _median(
            timings[point.trace].real_time_factor(point.rate_hz)
            for point in points
            if point.trace in timings and point.rate_hz is not None
        ),
        measurements.delay_ms(codec),
        cost.decoder_bytes if cost else None,
        cost.model_bytes if cost else None,
        cost.flash_bytes if cost else None,
        cost.peak_memory_bytes if cost else None,
        cost.width if cost else None,
        cost.note if cost else "",
    )


def prices(measurements: Measurements) -> list[Price]:
    """Return what one more decibel costs each codec measured here, the fastest decoder first."""
    means = _means_at(measurements, SNR, BITS_PER_SAMPLE)
    rows = [row for row in curve_costs(measurements) if row.codec in means and row.source == MEASURED]
    timed = [row for row in rows if row.decode_s_per_megasample is not None]
    timed.sort(key=lambda row: row.decode_s_per_megasample or 0.0)
    found: list[Price] = []
    best: CurveCost | None = None
    for row in timed:
        snr_db = means[row.codec]
        gained_db = None if best is None else snr_db - means[best.codec]
        extras: list[float | None] = [None] * 3
        if best is not None and gained_db is not None and gained_db > 0:
            extras = [_per_decibel(row, best, name, gained_db) for name in (*TIMES, "flash_bytes")]
        than = "" if best is None else with_runtime(best)
        finer = _finer_percent(measurements, row.codec, snr_db)
        found.append(Price(row.codec, row.runtime, snr_db, finer, than, gained_db, *extras))
        if gained_db is None or gained_db > 0:
            best = row
    return found


def _per_decibel(row: CurveCost, than: CurveCost, name: str, gained_db: float) -> float | None:
    more, less = getattr(row, name), getattr(than, name)
    return None if more is None or less is None else (more - less) / gained_db


def _finer_percent(measurements: Measurements, codec: str, snr_db: float) -> float | None:
    """Return by how much a codec's bytes grow for one decibel more, around a mean SNR."""
    curves = measurements.everywhere(codec, SNR) or []
    ratios = []
    for curve in curves:
        below, above = bits_per_sample_at(curve, (snr_db - 0.5, snr_db + 0.5))
        ratios.append(float(above / below))
    return 100 * (fmean(ratios) - 1) if ratios and all(map(math.isfinite, ratios)) else None


def bits_to_reach(measurements: Measurements, snr_db: float) -> dict[str, float]:
    """Return the mean bits per sample of the codecs that reach this SNR or more on every trace, the fewest first."""
    means = {}
    for codec in measurements.curves:
        bits = [_bits_to_reach(curve, snr_db) for curve in measurements.everywhere(codec, SNR) or [()]]
        if all(map(math.isfinite, bits)):
            means[codec] = fmean(bits)
    return dict(sorted(means.items(), key=lambda item: item[1]))


def _bits_to_reach(curve: Curve, snr_db: float) -> float:
    bits = float(bits_per_sample_at(curve, snr_db))
    return bits if math.isfinite(bits) else min((bits for bits, value in curve if value >= snr_db), default=math.inf)


def advice(measurements: Measurements) -> list[Advice]:
    """Return the measured codec that serves each need best; among equals the one with fewer bits."""
    measured = [codec for codec in measurements.curves if measurements.source(codec) != IMPORTED]
    bits, copies = (
        {codec: rate for codec, rate in bits_to_reach(measurements, snr_db).items() if codec in measured}
        for snr_db in (NEEDED_SNR_DB, COPY_SNR_DB)
    )
    fewest = min(bits.values(), default=0.0)
    costs = {codec: _curve_cost(measurements, codec, rate) for codec, rate in bits.items()}
    decode_s = {codec: cost.decode_s_per_megasample for codec, cost in costs.items()}
    encode_s = {codec: cost.encode_s_per_megasample for codec, cost in costs.items()}
    delay_ms = {codec: cost.delay_ms for codec, cost in costs.items()}
    flash_bytes = {codec: cost.flash_bytes for codec, cost in costs.items()}
    snr = f"{NEEDED_SNR_DB:g} dB SNR or more"
    # The words for a need, the rates of the codecs that it admits, and that of which the best has the least.
    needs: list[tuple[str, Mapping[str, float], Mapping[str, float | None]]]
    needs = [(f"the fewest bits at {snr}", bits, bits)]
    for factor in NEAR_FEWEST:
        near = {codec: rate for codec, rate in bits.items() if rate <= factor * fewest}
        needs += [
            (f"the fastest decoder at {snr}, with at most {factor:g} times the fewest bits", near, decode_s),
            (f"the fastest encoder at {snr}, with at most {factor:g} times the fewest bits", near, encode_s),
        ]
    needs += [
        (f"the shortest delay at {snr}", bits, delay_ms),
        (f"the smallest decoder and model, of those counted, at {snr}", bits, flash_bytes),
    ]
    for scale in (SPQI, ST_SIM_2800):
        means = _means_at(measurements, scale, RATES[0])
        at_rate = {codec: RATES[0] for codec in measured if codec in means}
        needs.append(
            (f"the best {scale.label} at {RATES[0]:g} bit/sample", at_rate, {codec: -means[codec] for codec in at_rate})
        )
    needs.append((f"a copy, of {COPY_SNR_DB:g} dB SNR or more, in the fewest bits", copies, copies))
    return [chosen for need, rates, least in needs if (chosen := _least(measurements, need, rates, least)) is not None]


def _least(
    measurements: Measurements, need: str, rates: Mapping[str, float], least: Mapping[str, float | None]
) -> Advice | None:
    """Return the codec of the least value, at its rate; None where none has a value."""
    ranked = [(value, rate, codec) for codec, rate in rates.items() if (value := least.get(codec)) is not None]
    if not ranked:
        return None
    _, rate, codec = min(ranked)
    cost = _curve_cost(measurements, codec, rate)
    times = cost.encode_s_per_megasample, cost.decode_s_per_megasample
    return Advice(need, codec, rate, *times, cost.delay_ms, cost.flash_bytes)


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None
