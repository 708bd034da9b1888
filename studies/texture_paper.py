"""Compares the texture paper's ratios with real bytes: `python -m studies.texture_paper`."""

import csv
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.fft import dct

from vibrocast import codec, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.stream import as_stream
from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.textures.generate import rough_profile

PAPER_LEVELS = (14, 12, 10, 8, 6, 5, 4)
LEVELS = range(4, 21)
B0_DB = (12.0, 8.0, 4.0, 0.0, -4.0, -8.0, -12.0)
HAND_SPEED_MM_S = 50.0
SECONDS = 4.0
LABEL_DB = 1.2  # height of a curve's name in the chart
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
        for quantiser, levels in itertools.product(("linear", "log"), LEVELS):
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
    uncut = [result for result in results if result.b0_db is None]
    lines = [
        "# Material-like textures: the paper's arithmetic and real bytes",
        "",
        f"Written by `python -m studies.texture_paper`. Height profiles swept at {HAND_SPEED_MM_S:g} mm/s, coded by",
        f"`dct` at {DEFAULT_STREAM_RATE_HZ} Hz in blocks of 512 (9.1 mm), DC and all above 400 Hz dropped. Wood,",
        "sandpaper and leather are generated surfaces, alike in kind only to those of the paper. Percentages are of 16",
        "bits for each coefficient that is kept; the columns of real bytes count the whole `.vct` file: header, packet",
        "heads, ranges, Huffman tables. SNR is that of the coefficients that are kept.",
        "",
        "The paper, of its own profiles: with Huffman, tables not counted, wood 22.3 %, sandpaper 17.5 %, leather",
        "12.1 %; zeros by threshold cut 28.7, 33.7 and 53.7 %. Its listeners did not notice L >= 14 (wood, sandpaper)",
        "or 12 (leather), nor b0 <= -8 (wood), -4 (sandpaper) or 4 dB (leather).",
    ]
    for quantiser in ("linear", "log"):
        cells = {(row.texture, row.levels): row for row in uncut if row.quantiser == quantiser}
        header = ["L", "log2(L) / 16", *(f"{name}: Huffman, range, SNR" for name in names)]
        rows = [
            [str(levels), f"{paper_percent(levels):.1f} %", *(_cell(cells[name, levels]) for name in names)]
            for levels in PAPER_LEVELS
        ]
        lines += ["", f"## {quantiser.capitalize()} levels", "", *_table(header, rows)]
    lines += [
        "",
        "## Quality is not monotone in L",
        "",
        f"Counts of levels from 5 to {max(LEVELS)} at which SNR is lower than with one level less:",
        "",
    ]
    for name, quantiser in itertools.product(names, ("linear", "log")):
        lower = falls(row for row in uncut if (row.texture, row.quantiser) == (name, quantiser))
        lines.append(f"- {name}, {quantiser}: {', '.join(map(str, lower)) or 'none'}")
    lines += [
        "",
        "Linear levels run from the least coefficient to the greatest: as their count changes, the level nearest zero,",
        "which most coefficients take, moves towards zero and away from it. Where it is not zero they all share its",
        "error, which adds up at the first sample of every block.",
        "",
        "![SNR over the number of levels](texture_paper.png)",
        "",
        "## Threshold cut",
        "",
        "b0 is relative to the detection threshold (`codec/data/detection_threshold.csv`, unverified). Off by default:",
        "the paper's listeners noticed a cut at 0 dB. Zeros are the part of kept coefficients that is cut.",
    ]
    for levels, title in ((SIXTEEN_BITS, "alone, 16 bits a coefficient"), (14, "with 14 linear levels")):
        cells_of_cut = {
            (row.texture, row.b0_db): row for row in results if row.levels == levels and row.b0_db is not None
        }
        header = ["b0", *(f"{name}: zeros, Huffman, range, SNR" for name in names)]
        rows = [
            [
                f"{b0_db:g} dB",
                *(
                    f"{cells_of_cut[name, b0_db].zeros_percent:.1f} %, {_cell(cells_of_cut[name, b0_db])}"
                    for name in names
                ),
            ]
            for b0_db in B0_DB
        ]
        lines += ["", f"Threshold cut {title}:", "", *_table(header, rows)]
    return "\n".join([*lines, ""])


def draw(path: Path, results: Sequence[Result]) -> None:
    """Draw SNR over the number of levels, a panel for each quantiser; large marks where the paper has one."""
    figure = Figure(figsize=(8, 3.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(result.texture for result in results))
    for axes, quantiser in zip(panels, ("linear", "log"), strict=True):
        ends: dict[str, float] = {}
        for index, name in enumerate(names):
            curve = [row for row in results if (row.texture, row.quantiser, row.b0_db) == (name, quantiser, None)]
            levels, snrs_db = [row.levels for row in curve], [row.snr_db for row in curve]
            dashes = ("-", "--", ":", "-.")[index % 4]
            axes.plot(levels, snrs_db, linestyle=dashes, color="black", linewidth=1, marker=".", markersize=3)
            marked = [row for row in curve if row.levels in PAPER_LEVELS]
            axes.plot([row.levels for row in marked], [row.snr_db for row in marked], "o", color="black", markersize=4)
            ends[name] = snrs_db[-1]
        lowest_db = -math.inf
        for name, snr_db in sorted(ends.items(), key=lambda end: end[1]):
            lowest_db = max(snr_db, lowest_db + LABEL_DB)
            axes.text(LEVELS[-1] + 0.4, lowest_db, name, va="center", fontsize=8)
        axes.set_title(f"{quantiser} levels", fontsize=9)
        axes.set_xlabel("number of levels L")
        axes.set_xlim(LEVELS[0] - 1, LEVELS[-1] + 4)
        axes.margins(y=0.1)
        axes.grid(color="0.85", linewidth=0.5)
    panels[0].set_ylabel("SNR, dB")
    figure.savefig(path)


def write(out: Path, results: Sequence[Result]) -> None:
    """Write texture_paper.md, .csv and .png into a folder that there is. Raises OSError."""
    (out / "texture_paper.md").write_text(markdown(results), encoding="utf-8")
    with (out / "texture_paper.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(field.name for field in fields(Result))
        for result in results:
            table.writerow("" if value is None else _rounded(value) for value in astuple(result))
    draw(out / "texture_paper.png", results)


def _kept_coefficients(heights_um: codec.Signal) -> codec.Signal:
    """Return the amplitudes in um that the codec keeps: (blocks, indices 1 to 146, k rate / (2 N) up to 400 Hz)."""
    padded = np.pad(heights_um[:, 0], (0, -len(heights_um) % 512)).reshape(-1, 512)
    return np.asarray(dct(padded, axis=1, norm="ortho")[:, 1:147] * math.sqrt(2 / 512))


def _cut_part(amplitudes_um: codec.Signal, b0_db: float) -> float:
    frequency_hz = np.arange(1, 147) * DEFAULT_STREAM_RATE_HZ / (2 * 512)
    threshold = threshold_amplitude(read_threshold(), frequency_hz, "um") * 10 ** (b0_db / 20)
    return float(np.mean(np.abs(amplitudes_um) < threshold))


def _cell(result: Result) -> str:
    return f"{result.huffman_percent:.1f} %, {result.range_percent:.1f} %, {result.snr_db:.1f} dB"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (header, ["---:"] * len(header), *rows)]


def _rounded(value: str | float) -> str | float:
    return round(value, 4) if isinstance(value, float) else value


@click.command()
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder for the results.")
@click.option(
    "--profiles",
    "folder",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of height profiles as CSV files, measured beside those made here.",
)
def main(out: Path, folder: Path | None) -> None:
    """Write the arithmetic of the paper on material-like textures beside the real bytes of the codec dct."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        profiles = generated_profiles()
        for path in sorted(folder.glob("*.csv")) if folder else ():
            profiles[path.stem] = textures.load_profile(path)
        write(out, measure_all(profiles))
    except (textures.TextureError, codec.CodecError) as error:
        raise click.ClickException(str(error)) from error
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}") from error
    click.echo(f"{out / 'texture_paper.md'}: {len(profiles)} profiles")


if __name__ == "__main__":
    main()
