"""Measures what the rotation of channels saves: `python -m studies.several_channels --out docs/benchmarks`."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import click
import numpy as np

from studies.page import OUT, errors_in_one_line, render, results_folder, write, write_rows
from vibrocast import codec, textures
from vibrocast.codec.interface import Signal
from vibrocast.codec.stream import as_stream
from vibrocast.evaluation.bd_rate import SNR, Curve, bd_rate, bits_per_sample_at
from vibrocast.textures import generate

RATE_HZ = 2800
SECONDS = 4.0
GENERATORS: dict[str, Callable[..., textures.Recording]] = {
    "rough": generate.rough,
    "ridges": generate.ridges,
    "stick-slip": generate.stick_slip,
}
"""Textures that drive the generated arrays."""
CHANNELS = (2, 4, 8)
DELAYS = (2, 4, 8)
"""Of a wave from one actuator to the next, in samples."""
NOISES_DB = (-10.0, -20.0, -30.0)
"""Of each actuator's own noise relative to the wave: another texture of the same kind."""
SCALES = (1.0, 0.5, 0.8, 0.3, 0.7, 0.4, 0.9, 0.6)
"""Levels of scaled copies."""
TABLE_CASE = (4, 4, -20.0)
"""Channels, delay and noise of the wave that the targets name."""
UNRELATED, WAVE, COPIES = "unrelated", "wave", "one drive"
SNRS_DB = (10, 15, 20)
_STEPS = [{"step": 2 ** (exponent / 2)} for exponent in range(4, -7, -1)]
PUBLISHED_PERCENT = (-69, -50)
"""MVibCode's BD-rate over its codec of one channel, as published."""
PAGE = "several_channels.md"
TABLE = "several_channels.csv"


@dataclass(frozen=True)
class Case:
    """A signal of several channels. `delay`: of a wave in samples; `noise_db`: of each channel's own noise."""

    kind: str
    name: str
    samples: Signal
    rate_hz: int = RATE_HZ
    delay: int | None = None
    noise_db: float | None = None


@dataclass(frozen=True)
class Row:
    """The bits of a signal with its rotation, relative to those without one, at equal SNR.

    `bd_percent`: BD-rate over 5 to 20 dB. `saved_10`, `saved_15`, `saved_20`: percent of bits saved at that SNR in dB;
    None where a curve does not reach it. `section_bytes`: of the rotation; 0 = the encoder chose none. `delay_samples`:
    that it adds.
    """

    kind: str
    name: str
    channels: int
    delay: int | None
    noise_db: float | None
    bd_percent: float | None
    saved_10: float | None
    saved_15: float | None
    saved_20: float | None
    section_bytes: int
    delay_samples: int


@click.command()
@OUT
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("../shared/data"),
    show_default=True,
    help="Read recordings of several channels from this folder, if it is there.",
)
def main(out: Path, data: Path) -> None:
    """Measure what the rotation of channels saves, and write the page several_channels.md."""
    rows = []
    with errors_in_one_line():
        for case in itertools.chain(generated(), recorded(data)):
            rows.append(measured(case))
            click.echo(f"{case.kind}, {case.name}: {rows[-1].bd_percent} %", err=True)
        write_rows(results_folder(out) / TABLE, rows, Row)
        write(out / PAGE, page(rows))


def generated() -> Iterator[Case]:
    """Yield unrelated channels, one drive on several actuators, and waves along arrays."""
    for channels, texture in itertools.product(CHANNELS, GENERATORS):
        each = [_texture(texture, seed) for seed in range(channels)]
        yield Case(UNRELATED, f"{texture}, {channels} places", np.stack(each, axis=1))
        copies = np.repeat(each[0][:, None], channels, axis=1)
        yield Case(COPIES, f"{texture}, {channels} equal", copies)
        yield Case(COPIES, f"{texture}, {channels} scaled", copies * np.array(SCALES[:channels]))
        for delay, noise_db in itertools.product(DELAYS, NOISES_DB):
            samples = wave(texture, channels, delay, noise_db)
            yield Case(WAVE, f"{texture}, {channels} actuators", samples, RATE_HZ, delay, noise_db)
    mixed = np.stack([_texture(texture, 0) for texture in GENERATORS], axis=1)
    yield Case(UNRELATED, "three kinds of texture", mixed)


def wave(texture: str, channels: int, delay: int, noise_db: float) -> Signal:
    """Return a texture (n, channels) that reaches each actuator `delay` samples later, each with its own noise."""
    drive = _texture(texture, 0)
    longest = delay * (channels - 1)
    samples = np.stack([drive[longest - delay * place :][: len(drive) - longest] for place in range(channels)], axis=1)
    noise = np.stack([_texture(texture, 1 + place) for place in range(channels)], axis=1)[: len(samples)]
    return samples + 10 ** (noise_db / 20) * noise


def recorded(data: Path) -> Iterator[Case]:
    """Yield the recordings of several channels below a folder; nothing for those that are not there."""
    for kind, file in (
        ("two fingertips", "penn_pr2_biotac_2finger_active_hp20.npz"),
        ("machine, three axes", "adi_cbm_xyz_4k.npz"),
        ("rigid pair", "shm7_base_board_1707.npz"),
    ):
        path = data / "channels" / file
        if not path.exists():
            continue
        with np.load(path) as archive:
            rate_hz = round(float(archive["fs"]))
            names = [name for name in archive.files if name != "fs"]
            for name in names:
                yield Case(kind, name, _centred(archive[name]), rate_hz)
            if kind == "two fingertips":
                for one, other in itertools.pairwise(names):
                    stop = min(len(archive[one]), len(archive[other]))
                    pair = np.stack([archive[one][:stop, 0], archive[other][:stop, 1]], axis=1)
                    yield Case(UNRELATED, f"fingers of {one} and {other}", _centred(pair), rate_hz)
    for path in sorted((data / "p1918_reference").glob("*_X.txt")):
        axes = [path.with_name(path.name.replace("_X.txt", f"_{axis}.txt")) for axis in "XYZ"]
        if all(axis.exists() for axis in axes):
            samples = np.stack([np.loadtxt(axis) for axis in axes], axis=1)
            yield Case("tool, three axes", path.stem[:-2], _centred(samples))


def measured(case: Case) -> Row:
    """Code a signal at several steps, with the rotation that the encoder chooses and without one."""
    source = codec.Source(case.samples, case.rate_hz)
    curves: list[list[tuple[float, float]]] = []
    sections, delays = [], []
    for rotation in ("none", "auto"):
        curve = []
        for step in _STEPS:
            coded = source.encode({**step, "rotation": rotation})
            stream = as_stream(coded, "full scale")
            ratio_db = codec.snr_db(case.samples, stream.decode())
            assert ratio_db is not None, "no case is silent"
            curve.append((8 * stream.size_bytes / case.samples.size, ratio_db))
        curves.append(curve)
        sections.append(len(coded.configuration))
        delays.append(stream.decoder().delay_samples)
    before, after = curves
    saved = saved_percent(before, after)
    found = bd_rate(before, after, SNR)
    return Row(
        kind=case.kind,
        name=case.name,
        channels=case.samples.shape[1],
        delay=case.delay,
        noise_db=case.noise_db,
        bd_percent=None if found is None else round(found.percent, 2),
        saved_10=saved[0],
        saved_15=saved[1],
        saved_20=saved[2],
        section_bytes=max(0, sections[1] - sections[0] - 1),
        delay_samples=delays[1] - delays[0],
    )


def saved_percent(anchor: Curve, test: Curve) -> list[float | None]:
    """Return the bits that `test` saves at each of SNRS_DB, in percent; None outside of either curve."""
    before, after = (bits_per_sample_at(curve, SNRS_DB) for curve in (anchor, test))
    return [None if np.isnan(each) else round(float(each), 2) for each in 100 * (1 - after / before)]


def page(rows: Sequence[Row]) -> str:
    """Return the page."""
    waves = [row for row in rows if row.kind == WAVE]
    channels, delay, noise_db = TABLE_CASE
    of_table = [row for row in waves if (row.channels, row.delay, row.noise_db) == TABLE_CASE]
    unrelated = [row for row in rows if row.kind == UNRELATED and row.bd_percent is not None]
    return render(
        "several_channels",
        kinds={
            kind: summary([row for row in rows if row.kind == kind]) for kind in dict.fromkeys(r.kind for r in rows)
        },
        waves={
            count: {
                noise: summary([r for r in waves if (r.channels, r.noise_db) == (count, noise)]) for noise in NOISES_DB
            }
            for count in CHANNELS
        },
        table={"channels": channels, "delay": delay, "noise_db": noise_db, **summary(of_table)},
        textures=list(GENERATORS),
        worst_unrelated=max((row.bd_percent for row in unrelated if row.bd_percent is not None), default=0.0),
        snrs_db=SNRS_DB,
        published=PUBLISHED_PERCENT,
        rate_hz=RATE_HZ,
        delays=DELAYS,
    )


def summary(rows: Sequence[Row]) -> dict[str, float | int | None]:
    """Return the means over rows, None where no row has a figure, and how many rows there are and are rotated."""

    def mean(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return fmean(known) if known else None

    return {
        "rows": len(rows),
        "rotated": sum(row.section_bytes > 0 for row in rows),
        "bd": mean([row.bd_percent for row in rows]),
        "10": mean([row.saved_10 for row in rows]),
        "15": mean([row.saved_15 for row in rows]),
        "20": mean([row.saved_20 for row in rows]),
    }


def _texture(name: str, seed: int) -> Signal:
    """Return a texture (n,) of RMS value 1, without the band that actuators do not play."""
    recording = GENERATORS[name](seed=seed, seconds=SECONDS, rate_hz=RATE_HZ)
    samples: Signal = textures.highpass(recording).recording.samples[:, 0]
    normalised: Signal = samples / np.sqrt(np.mean(np.square(samples)))
    return normalised


def _centred(samples: Signal) -> Signal:
    numbers = samples.astype(np.float64)
    centred: Signal = numbers - numbers.mean(axis=0)
    return centred


if __name__ == "__main__":
    main()
