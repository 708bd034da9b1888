"""Compares the texture paper's ratios with real bytes: `python -m studies.texture_paper`."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.fft import dct

from studies.page import OUT, errors_in_one_line, render, write_rows
from studies.page import write as write_page
from vibrocast import codec, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.stream import as_stream
from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.evaluation.stability.pictures import Curve, Panel, curves
from vibrocast.textures.generate import rough_profile

QUANTISERS = ("linear", "log")
PAPER_LEVELS = (14, 12, 10, 8, 6, 5, 4)
LEVELS = range(4, 21)
B0_DB = (12.0, 8.0, 4.0, 0.0, -4.0, -8.0, -12.0)
HAND_SPEED_MM_S = 50.0
SECONDS = 4.0
LENGTH_MM = HAND_SPEED_MM_S * SECONDS
SIXTEEN_BITS = 65_535
"""The levels of a coefficient that is only cut, not quantised."""


@dataclass(frozen=True)
class Result:
    """One profile at one setting. Percentages are of 16 bits for each coefficient that is kept below the limit.

    `paper_percent`: log2 L / 16. `huffman_percent`, `range_percent`: the whole file, tables and headers included.
    `zeros_percent`: coefficients that the threshold cuts; `b0_db` None: none is.
    """

    texture: str
    quantiser: str
    levels: int
    b0_db: float | None
    paper_percent: float
    huffman_percent: float
    range_percent: float
    huffman_bits_per_sample: float
    range_bits_per_sample: float
    snr_db: float
    zeros_percent: float


def paper_percent(levels: int) -> float:
    """Return the paper's compression ratio: log2(L) of 16 bits, in percent."""
    return 100 * math.log2(levels) / 16


def generated_profiles() -> dict[str, textures.Profile]:
    """Return surfaces like the paper's three materials, made here: their heights are not those of the paper."""
    return {
        "wood": textures.surface_profile("wood", 0, SECONDS, HAND_SPEED_MM_S),
        "sandpaper": rough_profile(3, LENGTH_MM, spacing_um=4.0, hurst=0.3, roll_off_mm=0.4, rms_um=6.0),
        "leather": rough_profile(5, LENGTH_MM, spacing_um=4.0, rms_um=6.0),
    }


def measure(name: str, profile: textures.Profile, setting: codec.Setting, b0_db: float | None = None) -> Result:
    """Code a profile at the paper's hand speed, means of blocks dropped as there. Raises CodecError or TextureError."""
    recording = textures.resample(profile.recording(HAND_SPEED_MM_S), DEFAULT_STREAM_RATE_HZ)
    whole: codec.Setting = {**setting, "dc": "drop"}
    if b0_db is not None:
        whole = {**whole, "threshold": "on", "b0_db": b0_db}
    streams = []
    for entropy in ("huffman", "range"):
        coded = codec.encode(
            recording.samples, DEFAULT_STREAM_RATE_HZ, {**whole, "entropy": entropy}, codec="dct", unit="um"
        )
        streams.append(as_stream(coded, "um"))
    kept, decoded = (_kept_coefficients(samples) for samples in (recording.samples, streams[0].decode()))
    bits = [8 * stream.size_bytes for stream in streams]
    samples = len(recording.samples)
    levels = int(str(setting["levels"]))
    return Result(
        texture=name,
        quantiser=str(setting.get("quantiser", "linear")),
        levels=levels,
        b0_db=b0_db,
        paper_percent=paper_percent(levels),
        huffman_percent=100 * bits[0] / (16 * kept.size),
        range_percent=100 * bits[1] / (16 * kept.size),
        huffman_bits_per_sample=bits[0] / samples,
        range_bits_per_sample=bits[1] / samples,
        snr_db=codec.snr_db(kept.reshape(-1, 1), decoded.reshape(-1, 1)) or 0.0,
        zeros_percent=0.0 if b0_db is None else 100 * _cut_part(kept, b0_db),
    )


def measure_all(profiles: Mapping[str, textures.Profile]) -> list[Result]:
    """Measure every profile: each count of levels, each threshold cut alone, and both together at 14 levels."""
    results = []
    for name, profile in profiles.items():
        for quantiser, levels in itertools.product(QUANTISERS, LEVELS):
            results.append(measure(name, profile, {"quantiser": quantiser, "levels": levels}))
        for levels, b0_db in itertools.product((SIXTEEN_BITS, 14), B0_DB):
            results.append(measure(name, profile, {"levels": levels}, b0_db))
    return results


def falls(results: Iterable[Result]) -> list[int]:
    """Return the counts of levels at which the SNR is lower than with one level less."""
    ordered = sorted(results, key=lambda result: result.levels)
    return [after.levels for before, after in itertools.pairwise(ordered) if after.snr_db < before.snr_db]


def markdown(results: Sequence[Result]) -> str:
    """Return the page."""
    names = list(dict.fromkeys(result.texture for result in results))
    uncut = {(row.texture, row.quantiser, row.levels): row for row in results if row.b0_db is None}
    curves = {
        (name, quantiser): [row for key, row in uncut.items() if key[:2] == (name, quantiser)]
        for name, quantiser in itertools.product(names, QUANTISERS)
    }
    return render(
        "texture_paper",
        hand_speed_mm_s=HAND_SPEED_MM_S,
        rate_hz=DEFAULT_STREAM_RATE_HZ,
        textures=names,
        quantisers=QUANTISERS,
        paper={levels: paper_percent(levels) for levels in PAPER_LEVELS},
        uncut=uncut,
        max_levels=max(LEVELS),
        falls={key: falls(curve) for key, curve in curves.items()},
        cuts_db=B0_DB,
        sixteen_bits=SIXTEEN_BITS,
        cut={(row.texture, row.levels, row.b0_db): row for row in results if row.b0_db is not None},
    )


def draw(path: Path, results: Sequence[Result]) -> None:
    """Draw SNR over the number of levels, a panel for each quantiser; ringed where the paper has one."""
    names = list(dict.fromkeys(result.texture for result in results))
    panels = []
    for quantiser in QUANTISERS:
        drawn = []
        for name in names:
            curve = [row for row in results if (row.texture, row.quantiser, row.b0_db) == (name, quantiser, None)]
            levels = [row.levels for row in curve]
            ringed = [count in PAPER_LEVELS for count in levels]
            drawn.append(Curve(name, levels, [row.snr_db for row in curve], ringed))
        panels.append(Panel(f"{quantiser} levels", "number of levels L", "SNR, dB", drawn))
    curves(path, panels)


def write(out: Path, results: Sequence[Result]) -> None:
    """Write texture_paper.md, .csv and .png into a folder that there is. Raises OSError."""
    rounded = [Result(*map(_rounded, astuple(result))) for result in results]
    write_page(out / "texture_paper.md", markdown(results))
    write_rows(out / "texture_paper.csv", rounded, Result)
    draw(out / "texture_paper.png", results)


def _kept_coefficients(heights_um: codec.Signal) -> codec.Signal:
    """Return the amplitudes in um that the codec keeps: (blocks, indices 1 to 146, k rate / (2 N) up to 400 Hz)."""
    padded = np.pad(heights_um[:, 0], (0, -len(heights_um) % 512)).reshape(-1, 512)
    return np.asarray(dct(padded, axis=1, norm="ortho")[:, 1:147] * math.sqrt(2 / 512))


def _cut_part(amplitudes_um: codec.Signal, b0_db: float) -> float:
    frequency_hz = np.arange(1, 147) * DEFAULT_STREAM_RATE_HZ / (2 * 512)
    threshold = threshold_amplitude(read_threshold(), frequency_hz, "um") * 10 ** (b0_db / 20)
    return float(np.mean(np.abs(amplitudes_um) < threshold))


def _rounded(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value


@click.command()
@OUT
@click.option(
    "--profiles",
    "folder",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of height profiles as CSV files, measured beside those made here.",
)
def main(out: Path, folder: Path | None) -> None:
    """Write the arithmetic of the paper on material-like textures beside the real bytes of the codec dct."""
    with errors_in_one_line():
        out.mkdir(parents=True, exist_ok=True)
        profiles = generated_profiles()
        for path in sorted(folder.glob("*.csv")) if folder else ():
            profiles[path.stem] = textures.load_profile(path)
        write(out, measure_all(profiles))
    click.echo(f"{out / 'texture_paper.md'}: {len(profiles)} profiles")


if __name__ == "__main__":
    main()
