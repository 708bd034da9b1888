"""Live streams when a link drops to half: `python -m studies.link_drop RECORDINGS --out docs/benchmarks`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from studies.page import FOLDER, OUT, errors_in_one_line, render, results_folder, write_rows
from vibrocast import codec, progress, textures
from vibrocast.codec import Signal
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.live_format import live_format
from vibrocast.codec.rate_controlled import added_bytes
from vibrocast.files import atomic_write
from vibrocast.host import live
from vibrocast.host.controller import Controller
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.faulty_link import MemoryLink
from vibrocast.simulated_device.slow_link import SlowLink, Wire
from vibrocast.textures import dataset

RATES_BPS = (1000, 2000, 4000, 8000)
LINK_SHARE = 0.8
"""What the asked rate takes of the link's capacity, before it falls and after."""
SECONDS, FALLS_S, RECOVERS_S = 16.0, 5.0, 10.0
BLOCK_SAMPLES = 16
"""Half of the shortest block of the codec, so that each ends with a packet or within it."""
TABLE, CHART = "link_drop.csv", "link_drop.png"


@dataclass(frozen=True)
class Packet:
    """A packet of a live stream: when its last sample was taken, the rate that was asked for it, its SNR, how early.

    `early_ms`: how late a packet may still be, by the controller's last Status: the data that it held and did not play.
    """

    recording: str
    asked_bps: int
    seconds: float
    rate_bps: float
    snr_db: float | None
    early_ms: float


@dataclass(frozen=True)
class Outcome:
    """A stream as a whole. `late_packets`: sent, and not there in time; `dropped_packets`: not sent, as too late."""

    recording: str
    asked_bps: int
    packet_ms: float
    margin_ms: float
    late_packets: int
    dropped_packets: int
    underruns: int
    min_early_ms: float
    before_bps: float
    during_bps: float
    recovered_s: float | None


@click.command()
@FOLDER
@OUT
def main(folder: Path, out: Path) -> None:
    """Stream a folder of recordings; write the table and the chart into OUT/results, and print the section."""
    with errors_in_one_line():
        click.echo(section([dataset.load(trace) for trace in dataset.entries(folder)], out), nl=False)


def section(recordings: Sequence[textures.Recording], out: Path) -> str:
    """Stream the recordings at each rate, write OUT/results/link_drop.*; return the page's section on it."""
    folder = results_folder(out)
    packets: list[Packet] = []
    outcomes: list[Outcome] = []
    cells = [(recording, rate_bps) for rate_bps in RATES_BPS for recording in recordings]
    with progress.bar("streaming over a link that falls") as update:
        for recording, rate_bps in cells:
            streamed, outcome = stream(recording, rate_bps)
            packets += streamed
            outcomes.append(outcome)
            update(len(outcomes) / len(cells), f"{recording.name}, {rate_bps} bit/s")
    write_rows(folder / TABLE, outcomes, Outcome)
    with atomic_write(folder / CHART) as partial:
        draw(partial, packets)
    return render(
        "link_drop",
        recordings=len(recordings),
        link_share=LINK_SHARE,
        falls_s=FALLS_S,
        recovers_s=RECOVERS_S,
        chart=CHART,
        rows=[_row([outcome for outcome in outcomes if outcome.asked_bps == rate_bps]) for rate_bps in RATES_BPS],
    )


def _row(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Return what the page says of the streams at one rate."""
    return {
        "target_bps": outcomes[0].asked_bps,
        "packet_ms": outcomes[0].packet_ms,
        "margin_ms": outcomes[0].margin_ms,
        "late": sum(each.late_packets for each in outcomes),
        "dropped": sum(each.dropped_packets for each in outcomes),
        "early_ms": min(each.min_early_ms for each in outcomes),
        "during": fmean(each.during_bps / each.before_bps for each in outcomes),
        "recovered_s": max(math.inf if each.recovered_s is None else each.recovered_s for each in outcomes),
    }


def stream(recording: textures.Recording, rate_bps: int) -> tuple[list[Packet], Outcome]:
    """Stream the first channel of a recording, again and again until SECONDS are full."""
    rate_hz = DEFAULT_STREAM_RATE_HZ
    samples = np.resize(textures.resample(recording, rate_hz).samples[:, :1], (round(SECONDS * rate_hz), 1))
    peak, rms = float(np.max(np.abs(samples))), float(np.sqrt(np.mean(np.square(samples))))
    signal_format = live_format(rate_hz, recording.unit, [peak], [rms])
    whole_bps = rate_bps / LINK_SHARE
    wire = Wire(whole_bps)
    link = MemoryLink(SlowLink(SimulatedController(), wire))
    policy = codec.ConstantRate(rate_bps, added_bytes)
    played = live.LiveStream(
        Controller(link, link.clock, link.sleep), signal_format, coding=live.LiveCoding(policy=policy)
    )
    coded: list[bytes | None] = []
    times_s, rates_bps, early_ms = [], [], []
    began_s = link.clock()
    for due_s, block in live.paced(played, samples, BLOCK_SAMPLES):
        now_s = due_s - began_s
        wire.bits_per_second = whole_bps / (2 if FALLS_S <= now_s < RECOVERS_S else 1)
        packets = played.coded(block)
        if played.packets_sent + len(packets) > len(coded):
            coded += packets or [None]
            times_s.append(now_s)
            rates_bps.append(policy.bits_per_second)
            early_ms.append(1000 * played.status.buffered_samples / rate_hz)
        played.send_packets(packets)
        played.keep_up()
    result = played.finish()
    ratios_db = _ratios_db(played, coded, samples)
    streamed = [
        Packet(recording.name, rate_bps, *values)
        for values in zip(times_s, rates_bps, ratios_db, early_ms, strict=True)
    ]
    back = [at for at, asked in zip(times_s, rates_bps, strict=True) if at >= RECOVERS_S and asked >= 0.95 * rate_bps]
    settled = [early for at, early in zip(times_s, early_ms, strict=True) if at > 2.5]
    outcome = Outcome(
        recording.name,
        rate_bps,
        packet_ms=1000 * played.packet_s,
        margin_ms=1000 * played.playout_delay_s,
        late_packets=result.lost_packets - result.dropped_packets,
        dropped_packets=result.dropped_packets,
        underruns=result.underruns,
        min_early_ms=min(settled),
        before_bps=_mean(times_s, rates_bps, 2.0, FALLS_S),
        during_bps=_mean(times_s, rates_bps, FALLS_S + 1, RECOVERS_S),
        recovered_s=back[0] - RECOVERS_S if back else None,
    )
    return streamed, outcome


def _mean(times_s: Sequence[float], values: Sequence[float], from_s: float, to_s: float) -> float:
    return float(np.mean([value for at, value in zip(times_s, values, strict=True) if from_s <= at < to_s]))


def _ratios_db(played: live.LiveStream, coded: Sequence[bytes | None], samples: Signal) -> list[float | None]:
    """Return the SNR of each packet as it is played; None where it was not sent, or is silent."""
    decoder = codec.decoder(played.header.codec_identifier, played.header.configuration, 1)
    ratios_db: list[float | None] = []
    padded = np.concatenate([np.zeros((decoder.delay_samples, 1)), samples / np.array(played.format.gains)])
    for number, packet in enumerate(coded):
        decoded = decoder.conceal() if packet is None else decoder.decode(packet)
        wanted = padded[number * played.packet_samples :][: len(decoded)]
        ratio_db = codec.snr_db(wanted, decoded / 32768)
        ratios_db.append(None if packet is None or ratio_db is None or not math.isfinite(ratio_db) else ratio_db)
    return ratios_db


def draw(path: Path, packets: Sequence[Packet]) -> None:
    """Draw rate, SNR and how early packets come over time, a column for each rate, a line for each recording."""
    figure = Figure(figsize=(11.0, 6.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, len(RATES_BPS), sharex=True, sharey="row", squeeze=False)
    names = list(dict.fromkeys(packet.recording for packet in packets))
    for column, rate_bps in enumerate(RATES_BPS):
        for name in names:
            line = [packet for packet in packets if (packet.asked_bps, packet.recording) == (rate_bps, name)]
            times_s = [packet.seconds for packet in line]
            rows: Sequence[Sequence[float]] = (
                [packet.rate_bps / rate_bps for packet in line],
                [math.nan if packet.snr_db is None else packet.snr_db for packet in line],
                [packet.early_ms for packet in line],
            )
            for axis, values in zip(axes[:, column], rows, strict=True):
                axis.plot(times_s, values, linewidth=0.7, color="0.35", alpha=0.7)
        for axis in axes[:, column]:
            axis.axvspan(FALLS_S, RECOVERS_S, color="0.9")
            axis.grid(linewidth=0.3)
        axes[0, column].set_title(f"{rate_bps} bit/s", fontsize=9)
        axes[2, column].set_xlabel("s", fontsize=8)
        axes[2, column].set_ylim(bottom=0)
    for axis, label in zip(axes[:, 0], ("rate, of what is asked", "SNR, dB", "held, ms"), strict=True):
        axis.set_ylabel(label, fontsize=8)
    figure.savefig(path, format="png")


if __name__ == "__main__":
    main()
