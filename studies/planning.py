"""Measures what planning saves at equal quality: `python -m studies.planning FOLDER... --out docs/benchmarks`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
import polars as pl

from studies import page
from vibrocast import codec, textures
from vibrocast.codec import mdct
from vibrocast.codec.encoding import DEFAULT_SNR_DB, DEFAULT_STREAM_RATE_HZ, Encoding, encode_recording
from vibrocast.codec.rate_control import added_bytes
from vibrocast.codec.threshold import DETECTION_THRESHOLD, read_threshold
from vibrocast.errors import InputError
from vibrocast.evaluation.tables import as_rows, frame
from vibrocast.host.bench_file import BenchActuator
from vibrocast.host.playback import output_delay_s
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.planner import costs
from vibrocast.planner.band import band_of, prepared
from vibrocast.planner.choose import Evaluator, choose
from vibrocast.planner.forecast import BUFFERS_MS
from vibrocast.planner.scene import MAX_DELAY_MS, Asked, Link, Scene, SceneController, SceneTexture, Weights, load
from vibrocast.textures import Profile, Recording, TextureError
from vibrocast.textures.dataset import DatasetEntry, entries

ADDRESS, CORE, CLOCK_HZ = "cortex-m4", "M4F", 168e6
HAND_SPEED_MM_S = 50.0
FREE, HELD = "any", "as the default's"
"""Delays: weighed as any other cost; or no longer than that of the default, both with the least margin."""


@dataclass(frozen=True)
class Saving:
    """One texture, planned with the weights of a scene, and the fixed default. `delay`: FREE or HELD.

    `snr_db`: of both in the band worth coding, default first. `wire_bps`: frames included. `instructions`: of decoding
    on a Cortex-M4F, in a second. `kilobytes`: flash and RAM of the decoder. `delay_ms`: from a sample at the host to
    the skin, without a link.
    """

    group: str
    texture: str
    delay: str
    highest_hz: float
    rate_hz: int
    chosen: str
    default_snr_db: float
    planned_snr_db: float
    default_wire_bps: float
    planned_wire_bps: float
    default_instructions: float
    planned_instructions: float
    default_kilobytes: float
    planned_kilobytes: float
    default_delay_ms: float
    planned_delay_ms: float


def savings(group: str, trace: DatasetEntry, unit: str | None) -> Iterator[Saving]:
    """Yield what planning a trace saves. Raises InputError."""
    recording = _loaded(trace, unit)
    default = encode_recording(recording, live=True)
    threshold = read_threshold()
    speeds = (HAND_SPEED_MM_S, HAND_SPEED_MM_S)
    band = band_of(recording, PIEZO_STACK, threshold, speeds, over_position=False)
    reference = prepared(recording, HAND_SPEED_MM_S, False, band.rate, band.lowest)
    decoded = Recording(default.stream.decode(), DEFAULT_STREAM_RATE_HZ, recording.unit, recording.name)
    in_band = prepared(decoded, HAND_SPEED_MM_S, False, band.rate, band.lowest)
    length = min(len(reference.samples), len(in_band.samples))
    default_snr_db = codec.snr_db(reference.samples[:length], in_band.samples[:length])
    assert default_snr_db is not None, "what is silent has no band worth coding"
    header = default.stream.header
    samples = default.stream.packet_samples + default.stream.delay_samples
    default_delay_s = samples / header.rate_hz + output_delay_s(header, PIEZO_STACK)
    limits_ms = {FREE: MAX_DELAY_MS, HELD: 1e3 * default_delay_s + BUFFERS_MS[-1]}
    evaluator: Evaluator | None = None
    for delay, limit_ms in limits_ms.items():
        scene = _scene(trace, recording, default_snr_db, limit_ms)
        evaluator = Evaluator(scene, scene.textures[0]) if evaluator is None else evaluator.in_scene(scene)
        chosen = choose(evaluator).chosen
        forecast = chosen.forecast
        assert forecast.instructions_per_second is not None and forecast.snr_db is not None
        assert forecast.flash_bytes is not None and forecast.ram_bytes is not None
        measured = chosen.measured
        rest_instructions = costs.rest_instructions(
            ADDRESS, CORE, recording.unit, recording.channels, band.rate, band.rate / measured.packet_samples
        )
        wire_bps, instructions, kilobytes = _default_costs(default)
        yield Saving(
            group=group,
            texture=trace.name,
            delay=delay,
            highest_hz=band.highest,
            rate_hz=band.rate,
            chosen=chosen.measured.option.name,
            default_snr_db=round(default_snr_db, 2),
            planned_snr_db=round(forecast.snr_db, 2),
            default_wire_bps=round(wire_bps),
            planned_wire_bps=round(forecast.wire_bps),
            default_instructions=round(instructions),
            planned_instructions=round(forecast.instructions_per_second - rest_instructions),
            default_kilobytes=round(kilobytes, 1),
            planned_kilobytes=round(
                (forecast.flash_bytes + forecast.ram_bytes - sum(costs.rest_memory(recording.channels))) / 1e3, 1
            ),
            default_delay_ms=round(1e3 * default_delay_s + BUFFERS_MS[0], 1),
            planned_delay_ms=round(forecast.delay_ms - chosen.buffer_ms + BUFFERS_MS[0], 1),
        )


def _loaded(trace: DatasetEntry, unit: str | None) -> Recording:
    """Load a trace; one relative to full scale, whose level nobody knows, is brought to the actuator's full stroke."""
    try:
        loaded = load([trace.path], {})
    except TextureError:
        if unit is None:
            raise
        loaded = load([trace.path], {"unit": unit})
    recording = loaded.recording(HAND_SPEED_MM_S) if isinstance(loaded, Profile) else loaded
    if recording.unit != "full scale":
        return recording
    peak: float = np.max(np.abs(recording.samples)) or 1.0
    return replace(recording, samples=recording.samples / peak)


def _scene(trace: DatasetEntry, recording: Recording, snr_db: float, delay_limit_ms: float | None) -> Scene:
    """Return a scene of a piezo stack on a Cortex-M4F that asks for an SNR, and for a delay where one is given."""
    controller = SceneController(name="controller", address=ADDRESS, core=CORE, clock_hz=CLOCK_HZ, channels=4)
    return Scene(
        path=trace.path,
        hand_speed_mm_s=(HAND_SPEED_MM_S, HAND_SPEED_MM_S),
        textures=(SceneTexture(trace.name, "controller", recording),),
        controllers=(controller,),
        actuators=(BenchActuator(PIEZO_STACK, "controller", None),),
        link=Link(math.inf, 0.0),
        asked=Asked(snr_db=snr_db, waveform=True, delay_limit_ms=delay_limit_ms),
        weights=Weights(),
        threshold_path=DETECTION_THRESHOLD,
    )


def _default_costs(default: Encoding) -> tuple[float, float, float]:
    """Return bits a second on the wire, instructions a second and kilobytes of decoding the default."""
    header, packets = default.stream.header, default.stream.packets
    seconds = len(packets) * default.stream.packet_samples / header.rate_hz
    payload_bytes = sum(map(len, packets))
    wire_bytes = payload_bytes + sum(map(added_bytes, packets))
    decoding = costs.decoder_cost(codec.DEFAULT_CODEC, CORE, str(mdct.hop_samples(header.rate_hz)))
    assert decoding is not None, "the tables have the default codec"
    bits_per_sample = 8 * payload_bytes / seconds / header.rate_hz / header.channels
    quiet = costs.quiet_part(default.stream.decode_integers())
    return (
        8 * wire_bytes / seconds,
        decoding.instructions_per_second(bits_per_sample, quiet, header.rate_hz, header.channels),
        (decoding.flash_bytes + decoding.ram_bytes(header.channels)) / 1e3,
    )


def rendered(rows: Sequence[Saving], left_out: Sequence[str], command: str) -> str:
    """Return the page. `command`: the one that measured."""

    def percent(cost: str) -> pl.Expr:
        return 100 * (pl.col(f"planned_{cost}") / pl.col(f"default_{cost}") - 1)

    costs = {"bits": percent("wire_bps"), "instructions": percent("instructions")}
    spread = [
        figure.alias(f"{name}_{of}")
        for name, cost in costs.items()
        for of, figure in (("mean", cost.mean()), ("low", cost.min()), ("high", cost.max()))
    ]
    kilobytes = (pl.col("planned_kilobytes") - pl.col("default_kilobytes")).mean().alias("kilobytes")
    table = frame(rows, Saving)
    of_group = table.group_by("group", "delay").agg(*spread, kilobytes, pl.len().alias("number"))
    savings = {(row.group, row.delay): row for row in as_rows(of_group)}
    groups = list(dict.fromkeys(row.group for row in rows))
    return page.render(
        "planning",
        globals(),
        rate_hz=DEFAULT_STREAM_RATE_HZ,
        snr_db=DEFAULT_SNR_DB,
        message={delay: _compared([savings[group, delay].bits_mean for group in groups]) for delay in (FREE, HELD)},
        groups=groups,
        savings=savings,
        left_out=left_out,
        command=command,
    )


def _compared(percents: Sequence[float]) -> str:
    """Return changes in percent as "4 to 9 % fewer", or "from 4 % fewer to 9 % more"."""
    low, high = round(min(percents)), round(max(percents))
    if low < 0 < high:
        return f"from {-low} % fewer to {high} % more"
    near, far = sorted((abs(low), abs(high)))
    return f"{near} to {far} % {'fewer' if high <= 0 else 'more'}"


def _planned(group: str, trace: DatasetEntry, unit: str | None) -> tuple[str, list[Saving], str]:
    """Return the name of a trace, and its savings, or why it cannot be planned."""
    try:
        return trace.name, list(savings(group, trace, unit)), ""
    except InputError as error:
        return trace.name, [], str(error)


@page.study
@click.argument("folders", nargs=-1, required=True, type=page.EXISTING)
@click.option("--unit", type=click.Choice(list(textures.INPUT_UNITS)), help="Give the unit of files that state none.")
def main(folders: tuple[Path, ...], out: Path, unit: str | None) -> None:
    """Plan all recordings of FOLDERS, and write the savings."""
    found = [(folder.name, trace) for folder in folders for trace in entries(folder)]
    planned = page.collected("planning", (_planned(*each, unit) for each in found), len(found), lambda each: each[0])
    rows = [saving for _, savings, _ in planned for saving in savings]
    left_out = [reason for _, _, reason in planned if reason]
    if not rows:
        raise click.ClickException("none of the recordings can be planned: " + "; ".join(left_out))
    given = "" if unit is None else f" --unit {unit}"
    names = " ".join(folder.name for folder in folders)
    command = f"python -m studies.planning {names}{given} --out docs/benchmarks"
    page.publish(out, "further_results", rendered(rows, left_out, command), [("planning.csv", rows, Saving)])


if __name__ == "__main__":
    main()
