"""Measures CPU time of streaming to many controllers: `python -m studies.many_controllers --out docs/benchmarks`."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from studies import page
from studies.latency import PARTS
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.source import recording_format
from vibrocast.device_protocol.transports import SerialTransport
from vibrocast.firmware.build import build
from vibrocast.harness.measurements import machine
from vibrocast.host import player
from vibrocast.host.controller import Controller
from vibrocast.host.event_loop import run_all
from vibrocast.host.live import LiveStream, paced
from vibrocast.textures import GENERATORS, Recording

RATE_HZ = 2800
CHANNELS = 10
CONTROLLERS = (1, 20, 50, 100)
SECONDS = 10.0
TABLE = "many_controllers.csv"
LIVE_TABLE = "many_live_streams.csv"
LIVE_STREAMS = (1, 10, 100)
LIVE_TEXTURE = "wood"
LIVE_FIGURES = {
    "median_ms": ("**sample to wire: median**, ms", ".2f"),
    "p99_ms": ("99 % are below, ms", ".2f"),
    "max_ms": ("maximum, ms", ".2f"),
    "jitter_ms": ("jitter of the stream with the most, ms", ".2f"),
    "wake_ms": (f"{PARTS['wake']}, ms", ".2f"),
    "turn_ms": ("waiting for the streams before it, ms", ".2f"),
    "encode_ms": (f"{PARTS['encode']}, ms", ".2f"),
    "send_ms": (f"{PARTS['send']}, ms", ".2f"),
    "round_ms": ("work for a packet of every stream, receiving included, ms", ".2f"),
    "host_share": ("host's share", ".3f"),
    "unsent_percent": ("packets left out, because too late, %", ".1f"),
    "restarts": ("streams begun again", "d"),
}


@dataclass(frozen=True)
class Measured:
    """The cost of streaming. `host_share`: CPU time of this process for each second of playback, 1 = a core.

    `controllers_share`: the same of all processes of the controllers together. `failed`: how many did not finish.
    """

    controllers: int
    channels: int
    host_share: float
    controllers_share: float
    underruns: int
    lost_packets: int
    failed: int


@dataclass(frozen=True)
class LiveMeasured:
    """Live streams of one channel: the times from a packet's last sample to the end of its write, and their parts.

    `jitter_ms`: between the 5 % and the 95 % of a stream's times. Parts, `wake_ms` to `send_ms`, are medians.
    `round_ms`: the median work for a packet, receiving included, times the streams. `host_share`: as in Measured.
    """

    streams: int
    restarts: int
    packet_ms: float
    median_ms: float
    p99_ms: float
    max_ms: float
    jitter_ms: float
    wake_ms: float
    turn_ms: float
    encode_ms: float
    send_ms: float
    round_ms: float
    host_share: float
    unsent_percent: float


@contextlib.contextmanager
def connected(count: int, channels: int) -> Iterator[list[Controller]]:
    """Run and connect `count` controllers, which may have to be compiled first.

    This process stays on one core, and those of the controllers share the others, if there are any.
    """
    program = build("host", {"VC_CHANNELS": channels, "VC_CAPTURE_SAMPLES": 0})
    own, *others = every = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, [own])
    processes = []
    try:
        for _ in range(count):
            process = subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            processes.append(process)
            os.sched_setaffinity(process.pid, others or every)
        ports = [process.stdout.readline().strip() for process in processes if process.stdout]
        with contextlib.ExitStack() as stack:
            yield [Controller(stack.enter_context(SerialTransport(port))) for port in ports]
    finally:
        for process in processes:
            process.communicate()
        os.sched_setaffinity(0, every)


def measure(count: int) -> Measured:
    """Stream noise to `count` controllers at once, a few kbit/s for each channel, without reading back."""
    samples = 5.0 * np.random.default_rng(1).standard_normal((round(SECONDS * RATE_HZ), CHANNELS))
    stream = encode_recording(Recording(samples, float(RATE_HZ), "um", "noise"), live=True).stream
    settings = player.PlaybackSettings()
    with connected(count, CHANNELS) as controllers:
        before = os.times()  # children count once they have ended, so the compiler is left out
        works = {number: (each, player.play_steps(each, stream, settings)) for number, each in enumerate(controllers)}
        began_s = time.process_time()
        results = run_all(works).values()
        took_s = time.process_time() - began_s
    after = os.times()
    children_s = after.children_user + after.children_system - before.children_user - before.children_system
    for result in results:
        if isinstance(result, Exception):
            print(f"failed: {result}", file=sys.stderr)
    played = [result for result in results if isinstance(result, player.PlaybackResult)]
    return Measured(
        count,
        CHANNELS,
        round(took_s / SECONDS, 3),
        round(children_s / SECONDS, 3),
        sum(result.underruns for result in played),
        sum(result.lost_packets for result in played),
        count - len(played),
    )


def measure_live(count: int) -> LiveMeasured:
    """Stream to `count` controllers as a program does that reads blocks of all channels and sends each its own."""
    sources = [GENERATORS[LIVE_TEXTURE](seed=seed, seconds=SECONDS, rate_hz=RATE_HZ) for seed in range(count)]
    with connected(count, 1) as controllers:
        streams = [LiveStream(*each) for each in zip(controllers, map(recording_format, sources), strict=True)]
        packet_samples, clock = streams[0].packet_samples, controllers[0].clock
        rounds = len(sources[0].samples) // packet_samples
        samples = np.hstack([source.samples for source in sources])[: rounds * packet_samples]
        times_s = np.full((rounds, count, 6), np.nan)
        began_s = time.process_time()
        for (due_s, block), times_of_round in zip(paced(streams[0], samples), times_s, strict=True):
            awake_s = clock()
            for number, stream in enumerate(streams):  # the steps of `LiveStream.send`, to time each
                turn_s = clock()
                packets = stream.coded(block[:, [number]])
                coded_s = clock()
                stream.send_packets(packets)
                sent_s = clock()
                stream.keep_up()
                if packets:
                    times_of_round[number] = due_s, awake_s, turn_s, coded_s, sent_s, clock()
        took_s = time.process_time() - began_s
    times_ms = 1e3 * times_s[1:]  # the first packet waited for the start of its stream
    totals_ms = times_ms[..., 4] - times_ms[..., 0]
    early_ms, late_ms = np.nanquantile(totals_ms, (0.05, 0.95), axis=0)
    figures = [
        1e3 * streams[0].packet_s,
        *np.nanquantile(totals_ms, (0.5, 0.99, 1)),
        np.nanmax(late_ms - early_ms),
        *np.nanmedian(np.diff(times_ms), axis=(0, 1))[:4],
        count * np.nanmedian(times_ms[..., 5] - times_ms[..., 2]),
        took_s / SECONDS,
        100 * sum(stream.dropped_packets for stream in streams) / (rounds * count),
    ]
    restarts = sum(stream.begun - 1 for stream in streams)
    return LiveMeasured(count, restarts, *(round(float(each), 3) for each in figures))


@page.study
def main(out: Path) -> None:
    """Measure hosts with many controllers, and write the page many_controllers.md."""
    rows, live = [measure(count) for count in CONTROLLERS], [measure_live(count) for count in LIVE_STREAMS]
    use = {"processor": machine()["processor"], "cores": os.cpu_count(), "buffer_s": player.BUFFER_S}
    text = page.render("many_controllers", globals(), rows=rows, live=live, **use)
    page.publish(out, "many_controllers", text, ((TABLE, rows, Measured), (LIVE_TABLE, live, LiveMeasured)))


if __name__ == "__main__":
    main()
