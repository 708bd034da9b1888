"""Measures how exactly rates are held: `python -m studies.rate_control RECORDINGS --out docs`."""

import argparse
import math
import shlex
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from statistics import fmean

import numpy as np

from studies import link_drop
from studies import rate_control_charts as charts
from studies.rate_control_charts import Held, RefreshCost
from vibrocast import codec, progress, textures
from vibrocast.codec import DEFAULT_CODEC, rate_controlled
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.rate_controlled import RateTarget, added_bytes
from vibrocast.evaluation.page_parts import code, count, paragraphs, table
from vibrocast.evaluation.points import write_rows
from vibrocast.files import atomic_write
from vibrocast.textures import dataset

RATES_BPS = (500, 1000, 2000, 4000, 8000, 20_000)
MAIN_RATES_BPS = (1000, 2000, 4000, 8000)
RATE_BUFFERS_S = (codec.rate_control.DEFAULT_RATE_BUFFER_S, 0.25, 1.0)
REFRESHES_S = (0.25, 0.5, 1.0, 2.0, math.inf)
MIN_SECONDS = 6.0
"""Recordings are repeated up to so long, so that there are many runs of 2 s in each."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all codecs that control the rate on a folder of recordings, and write page, charts and tables."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m studies.rate_control")
    parser.add_argument("recordings", type=Path, help="folder of recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder for rate_control.md and results/")
    chosen = parser.parse_args(arguments)
    recordings = {trace.name: _repeated(dataset.load(trace)) for trace in dataset.traces(chosen.recordings)}
    names = [name for name, known in codec.CODECS.items() if known.controls_rate]
    cells: list[tuple[str, str, int, float | None]] = [
        *product(recordings, names, RATES_BPS, (None,)),
        *product(recordings, (DEFAULT_CODEC,), MAIN_RATES_BPS, RATE_BUFFERS_S[1:]),
    ]
    refresh_cells = list(product(RATES_BPS, REFRESHES_S))
    held: list[Held] = []
    refreshes: list[RefreshCost] = []
    with progress.shown("measuring") as update:
        for recording, name, rate_bps, rate_buffer_s in cells:
            held.append(measure(recordings[recording], recording, name, rate_bps, rate_buffer_s))
            update(len(held) / (len(cells) + len(refresh_cells)), f"{recording}, {name}, {rate_bps} bit/s")
        for rate_bps, refresh_s in refresh_cells:
            refreshes.append(measure_refreshes(list(recordings.values()), rate_bps, refresh_s))
            update((len(held) + len(refreshes)) / (len(cells) + len(refresh_cells)), "refreshes")
    command = shlex.join(["python", "-m", "studies.rate_control", *(sys.argv[1:] if arguments is None else arguments)])
    link_drop_section = link_drop.section(list(recordings.values()), chosen.out)
    write(chosen.out, held, refreshes, dataset.printable(chosen.recordings.name), command, link_drop_section)


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
        _, outcome = rate_controlled.encode(recording, target, codec_name=codec_name, highpass_hz=None)
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
        source = codec.Source(recording.samples, rate_hz, DEFAULT_CODEC, recording.unit, live=True)
        coded = source.encode_rate_controlled(
            {}, codec.ConstantRate(total_bps, added_bytes), codec.Framing(framing.packet_samples, packets)
        )
        ratios_db.append(codec.snr_db(recording.samples, codec.decode(coded)))
    return RefreshCost(rate_bps, refresh_s, fmean(ratio for ratio in ratios_db if ratio is not None))


def write(
    out: Path,
    held: Sequence[Held],
    refreshes: Sequence[RefreshCost],
    data: str,
    command: str,
    link_drop_section: str,
) -> None:
    """Write OUT/rate_control.md, and OUT/results/rate_control*.csv and *.png. Raises OSError."""
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(folder / "rate_control.csv", held, Held)
    write_rows(folder / "rate_control_refreshes.csv", refreshes, RefreshCost)
    done = [row for row in held if not row.rejected]
    default = [row for row in done if row.rate_buffer_s == RATE_BUFFERS_S[0]]
    charts.plot_recordings(
        folder / "rate_control_recordings.png",
        [row for row in default if row.codec == DEFAULT_CODEC and row.bits_per_second in MAIN_RATES_BPS],
    )
    charts.plot_codecs(folder / "rate_control_codecs.png", default)
    by_rate_buffer = [row for row in done if row.codec == DEFAULT_CODEC and row.bits_per_second in MAIN_RATES_BPS]
    charts.plot_rate_buffers(folder / "rate_control_buffers.png", by_rate_buffer)
    with atomic_write(out / "rate_control.md") as partial:
        partial.write_text(page(held, refreshes, data, command, link_drop_section), encoding="utf-8")


def page(
    held: Sequence[Held], refreshes: Sequence[RefreshCost], data: str, command: str, link_drop_section: str
) -> str:
    """Return the page; `link_drop_section`: as `studies.link_drop.section` has it."""
    done = [row for row in held if not row.rejected]
    default = [row for row in done if row.rate_buffer_s == RATE_BUFFERS_S[0]]
    recordings = len({row.recording for row in held})
    furthest = max((row for row in default if row.furthest_percent is not None), key=_deviation)
    return (
        paragraphs(
            "# Rate control",
            f"Data: {code(data)}, {count(recordings, 'recording')} at {DEFAULT_STREAM_RATE_HZ} Hz, repeated up to "
            f"{MIN_SECONDS:g} s. Written by",
            f"    {command}",
            "What the policies are, and how they are asked for, is in [codecs.md](codecs.md#rate-control).",
            "## A constant rate",
            f"Asked for 500 bit/s to 20 kbit/s, the frames of packets included. Over every run of whole packets that "
            f"lasts 2 s, from the first packet on, no stream was further from its rate than "
            f"{abs(furthest.furthest_percent or 0):.2f} % ({furthest.codec}, {furthest.bits_per_second} bit/s, "
            f"{furthest.recording}).",
            "![Rate and quality of each recording](results/rate_control_recordings.png)",
            f"*Each recording by {code(DEFAULT_CODEC)} with the default rate buffer: mean SNR of the packets (mark), "
            "from the 5th to the 95th percentile (line), and the worst deviation over 2 s (number). "
            "Data: [rate_control.csv](results/rate_control.csv).*",
            "![Rate and quality of each codec](results/rate_control_codecs.png)",
            "*Worst deviation over 2 s of any recording, mean SNR and mean standard deviation of the packets' SNR over "
            "the recordings, for each codec that controls its rate and the rates that it holds on all recordings.*",
            table(
                ["codec", *(f"{rate} bit/s" for rate in RATES_BPS)],
                [[code(name), *(_cell(held, name, rate) for rate in RATES_BPS)] for name in _codecs(held)],
            ),
            "Packet length, what frames add to the packets' bytes, padding: means over the recordings. *Rejected*: on "
            "how many recordings the packets of full-scale noise, which is tried first, are too long at the coarsest:",
            _rejections(held),
            _silences(default),
            "## What a larger rate buffer buys",
            "![Evenness against the rate buffer's size](results/rate_control_buffers.png)",
            f"*Standard deviation of the packets' SNR, and worst deviation over 2 s, by {code(DEFAULT_CODEC)}: means "
            "over the recordings. The smallest rate buffer is the default; the larger ones aim at an even SNR.*",
            "A rate buffer of b seconds lets the rate wander by b seconds' bits: on a link of just that rate data may "
            "wait so long, and is late by as much unless the stream is begun so much earlier.",
            "## Refreshes",
            table(
                ["rate", *("first only" if math.isinf(every) else f"every {every:g} s" for every in REFRESHES_S)],
                [
                    [f"{rate} bit/s", *(f"{row.snr_db:.2f}" for row in refreshes if row.bits_per_second == rate)]
                    for rate in RATES_BPS
                ],
            ),
            f"SNR in dB by {code(DEFAULT_CODEC)} with the default rate buffer, mean over the recordings. A refresh is "
            "a packet at least: where packets are longer, each is one. Streams at a rate have one every "
            f"{codec.rate_control.REFRESH_S:g} s.",
            link_drop_section,
        )
        + "\n"
    )


def _deviation(row: Held) -> float:
    return abs(row.furthest_percent or 0.0)


def _codecs(held: Sequence[Held]) -> list[str]:
    return list(dict.fromkeys(row.codec for row in held))


def _cell(held: Sequence[Held], name: str, rate_bps: int) -> str:
    rows = [
        row
        for row in held
        if row.codec == name and row.bits_per_second == rate_bps and row.rate_buffer_s == RATE_BUFFERS_S[0]
    ]
    done = [row for row in rows if not row.rejected]
    rejected = f"{len(rows) - len(done)} rejected" if len(done) < len(rows) else ""
    if not done:
        return "rejected"
    added = fmean(100 * (row.sent_bps / row.packets_bps - 1) for row in done)
    padding = fmean(row.padding_percent for row in done)
    text = f"{fmean(row.packet_ms for row in done):.0f} ms, +{added:.0f} %, padding {padding:.1f} %"
    return ", ".join(filter(None, (text, rejected)))


def _silences(rows: Sequence[Held]) -> str:
    """Return which codecs send nothing but padding at which rates."""
    silent = {(row.codec, row.bits_per_second) for row in rows}
    silent -= {(row.codec, row.bits_per_second) for row in rows if row.snr_db > 0}
    names = sorted({name for name, _ in silent})
    highest = {name: max(rate for each, rate in silent if each == name) for name in names}
    told = [
        f"- {code(name)}: up to {highest[name]} bit/s what is coarse enough is silence, and the rest padding."
        for name in names
    ]
    return "\n".join(told)


def _rejections(held: Sequence[Held]) -> str:
    examples = {row.codec: row for row in held if row.rejected}
    return "\n".join(f"- {code(name)}, {row.recording}: {row.rejected}." for name, row in examples.items())


if __name__ == "__main__":
    main()
