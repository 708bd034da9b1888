"""Training data: recordings of many sources, split by material, as excerpts that vary at random."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast import textures
from vibrocast.errors import InputError
from vibrocast.export.configuration import ArchiveSource, Augmentation, FolderSource, GeneratorSource, HeldBack, Source
from vibrocast.textures import Recording, TextureError, arrays, dataset
from vibrocast.textures.recording import Signal

_MARGIN_SAMPLES = 128
"""Added on each side of an excerpt and cut off later, because its filters treat it as periodic."""
_TILT_REFERENCE_HZ = 250.0
_HIGH_PASS_HZ = (10.0, 150.0)
_LOW_PASS_HZ = (200.0, 1400.0)
_NOISE_DB = (-40.0, 10.0)
_DRAWS = 1000
"""Excerpts drawn before recordings count as silent."""


@dataclass(frozen=True)
class Trace:
    """One channel to train on: float32 (n,) at the rate of the training, its material, whether it is a test trace."""

    source: str
    material: str
    samples: NDArray[np.float32]
    test: bool = False


def archive_recordings(archive: Path, drop_s: float, high_pass_hz: float, rate_hz: int) -> Iterator[tuple[str, Signal]]:
    """Yield name and samples (n,) of each recording of an NPZ archive that states a `rate_hz`, at a rate in Hz.

    The start is dropped, the rest high-passed. Raises TextureError for another file, and for an archive without a rate.
    """
    if not archive.is_file():
        raise TextureError(f"{archive}: no such file; give the folder where its path starts as --data")
    held = arrays.read_archive(archive)
    if "rate_hz" not in held:
        raise TextureError(f"{archive} holds no array `rate_hz`; save it with the recordings")
    try:
        own_rate_hz = float(held["rate_hz"])
        signals = {name: samples.astype(np.float64, casting="same_kind") for name, samples in held.items()}
    except (ValueError, TypeError) as error:
        raise TextureError(f"{archive}: damaged, or not of numbers ({error}); save it again") from error
    for name, samples in signals.items():
        if samples.ndim == 1 and len(samples) > 2 * drop_s * own_rate_hz:
            steady = _high_passed(samples[int(drop_s * own_rate_hz) :], own_rate_hz, high_pass_hz)
            recording = Recording(steady[:, None], own_rate_hz, "full scale", name)
            yield name, textures.resample(recording, rate_hz).samples[:, 0]


def load(sources: Sequence[Source], folder: Path, rate_hz: int) -> list[Trace]:
    """Return the channels of all sources, whose paths start at a folder; none is silent.

    Raises TextureError for a source that cannot be read or holds nothing to train on.
    """
    traces: list[Trace] = []
    for source in sources:
        found = [
            Trace(source.name, f"{source.name}/{material}", single, test)
            for material, samples, test in _recordings(source, folder, rate_hz)
            if np.any(single := samples.astype(np.float32))
        ]
        if not found:
            raise TextureError(f"{source.name}: holds no recording to train on; remove it, or lower drop_s")
        traces += found
    return traces


def split(traces: Sequence[Trace], held_back: HeldBack, seed: int) -> tuple[list[Trace], list[Trace]]:
    """Return the channels to train on and those held back: as HeldBack states.

    Raises TextureError for an unknown material, and if nothing would be left on one side.
    """
    materials = sorted({trace.material for trace in traces})
    chosen = set(held_back.materials)
    if unknown := sorted(chosen - set(materials)):
        raise TextureError(f"no material {unknown[0]!r} to hold back; there are {', '.join(materials)}")
    if held_back.by == "material" and not chosen:
        lots = np.random.default_rng(seed).permutation(len(materials))
        shuffled = [materials[lot] for lot in lots]
        for source in sorted({trace.source for trace in traces}):
            own = [material for material in shuffled if material.startswith(f"{source}/")]
            if len(own) > 1:
                chosen |= set(own[: max(1, round(held_back.share * len(own)))])
    parts: tuple[list[Trace], list[Trace]] = [], []
    for trace in traces:
        parts[trace.test if held_back.by == "trace" else trace.material in chosen].append(trace)
    if not all(parts):
        raise TextureError(
            f"{len(materials)} materials leave none to {'train on' if parts[1] else 'hold back'}; "
            "give more recordings, or name the materials under [held_back]"
        )
    return parts


def _recordings(source: Source, folder: Path, rate_hz: int) -> Iterator[tuple[str, Signal, bool]]:
    """Yield material and samples of each channel of a source, and whether it is in the test part of a folder."""
    if isinstance(source, ArchiveSource):
        for name, samples in archive_recordings(folder / source.archive, source.drop_s, source.high_pass_hz, rate_hz):
            yield re.sub(r"_[^_]*$", "", name), samples, False
    elif isinstance(source, FolderSource):
        yield from _of_folder(source, folder / source.folder, rate_hz)
    else:
        yield from ((kind, samples, False) for kind, samples in _generated(source, rate_hz))


def _of_folder(source: FolderSource, folder: Path, rate_hz: int) -> Iterator[tuple[str, Signal, bool]]:
    options = {name: value for name, value in source.options.items() if value is not None}
    entries = dataset.entries(folder)
    chosen = dataset.split(entries, source.part, source.seed, source.split_by)
    by_trace = source.part == "all" and source.split_by == "recording"
    test = {entry.name for entry in dataset.split(entries, "test", source.seed, source.split_by)} if by_trace else ()
    for trace in chosen:
        recording = dataset.load_highpassed(trace, textures.HIGHPASS_HZ, rate_hz, **options).recording
        try:
            material = trace.material
        except InputError:  # then each recording is its own material
            material = trace.name
        steady = recording.samples[int(source.drop_s * rate_hz) :]
        for channel in _high_passed(steady.T, rate_hz, source.high_pass_hz):
            yield material, channel, trace.name in test


def _generated(source: GeneratorSource, rate_hz: int) -> Iterator[tuple[str, Signal]]:
    generator = np.random.default_rng(source.seed)
    for kind in source.kinds:
        for _ in range(source.recordings):
            mean_mm_s = 50.0 * 2.0 ** generator.uniform(-1.5, 1.5)
            speed_mm_s = textures.varying_speed(source.seconds, rate_hz, mean_mm_s, generator.uniform(0, 0.5))
            seed = int(generator.integers(2**31))
            recording = textures.GENERATORS[kind](
                seed=seed, seconds=source.seconds, hand_speed_mm_s=speed_mm_s, rate_hz=rate_hz
            )
            yield kind, _high_passed(recording.samples[:, 0], rate_hz, source.high_pass_hz)


def _high_passed(samples: Signal, rate_hz: float, corner_hz: float) -> Signal:
    """Filter along the last axis by a Butterworth high-pass of second order; a corner of 0 changes nothing."""
    from scipy import signal

    if corner_hz == 0:
        return samples
    if not corner_hz < rate_hz / 2 < math.inf:
        raise TextureError(
            f"no high-pass at {corner_hz:g} Hz is possible at a rate of {rate_hz:g} Hz; correct one of them"
        )
    high_pass = signal.butter(2, corner_hz, "highpass", fs=rate_hz, output="sos")
    filtered: Signal = signal.sosfilt(high_pass, samples)
    return filtered


class Excerpts:
    """Draws excerpts with equal chances for every source, and within it for every material, and varies them.

    The excerpts of a step depend only on seed and step, so a resumed training continues exactly.
    """

    def __init__(
        self, traces: Sequence[Trace], samples: int, rate_hz: int, augmentation: Augmentation, seed: int
    ) -> None:
        self._samples, self._rate_hz, self._augmentation, self._seed = samples, rate_hz, augmentation, seed
        grouped: dict[str, dict[str, list[NDArray[np.float32]]]] = {}
        for trace in traces:
            grouped.setdefault(trace.source, {}).setdefault(trace.material, []).append(trace.samples)
        self._sources = [list(materials.values()) for materials in grouped.values()]

    def batch(self, step: int, size: int) -> NDArray[np.float32]:
        """Return excerpts, float32 (size, samples), each of RMS 1 up to the augmentation's gain.

        Raises TextureError if all draws are silent.
        """
        generator = np.random.default_rng([self._seed, step])
        return np.stack([self._excerpt(generator) for _ in range(size)])

    def _excerpt(self, generator: np.random.Generator) -> NDArray[np.float32]:
        for _ in range(_DRAWS):
            materials = self._sources[generator.integers(len(self._sources))]
            recordings = materials[generator.integers(len(materials))]
            recording = recordings[generator.integers(len(recordings))]
            varied = self._varied(recording, generator)
            if np.any(varied):
                varied /= np.sqrt(np.mean(np.square(varied)))
                if generator.uniform() < self._augmentation.noise_share:
                    decibels = generator.uniform(*_NOISE_DB)
                    varied += 10 ** (decibels / 20) * generator.standard_normal(len(varied))
                    varied /= np.sqrt(np.mean(np.square(varied)))
                decibels = self._augmentation.gain_db * generator.uniform(-1, 1)
                return (varied * 10 ** (decibels / 20)).astype(np.float32)
        raise TextureError("the recordings are almost silent; cut out the silent parts")

    def _varied(self, recording: NDArray[np.float32], generator: np.random.Generator) -> Signal:
        """Return an excerpt at another speed, perhaps inverted, tilted and filtered, through one discrete spectrum."""
        chosen = self._augmentation
        wanted = self._samples + 2 * _MARGIN_SAMPLES
        taken = round(wanted * 2 ** (chosen.rate_octaves * generator.uniform(-1, 1)))
        start = int(generator.integers(max(1, len(recording) - taken + 1)))
        piece = recording[start : start + taken]
        if len(piece) < taken:
            before = (taken - len(piece)) // 2
            piece = np.pad(piece, (before, taken - len(piece) - before))
        spectrum = np.zeros(wanted // 2 + 1, dtype=np.complex128)
        own = np.fft.rfft(piece)[: len(spectrum)]
        spectrum[: len(own)] = own
        frequency_hz = np.fft.rfftfreq(wanted, 1 / self._rate_hz)
        frequency_hz[0] = frequency_hz[1]
        tilt_db = chosen.tilt_db_per_octave * generator.uniform(-1, 1)
        gain = (frequency_hz / _TILT_REFERENCE_HZ) ** (tilt_db / (20 * np.log10(2)))
        high_pass_hz, low_pass_hz = (
            np.exp(generator.uniform(*np.log(corners))) for corners in (_HIGH_PASS_HZ, _LOW_PASS_HZ)
        )
        if generator.uniform() < chosen.filter_share:
            gain /= np.sqrt(1 + (high_pass_hz / frequency_hz) ** 4)
        if generator.uniform() < chosen.filter_share:
            gain /= np.sqrt(1 + (frequency_hz / low_pass_hz) ** 4)
        polarity = -1 if chosen.polarity and generator.uniform() < 0.5 else 1
        varied: Signal = np.fft.irfft(polarity * gain * spectrum, wanted)
        return varied[_MARGIN_SAMPLES:-_MARGIN_SAMPLES]
