"""Trains models: bits + lambda * distortion, from a seed to checkpoints, validated on held-back materials."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.errors import VibrocastError
from vibrocast.export import training_data
from vibrocast.export.checkpoint import Checkpoint, load
from vibrocast.export.configuration import Augmentation, Configuration
from vibrocast.export.eva import REACH_SAMPLES, DeadZone, Eva, EvaShape
from vibrocast.export.lapped_start import start_lapped
from vibrocast.export.priors import FactorisedPrior, adaptive_bits
from vibrocast.export.training_data import Excerpts
from vibrocast.models import ModelError

CHECKPOINT = "checkpoint.pt"
LOGGED = ("training_loss", "loss", "bits_per_sample", "snr_db")
"""The curves: means over the steps since the last validation, then over the held-back materials."""
_EXPLODED = 100.0
"""Multiple of the mean loss that no batch reaches in a training that goes well."""
_LAST_LEARNING_RATE = 0.02
_UNVARIED = Augmentation(gain_db=0, rate_octaves=0, polarity=False, tilt_db_per_octave=0, filter_share=0, noise_share=0)


class TrainingError(VibrocastError):
    """A training that cannot begin or resume; the message says why and what to do."""


class Tell(Protocol):
    """Reports the finished part of the training, from 0 to 1, and its state."""

    def __call__(self, part: float, details: str = "", /) -> None:
        """Report the finished part of the training, and details such as the loss."""


@dataclass(frozen=True)
class Measured:
    """For each excerpt (batch,): the loss, bits per sample, and the mean squared error of the plain signal."""

    loss: Tensor
    bits: Tensor
    squared_error: Tensor


class _Average:
    """Means, over the steps since the last validation, of loss, bits per sample and SNR in dB."""

    def __init__(self) -> None:
        self._sums, self._steps = np.zeros(3), 0

    def add(self, *values: float) -> None:
        self._sums += values
        self._steps += 1

    @property
    def means(self) -> list[float]:
        """Loss, bits per sample, SNR in dB; NaN before the first step."""
        means: list[float] = (self._sums / self._steps).tolist() if self._steps else [math.nan] * 3
        return means


class Perception:
    """The perceptual transform g_p: none, or a weight of each frequency by the detection threshold."""

    MIN_HZ = 20.0
    """Below it, the threshold counts as constant: recordings have little but drift there."""

    def __init__(self, kind: str, rate_hz: float, samples: int, device: torch.device) -> None:
        self._gain: Tensor | None = None
        if kind != "plain":
            frequency_hz = np.maximum(np.fft.rfftfreq(samples, 1 / rate_hz), self.MIN_HZ)
            unit = {"acceleration": "m/s^2", "displacement": "um"}[kind]
            gain = 1 / threshold_amplitude(read_threshold(), frequency_hz, unit)
            self._gain = torch.from_numpy(gain / np.sqrt(np.mean(gain**2))).float().to(device)

    def mean_square(self, error: Tensor) -> Tensor:
        """Return the mean square (batch,) of the transformed errors (batch, 1, n); the transform is linear."""
        if self._gain is not None:
            error = torch.fft.irfft(torch.fft.rfft(error) * self._gain, error.shape[-1])
        return torch.mean(error**2, dim=(1, 2))


class Training:
    """A training of EVA in progress: model, prior, optimiser and data."""

    def __init__(self, configuration: Configuration, data_folder: Path, device: torch.device) -> None:
        """Load the data and make a model. Raises TextureError for data that cannot be used."""
        self.configuration, self._device = configuration, device
        self._schedule = schedule = configuration.training
        traces = training_data.load(configuration.sources, data_folder, schedule.rate_hz)
        trained, held_back = training_data.split(traces, configuration.held_back, configuration.seed)
        self._excerpts = Excerpts(
            trained, schedule.excerpt_samples, schedule.rate_hz, configuration.augmentation, configuration.seed
        )
        unseen = Excerpts(held_back, schedule.excerpt_samples, schedule.rate_hz, _UNVARIED, configuration.seed)
        self._validation = self._signals(unseen.batch(0, schedule.validation_excerpts))
        inner_samples = schedule.excerpt_samples - 2 * REACH_SAMPLES
        self._perception = Perception(schedule.distortion, schedule.rate_hz, inner_samples, device)
        torch.manual_seed(configuration.seed)
        choice = configuration.model
        model = Eva(EvaShape(choice.width, choice.width))
        if choice.start == "lapped":
            start_lapped(model, choice.lambda_)
        prior = FactorisedPrior(choice.width)
        self.state = Checkpoint(model.to(device), prior.to(device), configuration.as_dict())
        self._begin_optimiser()

    def resume(self, path: Path) -> None:
        """Resume from a checkpoint. Raises ModelError if it is damaged, or of another training; OSError."""
        state = load(path)
        ours = self.configuration.as_dict()
        # The schedule may change: more steps, or a lower rate after an explosion.
        names = sorted({*ours, *state.training} - {"training"})
        if other := [name for name in names if state.training.get(name) != ours.get(name)]:
            raise ModelError(f"{path}: was trained with another {other[0]}; choose another --out, or undo the change")
        if state.model.shape != self.state.model.shape or state.optimiser is None:
            raise ModelError(f"{path}: not a checkpoint of this training; choose another --out")
        state.model.to(self._device)
        state.prior.to(self._device)
        state.training = ours
        self.state = state
        self._begin_optimiser()
        try:
            self._optimiser.load_state_dict(state.optimiser)
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise ModelError(f"{path}: its state of the optimiser is damaged; choose another --out") from error

    def run(self, out: Path, tell: Tell) -> None:
        """Train to the end of the schedule; write CHECKPOINT into a folder at every validation.

        Raises TrainingError if the loss is not a number or explodes, OSError if nothing can be written.
        """
        schedule, progress = self._schedule, self.state.progress
        average, logs = _Average(), _tensorboard_logs(out, progress["step"])
        since_s = time.monotonic() - progress["seconds"]
        for module in (self.state.model, self.state.prior):
            module.train()
        while progress["step"] < schedule.steps:
            self._step(progress["step"], average)
            progress["step"] += 1
            loss, bits, snr_db = average.means
            tell(
                progress["step"] / schedule.steps,
                f"step {progress['step']}, {bits:.3f} bit/sample, {snr_db:.2f} dB, loss {loss:.4f}"
                + (f", on held-back materials {self.state.curves[-1]['loss']:.4f}" if self.state.curves else ""),
            )
            if progress["step"] % schedule.validate_every == 0 or progress["step"] == schedule.steps:
                progress["seconds"] = time.monotonic() - since_s
                self._validate(loss)
                average = _Average()
                if logs:
                    for name in LOGGED:
                        logs.add_scalar(name, self.state.curves[-1][name], progress["step"])
                    logs.flush()
                self.state.optimiser = self._optimiser.state_dict()
                self.state.save(out / CHECKPOINT)

    def _begin_optimiser(self) -> None:
        self._parameters = [*self.state.model.parameters(), *self.state.prior.parameters()]
        self._optimiser = torch.optim.Adam(self._parameters, lr=self._schedule.learning_rate)

    def _signals(self, excerpts: Any) -> Tensor:
        return torch.from_numpy(excerpts)[:, None].to(self._device)

    def _learning_rate(self, step: int) -> float:
        """Return a rate that warms up linearly, then falls along half a cosine."""
        schedule = self._schedule
        falling = _LAST_LEARNING_RATE + (1 - _LAST_LEARNING_RATE) * 0.5 * (
            1 + math.cos(math.pi * step / schedule.steps)
        )
        return schedule.learning_rate * falling * min(1.0, (step + 1) / (schedule.warm_up_steps + 1))

    def _step(self, step: int, average: _Average) -> None:
        """Take one step; its random numbers depend only on seed and step."""
        generator = torch.Generator().manual_seed(2**31 * self.configuration.seed + step)
        signals = self._signals(self._excerpts.batch(step, self._schedule.batch))
        measured = self._measure(signals, generator)
        loss = measured.loss.mean()
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self._parameters, self._schedule.gradient_norm)
        for group in self._optimiser.param_groups:
            group["lr"] = self._learning_rate(step)
        value = loss.item()
        if not math.isfinite(value) or not math.isfinite(norm.item()) or value > _EXPLODED * average.means[0]:
            raise TrainingError(
                f"the loss is {value:.3g} at step {step + 1}, {average.means[0]:.3g} on average before; the last "
                "good checkpoint is kept: lower [training] learning_rate and continue with --resume"
            )
        self._optimiser.step()
        average.add(value, measured.bits.mean().item(), self._mean_snr_db(signals, measured))

    def _measure(self, signals: Tensor, generator: torch.Generator | None) -> Measured:
        """Code signals (batch, 1, n): with plain rounding or, with a generator, as in training."""
        model, prior = self.state.model, self.state.prior
        values, used, rounded = self._quantised(model.analysis(signals), generator)
        bits = self._bits(values, rounded).sum(dim=(1, 2)) / signals.shape[-1]
        error = self._inner(model.synthesis(used) - signals)
        loss = bits + self.configuration.model.lambda_ * self._perception.mean_square(error)
        if generator is not None and self._schedule.cost != "static":
            # The prior, where the coder starts, still learns; this changes no other gradient, and not the loss.
            of_prior = prior.bits(values.detach()).sum(dim=(1, 2)) / signals.shape[-1]
            loss = loss + of_prior - of_prior.detach()
        return Measured(loss, bits, torch.mean(error**2, dim=(1, 2)))

    def _bits(self, values: Tensor, rounded: Tensor) -> Tensor:
        """Return the bits of each latent, by the cost of the configuration."""
        return self.state.prior.bits(values) if self._schedule.cost == "static" else adaptive_bits(values, rounded)

    def _quantised(self, latents: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return latents, in quantiser steps, for the prior, for the synthesis, and rounded.

        Without a generator they are the same. With one, as in training, the first and perhaps the second hold noise in
        place of rounding.
        """
        latents = DeadZone(latents.shape[1], self._schedule.dead_zone)(latents)
        rounded = torch.round(latents).detach()
        if generator is None:
            return rounded, rounded, rounded
        noisy = latents + torch.rand(latents.shape, generator=generator).to(self._device) - 0.5
        straight_through = self._schedule.rounding == "straight-through"
        return noisy, latents + (rounded - latents).detach() if straight_through else noisy, rounded

    def _validate(self, training_loss: float) -> None:
        """Code the held-back materials, and add the result to the curves."""
        progress = self.state.progress
        with torch.no_grad():
            measured = self._measure(self._validation, None)
            loss, bits = measured.loss.mean().item(), measured.bits.mean().item()
        if not math.isfinite(loss):
            raise TrainingError(
                f"the loss on held-back materials is {loss:.3g} at step {progress['step']}; the last good checkpoint "
                "is kept: lower [training] learning_rate and continue with --resume"
            )
        self.state.curves.append(
            {
                "step": progress["step"],
                "seconds": progress["seconds"],
                "training_loss": training_loss,
                "loss": loss,
                "bits_per_sample": bits,
                "snr_db": self._mean_snr_db(self._validation, measured),
            }
        )

    def _inner(self, signals: Tensor) -> Tensor:
        """Return signals (batch, 1, n) without their ends, which lack blocks that a stream has."""
        return signals[..., REACH_SAMPLES:-REACH_SAMPLES]

    def _mean_snr_db(self, signals: Tensor, measured: Measured) -> float:
        with torch.no_grad():
            power = torch.mean(self._inner(signals) ** 2, dim=(1, 2)).clamp(min=1e-12)
            return (10 * torch.log10(power / measured.squared_error.clamp(min=1e-12))).mean().item()


def train(
    configuration: Configuration, data_folder: Path, out: Path, resume: bool, tell: Tell, threads: int | None = None
) -> str:
    """Run one training, on a GPU if there is one; return a line about its result.

    The folder `out` gets CHECKPOINT, which `vibrocast export` reads, and from which `resume` continues an unfinished
    schedule. `threads`: of torch; None for all cores. Raises TrainingError, ModelError, TextureError and OSError.
    """
    checkpoint = out / CHECKPOINT
    if checkpoint.exists() and not resume:
        raise TrainingError(f"{out}: holds a training; continue it with --resume, or choose another --out")
    if threads:
        torch.set_num_threads(threads)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    training = Training(configuration, data_folder, device)
    if checkpoint.exists():
        training.resume(checkpoint)
    out.mkdir(parents=True, exist_ok=True)
    training.run(out, tell)
    end = training.state.curves[-1]
    return (
        f"{checkpoint}: all {end['step']} steps done, on held-back materials "
        f"{end['bits_per_sample']:.2f} bit/sample at {end['snr_db']:.1f} dB"
    )


def _tensorboard_logs(out: Path, step: int) -> Any:
    """Return a writer of the curves from a step on, into a folder next to the checkpoint; None without TensorBoard."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(out / "tensorboard"), purge_step=step)
