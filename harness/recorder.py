"""Records a sensor on a sound card or a serial port: levels, clipping and losses, a WAV file and its sidecar."""

import datetime
import errno
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.transports import TransportError
from vibrocast.files import atomic_write
from vibrocast.host.serial_sensor import Losses
from vibrocast.host.sources import Source
from vibrocast.textures import LiveHighPass, TextureError, sidecar, sound_files
from vibrocast.textures.recording import Signal

DRIFT_HZ = 2.0
"""Below it is drift: the offset of an amplifier, gravity, temperature. A tenth of textures.HIGHPASS_HZ, below which
coding removes everything, so that this causal filter leaves the band above as it was."""
CLIPPED_RUN = 3
"""So many samples in a row at full scale are clipped; a single one may be a peak that just fits."""

_FULL_SCALE = 1 - 2**-14  # of it, so that int16's highest value counts
_READ_S = 0.1
_PIECE_S = 0.05
_MAX_PLACES = 100
_SIDECAR_BYTES = 1 << 16
_NOT_ENDED = "the command was killed, or still records; peaks, clipping and losses are not known"
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def pieces(source: Source) -> Iterator[Signal]:
    """Yield the samples of a source (n, channels) as they come, none now and then. Raises TransportError at the end."""
    waiting: list[Signal] = []
    while True:
        try:
            waiting.append(source.read(_READ_S))
        except TransportError:
            yield from waiting
            raise
        # A serial port brings a few samples at a time.
        if not len(waiting[-1]) or sum(map(len, waiting)) >= _PIECE_S * source.rate_hz:
            yield np.concatenate(waiting)
            waiting.clear()


@dataclass
class Clipping:
    """Runs of samples at full scale. `places`: start in s, channel from 1 and samples; only the first ones."""

    runs: int = 0
    samples: int = 0
    places: list[tuple[float, int, int]] = field(default_factory=list)


class Levels:
    """Watches the samples of a source before anything is removed: peaks, and clipping.

    Attributes:
        clipping: As far as runs have ended.
        peaks: The largest magnitude since the start, of each channel.
    """

    def __init__(self, source: Source) -> None:
        self.clipping = Clipping()
        self.peaks = np.zeros(source.channels)
        self._source = source
        self._latest = np.zeros(source.channels)
        self._run = [0] * source.channels
        self._frames = 0

    def watch(self, samples: Signal) -> None:
        """Take further samples (n, channels)."""
        if not len(samples):
            return
        self._latest = np.max(np.abs(samples), axis=0)
        self.peaks = np.maximum(self.peaks, self._latest)
        if self._source.full_scale is not None:
            at_limit = np.abs(samples) >= _FULL_SCALE * self._source.full_scale
            for channel in range(samples.shape[1]):
                self._watch_channel(channel, at_limit[:, channel])
        self._frames += len(samples)

    def finish(self) -> None:
        """End the runs that last until the end."""
        for channel in range(len(self._run)):
            self._end_run(channel, self._frames)

    def _watch_channel(self, channel: int, at_limit: NDArray[np.bool_]) -> None:
        if not at_limit.any() and not self._run[channel]:
            return
        edges = np.flatnonzero(np.diff(at_limit, prepend=self._run[channel] > 0))
        inside, since = self._run[channel] > 0, 0
        for edge in edges.tolist():
            if inside:
                self._run[channel] += edge - since
                self._end_run(channel, self._frames + edge)
            inside, since = not inside, edge
        if inside:
            self._run[channel] += len(at_limit) - since

    def _end_run(self, channel: int, end: int) -> None:
        run, self._run[channel] = self._run[channel], 0
        if run >= CLIPPED_RUN:
            self.clipping.runs += 1
            self.clipping.samples += run
            if len(self.clipping.places) < _MAX_PLACES:
                start_s = round((end - run) / self._source.rate_hz, 4)
                self.clipping.places.append((start_s, channel + 1, run))

    def text(self) -> str:
        """Return a meter for each channel: latest peak as a bar over 60 dB, `|` at the highest so far, and that level.

        In dB of full scale, or in the unit where full scale is not known.
        """
        meters = []
        for channel, (latest, peak) in enumerate(zip(self._latest, self.peaks, strict=True)):
            name = self._source.axes[channel] if self._source.axes else str(channel + 1)
            reference = self._source.full_scale or max(peak, 1e-12)
            steps, held = (_meter_steps(level / reference) for level in (latest, peak))
            bar = "".join("|" if place == held - 1 else "#" if place < steps else "." for place in range(_METER_STEPS))
            level = (
                f"{peak:.3g} {self._source.unit}" if self._source.full_scale is None else _decibels(peak / reference)
            )
            meters.append(f"{name} {bar} {level}")
        if self.clipping.runs or any(run >= CLIPPED_RUN for run in self._run):
            meters.append("CLIPPED")
        if self._source.losses.gaps:
            meters.append(f"LOST {self._source.losses.gaps} times")
        return "  ".join(meters)


_METER_STEPS = 10
_METER_DB = 60.0


def _meter_steps(level: float) -> int:
    """Return how much of a bar a level fills, relative to full scale."""
    if level <= 0:
        return 0
    return max(0, min(_METER_STEPS, math.ceil(_METER_STEPS * (1 + 20 * math.log10(level) / _METER_DB))))


def _decibels(level: float) -> str:
    return "silent" if level <= 0 else f"{20 * math.log10(level):.0f} dBFS"


@dataclass(frozen=True)
class Recorded:
    """The result of a recording. `peaks`: of each channel, in the unit, with the drift."""

    frames: int
    seconds: float
    peaks: tuple[float, ...]
    clipping: Clipping
    losses: Losses
    warnings: tuple[str, ...]


def record(
    source: Source,
    path: Path,
    *,
    seconds: float | None = None,
    highpass_hz: float | None = DRIFT_HZ,
    progress: Callable[[float | None, str], None] | None = None,
) -> Recorded:
    """Record a source into a WAV file of 32-bit floats with a sidecar, until `seconds` are over or Ctrl-C.

    Writes as it goes: a kill costs the counts of the sidecar alone. `highpass_hz`: corner of the high-pass,
    `textures.LiveHighPass`; None keeps offset and drift. `progress` gets the part that is done, or None, and the levels
    as text. Raises TransportError after a lost sensor or a full disk, with the file saved so far, OSError and
    TextureError.
    """
    highpass = None if highpass_hz is None else LiveHighPass(source.rate_hz, highpass_hz)
    began = datetime.datetime.now(datetime.UTC)
    levels = Levels(source)
    origin = _origin(source, began, highpass_hz)
    writer = sound_files.Writer(path, source.rate_hz, source.channels, source.unit, source.axes)
    try:
        wanted = _wanted(path, writer, source.rate_hz, seconds)

        def begun() -> None:
            _write_sidecar(path, origin | {"warnings": [_NOT_ENDED]})

        limited = progress and _limited(progress, seconds)
        stopped = _record(source, writer, wanted, levels, highpass, begun, limited)
    finally:
        with suppress(OSError):
            writer.close()
    if not writer.frames:
        raise stopped or TransportError(f"{source.name}: ended before a sample came; record for longer")
    recorded = _recorded(source, writer.frames, levels, stopped, seconds)
    try:
        _write_sidecar(path, origin | _counts(recorded))
    except OSError as error:
        stopped = stopped or error
    if stopped is not None:
        raise TransportError(f"{stopped}; the first {recorded.seconds:.3f} s are saved in {path}") from stopped
    return recorded


def _write_sidecar(path: Path, facts: dict[str, Any]) -> None:
    with atomic_write(sidecar.path_of(path)) as partial:
        sidecar.write(partial, facts)


def _wanted(path: Path, writer: sound_files.Writer, rate_hz: int, seconds: float | None) -> int:
    """Return how many frames to record. Raises TextureError if the file cannot hold them."""
    wanted = writer.max_frames if seconds is None else max(1, round(seconds * rate_hz))
    if wanted > writer.max_frames:
        raise TextureError(
            f"{path}: {seconds:g} s do not fit into a WAV file of 4 GiB; record at most "
            f"{writer.max_frames / rate_hz:.0f} s"
        )
    return wanted


def _limited(progress: Callable[[float | None, str], None], seconds: float | None) -> Callable[[float, str], None]:
    return lambda now_s, text: progress(None if seconds is None else min(1.0, now_s / seconds), text)


def _record(
    source: Source,
    writer: sound_files.Writer,
    wanted: int,
    levels: Levels,
    highpass: LiveHighPass | None,
    begun: Callable[[], None],
    progress: Callable[[float, str], None] | None,
) -> Exception | None:
    """Record up to `wanted` frames, or until Ctrl-C; return the error that stopped it, if any.

    `begun` is called when the file holds its first samples.
    """
    frames = 0
    try:
        for piece in pieces(source):
            samples = piece[: wanted - frames]
            levels.watch(samples)
            if len(samples):
                writer.write(samples if highpass is None else highpass(samples))
                if not frames:
                    begun()
                frames = writer.frames
            if progress is not None:
                now_s = frames / source.rate_hz
                progress(now_s, f"{now_s:.0f} s  {levels.text()}")
            if frames == wanted:
                break
    except KeyboardInterrupt:
        writer.shorten(frames)
    except TransportError as error:
        writer.shorten(frames)
        return error
    except OSError as error:
        sidecar_frames = _SIDECAR_BYTES // (4 * source.channels)  # leaves room for it
        writer.shorten(max(1, frames - sidecar_frames) if error.errno in _DISK_FULL else frames)
        return OSError(f"the disk: {error.strerror}; free some space, or write elsewhere")
    return None


def _recorded(
    source: Source, frames: int, levels: Levels, stopped: Exception | None, seconds: float | None
) -> Recorded:
    levels.finish()
    losses, clipping = source.losses, levels.clipping
    remarks = []
    if clipping.runs:
        places = ", ".join(f"{at:.3f} s" for at, _, _ in clipping.places[:3])
        remarks.append(f"clipped {clipping.runs} times, first at {places}; lower the gain and record again")
    if losses.gaps:
        places = ", ".join(f"{at:.3f} s" for at, _ in losses.places[:3])
        how_many = f"{losses.samples} samples in {losses.gaps} gaps" if losses.samples else f"{losses.gaps} times"
        remarks.append(f"lost {how_many}, first at {places}; close other programs and record again")
    remarks += source.warnings()
    if stopped is None and seconds is None and frames * 4 * source.channels > sound_files.MAX_BYTES - (1 << 20):
        remarks.append("the file is full at 4 GiB; record in parts")
    return Recorded(frames, frames / source.rate_hz, tuple(levels.peaks.tolist()), clipping, losses, tuple(remarks))


def _origin(source: Source, began: datetime.datetime, highpass_hz: float | None) -> dict[str, Any]:
    """Return what the sidecar states from the first sample on."""
    return {
        "unit": source.unit,
        "rate_hz": source.rate_hz,
        "channels": source.channels,
        "axes": source.axes,
        "input": source.name,
        "sensitivity": source.sensitivity,
        "full_scale": source.full_scale,
        **source.facts(),
        "highpass_hz": highpass_hz,
        "date": began.isoformat(timespec="seconds"),
    }


def _counts(recorded: Recorded) -> dict[str, Any]:
    """Return what the sidecar states at the end of the recording."""
    places: Sequence[tuple[float, int | None]] = recorded.losses.places
    return {
        "samples": recorded.frames,
        "seconds": recorded.seconds,
        "peaks": list(recorded.peaks),
        "clipped": {
            "runs": recorded.clipping.runs,
            "samples": recorded.clipping.samples,
            "first": [{"at_s": at, "channel": each, "samples": run} for at, each, run in recorded.clipping.places],
        },
        "lost": {
            "gaps": recorded.losses.gaps,
            "samples": recorded.losses.samples,
            "first": [{"at_s": at, "samples": count} for at, count in places],
        },
        "warnings": list(recorded.warnings),
    }
