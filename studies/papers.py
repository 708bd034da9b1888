"""Lists what the two papers claim, and what happened here: `python -m studies.papers FOLDER --out docs/benchmarks`."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy import signal

from studies import page, pvc_slp, texture_paper
from studies.pvc_slp import Sensitivity
from studies.texture_paper import PUBLISHED, SIXTEEN_BITS, Result
from vibrocast import codec
from vibrocast.codec.encoding import encode_profile, profile_recording
from vibrocast.codec.stream import Stream
from vibrocast.evaluation import cells, charts, trained
from vibrocast.evaluation.bd_rate import PSNR, SPQI, ST_SIM_2800
from vibrocast.evaluation.comparison import (
    AUTOENCODER,
    PAPER_SCALES,
    REFERENCE,
    TABLES,
    Measurements,
    bd_regions,
    mean_bd_rates,
    pair_bd_rates,
)
from vibrocast.evaluation.points import MEASURED, Point, Row, read_rows
from vibrocast.evaluation.results_page import NOTE, HeldOut, read_held_out
from vibrocast.evaluation.speed import RATES, RATIO, Speed
from vibrocast.evaluation.tables import as_rows, frame, grouped
from vibrocast.files import atomic_write
from vibrocast.host.cli.options import own_models_option
from vibrocast.output import profile as rendering
from vibrocast.output.actuator import PIEZO_STACK, followed_gain

EVA, DCT = "EVA", "DCT"
YES, NO, NOT_YET, MODEL, NOT_COMPARABLE = "yes", "no", "not yet", "in a model", "not comparable"
UNDECIDABLE = "not decidable"
ANCHORS = (REFERENCE, "mdct")
TOLERANCE = 1.0
"""Percentage points within which a figure counts as reproduced."""
ALMOST_ALL = 0.9
"""Of the recordings."""
LAMBDAS = 8
ABSTRACT_PERCENT = (10.0, 20.0)
LOUDER_LEVELS = {"wood": 8, "sandpaper": 10, "leather": 12}
"""Levels that the DCT paper's listeners found unexpectedly like the original; its authors suspect a raised energy."""
SENSED_NM = 400
PROFILE = Path(__file__).parents[1] / "examples" / "leather_profile.csv"
POSITION_S = 0.004
"""Between two positions of the hand."""
STROKE_MM, STROKE_S = 40.0, 0.8
"""Of the DCT paper's participants."""
WAVEFORM_RATIOS = (20.0, RATIO, 5.0)
WAVEFORM_SAMPLES = 200
HIGHEST_HZ = 400.0
"""Up to which the display of the DCT paper is without a resonance."""
OTHER_DATA = (
    "The authors' PVC-SLP was never measured, and readings of its description differ by more. Models were trained on "
    "fluid pressure of a robot finger, sounds of tools and generated textures. The paper trains and tests on parts of "
    "one set."
)
OTHER_MACHINE = "Other programs on another processor. The paper does not say how many cores worked."
OTHER_SURFACES = "Other surfaces: generated ones, alike in kind. The part on that paper explains each difference."
OTHER_THRESHOLD = "Other surfaces, and another detection threshold, which is from memory."
OTHER_SPLIT = "The set does not ship with this project, and the paper publishes no list of its split."
NO_PEOPLE = "No people took part. The last part shows what simulated observers answer."
BY_CHANCE = "The energy rises at every L. By chance a third of the stretches would peak here."
IN_A_MODEL = "Computed from the model of the actuator. No recording has been played on a real one."
PEOPLE_DECIDE = (
    ("the least L that listeners did not notice", "wood 14, sandpaper 14, leather 12"),
    ("the least L of log levels that listeners did not notice", "wood 14, sandpaper 12"),
    ("levels unexpectedly like the original", "wood 8, sandpaper 10, leather 12"),
    ("t and p of grades in 51 conditions, 10 listeners a texture", "Tables 2 to 4"),
    ("d' of two listeners, linear levels: wood 12, sandpaper 12, leather 10", "0.67 to 0.87"),
    ("d' of two listeners, cut: wood -4, sandpaper 0, leather 8 dB", "0.60 to 1.15"),
    ("the highest b0 that listeners did not notice", "wood -8 dB, sandpaper -4 dB, leather 4 dB"),
    ("listeners noticed a cut at b0 = 0 dB", "noticed"),
    ("quality is not monotone in L for listeners", "not monotone"),
)
"""Claims of the texture paper that only people can decide, and what it states."""


@dataclass(frozen=True)
class Claim:
    """One claim of a paper, EVA or DCT: what it states, and what was found here. `difference`: in percentage points.

    `reproduced`: YES, NO, NOT_YET, MODEL, NOT_COMPARABLE or UNDECIDABLE.
    """

    paper: str
    claim: str
    stated: str
    here: str
    difference: float | None
    reproduced: str
    why: str


@dataclass(frozen=True)
class WaveformSample:
    """One sample of a recording and of its decoded signal, in the recording's unit, at one of WAVEFORM_RATIOS."""

    trace: str
    codec: str
    source: str
    setting: str
    compression_ratio: float
    snr_db: float
    time_ms: float
    original: float
    decoded: float


def families(measurements: Measurements) -> list[str]:
    """Return the paper's models: families of the autoencoder with one model for each rate, the widest first."""
    several = {point.codec for point in measurements.points if "model=" in point.setting}
    widths = {cost.codec: cost.width or 0 for cost in measurements.costs if cost.coder == AUTOENCODER}
    return sorted(several & set(widths) & set(measurements.curves), key=lambda family: (-widths[family], family))


def bd_rates(measurements: Measurements, names: Sequence[str]) -> pl.DataFrame:
    """Return the mean BD-rates relative to ANCHORS at PAPER_SCALES and SPQI."""
    anchors = [anchor for anchor in ANCHORS if anchor in measurements.curves]
    pairs = [(scale, anchor, name) for anchor in anchors for name in names for scale in (*PAPER_SCALES, SPQI)]
    return mean_bd_rates(pair_bd_rates(measurements, pairs))


def eva_claims(measurements: Measurements) -> Iterator[Claim]:
    """Yield the claims of the EVA paper, held by the widest of its models that was measured.

    Its savings are relative to every reading of PVC-SLP in the measurements.
    """
    names = families(measurements)[:1]
    rows = list(pvc_slp.sensitivity(measurements, names))
    by_scale = {scale: [row for row in rows if row.quality == scale.field] for scale in PAPER_SCALES}
    for scale, percent in ((PSNR, -14.98), (ST_SIM_2800, -13.08)):
        found = {row.anchor: row.cubic_percent for row in by_scale[scale]}
        window = _range([row.percent for row in by_scale[scale]], "+.1f", " % in this project's window")
        yield _savings(f"BD-rate against PVC-SLP, {scale.name}", percent, found, window)
    found = {row.anchor: row.best_percent for row in by_scale[PSNR]}
    yield _savings("BD-rate of the best recording, PSNR", -38.7, found, "")
    of_psnr = by_scale[PSNR]
    won = _range([row.won for row in of_psnr], "d", f" of {of_psnr[0].traces}") if of_psnr else ""
    holds = _verdict([row.won / row.traces >= ALMOST_ALL for row in of_psnr])
    claim = "fewer bits than PVC-SLP at equal PSNR for almost all recordings"
    yield Claim(EVA, claim, "almost all", won, None, holds, OTHER_DATA)
    low, (first, *_, last) = _at_low_rates(rows), (band.label for band in pvc_slp.BANDS)
    here = (
        f"at {first} SNR fewer bits, and fewer than at {last}: against {sum(low)} of {len(low)} readings of PVC-SLP"
        if low
        else ""
    )
    stated = "especially at low rates"
    yield Claim(EVA, "saves bits especially at low rates", stated, here, None, _verdict(low), OTHER_DATA)
    models = {point.setting.partition("model=")[2] for point in measurements.points if point.codec in names}
    here, holds = f"{len(models)} models" if models else "", _verdict([len(models) == LAMBDAS] if models else [])
    why = "A model for each lambda."
    yield Claim(EVA, "one training for each lambda", f"{LAMBDAS} lambdas", here, None, holds, why)
    for what, eva_s, reference_s in (("encode", 24.99, 7.14), ("decode", 21.42, 3.57)):
        stated = f"{eva_s} s, PVC-SLP {reference_s} s: {eva_s / reference_s:.1f} times"
        reference = next((_spent(what, speed) for speed in _speeds(measurements, REFERENCE)), None)
        times = [
            f"{name} {_spent(what, speed):.3g} s{f' ({speed.runtime})' if speed.runtime else ''}"
            + (f", {_spent(what, speed) / reference:.2g} times" if name != REFERENCE and reference else "")
            for name in (REFERENCE, *names)
            for speed in _speeds(measurements, name)
        ]
        claim = f"time to {what} a million samples at compression ratio {RATIO:g}"
        holds = NOT_COMPARABLE if times and names else NOT_YET
        yield Claim(EVA, claim, stated, "; ".join(times), None, holds, OTHER_MACHINE)
    of_set = sum(trace.startswith("p1918") for trace in measurements.compared)
    here = f"{len(measurements.compared)} recordings, {of_set} of that set"
    claim = "56 test recordings of IEEE P1918.1.1, a fifth of them"
    yield Claim(EVA, claim, "280 recordings at 2800 Hz", here, None, NO, OTHER_SPLIT)


def dct_claims(rows: Sequence[Result]) -> Iterator[Claim]:
    """Yield the claims of the texture paper, with the results of texture_paper.csv and the actuator."""
    yield from _compression_claims(rows)
    for claim, stated in PEOPLE_DECIDE:
        yield Claim(DCT, claim, stated, "", None, NOT_YET, NO_PEOPLE)
    yield from _display_claims()


def _compression_claims(rows: Sequence[Result]) -> Iterator[Claim]:
    """Yield the claims that coding alone decides."""
    ratios = {row.levels: row.paper_percent for row in rows if row.quantiser == "linear" and row.b0_db is None}
    worst = max((abs(ratio - 100 * math.log2(levels) / 16) for levels, ratio in ratios.items()), default=None)
    here = ", ".join(f"{ratios[levels]:.1f} % at L = {levels}" for levels in (14, 4) if levels in ratios)
    stated, why = "23.8 % at L = 14 to 12.5 % at L = 4", "It is arithmetic: bits of a level, no file."
    holds = _verdict([] if worst is None else [worst < TOLERANCE])
    yield Claim(DCT, "compression ratio log2(L) / 16", stated, here, worst, holds, why)
    linear = {(row.surface, row.levels, row.b0_db): row for row in rows if row.quantiser == "linear"}
    small = []
    for surface, published in PUBLISHED.items():
        coded, cut = linear.get((surface, published.levels, None)), linear.get((surface, SIXTEEN_BITS, published.b0_db))
        ratio = None if coded is None else coded.huffman_percent
        small += [] if ratio is None else [ratio]
        claim = f"{surface}: ratio with Huffman codes, L = {published.levels}"
        yield _percent(claim, published.huffman_percent, ratio, ", tables not counted", OTHER_SURFACES)
        claim = f"{surface}: zeros by the cut, b0 = {published.b0_db:g} dB"
        yield _percent(claim, published.zeros_percent, None if cut is None else cut.zeros_percent, "", OTHER_THRESHOLD)
    lowest, highest = ABSTRACT_PERCENT
    within = [all(lowest - TOLERANCE <= percent <= highest + TOLERANCE for percent in small)] if small else []
    claim = "size with Huffman codes, at the least L that listeners did not notice"
    here, stated = _range(small, ".1f", " %") if small else "", f"{lowest:g} to {highest:g} %"
    yield Claim(DCT, claim, stated, here, None, _verdict(within), "All surfaces, tables not counted.")
    at_threshold = linear.get(("sandpaper", SIXTEEN_BITS, 0.0))
    claim = "sandpaper: zeros by the cut, b0 = 0 dB (Fig. 6)"
    yield _percent(claim, 45.0, None if at_threshold is None else at_threshold.zeros_percent, "", OTHER_THRESHOLD)
    for surface, (mean_db, peaks, stretches) in louder().items():
        levels = LOUDER_LEVELS[surface]
        claim = f"{surface}: L = {levels} raises the energy, and so seems like the original (section 6.3)"
        here = f"{mean_db:+.2f} dB; more than at both neighbours in {peaks} of {stretches} stretches"
        yield Claim(DCT, claim, "suspected", here, None, YES if 2 * peaks > stretches else NO, BY_CHANCE)


def _display_claims() -> Iterator[Claim]:
    """Yield the claims about the display, held by the model of its actuator."""
    corner_db, falls, deviation_db = display()
    rate_khz = PIEZO_STACK.dac_rate_hz / 1000
    driven = f"{rate_khz:g} kHz; within {deviation_db:.2f} dB up to {HIGHEST_HZ:g} Hz, with the hold"
    sensing = f"rounding the positions of a stroke so changes the heights by {sensed():.0f} dB"
    falling = "its gain falls throughout" if falls else "its gain rises"
    for claim, stated, here in (
        ("display: -3 dB at 270 Hz", "-3 dB", f"{corner_db:.2f} dB at 270 Hz"),
        ("display: no resonance up to 400 Hz", "none", falling),
        ("driven at 3.0 kHz through the inverse of its response", "3.0 kHz", driven),
        ("position sensed to 0.4 um", "0.4 um", sensing),
    ):
        yield Claim(DCT, claim, stated, here, None, MODEL, IN_A_MODEL)
    unloaded = "a finger does not load the display"
    yield Claim(DCT, unloaded, "some 800 N", "", None, NOT_YET, "The model has no finger.")


def louder() -> dict[str, tuple[float, int, int]]:
    """Return how LOUDER_LEVELS change the energy of a generated surface's coefficients, by surface.

    The mean over its stretches in dB; in how many it rises more than at the next finer and coarser of the paper's
    levels; and the number of stretches.
    """
    surfaces, found = texture_paper.generated_profiles(), {}
    for surface, levels in LOUDER_LEVELS.items():
        place = texture_paper.PAPER_LEVELS.index(levels)
        coded = [
            texture_paper.code(surfaces[surface], {"levels": each})
            for each in texture_paper.PAPER_LEVELS[place - 1 : place + 2]
        ]
        finer_db, at_db, coarser_db = (
            10 * np.log10(np.sum(each.coded_um**2, axis=1) / np.sum(each.original_um**2, axis=1)) for each in coded
        )
        peaks = (at_db > finer_db) & (at_db > coarser_db)
        found[surface] = float(np.mean(at_db)), int(np.sum(peaks)), len(peaks)
    return found


def sensed() -> float:
    """Return by how much the heights of a profile under a stroke change, in dB, if positions come in SENSED_NM."""
    stream = encode_profile(profile_recording(PROFILE), snr_db=20.0).stream
    time_s = np.arange(0, 2 * STROKE_S, POSITION_S)
    position_nm = 5e5 * STROKE_MM * (1 - np.cos(np.pi * time_s / STROKE_S))
    exact, rounded = (_heights(stream, time_s, step_nm * np.rint(position_nm / step_nm)) for step_nm in (1, SENSED_NM))
    return float(10 * np.log10(np.sum((rounded - exact) ** 2) / np.sum(exact**2)))


def _heights(stream: Stream, time_s: codec.Signal, position_nm: codec.Signal) -> codec.Signal:
    positions = [(round(1e6 * at_s), int(at_nm)) for at_s, at_nm in zip(time_s, position_nm, strict=True)]
    count = round(float(time_s[-1]) * PIEZO_STACK.dac_rate_hz)
    delay, integers = stream.delay_samples, stream.decode_integers()
    heights, _ = rendering.render(stream.header, integers, delay, positions, count, PIEZO_STACK)
    return heights.astype(np.float64)


def display() -> tuple[float, bool, float]:
    """Return what the model of the paper's display does.

    Its gain at 270 Hz in dB; whether its gain only falls up to HIGHEST_HZ; and the largest deviation of the compensated
    gain from 0 dB up to there, in dB. The last includes the DAC's hold.
    """
    frequency_hz = np.linspace(1.0, HIGHEST_HZ, 400)
    fine_hz = 1e6  # at a high rate the hold between samples has no effect
    _, response = signal.freqz(*PIEZO_STACK.response(fine_hz), np.append(frequency_hz, 270.0), fs=fine_hz)
    alone = 20 * np.log10(np.abs(response))
    driven = 20 * np.log10(followed_gain(frequency_hz, PIEZO_STACK))
    return float(alone[-1]), bool(np.all(np.diff(alone[:-1]) < 0)), float(np.max(np.abs(driven)))


def waveforms(folder: Path, measurements: Measurements, model_folders: Sequence[Path] = ()) -> Iterator[WaveformSample]:
    """Yield WAVEFORM_SAMPLES from the middle of a recording in a folder, coded by the codecs of `paper_pair`.

    The recording is the one whose BD-rate is the median, coded at the settings nearest to WAVEFORM_RATIOS. Raises
    InputError, also for a model that neither ships nor lies in a model folder, and OSError for the folder.
    """
    regions = bd_regions(measurements, PAPER_SCALES)
    trace = regions["trace"][0] if len(regions) else measurements.traces[0]
    recording = pvc_slp.load(folder, trace)
    samples, rate_hz = recording.samples, recording.rate_hz
    pair = measurements.paper_pair
    methods = {method.name: method for method in cells.methods(pair, models=trained.known_models(model_folders))}
    for method in (methods[name] for name in pair):
        ratios = {point.setting: point.compression_ratio for point in measurements.curves[method.name][trace]}
        rate_points = {method.text(rate_point): rate_point for rate_point in method.rate_points}
        for ratio in WAVEFORM_RATIOS:
            nearest = min(set(ratios) & set(rate_points), key=lambda text: abs(math.log2(ratios[text] / ratio)))
            decoded = rate_points[nearest].decode(rate_points[nearest].encode(recording))
            first = (len(samples) - WAVEFORM_SAMPLES) // 2
            for place in range(max(0, first), min(len(samples), first + WAVEFORM_SAMPLES)):
                yield WaveformSample(
                    trace,
                    method.name,
                    MEASURED,
                    nearest,
                    round(ratios[nearest], 2),
                    round(codec.snr_db(samples, decoded) or 0.0, 2),
                    round(1000 * (place - first) / rate_hz, 4),
                    round(float(samples[place, 0]), 6),
                    round(float(decoded[place, 0]), 6),
                )


def rendered(
    measurements: Measurements,
    claims: Sequence[Claim],
    rows: Sequence[Sensitivity],
    figure: charts.Chart,
) -> str:
    """Return the page; `rows`: of the families against each reading of PVC-SLP."""
    names = families(measurements)
    others = [name for name in ("mdct", *measurements.learned) if name in measurements.curves and name not in names]
    means = bd_rates(measurements, [*names, *others])
    rates = {(row.codec, row.anchor, row.quality): row for row in as_rows(means)}
    return page.render(
        "papers",
        globals(),
        claims={paper: [claim for claim in claims if claim.paper == paper] for paper in (EVA, DCT)},
        outcomes=(YES, NO, UNDECIDABLE, NOT_YET, MODEL, NOT_COMPARABLE),
        readings={name: text for name, text in pvc_slp.readings().items() if name in measurements.curves},
        sensitivity={(row.anchor, row.codec, row.quality, row.low): row for row in rows},
        bands=pvc_slp.BANDS,
        families=names,
        others=others,
        rates=rates,
        costs={name: measurements.cost(name) for name in (*names, *others)},
        speeds={name: _speeds(measurements, name) for name in (*names, *others)},
        pair=measurements.paper_pair,
        figure=figure,
        traces=len(measurements.compared),
    )


def note(held_out: Sequence[HeldOut]) -> str:
    """Return what the page of results says of its recordings, with the figures on those that no choice has seen."""
    peers = list(dict.fromkeys(row.peer for row in held_out))
    rows = grouped(held_out, lambda row: (row.codec, row.measure))
    return page.render("held_out", globals(), peers=peers, rows=rows)


def _percent(claim: str, stated: float, here: float | None, words: str, why: str) -> Claim:
    """Return a claim of a percentage of the texture paper."""
    if here is None:
        return Claim(DCT, claim, f"{stated:.1f} %", "", None, NOT_YET, "Not measured.")
    holds = _verdict([abs(here - stated) <= TOLERANCE])
    return Claim(DCT, claim, f"{stated:.1f} %", f"{here:.1f} %{words}", round(here - stated, 1), holds, why)


def _savings(claim: str, stated: float, found: Mapping[str, float], words: str) -> Claim:
    """Return a claim of savings, found relative to each reading of PVC-SLP."""
    stated_text = f"{stated:+.2f} %"
    if not found:
        return Claim(EVA, claim, stated_text, "", None, NOT_YET, "Not measured.")
    text = f"{_range(list(found.values()), '+.1f', ' %')} by the paper's method{f'; {words}' if words else ''}"
    verdict = _verdict([percent <= stated + TOLERANCE for percent in found.values()])
    if verdict == NO and min(found.values()) < 0 < max(found.values()):
        verdict = UNDECIDABLE
    difference = round(found[REFERENCE] - stated, 1) if len(found) == 1 else None
    return Claim(EVA, claim, stated_text, text, difference, verdict, OTHER_DATA)


def _verdict(holds: Sequence[bool]) -> str:
    """Return the verdict on a claim that holds, or not, relative to each reading of PVC-SLP."""
    return NOT_YET if not holds else YES if all(holds) else UNDECIDABLE if any(holds) else NO


def _range(values: Sequence[float], form: str, unit: str) -> str:
    low, high = (f"{value:{form}}" for value in (min(values, default=0.0), max(values, default=0.0)))
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"


def _at_low_rates(rows: Sequence[Sensitivity]) -> list[bool]:
    """Return, for each reading, whether a codec saves bits in the lowest band, and more than in the highest."""
    lowest, highest = (
        {row.anchor: row for row in rows if row.low == band.low} for band in (pvc_slp.BANDS[0], pvc_slp.BANDS[-1])
    )
    return [low.percent < min(0.0, highest[anchor].percent) for anchor, low in lowest.items() if anchor in highest]


def _spent(what: str, speed: Speed) -> float:
    return float(getattr(speed, f"{what}_s_per_megasample"))


def _speeds(measurements: Measurements, name: str) -> list[Speed]:
    return [speed for speed in measurements.speeds if (speed.codec, speed.rate) == (name, RATES[0])]


@page.study
@page.FOLDER
@own_models_option
def main(folder: Path, out: Path, model_folders: tuple[Path, ...]) -> None:
    """Write papers.md and results/note.md from the tables of a benchmark.

    The benchmark of FOLDER has written its tables into OUT/results. Tables of other scripts may be missing there.
    """
    results = out / "results"

    def of_others(name: str, kind: type[Row]) -> list[Row]:
        return read_rows(results / name, kind) if (results / name).exists() else []

    tables: dict[str, Any] = {name: read_rows(results / f"{name}.csv", kind) for name, kind in TABLES.items()}
    measurements = Measurements(**tables)
    points = list(pvc_slp.points(folder, measurements))
    measurements = pvc_slp.with_points(measurements, points)
    sensitivity = list(pvc_slp.sensitivity(measurements, families(measurements)))
    claims = [*eva_claims(measurements), *dct_claims(of_others("texture_paper.csv", Result))]
    samples = frame(waveforms(folder, measurements, model_folders), WaveformSample)
    title = f"Decoded over original, at compression ratios near {', '.join(map('{:g}'.format, WAVEFORM_RATIOS))}"
    figure = charts.Chart("waveforms", title, samples).write(results, charts.plot_waveforms)
    text = rendered(measurements, claims, sensitivity, figure)
    written = (
        (pvc_slp.POINTS, points, Point),
        (pvc_slp.TABLE, sensitivity, Sensitivity),
        ("claims.csv", claims, Claim),
    )
    page.publish(out, "papers", text, written)
    if held_out := read_held_out(results):
        with atomic_write(results / NOTE) as partial:  # a part of another page
            partial.write_text(note(held_out), encoding="utf-8")


if __name__ == "__main__":
    main()
