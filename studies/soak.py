"""Streams for half an hour on a busy machine: `python -m studies.soak --out docs/benchmarks`."""

import multiprocessing
import os
from collections.abc import Sequence
from pathlib import Path

import click

from studies.page import OUT, errors_in_one_line, render, results_folder, write, write_rows
from vibrocast import progress, textures
from vibrocast.harness.live_run import run_live
from vibrocast.harness.measurements import machine
from vibrocast.host import devices, live
from vibrocast.host import playback as end_to_end
from vibrocast.host.cli.option_types import Whole, positive
from vibrocast.host.live_watch import Minute

PAGE, TABLE = "soak.md", "soak.csv"
TEXTURE_S = 30.0
"""The texture is repeated after this time."""


def spin() -> None:
    """Keep a core busy."""
    while True:
        pass


def page(minutes: Sequence[Minute], busy: int, playout_delay_ms: float) -> str:
    """Return the page of a soak while `busy` loops ran."""
    causes = {cause: sum(minute.cause == cause for minute in minutes) for cause in ("host", "wire", "device")}
    return render(
        "soak",
        minutes=minutes,
        busy=busy,
        playout_delay_ms=playout_delay_ms,
        causes=causes,
        processor=machine()["processor"],
        cores=os.cpu_count(),
    )


@click.command()
@click.option("--minutes", type=positive("min"), default=30.0, show_default=True, help="Stream for so long.")
@click.option("--busy", type=Whole("NUMBER", 0), default=1, show_default=True, help="Run loops that keep cores busy.")
@click.option(
    "--playout-delay-ms",
    type=positive("ms"),
    default=1e3 * live.PLAYOUT_DELAY_S,
    show_default=True,
    help="Delay the output to bear late packets.",
)
@OUT
def main(minutes: float, busy: int, playout_delay_ms: float, out: Path) -> None:
    """Soak the simulated controller on a busy machine, and write the page soak.md."""
    loops = [multiprocessing.Process(target=spin, daemon=True) for _ in range(busy)]
    with errors_in_one_line(), devices.connect("sim") as controller, progress.bar("soaking") as update:
        for loop in loops:
            loop.start()
        try:
            run = run_live(
                end_to_end.member(controller, "sim", None),
                textures.GENERATORS["rough"](seconds=TEXTURE_S),
                60 * minutes,
                playout_delay_s=playout_delay_ms / 1e3,
                progress=lambda seconds: update(seconds / (60 * minutes), f"{seconds:.0f} s"),
            )
        finally:
            for loop in loops:
                loop.kill()
        write_rows(results_folder(out) / TABLE, run.minutes, Minute)
        write(out / PAGE, page(run.minutes, busy, playout_delay_ms))


if __name__ == "__main__":
    main()
