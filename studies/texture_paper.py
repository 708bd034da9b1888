"""Repeats the texture paper's figures, like for like: `python -m studies.texture_paper`."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct as fast_dct

from studies import page
from vibrocast import codec, textures
from vibrocast.codec import dct
from vibrocast.codec.core import UNIT
from vibrocast.codec.dct import code_lengths
from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.evaluation.charts import WIDTH_IN
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.evaluation.pictures import figure_file
from vibrocast.evaluation.tables import grouped
from vibrocast.textures import dataset
from vibrocast.textures.generate import rough_profile

PAPER_QUANTISERS = ("linear", "log")
QUANTISERS = (*PAPER_QUANTISERS, "log-nearest")
PAPER_LEVELS = (14, 12, 10, 8, 6, 5, 4)
LEVELS = range(4, 21)
B0_DB = (12.0, 8.0, 4.0, 0.0, -4.0, -8.0, -12.0, -16.0, -20.0)
HAND_SPEED_MM_S = 50.0
SPACING_UM = 0.5
"""The source paper's: N = 20 000 heights over D = 10 mm."""
RATE_HZ = round(1000 * HAND_SPEED_MM_S / SPACING_UM)
STRETCHES = 20
STRETCH_MM = 10.0
LENGTH_MM = STRETCHES * STRETCH_MM
SIXTEEN_BITS = 65_535
"""The levels of a coefficient that is only cut, not quantised."""
AMPLITUDES_UM = 1e-3, 30.0
"""Shown of a spectrum; a coefficient of zero is drawn at the lower one."""
PANEL_IN = 1.75
RECORDING_LEVELS = (6, 14, 28, 56, 112)
RECORDING_BLOCKS = ("128", "256", "512", "1024")
DEFAULT_BLOCK = "512"


@dataclass(frozen=True)
class Published:
    """The source paper's figures of one of its materials, at the coarsest setting that nobody noticed.

    `huffman_percent`: of 16 bits, tables not counted. `zeros_percent`: by the threshold cut at `b0_db`.
    """

    levels: int
    huffman_percent: float
    b0_db: float
    zeros_percent: float


PUBLISHED = {
    "wood": Published(14, 22.3, -8.0, 28.7),
    "sandpaper": Published(14, 17.5, -4.0, 33.7),
    "leather": Published(12, 12.1, 4.0, 53.7),
}
STRICTEST = "wood"
"""Surfaces that the paper does not have are coded at its settings for this one, which lose least."""


@dataclass(frozen=True)
class Result:
    """One surface at one setting. Percentages are of 16 bits for each coefficient that is coded.

    `b0_db` None: nothing is cut. `paper_percent`: log2 L / 16. `huffman_percent`: the values alone, by a Huffman code
    for each transform, its table not counted, as in the source paper. `file_percent`: the whole .vct file, Huffman
    coded. `zeros_percent`: coefficients that are coded as zero. `snr_db`: of the coefficients that are coded.
    """

    surface: str
    quantiser: str
    levels: int
    b0_db: float | None
    paper_percent: float
    huffman_percent: float
    file_percent: float
    zeros_percent: float
    snr_db: float


@dataclass(frozen=True)
class Line:
    """One line of a surface's spectrum, in um: what it was, and what each version has there."""

    surface: str
    frequency_hz: float
    threshold_um: float
    original_um: float
    linear_um: float
    log_um: float
    cut_um: float


@dataclass(frozen=True)
class Median:
    """Medians over recordings of acceleration, of .vct files: bits per sample by either entropy coder, and the SNR."""

    quantiser: str
    block: str
    levels: int
    huffman_bits: float
    range_bits: float
    snr_db: float


@dataclass(frozen=True)
class Coded:
    """Amplitudes in um, float64 (transforms, coefficients), before and after coding.

    `file_bits`: of the .vct file. `frequency_hz`: of each coefficient, k rate / (2 N) from k = 1 to 400 Hz.
    """

    original_um: codec.Signal
    coded_um: codec.Signal
    file_bits: int
    frequency_hz: NDArray[np.float64]


def paper_percent(levels: int) -> float:
    """Return the paper's compression ratio: log2(L) of 16 bits, in percent."""
    return 100 * math.log2(levels) / 16


def generated_profiles() -> dict[str, textures.Profile]:
    """Return surfaces like the paper's three materials, made here: their heights are not those of the paper."""
    last_mm = LENGTH_MM - SPACING_UM / 1000
    return {
        "wood": textures.surface_profile("wood", 0, LENGTH_MM / HAND_SPEED_MM_S, HAND_SPEED_MM_S, RATE_HZ),
        "sandpaper": rough_profile(3, last_mm, SPACING_UM, hurst=0.3, roll_off_mm=0.4, rms_um=6.0),
        "leather": rough_profile(5, last_mm, SPACING_UM, rms_um=6.0),
    }


def published(surface: str) -> Published:
    """Return the paper's settings for a surface, with its figures for one that it has."""
    return PUBLISHED.get(surface, PUBLISHED[STRICTEST])


def code(profile: textures.Profile, setting: codec.Setting, b0_db: float | None = None) -> Coded:
    """Code a profile as the paper does: transforms of 10 mm at 0.5 um, DC and all above 400 Hz dropped.

    Raises CodecError or TextureError.
    """
    recording = textures.resample(profile.recording(HAND_SPEED_MM_S), RATE_HZ)
    whole: codec.Setting = {**setting, "block": "whole", "dc": "drop"}
    if b0_db is not None:
        whole = {**whole, "threshold": "on", "b0_db": b0_db}
    coded = codec.encode(recording.samples, RATE_HZ, whole, codec="dct", unit="um")
    decoder = dct.WholeDecoder(coded.header.configuration, 1)
    samples = decoder.packet_samples
    coded_um = np.array([decoder.coefficients(packet)[0] for packet in coded.packets]) * (coded.header.gains[0] / UNIT)
    padded = np.pad(recording.samples[:, 0], (0, -len(recording.samples) % samples)).reshape(-1, samples)
    original_um = fast_dct(padded, axis=1, norm="ortho")[:, 1 : coded_um.shape[1] + 1] * math.sqrt(2 / samples)
    frequency_hz = np.arange(1, coded_um.shape[1] + 1) * RATE_HZ / (2 * samples)
    return Coded(original_um, coded_um, 8 * coded.size_bytes, frequency_hz)


def measure(surface: str, coded: Coded, setting: codec.Setting, b0_db: float | None = None) -> Result:
    """Return the figures of a coded surface."""
    levels = int(str(setting["levels"]))
    bits_of_all = 16 * coded.coded_um.size
    return Result(
        surface=surface,
        quantiser=str(setting.get("quantiser", "linear")),
        levels=levels,
        b0_db=b0_db,
        paper_percent=paper_percent(levels),
        huffman_percent=100 * sum(map(huffman_bits, coded.coded_um)) / bits_of_all,
        file_percent=100 * coded.file_bits / bits_of_all,
        zeros_percent=100 * float(np.mean(coded.coded_um == 0)),
        snr_db=codec.snr_db(coded.original_um.reshape(-1, 1), coded.coded_um.reshape(-1, 1)) or 0.0,
    )


def huffman_bits(values: codec.Signal) -> int:
    """Return the bits of values by the Huffman code of their own counts, its table not counted; one each at least."""
    counts = np.unique(values, return_counts=True)[1].tolist()
    return sum(map(int.__mul__, counts, code_lengths(counts))) if len(counts) > 1 else len(values)


def measure_all(profiles: Mapping[str, textures.Profile]) -> list[Result]:
    """Measure every profile: each count of levels, and each threshold cut alone."""
    settings: list[tuple[codec.Setting, float | None]] = [({"levels": SIXTEEN_BITS}, b0_db) for b0_db in B0_DB]
    settings[:0] = [
        ({"quantiser": quantiser, "levels": levels}, None) for quantiser, levels in product(QUANTISERS, LEVELS)
    ]
    return [measure(name, code(profiles[name], *each), *each) for name, each in product(profiles, settings)]


def spectra(profiles: Mapping[str, textures.Profile]) -> list[Line]:
    """Return the spectra of the first transform of every profile, at the paper's settings."""
    lines = []
    for name, profile in profiles.items():
        at = published(name)
        linear = code(profile, {"quantiser": "linear", "levels": at.levels})
        log = code(profile, {"quantiser": "log", "levels": at.levels})
        cut = code(profile, {"levels": SIXTEEN_BITS}, at.b0_db)
        threshold_um = threshold_amplitude(read_threshold(), linear.frequency_hz, "um")
        versions_um = [linear.original_um[0], *(each.coded_um[0] for each in (linear, log, cut))]
        columns = zip(linear.frequency_hz, threshold_um, *versions_um, strict=True)
        lines += [Line(name, *map(float, row)) for row in columns]
    return lines


def medians(recordings: Sequence[textures.Recording]) -> list[Median]:
    """Return the figures of recordings: of each quantiser at several levels, and of linear levels in other blocks."""
    trials = [*product(QUANTISERS, (DEFAULT_BLOCK,), RECORDING_LEVELS)]
    trials += [("linear", block, 14) for block in RECORDING_BLOCKS if block != DEFAULT_BLOCK]
    return [Median(*trial, *_medians(recordings, *trial)) for trial in trials]


def _medians(recordings: Sequence[textures.Recording], quantiser: str, block: str, levels: int) -> Iterator[float]:
    """Yield the medians at one setting, in the order of `Median`."""
    setting: codec.Setting = {"quantiser": quantiser, "block": block, "levels": levels}
    by_huffman, by_range = (
        [
            codec.encode(each.samples, round(each.rate_hz), {**setting, "entropy": entropy}, codec="dct", unit="m/s^2")
            for each in recordings
        ]
        for entropy in ("huffman", "range")
    )
    for streams in (by_huffman, by_range):
        yield float(np.median([stream.bits_per_second / stream.header.rate_hz for stream in streams]))
    decoded = zip(recordings, by_huffman, strict=True)
    yield float(np.median([codec.snr_db(each.samples, stream.decode()) or 0.0 for each, stream in decoded]))


def falls(results: Iterable[Result]) -> dict[int, float]:
    """Return the counts of levels at which the SNR is lower than with one level less, and by how many dB."""
    ordered = sorted(results, key=lambda result: result.levels)
    return {
        after.levels: before.snr_db - after.snr_db
        for before, after in pairwise(ordered)
        if after.snr_db < before.snr_db
    }


def b0_of_share(results: Sequence[Result], zeros_percent: float) -> float:
    """Return the b0 at which a threshold cut would leave this share of zeros, between those measured."""
    rising = np.array(sorted((result.zeros_percent, result.b0_db or 0.0) for result in results))
    return float(np.interp(zeros_percent, rising[:, 0], rising[:, 1]))


def markdown(results: Sequence[Result], recordings: Sequence[Median]) -> str:
    """Return the page; without `recordings` it says nothing of them."""
    names = list(dict.fromkeys(result.surface for result in results))
    materials = [name for name in names if name in PUBLISHED]
    uncut = {(row.surface, row.quantiser, row.levels): row for row in results if row.b0_db is None}
    cuts = {name: [row for row in results if row.surface == name and row.b0_db is not None] for name in names}
    falling = {curve: falls(_curve(results, *curve)) for curve in product(names, PAPER_QUANTISERS)}
    return page.render(
        "texture_paper",
        globals(),
        surfaces=names,
        materials=materials,
        published=published,
        paper={levels: paper_percent(levels) for levels in PAPER_LEVELS},
        uncut=uncut,
        cut={(name, row.b0_db): row for name, rows in cuts.items() for row in rows},
        gains_db=[uncut[name, "log-nearest", 6].snr_db - uncut[name, "log", 6].snr_db for name in materials],
        medians={(row.quantiser, row.block, row.levels): row for row in recordings},
        falling=falling,
        rises=not any(falling[name, "linear"] for name in materials),
        b0_of_share={name: b0_of_share(cuts[name], PUBLISHED[name].zeros_percent) for name in materials},
    )


def draw_levels(path: Path, results: Sequence[Result]) -> None:
    """Draw SNR over the number of levels: a row for generated and one for measured surfaces; ringed where it falls."""
    names = list(dict.fromkeys(result.surface for result in results))
    panels = []
    for generated, quantiser in product((True, False), PAPER_QUANTISERS):
        drawn = []
        for name in names:
            if (name in PUBLISHED) == generated:
                rows = _curve(results, name, quantiser)
                ringed = [row.levels in falls(rows) for row in rows]
                drawn.append(Curve(name, [row.levels for row in rows], [row.snr_db for row in rows], ringed))
        if drawn:
            title = f"{quantiser} levels, {'generated' if generated else 'measured'} surfaces"
            panels.append(Panel(title, "number of levels L", "SNR, dB", drawn))
    curves(path, panels)


def draw_spectra(path: Path, lines: Sequence[Line]) -> None:
    """Draw a row of panels for each surface: its spectrum, and that of each version, with the threshold."""
    surfaces = grouped(lines, lambda line: line.surface)
    with figure_file(path, WIDTH_IN, 0.4 + PANEL_IN * len(surfaces)) as figure:
        grid = figure.subplots(len(surfaces), 4, squeeze=False, sharex=True, sharey=True)
        for row, (name, own) in zip(grid, surfaces.items(), strict=True):
            at = published(name)
            for axes, version, title, b0_db in (
                (row[0], "original_um", f"{name}\noriginal", 0.0),
                (row[1], "linear_um", f"{at.levels} linear levels", 0.0),
                (row[2], "log_um", f"{at.levels} log levels", 0.0),
                (row[3], "cut_um", f"cut at {at.b0_db:+g} dB", at.b0_db),
            ):
                frequency_hz = [line.frequency_hz for line in own]
                threshold_um = [line.threshold_um * 10 ** (b0_db / 20) for line in own]
                magnitudes_um = np.clip([abs(getattr(line, version)) for line in own], *AMPLITUDES_UM)
                axes.plot(frequency_hz, threshold_um, color="#d55e00", linestyle="--", linewidth=1)
                axes.plot(frequency_hz, magnitudes_um, ".", color="#0072b2", markersize=2.5, clip_on=False)
                axes.set_yscale("log")
                axes.set_ylim(*AMPLITUDES_UM)
                axes.set_title(title, loc="left")
            row[0].set_ylabel("amplitude, um")
        for axes in grid[-1]:
            axes.set_xlabel("frequency, Hz")


def _curve(results: Iterable[Result], surface: str, quantiser: str) -> list[Result]:
    """Return the results of a surface over the number of levels."""
    return [row for row in results if (row.surface, row.quantiser, row.b0_db) == (surface, quantiser, None)]


@page.study
@click.option("--profiles", type=page.EXISTING, help="Add measured height profiles, the CSV files of this folder.")
@click.option("--recordings", type=page.EXISTING, help="Code these recordings of acceleration, too.")
def main(out: Path, profiles: Path | None, recordings: Path | None) -> None:
    """Compare the texture paper's figures with those of the codec dct, coded as in the paper."""
    measured = {path.stem: textures.load_profile(path) for path in sorted(profiles.glob("*.csv"))} if profiles else {}
    surfaces = {**generated_profiles(), **measured}
    results, lines = measure_all(surfaces), spectra(surfaces)
    tables: list[tuple[str, Sequence[Any], type[Any]]] = [
        ("texture_paper.csv", results, Result),
        ("texture_paper_spectra.csv", lines, Line),
    ]
    of_recordings: list[Median] = []
    if recordings:
        of_recordings = medians([dataset.load(entry) for entry in dataset.entries(recordings)])
        tables.append(("texture_paper_recordings.csv", of_recordings, Median))
    folder = page.results_folder(out)
    draw_levels(folder / "texture_paper.png", results)
    draw_spectra(folder / "texture_paper_spectra.png", lines)
    rounded = [(file, [page.rounded(row, ".4f") for row in rows], kind) for file, rows, kind in tables]
    page.publish(out, "papers", markdown(results, of_recordings), rounded)


if __name__ == "__main__":
    main()
