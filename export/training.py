"""Trains EVA: bits + lambda * distortion, from a seed to checkpoints, validated on materials that are held back."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.export import training_data
from vibrocast.export.checkpoint import Checkpoint, ModelError, load
from vibrocast.export.configuration import Augmentation, Configuration
from vibrocast.export.eva import REACH_SAMPLES, Eva, EvaShape
from vibrocast.export.priors import FactorisedPrior
from vibrocast.export.training_data import Excerpts

CHECKPOINT = "checkpoint.pt"
LOGGED = ("training_loss", "loss", "bits_per_sample", "snr_db")
"""The curves: means over the steps since the last validation, then of the held-back materials."""
_EXPLODED = 100.0
"""Times the mean loss: what no batch of a training that goes well reaches."""
_LAST_LEARNING_RATE = 0.02
_UNVARIED = Augmentation(gain_db=0, rate_octaves=0, polarity=False, tilt_db_per_octave=0, filter_share=0, noise_share=0)


class TrainingError(RuntimeError):
    """A training that cannot begin, or go on; the message says why and what to do."""


class Tell(Protocol):
    """Takes the part of the training that is done, from 0 to 1, and how it goes."""

    def __call__(self, part: float, details: str = "", /) -> None: ...


@dataclass(frozen=True)
class Measured:
    """Of each excerpt (batch,): bits per sample, mean squared error as in the loss, and that of the plain signal."""

    bits: Tensor
    distortion: Tensor
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
    """The perceptual transform g_p: none, or a weight of each frequency by how little of it can be felt."""

    MIN_HZ = 20.0
    """Below, the threshold is taken as here: recordings hold little but drift."""

    def __init__(self, kind: str, rate_hz: float, samples: int, device: torch.device) -> None:
        self._gain: Tensor | None = None
        if kind != "plain":
            frequency_hz = np.maximum(np.fft.rfftfreq(samples, 1 / rate_hz), self.MIN_HZ)
            unit = {"acceleration": "m/s^2", "displacement": "um"}[kind]
            gain = 1 / threshold_amplitude(read_threshold(), frequency_hz, unit)
            self._gain = torch.from_numpy(gain / np.sqrt(np.mean(gain**2))).float().to(device)

    def mean_square(self, error: Tensor) -> Tensor:
        """Return the mean square (batch,) of what the transform, which is linear, makes of errors (batch, 1, n)."""
        if self._gain is not None:
            error = torch.fft.irfft(torch.fft.rfft(error) * self._gain, error.shape[-1])
        return torch.mean(error**2, dim=(1, 2))


class Training:
    """A training under way: model, prior, optimiser and data."""

    def __init__(self, configuration: Configuration, data_folder: Path, device: torch.device) -> None:
        """Load the data and begin a model. Raises TextureError for data that cannot be used."""
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
        choice = configuration.model
        torch.manual_seed(configuration.seed)
        self.state = Checkpoint(
            Eva(EvaShape(choice.width, choice.width)).to(device),
            FactorisedPrior(choice.width).to(device),
            configuration.as_dict(),
            {"step": 0, "seconds": 0.0},
        )
        self._begin_optimiser()

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint. Raises ModelError for one that is damaged, or of another training; OSError."""
        state = load(path)
        ours = self.configuration.as_dict()
        # The schedule may be changed on the way: more steps, or a lower rate after an explosion.
        names = sorted({*ours, *state.training} - {"training"})
        if other := [name for name in names if state.training.get(name) != ours.get(name)]:
            raise ModelError(f"{path}: was trained with another {other[0]}; choose another --out, or undo the change")
        if state.shape != self.state.shape or state.optimiser is None:
            raise ModelError(f"{path}: not a checkpoint of this training to go on from; choose another --out")
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
        """Train to the end of the schedule, writing CHECKPOINT into a folder at every validation.

        Raises TrainingError where the loss is not a number or explodes, OSError where nothing can be written.
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
        """Return a rate that warms up linearly and falls by half a cosine."""
        schedule = self._schedule
        falling = _LAST_LEARNING_RATE + (1 - _LAST_LEARNING_RATE) * 0.5 * (
            1 + math.cos(math.pi * step / schedule.steps)
        )
        return schedule.learning_rate * falling * min(1.0, (step + 1) / (schedule.warm_up_steps + 1))

    def _step(self, step: int, average: _Average) -> None:
        """Take one step; all that is random in it depends on seed and step alone."""
        generator = torch.Generator().manual_seed(2**31 * self.configuration.seed + step)
        signals = self._signals(self._excerpts.batch(step, self._schedule.batch))
        measured = self._measure(signals, generator)
        loss = self._loss(measured)
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self._parameters, self._schedule.gradient_norm)
        for group in self._optimiser.param_groups:
            group["lr"] = self._learning_rate(step)
        value = loss.item()
        if not math.isfinite(value) or not math.isfinite(norm.item()) or value > _EXPLODED * average.means[0]:
            raise TrainingError(
                f"the loss is {value:.3g} at step {step + 1}, {average.means[0]:.3g} on average before; the last "
                "good checkpoint is kept: lower [training] learning_rate and go on with --resume"
            )
        self._optimiser.step()
        average.add(value, measured.bits.mean().item(), _mean_snr_db(signals, measured.squared_error))

    def _loss(self, measured: Measured) -> Tensor:
        return torch.mean(measured.bits + self.configuration.model.lambda_ * measured.distortion)

    def _measure(self, signals: Tensor, generator: torch.Generator | None) -> Measured:
        """Code signals (batch, 1, n): with rounding alone, or as in training with a generator."""
        model = self.state.model
        latents = model.analysis(signals)
        # What is shrunk before it is rounded has a dead zone around zero.
        latents = torch.sign(latents) * nn.functional.relu(torch.abs(latents) - self._schedule.dead_zone)
        rounded = torch.round(latents).detach()
        values = used = rounded
        if generator is not None:
            noise = torch.rand(latents.shape, generator=generator).to(self._device) - 0.5
            values = used = latents + noise
            if self._schedule.rounding == "straight-through":
                used = latents + (rounded - latents).detach()
        bits = self.state.prior.bits(values).sum(dim=(1, 2)) / signals.shape[-1]
        error = _inner(model.synthesis(used) - signals)
        return Measured(bits, self._perception.mean_square(error), torch.mean(error**2, dim=(1, 2)))

    def _validate(self, training_loss: float) -> None:
        """Code the held-back materials, and note the outcome in the curves."""
        progress = self.state.progress
        with torch.no_grad():
            measured = self._measure(self._validation, None)
            loss, bits = self._loss(measured).item(), measured.bits.mean().item()
        if not math.isfinite(loss):
            raise TrainingError(
                f"the loss on held-back materials is {loss:.3g} at step {progress['step']}; the last good checkpoint "
                "is kept: lower [training] learning_rate and go on with --resume"
            )
        self.state.curves.append(
            {
                "step": progress["step"],
                "seconds": progress["seconds"],
                "training_loss": training_loss,
                "loss": loss,
                "bits_per_sample": bits,
                "snr_db": _mean_snr_db(self._validation, measured.squared_error),
            }
        )


def train(
    configuration: Configuration, data_folder: Path, out: Path, resume: bool, tell: Tell, threads: int | None = None
) -> str:
    """Run one training, on a GPU where there is one; return a line on its outcome.

    The folder `out` gets CHECKPOINT, the model to export, from which `resume` goes on where the schedule is not at its
    end. `threads`: of torch; None for all cores. Raises TrainingError, ModelError, TextureError and OSError.
    """
    checkpoint = out / CHECKPOINT
    if checkpoint.exists() and not resume:
        raise TrainingError(f"{out}: holds a training; go on with it by --resume, or choose another --out")
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
    """Return a writer of the curves from a step on, into a folder beside the checkpoint; None without TensorBoard."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(out / "tensorboard"), purge_step=step)


def _inner(signals: Tensor) -> Tensor:
    """Return what lies between the ends of signals (batch, 1, n): at the ends columns are missing that a stream has."""
    return signals[..., REACH_SAMPLES:-REACH_SAMPLES]


def _mean_snr_db(signals: Tensor, squared_error: Tensor) -> float:
    with torch.no_grad():
        power = torch.mean(_inner(signals) ** 2, dim=(1, 2)).clamp(min=1e-12)
        return (10 * torch.log10(power / squared_error.clamp(min=1e-12))).mean().item()
