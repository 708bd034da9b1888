"""Measures how exactly rates are held: `python -m studies.rate_control RECORDINGS --out docs/benchmarks`."""

import math
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import numpy as np

from studies import page
from vibrocast import codec, progress, textures
from vibrocast.codec import DEFAULT_CODEC
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, encode_live
from vibrocast.codec.rate_control import RateTarget, added_bytes
from vibrocast.codec.source import REFRESH_S
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.textures import dataset

RATES_BPS = (500, 1000, 2000, 4000, 8000, 20_000)
MAIN_RATES_BPS = (1000, 2000, 4000, 8000)
RATE_BUFFERS_S = (codec.rate_control.DEFAULT_RATE_BUFFER_S, 0.25, 1.0)
REFRESHES_S = (0.25, 0.5, 1.0, 2.0, math.inf)
MIN_SECONDS = 6.0
"""Recordings are repeated up to so long, so that there are many runs of 2 s in each."""
_LIMIT_PERCENT = 1.0

Key = TypeVar("Key")


@dataclass(frozen=True)
class Held:
    """One recording coded at a constant rate, of each channel and with frames.

    `rate_buffer_s`: the rate buffer's size. `rejected`: why the codec cannot, and then nothing else.
    `furthest_percent`: by how much the run of packets of 2 s that is furthest from the rate differs. `snr_...`: of
    packets.
    """

    recording: str
    codec: str
    bits_per_second: int
    rate_buffer_s: float
    packet_ms: float = 0.0
    sent_bps: float = 0.0
    packets_bps: float = 0.0
    furthest_percent: float | None = None
    padding_percent: float = 0.0
    snr_db: float = 0.0
    snr_deviation_db: float = 0.0
    snr_low_db: float = 0.0
    snr_high_db: float = 0.0
    rejected: str = ""


@dataclass(frozen=True)
class RefreshCost:
    """Mean SNR over recordings at a rate with a refresh every `refresh_s` seconds."""

    bits_per_second: int
    refresh_s: float
    snr_db: float


@page.study
@page.FOLDER
def main(folder: Path, out: Path) -> None:
    """Measure rate control on a folder of recordings; write page and charts."""
    recordings = {trace.name: _repeated(dataset.load(trace)) for trace in dataset.entries(folder)}
    names = [name for name, known in codec.CODECS.items() if known.controls_rate]
    cells: list[tuple[str, str, int, float | None]] = [
        *product(recordings, names, RATES_BPS, (None,)),
        *product(recordings, (DEFAULT_CODEC,), MAIN_RATES_BPS, RATE_BUFFERS_S[1:]),
    ]
    refresh_cells = list(product(RATES_BPS, REFRESHES_S))
    held: list[Held] = []
    refreshes: list[RefreshCost] = []
    with progress.bar("measuring") as update:
        for recording, name, rate_bps, rate_buffer_s in cells:
            held.append(measure(recordings[recording], recording, name, rate_bps, rate_buffer_s))
            update(len(held) / (len(cells) + len(refresh_cells)), f"{recording}, {name}, {rate_bps} bit/s")
        for rate_bps, refresh_s in refresh_cells:
            refreshes.append(measure_refreshes(list(recordings.values()), rate_bps, refresh_s))
            update((len(held) + len(refreshes)) / (len(cells) + len(refresh_cells)), "refreshes")
    write(out, held, refreshes, dataset.printable(folder.name))


def _repeated(recording: textures.Recording) -> textures.Recording:
    resampled = textures.resample(recording, DEFAULT_STREAM_RATE_HZ)
    times = math.ceil(MIN_SECONDS / resampled.seconds)
    samples = np.tile(resampled.samples, (times, 1))
    return textures.Recording(samples, resampled.rate_hz, resampled.unit, resampled.name)


def measure(
    recording: textures.Recording, name: str, codec_name: str, rate_bps: int, rate_buffer_s: float | None
) -> Held:
    """Code a recording at a constant rate for each channel, frames included; `rate_buffer_s`: None = the default."""
    target = RateTarget(constant_rate_bps=rate_bps * recording.channels, rate_buffer_s=rate_buffer_s)
    size_s = RATE_BUFFERS_S[0] if rate_buffer_s is None else rate_buffer_s
    try:
        _, outcome = encode_live(recording, target, codec_name=codec_name, highpass_hz=None)
    except codec.CodecError as error:
        return Held(name, codec_name, rate_bps, size_s, rejected=str(error))
    low_db, high_db = outcome.snr_range_db
    return Held(
        name,
        codec_name,
        rate_bps,
        size_s,
        packet_ms=1000 * outcome.packet_s,
        sent_bps=outcome.sent_bps,
        packets_bps=outcome.packets_bps,
        furthest_percent=None if outcome.furthest is None else 100 * outcome.furthest,
        padding_percent=100 * outcome.padding,
        snr_db=outcome.snr_db,
        snr_deviation_db=outcome.snr_deviation_db,
        snr_low_db=low_db,
        snr_high_db=high_db,
    )


def measure_refreshes(recordings: Sequence[textures.Recording], rate_bps: int, refresh_s: float) -> RefreshCost:
    """Code recordings by the default codec at a constant rate with a refresh every so often; infinity = the first."""
    ratios_db = []
    for recording in recordings:
        total_bps = rate_bps * recording.channels
        rate_hz = round(recording.rate_hz)
        framing = codec.rate_controlled_framing(total_bps, rate_hz, added_bytes)
        packets = 0 if math.isinf(refresh_s) else max(1, round(refresh_s * rate_hz / framing.packet_samples))
        source = codec.Source.of(recording.samples, rate_hz, DEFAULT_CODEC, recording.unit, live=True)
        policy = codec.ConstantRate(total_bps, added_bytes)
        coded = codec.encode_rate_controlled(source, {}, policy, codec.Framing(framing.packet_samples, packets))
        ratios_db.append(codec.snr_db(recording.samples, coded.decode()))
    return RefreshCost(rate_bps, refresh_s, fmean(ratio for ratio in ratios_db if ratio is not None))


def write(out: Path, held: Sequence[Held], refreshes: Sequence[RefreshCost], data: str) -> None:
    """Write OUT/rate_control.md, and OUT/results/rate_control*.csv and *.png. Raises OSError."""
    folder = page.results_folder(out)
    done = [row for row in held if not row.rejected]
    default = [row for row in done if row.rate_buffer_s == RATE_BUFFERS_S[0]]
    plot_codecs(folder / "rate_control_codecs.png", default)
    by_rate_buffer = [row for row in done if row.codec == DEFAULT_CODEC and row.bits_per_second in MAIN_RATES_BPS]
    plot_rate_buffers(folder / "rate_control_buffers.png", by_rate_buffer)
    tables = (("rate_control.csv", held, Held), ("rate_control_refreshes.csv", refreshes, RefreshCost))
    page.publish(out, "rate_control", rendered(held, refreshes, data), tables)


def rendered(held: Sequence[Held], refreshes: Sequence[RefreshCost], data: str) -> str:
    """Return the page. `data`: the name of the recordings' folder."""
    default = [row for row in held if not row.rejected and row.rate_buffer_s == RATE_BUFFERS_S[0]]
    return page.render(
        "rate_control",
        data=data,
        recordings=len({row.recording for row in held}),
        rate_hz=DEFAULT_STREAM_RATE_HZ,
        min_seconds=MIN_SECONDS,
        command=shlex.join(["python", "-m", "studies.rate_control", *sys.argv[1:]]),
        furthest=max((row for row in default if row.furthest_percent is not None), key=_deviation),
        codec=DEFAULT_CODEC,
        rates_bps=RATES_BPS,
        codecs={name: [_cell(held, name, rate) for rate in RATES_BPS] for name in _codecs(held)},
        examples={row.codec: row for row in held if row.rejected}.values(),
        silent=_silent(default),
        refreshes_s=REFRESHES_S,
        infinity=math.inf,
        refreshes={rate: [row for row in refreshes if row.bits_per_second == rate] for rate in RATES_BPS},
        refresh_s=REFRESH_S,
    )


def _deviation(row: Held) -> float:
    return abs(row.furthest_percent or 0.0)


def _codecs(held: Sequence[Held]) -> list[str]:
    return list(dict.fromkeys(row.codec for row in held))


def _cell(held: Sequence[Held], name: str, rate_bps: int) -> dict[str, float]:
    """Return means over the recordings of a codec at a rate, and how many recordings it rejects."""
    cell = name, rate_bps, RATE_BUFFERS_S[0]
    rows = [row for row in held if (row.codec, row.bits_per_second, row.rate_buffer_s) == cell]
    done = [row for row in rows if not row.rejected]
    if not done:
        return {"kept": 0}
    return {
        "kept": len(done),
        "rejected": len(rows) - len(done),
        "packet_ms": fmean(row.packet_ms for row in done),
        "added_percent": fmean(100 * (row.sent_bps / row.packets_bps - 1) for row in done),
        "padding_percent": fmean(row.padding_percent for row in done),
    }


def _silent(rows: Sequence[Held]) -> dict[str, int]:
    """Return which codecs send nothing but padding, each with the highest rate at which it does."""
    silent = {(row.codec, row.bits_per_second) for row in rows}
    silent -= {(row.codec, row.bits_per_second) for row in rows if row.snr_db > 0}
    return dict(sorted(silent))


def plot_codecs(path: Path, rows: Sequence[Held]) -> None:
    """Draw worst deviation, mean SNR and its mean deviation over the rates, a line for each codec. Raises OSError."""
    recordings = len({row.recording for row in rows})
    panels: Mapping[str, Callable[[Sequence[Held]], float]] = {
        "worst over 2 s, %": lambda some: max(abs(row.furthest_percent or 0.0) for row in some),
        "mean SNR, dB": lambda some: fmean(row.snr_db for row in some),
        "deviation of SNR, dB": lambda some: fmean(row.snr_deviation_db for row in some),
    }
    codecs = _grouped(rows, lambda row: row.codec)
    whole = {
        codec: {
            rate: some
            for rate, some in _grouped(own, lambda row: float(row.bits_per_second)).items()
            if len(some) == recordings
        }
        for codec, own in codecs.items()
    }
    _plot(path, whole, panels, "bit/s, frames included", (_LIMIT_PERCENT,))


def plot_rate_buffers(path: Path, rows: Sequence[Held]) -> None:
    """Draw mean deviations of SNR and rate over the rate buffer's size, a line for each rate. Raises OSError."""
    panels: Mapping[str, Callable[[Sequence[Held]], float]] = {
        "deviation of SNR, dB": lambda some: fmean(row.snr_deviation_db for row in some),
        "worst over 2 s, %": lambda some: fmean(abs(row.furthest_percent or 0.0) for row in some),
    }
    rates = _grouped(sorted(rows, key=lambda row: row.bits_per_second), lambda row: row.bits_per_second)
    lines = {f"{rate} bit/s": _grouped(own, lambda row: row.rate_buffer_s) for rate, own in rates.items()}
    _plot(path, lines, panels, "rate buffer, s")


def _plot(
    path: Path,
    lines: Mapping[str, Mapping[float, Sequence[Held]]],
    values: Mapping[str, Callable[[Sequence[Held]], float]],
    x_label: str,
    levels: Sequence[float] = (),
) -> None:
    """Draw a panel for each of the values, with a line over the groups of rows. `levels`: of the first."""
    panels = [
        Panel(
            title,
            x_label,
            "",
            [Curve(name, sorted(line), [value(line[x]) for x in sorted(line)]) for name, line in lines.items() if line],
            log_x=True,
            lines=levels if not place else (),
        )
        for place, (title, value) in enumerate(values.items())
    ]
    curves(path, panels, across=1)


def _grouped(rows: Iterable[Held], key: Callable[[Held], Key]) -> dict[Key, list[Held]]:
    groups: dict[Key, list[Held]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


if __name__ == "__main__":
    main()
