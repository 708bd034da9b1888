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
from torch import Tensor, nn

from studies import page
from studies.papers import ABLATION, Ablation
from vibrocast import progress, workers
from vibrocast.codec.eva import LatentEncoder, configuration
from vibrocast.export import model_card, training_data
from vibrocast.export.configuration import Configuration, ModelChoice, Schedule, Sweep, read
from vibrocast.export.eva import HOP_SAMPLES, DeadZone
from vibrocast.export.priors import MIN_SCALE, laplace_bits
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
CONTEXTS = "contexts"
"""A cost of this study alone: bits by the magnitudes of neighbouring latents."""
_NEIGHBOURS = 2
_COLUMNS = 3
_AVERAGED_COLUMNS = 24
_AVERAGE_FORGETS = 1 / 8
_ESTIMATES = 4


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
    Variant("contexts of neighbouring latents", False, {"cost": CONTEXTS}),
    Variant("", True),
    Variant("twice the steps", True, {"steps": 8000}),
    Variant("learning rate 8e-3", True, {"learning_rate": 8e-3}),
    Variant("random start", True, {"start": "random"}),
    Variant("noise, no dead zone", True, {"rounding": "noise", "dead_zone": 0.0}),
    Variant("no dead zone", True, {"dead_zone": 0.0}),
    Variant("static cost", True, {"cost": "static"}),
    Variant("contexts of neighbouring latents", True, {"cost": CONTEXTS}),
)


class ContextPrior(nn.Module):
    """A Laplace density whose scale follows earlier magnitudes: a differentiable stand-in for adaptive coding.

    Four weighted sums of neighbouring magnitudes - two lower channels of this column, five channels of the last three,
    and a running average - each plus a constant, are combined as powers, with weights for each channel. The sums start
    as the expected magnitude of firmware/src/core/vc_mdct_model.c.
    """

    def __init__(self, latents: int) -> None:
        super().__init__()
        # Channels k - 2 to k + 2 by columns t - 3 to t, of magnitudes and of their running average.
        expected = torch.zeros(2, 2 * _NEIGHBOURS + 1, _COLUMNS + 1)
        expected[0, :, 3] = torch.tensor([8.0, 28.0, 0.0, 0.0, 0.0])
        expected[0, :, 2] = torch.tensor([1.0, 6.0, 21.0, 18.0, 2.0])
        expected[0, :, 1] = torch.tensor([1.0, 1.0, 12.0, 3.0, 1.0])
        expected[0, :, 0] = torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0])
        expected[1, :, 3] = torch.tensor([1.0, 2.0, 26.0, 2.0, 1.0])
        spread = torch.tensor([0.25, 0.5, 1.0, 2.0])[:, None, None, None]
        known = (expected > 0).float()
        self.register_buffer("known", known, persistent=False)
        self.root_weight = nn.Parameter(torch.sqrt((expected / 128) ** spread * known))
        self.root_constant = nn.Parameter(torch.full((_ESTIMATES,), 0.4))
        self.power = nn.Parameter(torch.tensor([0.1, 0.2, 0.6, 0.1])[:, None].repeat(1, latents))
        self.offset = nn.Parameter(torch.zeros(latents))
        average = _AVERAGE_FORGETS * (1 - _AVERAGE_FORGETS) ** torch.arange(_AVERAGED_COLUMNS - 1, -1, -1)
        self.register_buffer("average", average[None, None], persistent=False)

    def scales(self, contexts: Tensor) -> Tensor:
        """Return the expected magnitudes of latents (batch, channels, columns) before they are known."""
        columns = contexts.shape[2]
        magnitudes = torch.abs(contexts)
        earlier = nn.functional.pad(magnitudes.reshape(-1, 1, columns), (_AVERAGED_COLUMNS, -1))
        average = nn.functional.conv1d(earlier, self.get_buffer("average")).reshape(magnitudes.shape)
        both = nn.functional.pad(torch.stack([magnitudes, average], 1), (_COLUMNS, 0, _NEIGHBOURS, _NEIGHBOURS))
        weight = self.root_weight**2 * self.get_buffer("known")
        sums = torch.log(nn.functional.conv2d(both, weight, self.root_constant**2 + 1e-3))
        exponent = torch.einsum("bekt,ek->bkt", sums, self.power) + self.offset[:, None]
        return torch.exp(exponent.clamp(max=20.0)) + MIN_SCALE

    def bits(self, values: Tensor, contexts: Tensor) -> Tensor:
        """Return the bits of each of `values` given the latents before it: all (batch, latents, columns).

        `contexts`: the rounded latents. When a latent is coded, those of its column's lower channels and of all earlier
        columns are known. In training `values` hold noise in place of rounding.
        """
        return laplace_bits(values, self.scales(contexts))


class _ContextTraining(Training):
    """Trains with bits that a Laplace density estimates from the magnitudes of neighbouring latents."""

    def _begin_optimiser(self) -> None:
        self.contexts = ContextPrior(self.configuration.model.width)
        super()._begin_optimiser()
        self._parameters += self.contexts.parameters()
        self._optimiser = torch.optim.Adam(self._parameters, lr=self._schedule.learning_rate)

    def _bits(self, values: Tensor, rounded: Tensor) -> Tensor:
        return self.contexts.bits(values, rounded)


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
    """Return the training of a variant; CONTEXTS changes no configuration. Raises InputError, OSError."""
    whole = read(CONFIGURATION)
    changes = {"width": WIDTH, "lambda_": LAMBDA, "steps": STEPS, **({} if variant.ours else PAPER), **variant.changes}
    if changes.get("cost") == CONTEXTS:
        changes["cost"] = "adaptive"

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
    with_contexts = variant.changes.get("cost") == CONTEXTS
    chosen = configured(variant)
    training = (_ContextTraining if with_contexts else Training)(chosen, folder, torch.device("cpu"))
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
            if with_contexts:
                bits = float(training._bits(levels, levels).sum())
            else:
                bits = _coded_bits(image, levels[0].numpy().astype(np.int32))
        coded.append(bits / signal.shape[-1])
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
