"""Writes the page of the speed of coding, and its table: `python -m studies.speed --out docs/benchmarks`."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import vibrocast.evaluation.peers  # noqa: F401 - fills codec.PEERS
from studies import page
from vibrocast import codec
from vibrocast.codec import Signal, Source, Stream
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
def main(out: Path) -> None:
    """Measure the speed of codecs and of searches in one run, and write the page speed.md."""
    rows = measure()
    text = page.render("speed", globals(), rows=rows, machine=machine())
    page.publish(out, "speed", text, [("speed.csv", rows, Row)])


def measure() -> list[Row]:
    """Return the rows of the table: lossless coders, Opus, and codecs with a setting, to an SNR and to a rate."""
    signal = wood(seed=1, seconds=SAMPLES / RATE_HZ, rate_hz=RATE_HZ).samples[:SAMPLES]
    signal = signal / np.max(np.abs(signal))
    integers = np.rint(32767 * signal).astype("<i2").tobytes()
    packed = zlib.compress(integers, 6)
    seconds = time_coding(lambda: zlib.compress(integers, 6), lambda _: zlib.decompress(packed), SAMPLES, REPEATS)
    opus = {"bit_rate_bps": OPUS_BPS}
    rows = [
        Row("zlib -6", GIVEN, 8 * len(packed) / SAMPLES, None, *seconds),
        _row("flac", GIVEN, signal, lambda: Source.of(signal, RATE_HZ, "flac").encode({})),
        _row("opus", GIVEN, signal, lambda: Source.of(signal, RATE_HZ, "opus").encode(opus)),
        *_searched("mdct", "step", signal),
        *_searched("slp", "quality", signal),
    ]
    of_mdct = next(row.encode_s for row in rows if (row.codec, row.task) == ("mdct", GIVEN))
    return [replace(row, of_mdct=row.encode_s / of_mdct) for row in rows]


def _searched(name: str, parameter: str, signal: Signal) -> list[Row]:
    """Return the rows of a codec: with a given setting, to an SNR, and to the rate that this takes.

    The setting is that of the codec's rate points that comes nearest to this rate, on the signal's beginning.
    """

    def source() -> Source:
        return Source.of(signal, RATE_HZ, name)  # a new one has chosen nothing yet

    rate_bps = codec.encode_to_snr(source(), SNR_DB).bits_per_second
    beginning = Source.of(signal[: 10 * RATE_HZ], RATE_HZ, name)
    points = codec.codec_by_name(name).rate_points
    rates = {point[parameter]: beginning.encode(point).bits_per_second for point in points}
    nearest = min(rates, key=lambda value: abs(np.log(rates[value] / rate_bps)))
    given = _row(name, GIVEN, signal, lambda: source().encode({parameter: nearest}))
    searched = [
        _row(name, TO_SNR, signal, lambda: codec.encode_to_snr(source(), SNR_DB)),
        _row(name, TO_RATE, signal, lambda: codec.encode_to_rate(source(), rate_bps)),
    ]
    return [given, *(replace(row, encodings=row.encode_s / given.encode_s) for row in searched)]


def _row(name: str, task: str, signal: Signal, encode: Callable[[], Stream]) -> Row:
    coded = encode()
    ratio_db = None if name == "flac" else codec.snr_db(signal, coded.decode())
    seconds = time_coding(encode, Stream.decode, len(signal), REPEATS)
    return Row(name, task, coded.bits_per_second / RATE_HZ, ratio_db, *seconds)


if __name__ == "__main__":
    main()
