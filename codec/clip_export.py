"""Writes a texture as a haptic clip by the description of the codec `parametric`, and measures what remains."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vibrocast import textures
from vibrocast.codec import metrics, parametric
from vibrocast.codec.source import DEFAULT_STREAM_RATE_HZ
from vibrocast.textures import Recording, TextureError, clips
from vibrocast.textures.clips.synthesis import Envelope


@dataclass(frozen=True)
class ClipExport:
    """What a clip keeps of a texture.

    `full_scale`: the value of an amplitude of 1, in the texture's unit. `limited_energy`: the part, 0 to 1, of the
    energy at times whose mean frequency the format cannot state. `quality`: of the rendered clip against the texture.
    """

    full_scale: float
    limited_energy: float
    quality: metrics.Quality


def export(path: Path, recording: Recording) -> ClipExport:
    """Write a recording of one channel as a clip; the suffix of `path` is one of `clips.WRITERS`.

    The clip is a sine whose amplitude and frequency change over time. Raises TextureError, OSError.
    """
    if recording.channels > 1:
        raise TextureError(
            f"{recording.name}: {recording.channels} channels, and a clip has one; write each into a file of its own"
        )
    writer = clips.WRITERS[path.suffix.lower()]
    texture = textures.resample(textures.highpass(recording).recording, DEFAULT_STREAM_RATE_HZ)
    peak = float(np.max(np.abs(texture.samples)))
    if peak == 0:
        raise TextureError(f"{recording.name}: silent; give another recording")
    amplitudes, turns = parametric.envelope(texture.samples[:, 0] / peak)
    frequencies_hz = turns * DEFAULT_STREAM_RATE_HZ
    limited_hz = np.clip(frequencies_hz, *writer.range_hz)
    full_scale = 1.0 if recording.unit == "full scale" else peak * float(np.max(amplitudes))
    scaled = np.minimum(amplitudes * peak / full_scale, 1.0)
    times_s = np.arange(len(amplitudes)) * parametric.ENVELOPE.hop / DEFAULT_STREAM_RATE_HZ
    kept = np.flatnonzero(times_s < texture.seconds)
    places = np.append(kept, kept[-1])
    times_s = np.append(times_s[kept], texture.seconds)
    path.write_bytes(writer.write(Envelope(times_s, scaled[places], limited_hz[places])))
    rendered = clips.read(path, DEFAULT_STREAM_RATE_HZ).samples * full_scale
    quality = metrics.measure(texture.samples, rendered, DEFAULT_STREAM_RATE_HZ, recording.unit, perceptual=False)
    energies = np.square(amplitudes)
    limited = float(np.sum(energies[limited_hz != frequencies_hz]) / np.sum(energies))
    return ClipExport(full_scale, limited, quality)
