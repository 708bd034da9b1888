"""Measures the time of encoding and decoding on one core, beside a fixed workload: `python -m evaluation.speed`."""

import json
import platform
import time
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.table import Table

import codec
from textures.generate import varying_speed, wood

RATE_HZ = 2800
SECONDS = 180.0
STEPS = (1.0, 0.5, 0.25)  # relative to the RMS value


def processor_seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the median processor time of `work`, all threads together, after one run that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return median(times)


def reference_seconds(repeats: int) -> float:
    """Return the time of the reference workload: zlib, level 6, of four million bytes of seeded Gaussian noise.

    Integer work in C on one core, so a ratio to it says more of another machine than seconds do.
    """
    noise = np.random.default_rng(0).normal(0, 8, 4_000_000).astype(np.int8).tobytes()
    return processor_seconds(lambda: zlib.compress(noise, 6), repeats)


def measure(codec_name: str, repeats: int) -> dict[str, Any]:
    """Return the times, in seconds per million samples, at each of STEPS, and that of the reference workload."""
    speed = varying_speed(SECONDS, RATE_HZ)
    samples = wood(0, SECONDS, speed, RATE_HZ).samples
    megasamples = len(samples) / 1e6
    reference_s = reference_seconds(repeats)
    results: list[dict[str, float | None]] = []
    for step in STEPS:
        encode = partial(codec.encode, samples, RATE_HZ, {"step": step}, codec=codec_name)
        coded = encode()
        encode_s = processor_seconds(encode, repeats)
        decode_s = processor_seconds(partial(codec.decode, coded), repeats)
        results.append(
            {
                "step": step,
                "snr_db": codec.snr_db(samples, codec.decode(coded)),
                "bits_per_sample": 8 * sum(map(len, coded.packets)) / len(samples),
                "encode_s_per_megasample": encode_s / megasamples,
                "decode_s_per_megasample": decode_s / megasamples,
                "both_over_reference": (encode_s + decode_s) / megasamples / reference_s,
            }
        )
    return {
        "codec": codec_name,
        "samples": len(samples),
        "repeats": repeats,
        "reference_s": reference_s,
        "machine": platform.machine(),
        "python": platform.python_version(),
        "results": results,
    }


HEADER = ("SNR, dB", "bits per sample", "encode, s", "decode, s", "both, s", "both / reference")


def table_rows(figures: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return one row of text for each step."""
    rows = []
    for result in figures["results"]:
        encode_s, decode_s = result["encode_s_per_megasample"], result["decode_s_per_megasample"]
        seconds = (f"{value:.3f}" for value in (encode_s, decode_s, encode_s + decode_s))
        snr, bits = f"{result['snr_db']:.1f}", f"{result['bits_per_sample']:.2f}"
        rows.append((snr, bits, *seconds, f"{result['both_over_reference']:.2f}"))
    return rows


def markdown(figures: dict[str, Any]) -> str:
    """Return the page that holds the table."""
    lines = [
        f"# Speed of `{figures['codec']}`",
        "",
        "Written by `python -m evaluation.speed`: processor seconds per million samples on one core of a shared",
        f"{figures['machine']} machine, median of {figures['repeats']} runs without process start, coding one channel",
        f"of {SECONDS:g} s of a generated wood texture at a given step, without the search for a rate or an SNR.",
        f"Reference: zlib, level 6, of four million bytes of noise in the same run, {figures['reference_s']:.3f} s.",
        "",
        f"| {' | '.join(HEADER)} |",
        "|---:" * len(HEADER) + "|",
        *(f"| {' | '.join(row)} |" for row in table_rows(figures)),
        "",
    ]
    return "\n".join(lines)


@click.command()
@click.option("--codec", "codec_name", type=click.Choice(sorted(codec.CODECS)), default="mdct", show_default=True)
@click.option("--repeats", type=click.IntRange(min=1), default=5, show_default=True, help="The median of so many runs.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for speed.md and speed.json.")
def main(codec_name: str, repeats: int, out: Path | None) -> None:
    """Print processor seconds per million samples, encoding and decoding a generated texture, one channel."""
    figures = measure(codec_name, repeats)
    table = Table(*HEADER)
    for row in table_rows(figures):
        table.add_row(*row)
    console = Console()
    console.print(f"{codec_name}: processor seconds per million samples, median of {repeats} runs")
    console.print(table)
    console.print(f"reference, zlib level 6 of 4 million bytes of noise: {figures['reference_s']:.3f} s")
    if out:
        try:
            out.mkdir(parents=True, exist_ok=True)
            (out / "speed.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
            (out / "speed.md").write_text(markdown(figures), encoding="utf-8")
        except OSError as error:
            raise click.ClickException(f"{out}: cannot be written: {error.strerror}") from error


if __name__ == "__main__":
    main()
