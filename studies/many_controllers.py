"""Measures CPU time of streaming to many controllers: `python -m studies.many_controllers --out docs/benchmarks`."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from studies.page import OUT, errors_in_one_line, render, results_folder, write, write_rows
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import MAX_CHANNELS
from vibrocast.device_protocol.transports import SerialTransport
from vibrocast.firmware.build import build
from vibrocast.host import player
from vibrocast.host.cli.option_types import Whole, positive
from vibrocast.host.controller import Controller
from vibrocast.host.event_loop import run_all
from vibrocast.host.harness import machine
from vibrocast.textures import Recording

KINDS = {
    "firmware": "firmware",
    "null": "packet counters",
}
RATE_HZ = 2800
PAGE = "many_controllers.md"
TABLE = "many_controllers.csv"


@dataclass(frozen=True)
class Measured:
    """The cost of streaming. `host_share`: CPU time of this process for each second of playback, 1 = a core.

    `controllers_share`: the same of all processes of the controllers together. `failed`: how many did not finish.
    """

    kind: str
    controllers: int
    channels: int
    host_share: float
    controllers_share: float
    underruns: int
    lost_packets: int
    failed: int

    def __str__(self) -> str:
        return (
            f"{self.controllers} controllers ({self.kind}) of {self.channels} channels: the host takes "
            f"{self.host_share:.3f} of a core, the controllers {self.controllers_share:.3f}; underruns "
            f"{self.underruns}, lost packets {self.lost_packets}, failed {self.failed}"
        )


def noise(channels: int, seconds: float) -> Stream:
    """Return a coded stream of noise, a few kbit/s for each channel."""
    samples = 5.0 * np.random.default_rng(1).standard_normal((round(seconds * RATE_HZ), channels))
    return encode_recording(Recording(samples, float(RATE_HZ), "um", "noise"), live=True).stream


def commands_of(kind: str, count: int, channels: int) -> list[list[str]]:
    """Return the commands that run `count` controllers, which may have to be compiled first."""
    if kind == "firmware":
        return [[str(build("host", {"VC_CHANNELS": channels, "VC_CAPTURE_SAMPLES": 0}))]] * count
    return [[sys.executable, "-m", "studies.null_controllers", str(count)]]


@contextlib.contextmanager
def ports(commands: Sequence[Sequence[str]], count: int, cores: Sequence[int]) -> Iterator[list[str]]:
    """Run `count` controllers on some cores; yield the names of their serial ports."""
    processes = []
    try:
        for command in commands:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            processes.append(process)
            if cores:
                os.sched_setaffinity(process.pid, cores)
        lines = count // len(commands)
        yield [process.stdout.readline().strip() for process in processes for _ in range(lines) if process.stdout]
    finally:
        for process in processes:
            process.communicate()


def measure(kind: str, count: int, channels: int, seconds: float, buffer_s: float) -> Measured:
    """Stream to `count` controllers at once, without reading back; this process on one core, theirs on the others."""
    stream = noise(channels, seconds)
    packet_samples = stream.decoder().packet_samples
    settings = player.PlaybackSettings(buffer_s=buffer_s)
    commands = commands_of(kind, count, channels)
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[:1])
    children_s = os.times().children_user + os.times().children_system
    try:
        with ports(commands, count, cores[1:]) as names, contextlib.ExitStack() as stack:
            controllers = [Controller(stack.enter_context(SerialTransport(name))) for name in names]
            works = {
                number: (each, player.play_steps(each, stream.header, stream.packets, packet_samples, settings))
                for number, each in enumerate(controllers)
            }
            began_s = time.process_time()
            results = run_all(works).values()
            took_s = time.process_time() - began_s
    finally:
        os.sched_setaffinity(0, cores)
    children_s = os.times().children_user + os.times().children_system - children_s
    for result in results:
        if isinstance(result, Exception):
            print(f"failed: {result}", file=sys.stderr)
    played = [result for result in results if isinstance(result, player.PlaybackResult)]
    return Measured(
        kind,
        count,
        channels,
        took_s / seconds,
        children_s / seconds,
        sum(result.underruns for result in played),
        sum(result.lost_packets for result in played),
        count - len(played),
    )


def page(rows: Sequence[Measured], seconds: float, buffer_s: float) -> str:
    """Return the page with the table."""
    return render(
        "many_controllers",
        rows=rows,
        kinds=KINDS,
        seconds=seconds,
        buffer_s=buffer_s,
        processor=machine()["processor"],
        cores=os.cpu_count(),
    )


@click.command()
@click.option(
    "--controllers",
    "counts",
    type=Whole("NUMBER", 1),
    multiple=True,
    default=(1, 20, 50, 100),
    show_default=True,
    help="Measure with this number of controllers; may be repeated.",
)
@click.option(
    "--channels", type=Whole("NUMBER", 1, MAX_CHANNELS), default=10, show_default=True, help="Set the channels of each."
)
@click.option("--seconds", type=positive("s"), default=10.0, show_default=True, help="Set the duration.")
@click.option(
    "--buffer-s", type=positive("s"), default=player.BUFFER_S, show_default=True, help="Set the buffer of each."
)
@click.option(
    "--kind",
    "kinds",
    type=click.Choice(list(KINDS)),
    multiple=True,
    default=tuple(KINDS),
    show_default=True,
    help="Choose the kind of controllers; may be repeated.",
)
@OUT
def main(
    counts: tuple[int, ...], channels: int, seconds: float, buffer_s: float, kinds: tuple[str, ...], out: Path
) -> None:
    """Measure hosts with many controllers, and write the page many_controllers.md."""
    with errors_in_one_line():
        rows = []
        for kind in kinds:
            for count in counts:
                rows.append(measure(kind, count, channels, seconds, buffer_s))
                click.echo(rows[-1])
        write_rows(results_folder(out) / TABLE, rows, Measured)
        write(out / PAGE, page(rows, seconds, buffer_s))


if __name__ == "__main__":
    main()
