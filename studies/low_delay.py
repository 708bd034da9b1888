"""Writes the page of the least delay and its price in bits: `python -m studies.low_delay --out docs/benchmarks`."""

from dataclasses import dataclass, replace
from pathlib import Path

import click

import vibrocast
from studies.page import OUT, errors_in_one_line, render, results_folder, write, write_rows
from vibrocast import codec, textures
from vibrocast.codec import CodedSignal, Framing, Source
from vibrocast.codec.core import decoding_cycles
from vibrocast.codec.rate_controlled import added_bytes
from vibrocast.harness.latency import Latency, measure_latency
from vibrocast.harness.measurements import machine, subject
from vibrocast.host import bench_file, live
from vibrocast.host.bench_file import Bench, BenchController
from vibrocast.textures import Recording

RECORDING = Path("examples/oak.wav")
SNR_DB = 12.0
RUNS = 3
SECONDS = 2.0
ADDRESSES = {"sim": "serial", "sim-usb": "USB"}
LOW_MS = 1e3 * live.LOW_DELAY_PLAYOUT_S
DEFAULT_MS = 1e3 * live.PLAYOUT_DELAY_S
CHAINS = ((2800, "16", DEFAULT_MS), (2800, "16", LOW_MS), (8000, "32", LOW_MS), (live.LOW_DELAY_RATE_HZ, "16", LOW_MS))
"""Rate in Hz, samples of a block, playout delay in ms: from the default to `--low-delay`."""
OPUS_FRAMES = ("20", "160")
CLOCK_HZ = 168e6
"""Of the Cortex-M4 whose decoding time the page states."""
PAGE, TABLE = "low_delay.md", "low_delay.csv"


@dataclass(frozen=True)
class Row:
    """A live stream of one block per packet: its delay, and its bits at SNR_DB.

    `codec_ms`: a packet and the overlap of blocks. `*_ms` further: of the whole chain to the DAC; None for a codec of
    others. `*_late`: packets that were late, of all runs. `encode_ms`, `decode_ms`: computation for a packet, at the
    host and by a Cortex-M4. `wire_bps`: with frames.
    """

    codec: str
    rate_hz: int
    block: str
    playout_ms: float | None
    codec_ms: float
    snr_db: float
    payload_bps: float
    wire_bps: float
    serial_ms: float | None = None
    usb_ms: float | None = None
    serial_late: int | None = None
    usb_late: int | None = None
    output_ms: float | None = None
    encode_ms: float | None = None
    decode_ms: float | None = None


@click.command()
@OUT
def main(out: Path) -> None:
    """Measure the delay of live streams down to the least and their bits, and write the page low_delay.md."""
    recording = vibrocast.load(RECORDING)
    with errors_in_one_line():
        rows = [chain(recording, *each) for each in CHAINS]
        rows += [opus(recording, frame) for frame in OPUS_FRAMES]
        write_rows(results_folder(out) / TABLE, rows, Row)
        write(out / PAGE, page(rows))


def chain(recording: Recording, rate_hz: int, block: str, playout_ms: float) -> Row:
    """Measure a live stream of `mdct` on the simulated controllers, and its bits."""
    bits, coded = _coded("mdct", recording, rate_hz, block, {"hop": block})
    found = {}
    for address, link in ADDRESSES.items():
        bench = Bench((BenchController(address, address),))
        with bench_file.connect(bench, bench.first) as controller:
            measured = subject(bench, controller)
            found[link] = [
                measure_latency(
                    controller,
                    measured.actuator,
                    measured.scene[0],
                    seconds=SECONDS,
                    rate_hz=rate_hz,
                    setting={"hop": block},
                    playout_delay_s=playout_ms / 1e3,
                )
                for _ in range(RUNS)
            ]
    parts = _middle(found["USB"]).parts
    cycles = decoding_cycles(codec.codec_by_name("mdct").identifier, coded.configuration, 1, None)
    return replace(
        bits,
        playout_ms=playout_ms,
        serial_ms=_middle(found["serial"]).total_ms,
        usb_ms=_middle(found["USB"]).total_ms,
        serial_late=sum(run.lost_packets for run in found["serial"]),
        usb_late=sum(run.lost_packets for run in found["USB"]),
        output_ms=parts["drive"].median_ms + parts["dac"].median_ms,
        encode_ms=parts["encode"].median_ms,
        decode_ms=1e3 * cycles * int(block) / CLOCK_HZ,
    )


def opus(recording: Recording, frame: str) -> Row:
    """Return Opus with frames of this many samples at 8000 Hz; the chain is not measured with it."""
    return _coded("opus", recording, 8000, frame, {"frame_samples": frame})[0]


def _coded(
    name: str, recording: Recording, rate_hz: int, block: str, setting: codec.Setting
) -> tuple[Row, CodedSignal]:
    """Return the row with the codec's delay and bits, and the coded recording: one block per packet, at SNR_DB."""
    samples = textures.resample(recording, rate_hz).samples
    framing = Framing(int(block), max(1, int(live.REFRESH_S * rate_hz / int(block))))
    source = Source(samples, rate_hz, name, recording.unit, live=True, framing=framing)
    coded = codec.encode_to_snr(source, SNR_DB, setting)
    seconds = len(samples) / rate_hz
    decoder = codec.decoder(codec.codec_by_name(name).identifier, coded.configuration, 1)
    payload = sum(map(len, coded.packets))
    reached_db = codec.snr_db(samples, codec.decode(coded))
    assert reached_db is not None, "the recording is not silent"
    row = Row(
        codec=name,
        rate_hz=rate_hz,
        block=block,
        playout_ms=None,
        codec_ms=1e3 * (decoder.packet_samples - 1 + decoder.delay_samples) / rate_hz,
        snr_db=reached_db,
        payload_bps=8 * payload / seconds,
        wire_bps=8 * (payload + sum(map(added_bytes, coded.packets))) / seconds,
    )
    return row, coded


def _middle(runs: list[Latency]) -> Latency:
    return sorted(runs, key=lambda run: run.total_ms)[len(runs) // 2]


def page(rows: list[Row]) -> str:
    """Return the page."""
    return render(
        "low_delay",
        rows=rows,
        default=rows[0],
        low=rows[len(CHAINS) - 1],
        rate_hz=live.LOW_DELAY_RATE_HZ,
        low_ms=LOW_MS,
        snr_db=SNR_DB,
        runs=RUNS,
        seconds=SECONDS,
        recording=RECORDING,
        machine=machine(),
    )


if __name__ == "__main__":
    main()
