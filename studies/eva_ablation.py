"""Measures each part of EVA's training alone: `python -m studies.eva_ablation RECORDINGS --out docs/benchmarks`."""

import tempfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from msgspec.structs import replace

from studies import page
from studies.papers import ABLATION, Ablation
from vibrocast import progress, workers
from vibrocast.codec.eva import LatentEncoder, configuration
from vibrocast.export import model_card, training_data
from vibrocast.export.configuration import Configuration, ModelChoice, Schedule, Sweep, read
from vibrocast.export.eva import HOP_SAMPLES, DeadZone
from vibrocast.export.quantise import quantise
from vibrocast.export.training import Training

CONFIGURATION = Path(__file__).parents[1] / "examples/eva.toml"
LAMBDA, WIDTH, STEPS = 6.0, 16, 4000
PACKET_COLUMNS = 64
PAPER: dict[str, Any] = {
    "start": "random",
    "rounding": "noise",
    "dead_zone": 0.0,
    "cost": "static",
    "learning_rate": 8e-3,
}
"""The parts of the EVA paper's training. It states no learning rate; of 1e-3, 2e-3 and 8e-3, this one was best."""


@dataclass(frozen=True)
class Variant:
    """A training that differs in `changes` from the paper's or, with `ours`, from that of examples/eva.toml."""

    name: str
    ours: bool
    changes: dict[str, Any] = field(default_factory=dict)


VARIANTS = (
    Variant("", False),
    Variant("twice the steps", False, {"steps": 8000}),
    Variant("learning rate 2e-3", False, {"learning_rate": 2e-3}),
    Variant("lapped start", False, {"start": "lapped"}),
    Variant("straight-through rounding", False, {"rounding": "straight-through"}),
    Variant("straight-through rounding, dead zone", False, {"rounding": "straight-through", "dead_zone": 0.12}),
    Variant("adaptive cost", False, {"cost": "adaptive"}),
    Variant("", True),
    Variant("twice the steps", True, {"steps": 8000}),
    Variant("learning rate 8e-3", True, {"learning_rate": 8e-3}),
    Variant("random start", True, {"start": "random"}),
    Variant("noise, no dead zone", True, {"rounding": "noise", "dead_zone": 0.0}),
    Variant("no dead zone", True, {"dead_zone": 0.0}),
    Variant("static cost", True, {"cost": "static"}),
)


@dataclass(frozen=True)
class Measured:
    """Of all held-back recordings: mean bits per sample, squared error and SNR, and the latents that were not zero."""

    bits: float
    squared_error: float
    snr_db: float
    living: int


@page.study
@page.FOLDER
def main(folder: Path, out: Path) -> None:
    """Train every variant on FOLDER, which holds the archives of examples/eva.toml, and write a table."""
    tasks = iter([(number, partial(_measured, variant, folder)) for number, variant in enumerate(VARIANTS)])
    measured: dict[int, Measured] = {}
    with progress.bar("training") as update, closing(workers.on_cores(tasks, processes=workers.cores())) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, Exception):
                raise click.ClickException(f"{VARIANTS[number].name}: {outcome}")
            measured[number] = outcome
            update(len(measured) / len(VARIANTS), VARIANTS[number].name)
    rows = rows_of([measured[number] for number in range(len(VARIANTS))])
    page.write_rows(page.results_folder(out) / ABLATION, rows, Ablation)


def rows_of(measured: Sequence[Measured]) -> list[Ablation]:
    """Return the rows of the variants' measurements, in the order of VARIANTS."""
    rows = []
    for variant, own in zip(VARIANTS, measured, strict=True):
        reference = measured[[each.ours for each in VARIANTS].index(variant.ours)]
        more = own.bits - reference.bits + LAMBDA * (own.squared_error - reference.squared_error)
        recipe = "examples/eva.toml" if variant.ours else "the paper"
        rows.append(Ablation(recipe, variant.name, own.bits, own.snr_db, own.living, 100 * more / reference.bits))
    return rows


def configured(variant: Variant) -> Configuration:
    """Return the training of a variant. Raises InputError, OSError."""
    whole = read(CONFIGURATION)
    changes = {"width": WIDTH, "lambda_": LAMBDA, "steps": STEPS, **({} if variant.ours else PAPER), **variant.changes}

    def of(table: type[ModelChoice | Schedule]) -> dict[str, Any]:
        return {name: value for name, value in changes.items() if name in table.__struct_fields__}

    return replace(
        whole,
        model=replace(whole.model, **of(ModelChoice)),
        training=replace(whole.training, **of(Schedule)),
        sweep=Sweep(),
    )


def _measured(variant: Variant, folder: Path) -> Measured:
    """Train a variant, and code the held-back recordings."""
    torch.set_num_threads(1)
    chosen = configured(variant)
    training = Training(chosen, folder, torch.device("cpu"))
    with tempfile.TemporaryDirectory() as out:
        training.run(Path(out), lambda part, details="", /: None)
    model, prior = training.state.model.eval(), training.state.prior
    rate_hz = chosen.training.rate_hz
    traces = training_data.load(chosen.sources, folder, rate_hz)
    trained, held_back = training_data.split(traces, chosen.held_back, chosen.seed)
    image = quantise(model, prior, [trace.samples.astype(np.float64) for trace in trained]).pack()
    narrowed = DeadZone(model.shape.latents, chosen.training.dead_zone)
    coded, errors, living = [], [], np.zeros(model.shape.latents, dtype=bool)
    for recording in model_card.recordings_of(held_back, rate_hz):
        columns = len(recording.samples) // (HOP_SAMPLES * PACKET_COLUMNS) * PACKET_COLUMNS
        signal = torch.from_numpy(recording.samples[: columns * HOP_SAMPLES, 0]).float()
        signal = (signal / torch.sqrt(torch.mean(signal**2)))[None, None]
        with torch.no_grad():
            levels = torch.round(narrowed(model.analysis(signal)))
            errors.append(float(torch.mean((model.synthesis(levels) - signal) ** 2)))
        coded.append(_coded_bits(image, levels[0].numpy().astype(np.int32)) / signal.shape[-1])
        living |= np.any(levels[0].numpy() != 0, axis=1)
    snr_db = float(np.mean(-10 * np.log10(errors)))
    return Measured(float(np.mean(coded)), float(np.mean(errors)), snr_db, int(living.sum()))


def _coded_bits(image: bytes, levels: np.ndarray[Any, np.dtype[np.int32]]) -> int:
    """Return the bits of the packets of levels, int32 (latents, columns), by the coder that ships."""
    encoder = LatentEncoder(configuration(PACKET_COLUMNS, [0]), 1, image, 0)
    packets = np.split(levels, levels.shape[1] // PACKET_COLUMNS, axis=1)
    return sum(8 * len(encoder.encode([packet])) for packet in packets)


if __name__ == "__main__":
    main()
