"""Writes the page of the speed of coding, and its table: `python -m studies.speed --out docs/benchmarks`."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from studies import page
from vibrocast import codec
from vibrocast.codec import Signal, Source, Stream
from vibrocast.codec.interface import Value
from vibrocast.codec.timing import time_coding
from vibrocast.harness.measurements import machine
from vibrocast.textures.generate import wood

RATE_HZ = 2800
SAMPLES = 1 << 19
SNR_DB = 12.0
REPEATS = 3
GIVEN, TO_SNR, TO_RATE = "step given", "to an SNR", "to a rate"
OPUS_BPS = 8000
"""The rate of Opus at which it comes near SNR_DB, for samples that are labelled 8000 Hz."""


@dataclass(frozen=True)
class Row:
    """The speed of coding one signal, in processor seconds for a million samples.

    `of_mdct`: encoding time relative to that of `mdct` with a given step. `encodings`: relative to the same codec with
    a given setting. `snr_db`: None where nothing is lost.
    """

    codec: str
    task: str
    bits_per_sample: float
    snr_db: float | None
    encode_s: float
    decode_s: float
    of_mdct: float = 1.0
    encodings: float | None = None


@page.study
@click.option("--samples", type=int, default=SAMPLES, show_default=True, help="Code this many samples.")
@click.option("--repeats", type=int, default=REPEATS, show_default=True, help="Take the median of this many runs.")
def main(out: Path, samples: int, repeats: int) -> None:
    """Measure the speed of codecs and of searches in one run, and write the page speed.md."""
    rows = measure(samples, repeats)
    text = page.render(
        "speed", rows=rows, samples=samples, repeats=repeats, rate_hz=RATE_HZ, snr_db=SNR_DB, machine=machine()
    )
    page.publish(out, "speed", text, [("speed.csv", rows, Row)])


def measure(samples: int, repeats: int) -> list[Row]:
    """Return the rows of the table: lossless coders, Opus, and codecs with a setting, to an SNR and to a rate."""
    signal = wood(seed=1, seconds=samples / RATE_HZ, rate_hz=RATE_HZ).samples[:samples]
    signal = signal / np.max(np.abs(signal))
    integers = np.rint(32767 * signal).astype("<i2").tobytes()
    packed = zlib.compress(integers, 6)
    seconds = time_coding(lambda: zlib.compress(integers, 6), lambda _: zlib.decompress(packed), samples, repeats)
    rows = [Row("zlib -6", GIVEN, 8 * len(packed) / samples, None, *seconds)]
    rows.append(_row("flac", GIVEN, signal, repeats, lambda: _source(signal, "flac").encode({})))
    opus = {"bit_rate_bps": OPUS_BPS}
    rows.append(_row("opus", GIVEN, signal, repeats, lambda: _source(signal, "opus").encode(opus)))
    for name, parameter in (("mdct", "step"), ("slp", "quality")):
        rows += _searched(name, parameter, signal, repeats)
    of_mdct = next(row.encode_s for row in rows if (row.codec, row.task) == ("mdct", GIVEN))
    return [replace(row, of_mdct=row.encode_s / of_mdct) for row in rows]


def _searched(name: str, parameter: str, signal: Signal, repeats: int) -> list[Row]:
    """Return the rows of a codec: to an SNR, to the rate that this takes, and with a given setting near it."""
    found = codec.encode_to_snr(_source(signal, name), SNR_DB)
    rate_bps = found.bits_per_second
    nearest = _nearest(signal, name, parameter, rate_bps)
    tasks: dict[str, Callable[[], Stream]] = {
        GIVEN: lambda: _source(signal, name).encode({parameter: nearest}),
        TO_SNR: lambda: codec.encode_to_snr(_source(signal, name), SNR_DB),
        TO_RATE: lambda: codec.encode_to_rate(_source(signal, name), rate_bps),
    }
    rows = [_row(name, task, signal, repeats, encode) for task, encode in tasks.items()]
    return [rows[0], *(replace(row, encodings=row.encode_s / rows[0].encode_s) for row in rows[1:])]


def _nearest(signal: Signal, name: str, parameter: str, rate_bps: float) -> Value:
    """Return the value of a codec's rate points that comes nearest to a rate, on the signal's beginning."""
    beginning = _source(signal[: 10 * RATE_HZ], name)
    points = next(iter(codec.codec_by_name(name).rate_point_sets.values()))
    rates = {rate_point[parameter]: beginning.encode(rate_point).bits_per_second for rate_point in points}
    return min(rates, key=lambda value: abs(np.log(rates[value] / rate_bps)))


def _source(signal: Signal, name: str) -> Source:
    """Return a new source: it has chosen nothing yet."""
    return Source.of(signal, RATE_HZ, name)


def _row(name: str, task: str, signal: Signal, repeats: int, encode: Callable[[], Stream]) -> Row:
    coded = encode()
    ratio_db = None if name == "flac" else codec.snr_db(signal, coded.decode())
    seconds = time_coding(encode, Stream.decode, len(signal), repeats)
    return Row(name, task, coded.bits_per_second / RATE_HZ, ratio_db, *seconds)


if __name__ == "__main__":
    main()
