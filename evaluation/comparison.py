"""Tables that compare codecs over all recordings, one for each chart, computed from measured rows alone."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from statistics import fmean
from typing import Any

import numpy as np
import polars as pl

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
    fewest_bits,
    monotone_envelope,
    quality_at,
    summary,
)
from vibrocast.evaluation.cost import CodecCost
from vibrocast.evaluation.kinds import TraceKind
from vibrocast.evaluation.peers import measured_codecs, named
from vibrocast.evaluation.points import IMPORTED, Failure, Point, Timing, by_codec_and_trace
from vibrocast.evaluation.speed import BITS_PER_SAMPLE, RATES, Speed
from vibrocast.evaluation.tables import as_rows, by, columns, frame

FIT = "(fit)"
"""Stands for a trace where a row is of the fit to all of them."""
ANCHORS = ("mdct", "slp", "vcpwq")
"""The codecs that all others are compared with: the project's own, one of the kind that the EVA paper compares with,
and the reference software of IEEE 1918.1.1."""
REFERENCE = "slp"
"""The anchor of learned codecs: of the kind that the EVA paper compares with."""
AUTOENCODER = "eva"
"""The codec of the EVA paper."""
PAPER_SCALES = (PSNR, ST_SIM_2800)
"""The qualities at which the EVA paper states BD-rates."""
MIN_RATIO, MAX_RATIO = 4.0, 64.0
"""Compression ratios of the charts in the form of the EVA paper's: where its codec and its anchor have points."""
FIT_POINTS = 64
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
_CURVE_COSTS = (
    *("codec", "source", "runtime", "settings", "setting", "bits_per_sample", "snr_db", *TIMES, "real_time_factor"),
    *("delay_ms", "decoder_bytes", "model_bytes", "flash_bytes", "peak_memory_bytes", "width", "note"),
)
_REGIONS = "quality:text trace:text codec:text source:text value bits_per_sample in_region:bool percent"
_PAIR = ("quality", "anchor", "codec", "source")
_COLUMN_TYPES: Mapping[str, Any] = {"text": pl.String, "whole": pl.Int64, "bool": pl.Boolean, "": pl.Float64}


@dataclass(frozen=True)
class Measurements:
    """All measured or imported rows: points, times, costs of codecs, failures, speeds, kinds of textures."""

    points: Sequence[Point]
    timings: Sequence[Timing]
    costs: Sequence[CodecCost]
    failures: Sequence[Failure]
    speeds: Sequence[Speed] = ()
    kinds: Sequence[TraceKind] = ()

    @cached_property
    def curves(self) -> dict[str, dict[str, list[Point]]]:
        """The points by codec and recording; imported ones only of codecs not measured here, on recordings that are.

        The PSNR of an imported one that lacks it follows from its SNR: they differ by the recording's crest factor.
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
    def drawn(self) -> pl.DataFrame:
        """The points of all curves, one a row, with `bits_per_sample`."""
        points = [point for by_trace in self.curves.values() for some in by_trace.values() for point in some]
        bits = pl.Series("bits_per_sample", [point.bits_per_sample for point in points], pl.Float64)
        return frame(points, Point).with_columns(bits)

    @cached_property
    def traces(self) -> list[str]:
        """The names of all recordings."""
        return sorted(self.drawn["trace"].unique())

    @cached_property
    def rate_hz(self) -> float | None:
        """The sample rate of all recordings; None where they differ, or none is known."""
        rates_hz = self.drawn["rate_hz"].drop_nulls().unique().to_list()
        return rates_hz[0] if len(rates_hz) == 1 else None

    @cached_property
    def compared(self) -> list[str]:
        """The recordings that count in means and BD-rates: those with a block that is long and loud enough for ST-SIM.

        A few samples, or a constant, have a file but no curve. Without any such recording, all count.
        """
        return sorted(self.drawn.drop_nulls("st_sim_8000")["trace"].unique()) or self.traces

    def source(self, codec: str) -> str:
        """Return where a codec's points come from: MEASURED, PROGRAM or IMPORTED."""
        return next(iter(self.curves[codec].values()))[0].source

    @cached_property
    def anchors(self) -> list[str]:
        """Those of ANCHORS that have points; without any, the first codec that has."""
        return [name for name in ANCHORS if name in self.curves] or list(self.curves)[:1]

    @property
    def anchor(self) -> str:
        """The first of `anchors`; "" without any curve."""
        return next(iter(self.anchors), "")

    @cached_property
    def kind_of(self) -> dict[str, str]:
        """The kinds of textures by recording."""
        return {row.trace: row.kind for row in self.kinds}

    @cached_property
    def learned(self) -> list[str]:
        """The curves of trained models."""
        with_models = {cost.codec for cost in self.costs if cost.model_bytes is not None}
        return [codec for codec in self.curves if codec in with_models]

    @cached_property
    def paper_pair(self) -> list[str]:
        """At most two codecs for charts in the form of the EVA paper's.

        The first is its own at its widest, or else another learned one; the second is REFERENCE, or another anchor.
        """
        widths = {cost.codec: cost.width or 0 for cost in self.costs if cost.coder == AUTOENCODER}
        first = sorted(self.learned, key=lambda codec: -widths.get(codec, 0))[:1]
        others = sorted(self.anchors, key=lambda codec: codec != REFERENCE)
        return list(dict.fromkeys([*first, *others]))[:2]

    def of(self, codec: str, scale: Scale) -> dict[str, Curve]:
        """Return a codec's rate and quality by recording, of the compared recordings on which it has that quality."""
        curves = {trace: scale.curve(self.curves[codec].get(trace, [])) for trace in self.compared}
        return {trace: curve for trace, curve in curves.items() if curve}

    def everywhere(self, codec: str, scale: Scale) -> list[Curve] | None:
        """Return a codec's curves of all recordings on which any has that quality; None where it lacks one."""
        curves = self.of(codec, scale)
        return list(curves.values()) if curves and set(curves) == self._traces_with[scale] else None

    @cached_property
    def _traces_with(self) -> dict[Scale, set[str]]:
        return {scale: {trace for codec in self.curves for trace in self.of(codec, scale)} for scale in SCALES}

    def cost(self, codec: str) -> CodecCost | None:
        """Return the cost of the codec that a curve belongs to, by its name or its set of rate points."""
        by_name = {cost.codec: cost for cost in self.costs}
        return by_name.get(codec) or by_name.get(self.owner(codec))

    def owner(self, codec: str) -> str:
        """Return the codec whose set of rate points or family of models a curve is; "" for others' curves."""
        owners = [cost.coder for cost in self.costs if cost.codec == codec and cost.coder]
        return next(
            iter([*owners, *(name for name, known in measured_codecs().items() if codec in known.rate_point_sets)]), ""
        )

    @cached_property
    def codec_costs(self) -> pl.DataFrame:
        """The costs of each curve's codec that hold at every rate, a row for each curve; columns as in CodecCost."""
        costs = [(codec, self.cost(codec)) for codec in self.curves]
        kept = [replace(cost, codec=codec) for codec, cost in costs if cost]
        flash = pl.Series("flash_bytes", [cost.flash_bytes for cost in kept], pl.Int64)
        return frame(kept, CodecCost).with_columns(flash)

    @cached_property
    def timed(self) -> pl.DataFrame:
        """The timings of all curves, each with the rate of its point."""
        points = self.drawn.unique(["codec", "source", "trace", "setting"], keep="last", maintain_order=True)
        keys = ["codec", "source", "trace", "setting"]
        points = points.select(*keys, "bits_per_sample", "rate_hz")
        return _with_real_time(frame(self.timings, Timing).join(points, on=keys, maintain_order="left"))


def mean_curves(measurements: Measurements, scale: Scale) -> pl.DataFrame:
    """Return the mean curve of each codec over the rates at which it has a value for every recording.

    Columns: `codec`, `source`, `bits_per_sample`, `mean`, the `low` and `high` end of the spread (10 and 90 %), and
    `traces`, their number. A codec that reaches an exact copy of every recording has a last point there, of infinite
    SNR. Of a codec with one point for each recording, the rate is a mean as well.
    """
    found = [
        (codec, measurements.source(codec), *point, len(curves))
        for codec in measurements.curves
        if (curves := measurements.everywhere(codec, scale)) is not None
        for point in _mean_curve(curves)
    ]
    return _table(found, "codec:text source:text bits_per_sample mean low high traces:whole")


def _mean_curve(curves: Sequence[Curve]) -> list[tuple[float, float, float, float]]:
    """Return rates with mean, low and high quality."""
    envelopes = [monotone_envelope(curve) for curve in curves]
    points = []
    if all(len(envelope) == 1 for envelope in envelopes):
        rates, values = zip(*(envelope[0] for envelope in envelopes), strict=True)
        points.append((fmean(rates), *_mean_and_spread(values)))
    elif all(envelopes):
        lowest, highest = max(envelope[0][0] for envelope in envelopes), min(envelope[-1][0] for envelope in envelopes)
        grid = sorted({lowest, highest, *(rate for rate in _RATE_GRID if lowest < rate < highest)})
        columns = np.transpose([quality_at(curve, grid) for curve in curves])
        points += [
            (rate, *_mean_and_spread(values))
            for rate, values in zip(grid, columns, strict=True)
            if np.all(np.isfinite(values))
        ]
    copies = [[bits for bits, quality in curve if quality == math.inf] for curve in curves]
    if all(copies):
        points.append((fmean(map(min, copies)), math.inf, math.inf, math.inf))
    return points


def _mean_and_spread(values: Sequence[float]) -> tuple[float, float, float]:
    low, high = np.percentile(values, SPREAD_PERCENT)
    return float(np.mean(values)), float(low), float(high)


def ratio_points(measurements: Measurements, scales: Iterable[Scale]) -> pl.DataFrame:
    """Return qualities over the compression ratio against 16 bits per sample, of the codecs of `paper_pair`.

    Columns: `quality`, `codec`, `source`, `trace`, `compression_ratio` from MIN_RATIO to MAX_RATIO, `value`. Rows with
    the trace FIT are of the least-squares fit to all points: a polynomial of the logarithm of the ratio, cubic where
    there are enough ratios.
    """
    found: list[tuple[object, ...]] = []
    for scale in scales:
        for codec in measurements.paper_pair:
            pairs = [
                (trace, 16 / bits, value)
                for trace, curve in measurements.of(codec, scale).items()
                for bits, value in curve
                if math.isfinite(value) and MIN_RATIO <= 16 / bits <= MAX_RATIO
            ]
            logarithms = np.log2([ratio for _, ratio, _ in pairs])
            if len(distinct := np.unique(logarithms)) > 1:
                degree = min(3, len(distinct) - 1)
                fit = np.polynomial.Polynomial.fit(logarithms, [value for *_, value in pairs], degree)
                pairs += [(FIT, 2**x, float(fit(x))) for x in np.linspace(distinct[0], distinct[-1], FIT_POINTS)]
            found += [(scale.field, codec, measurements.source(codec), *pair) for pair in pairs]
    return _table(found, "quality:text codec:text source:text trace:text compression_ratio value")


def bd_regions(measurements: Measurements, scales: Iterable[Scale]) -> pl.DataFrame:
    """Return the two curves between which BD-rate integrates, of the codecs of `paper_pair`.

    They are of the recording whose BD-rate is the median at the first scale. Columns: `quality`, `trace`, `codec`,
    `source`, `value`, `bits_per_sample`, `in_region`, and the BD-rate of the first codec relative to the second in
    `percent`. `in_region` is True for the interpolated curve over the range of quality that is integrated, and False
    for the measured points. Empty without two codecs that can be compared.
    """
    chosen = list(scales)
    if len(measurements.paper_pair) < 2:
        return _table([], _REGIONS)
    test, anchor = measurements.paper_pair
    rates = {scale: bd_rates(measurements.of(anchor, scale), measurements.of(test, scale), scale) for scale in chosen}
    ranked = sorted(rates[chosen[0]], key=lambda trace: rates[chosen[0]][trace].percent)
    found: list[tuple[object, ...]] = []
    for scale in chosen:
        for trace in ranked[len(ranked) // 2 :][:1]:
            if (rate := rates[scale].get(trace)) is None:
                continue
            qualities = np.linspace(rate.low, rate.high, FIT_POINTS)
            for codec in (test, anchor):
                envelope = monotone_envelope(measurements.of(codec, scale)[trace])
                within = zip(qualities.tolist(), bits_per_sample_at(envelope, qualities).tolist(), strict=True)
                rows = [(quality, bits, False) for bits, quality in envelope]
                rows += [(quality, bits, True) for quality, bits in within]
                found += [(scale.field, trace, codec, measurements.source(codec), *row, rate.percent) for row in rows]
    return _table(found, _REGIONS)


def cost_points(measurements: Measurements, scale: Scale, names: Sequence[str]) -> pl.DataFrame:
    """Return each codec's mean quality at each of RATES with these of its costs, by each runtime that it has.

    Columns: `bits_per_sample` (one of RATES), `codec`, `source`, `quality`, `cost` (a column of `curve_costs`), its
    `value`, `flash_bytes`, and `on_front`: whether no other measured codec beats it in both quality and cost.
    """
    found = []
    for rate in RATES:
        means = means_at(measurements, scale, rate)
        found += [
            (rate, with_runtime(cost), cost.source, means[cost.codec], name, value, cost.flash_bytes)
            for cost in as_rows(curve_costs(measurements, rate))
            if cost.codec in means
            for name in names
            if (value := getattr(cost, name)) is not None
        ]
    table = _table(found, "bits_per_sample codec:text source:text quality cost:text value flash_bytes:whole")
    keys = ("bits_per_sample", "cost")
    fronts = {
        key: best_of(own.select("value", "quality").rows())
        for key, own in by(table.filter(pl.col("source") != IMPORTED), *keys)
    }
    on_front = [
        source != IMPORTED and tuple(place) in fronts[rate, cost]
        for source, rate, cost, *place in table.select("source", *keys, "value", "quality").rows()
    ]
    return table.with_columns(on_front=pl.Series(on_front, dtype=pl.Boolean))


def best_of(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points of cost and quality that no other beats or equals in both, by rising cost."""
    every = sorted(points)
    return [
        point
        for point in every
        if not any(other[0] <= point[0] and other[1] >= point[1] and other != point for other in every)
    ]


def with_runtime(row: Any) -> str:
    """Return the name of a row's curve, and its decoder where there is a choice."""
    return f"{row.codec} ({row.runtime})" if row.runtime else str(row.codec)


def means_at(measurements: Measurements, scale: Scale, rate: float) -> dict[str, float]:
    """Return the mean quality of the codecs that have one for every recording at this rate."""
    means = {}
    for codec in measurements.curves:
        values = [float(quality_at(curve, rate)) for curve in measurements.everywhere(codec, scale) or [()]]
        if all(map(math.isfinite, values)):
            means[codec] = fmean(values)
    return means


def rate_excesses(measurements: Measurements) -> pl.DataFrame:
    """Return the bits of each codec on each recording at EQUAL_SNR_DB, compared with the recording's best codec.

    Columns: `trace`, `codec`, `source`, `bits_per_sample`, and `excess_percent` over the codec that needs the fewest.
    """
    found = [
        (trace, codec, measurements.source(codec), bits)
        for trace in measurements.traces
        for codec, by_trace in measurements.curves.items()
        if math.isfinite(bits := float(bits_per_sample_at(SNR.curve(by_trace.get(trace, [])), EQUAL_SNR_DB)))
    ]
    fewest = pl.col("bits_per_sample").min().over("trace")
    return _table(found, "trace:text codec:text source:text bits_per_sample").with_columns(
        excess_percent=100 * (pl.col("bits_per_sample") / fewest - 1)
    )


def trace_bd_rates(measurements: Measurements) -> pl.DataFrame:
    """Return the BD-rate of every codec relative to each anchor on every recording, as `pair_bd_rates`."""
    anchors, others = measurements.anchors, measurements.curves
    return pair_bd_rates(
        measurements, [(scale, anchor, codec) for anchor in anchors for scale in SCALES for codec in others]
    )


def pair_bd_rates(measurements: Measurements, pairs: Iterable[tuple[Scale, str, str]]) -> pl.DataFrame:
    """Return the BD-rate of one codec relative to another, an anchor, on every recording at one quality, for all pairs.

    Columns: `quality`, `anchor`, `codec` and its `source`, those of BdRate, and `trace`; none of a codec and itself.
    """
    found = [
        (scale.field, anchor, codec, measurements.source(codec), *astuple(rate), trace)
        for scale, anchor, codec in pairs
        if codec != anchor
        for trace, rate in bd_rates(measurements.of(anchor, scale), measurements.of(codec, scale), scale).items()
    ]
    pair = dict.fromkeys(_PAIR, pl.String)
    return pl.DataFrame(found, {**pair, **columns(BdRate), "trace": pl.String}, orient="row")


def mean_bd_rates(rates: pl.DataFrame, kinds: Mapping[str, str] | None = None) -> pl.DataFrame:
    """Sum up BD-rates over the recordings and each kind of them, fewest bits first for each anchor and quality.

    Columns: those of the pair, of Summary, `won`: on how many recordings the codec needs fewer bits, and `kind`, "" for
    all recordings.
    """
    kind = pl.col("trace").replace_strict(kinds or {}, default=None, return_dtype=pl.String)
    of_kinds = rates.with_columns(kind=kind).drop_nulls("kind")
    parts = pl.concat([rates.with_columns(kind=pl.lit("")), of_kinds]).group_by(*_PAIR, "kind", maintain_order=True)
    scales = {scale.field: scale for scale in SCALES}
    found = [
        (
            *pair,
            *astuple(summary([BdRate(*row) for row in some.select(*columns(BdRate)).rows()], scales[pair[0]])),
            (some["percent"] < 0).sum(),
            kind,
        )
        for (*pair, kind), some in parts
    ]
    schema = {**dict.fromkeys(_PAIR, pl.String), **columns(Summary), "won": pl.Int64, "kind": pl.String}
    table = pl.DataFrame(found, schema, orient="row").with_row_index("place")
    first_place = pl.col("place").min().over("anchor", "quality")
    return table.sort(first_place, "kind", "mean", maintain_order=True).drop("place")


def rival_bd_rates(measurements: Measurements) -> pl.DataFrame:
    """Return the mean BD-rates of learned codecs relative to every other curve, over all recordings and each kind."""
    learned, others = measurements.learned, measurements.curves
    pairs = [(scale, rival, codec) for scale in LEARNED_SCALES for codec in learned for rival in others]
    return mean_bd_rates(pair_bd_rates(measurements, pairs), measurements.kind_of)


def curve_costs(measurements: Measurements, rate: float = BITS_PER_SAMPLE) -> pl.DataFrame:
    """Return the costs of each curve's codec near a rate, a row for each of its runtimes; null where not measured.

    Columns: `codec`, `source`, `runtime`, `settings` (their number), the `setting` and its `bits_per_sample` and
    `snr_db`, TIMES, `real_time_factor` (seconds of encoding and decoding for each second of one channel), `delay_ms`,
    those of CodecCost. Times of codecs measured here are of all recordings as one signal, of others medians over the
    recordings.
    """
    speeds = frame([speed for speed in measurements.speeds if speed.rate == rate], Speed).drop("rate", "samples")
    first_rate_hz = measurements.drawn.group_by("codec").agg(pl.first("rate_hz"))
    speeds = _with_real_time(speeds.join(first_rate_hz, on="codec", maintain_order="left"))
    costs = _costs_at(measurements, dict.fromkeys(measurements.curves, rate))
    joined = costs.join(speeds, on="codec", how="left", suffix="_of_speed", maintain_order="left_right")
    timed = ("setting", "bits_per_sample", *TIMES, "real_time_factor")
    measured = pl.col("runtime").is_not_null()
    return joined.with_columns(
        pl.col("runtime").fill_null(""),
        *(pl.when(measured).then(f"{name}_of_speed").otherwise(name).alias(name) for name in timed),
    ).select(_CURVE_COSTS)


def _costs_at(measurements: Measurements, rates: Mapping[str, float]) -> pl.DataFrame:
    """Return the costs of codecs, each at the rate given, by timings of single recordings at the nearest setting."""
    targets = _table(rates.items(), "codec:text rate")
    nearest = (
        measurements.timed.join(targets, on="codec", maintain_order="left")
        .with_columns(distance=(pl.col("bits_per_sample") / pl.col("rate")).log(2).abs())
        .sort("distance", maintain_order=True)
        .unique(["codec", "trace"], keep="first")
        .group_by("codec")
        .agg(pl.median("bits_per_sample", *TIMES, "real_time_factor"))
    )
    whole = measurements.drawn.group_by("codec").agg(
        pl.first("source"), pl.n_unique("setting").cast(pl.Int64).alias("settings"), pl.median("delay_ms")
    )
    table = targets
    for each in (whole, nearest, measurements.codec_costs):
        table = table.join(each, on="codec", how="left", maintain_order="left")
    return table.with_columns(pl.col("note").fill_null(""), setting=pl.lit(""))


def bits_to_reach(measurements: Measurements, snr_db: float) -> dict[str, float]:
    """Return the mean bits per sample of the codecs that reach an SNR or more on every recording, the fewest first."""
    means = {}
    for codec in measurements.curves:
        bits = [fewest_bits(curve, snr_db) for curve in measurements.everywhere(codec, SNR) or [()]]
        if all(map(math.isfinite, bits)):
            means[codec] = fmean(bits)
    return dict(sorted(means.items(), key=lambda item: item[1]))


def at_needed_snr(measurements: Measurements) -> pl.DataFrame:
    """Return the codecs that reach NEEDED_SNR_DB or more on every recording, the fewest bits first.

    Columns: `codec`, its `name`, `source` and `software`; the mean `bits_per_sample`, and `bits_per_second` where all
    recordings have one rate; the algorithmic delay from `delay_low_ms` to `delay_high_ms`. `delay_from`: `measured`, or
    `frames` where it follows from their length. `anchor_percent`: the mean BD-rate of the first anchor relative to this
    codec at equal SNR, over `recordings` of them; null where they cannot be compared.
    """
    reached = bits_to_reach(measurements, NEEDED_SNR_DB)
    pairs = [(SNR, codec, measurements.anchor) for codec in reached]
    compared = pair_bd_rates(measurements, pairs).group_by("anchor").agg(pl.mean("percent"), pl.len())
    percents = {codec: (percent, count) for codec, percent, count in compared.rows()}
    delays = measurements.drawn.group_by("codec").agg(pl.min("delay_ms").alias("low"), pl.max("delay_ms").alias("high"))
    measured_ms = {codec: (low, high) for codec, low, high in delays.rows()}
    rate_hz = measurements.rate_hz
    found = []
    for codec, bits in reached.items():
        peer, owner, delay_ms = named(codec), measured_codecs().get(measurements.owner(codec)), measured_ms[codec]
        software = peer.software or (owner.summary if owner else "")
        delay_from = "" if delay_ms[0] is None else "measured"
        if not delay_from and rate_hz and peer.delay_samples:
            delay_from, delay_ms = "frames", (1000 * peer.delay_samples / rate_hz,) * 2
        bits_per_second = bits * rate_hz if rate_hz else None
        about = (codec, peer.name, measurements.source(codec), software)
        found.append((*about, bits, bits_per_second, *delay_ms, delay_from, *percents.get(codec, (None, None))))
    return _table(
        found,
        "codec:text name:text source:text software:text bits_per_sample bits_per_second delay_low_ms delay_high_ms "
        "delay_from:text anchor_percent recordings:whole",
    )


def recommendations(measurements: Measurements) -> pl.DataFrame:
    """Return the measured codec that serves each need best; among equals the one with fewer bits.

    Columns: `need`, `codec`, `bits_per_sample`, TIMES, `delay_ms`, `flash_bytes`.
    """
    measured = [codec for codec in measurements.curves if measurements.source(codec) != IMPORTED]

    def costs(rates: Mapping[str, float]) -> pl.DataFrame:
        table = _costs_at(measurements, {codec: rate for codec, rate in rates.items() if codec in measured})
        return table.with_columns(bits_per_sample="rate")

    enough = costs(bits_to_reach(measurements, NEEDED_SNR_DB))
    copies = costs(bits_to_reach(measurements, COPY_SNR_DB))
    snr = f"{NEEDED_SNR_DB:g} dB SNR or more"
    needs = [(f"the fewest bits at {snr}", enough, "rate")]
    for factor in NEAR_FEWEST:
        near = enough.filter(pl.col("rate") <= factor * pl.col("rate").min())
        with_few = f"at {snr}, with at most {factor:g} times the fewest bits"
        needs += [(f"the fastest {name.partition('_')[0]}r {with_few}", near, name) for name in reversed(TIMES)]
    needs.append((f"the shortest delay at {snr}", enough, "delay_ms"))
    needs.append((f"the smallest decoder and model, of those counted, at {snr}", enough, "flash_bytes"))
    for scale in (SPQI, ST_SIM_2800):
        means = means_at(measurements, scale, RATES[0])
        at_rate = costs(dict.fromkeys(means, RATES[0]))
        loss = pl.col("codec").replace_strict(means, default=None, return_dtype=pl.Float64)
        needs.append((f"the best {scale.label} at {RATES[0]:g} bit/sample", at_rate.with_columns(loss=-loss), "loss"))
    needs.append((f"a copy, of {COPY_SNR_DB:g} dB SNR or more, in the fewest bits", copies, "rate"))
    kept = ["need", "codec", "bits_per_sample", *TIMES, "delay_ms", "flash_bytes"]
    chosen = [
        table.drop_nulls(by).sort(by, "rate", "codec").head(1).with_columns(need=pl.lit(need))
        for need, table, by in needs
    ]
    return pl.concat(each.select(kept) for each in chosen)


def _with_real_time(table: pl.DataFrame) -> pl.DataFrame:
    """Add the seconds of encoding and decoding for each second of one channel; null without a rate."""
    # Not by polars: it divides by a constant with another last digit.
    factors = [
        (sum(times) * rate_hz / 1e6 if rate_hz else None) for *times, rate_hz in table.select(*TIMES, "rate_hz").rows()
    ]
    return table.with_columns(real_time_factor=pl.Series(factors, dtype=pl.Float64))


def _table(found: Iterable[Sequence[object]], names: str) -> pl.DataFrame:
    """Return rows as a table. `names`: of its columns, each with one of _COLUMN_TYPES behind a colon."""
    parts = (name.partition(":") for name in names.split())
    return pl.DataFrame(list(found), {name: _COLUMN_TYPES[kind] for name, _, kind in parts}, orient="row")
