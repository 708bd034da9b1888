"""The report of a playback: figures of stream, device and comparison with the offline decoder, as JSON."""

import datetime
import json
import platform
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from vibrocast.codec.threshold import FeltError
from vibrocast.files import atomic_write
from vibrocast.host.bench_limits import Judged, lost_percent
from vibrocast.host.skin_quality import SkinQuality, judged_skin
from vibrocast.output.sound_card import CardUse


def _versions() -> dict[str, str]:
    return {
        "vibrocast": version("vibrocast"),
        "numpy": version("numpy"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class Provenance:
    """The origin of a report. `date`: ISO 8601, UTC. `bench_sha256`: of the bench file, hexadecimal; None = no file."""

    bench_sha256: str | None = None
    run_id: str = field(default_factory=lambda: str(uuid.uuid4()))
    date: str = field(default_factory=_now)
    versions: dict[str, str] = field(default_factory=_versions)


SCHEMA = 3
"""Of the JSON of playbacks and live streams."""


@dataclass(frozen=True)
class Latency:
    """Delays in ms: of the codec, the mean wait of samples in the controller, and from recorded sample to skin."""

    algorithmic: float
    buffered: float
    end_to_end: float


@dataclass(frozen=True)
class ActuatorUse:
    """The actuator and how many of its samples were held back by each limit, since the stream started.

    `follows_hz`: the band in which the skin moves as asked to 1 dB; None = nowhere. `gains_db`: its displacement over
    the one asked for, by the frequency in Hz. `clipped_samples`: the inverse compensation asked for more than the
    stroke. The other limits follow it.
    """

    name: str
    follows_hz: tuple[float, float] | None
    gains_db: Mapping[str, float]
    clipped_samples: int
    voltage_limited: int
    slew_limited: int
    power_limited: int

    @property
    def limited_samples(self) -> int:
        """DAC samples that the limits held back, all together."""
        return self.clipped_samples + self.voltage_limited + self.slew_limited + self.power_limited


@dataclass(frozen=True)
class Touch:
    """The third octave at the skin that exceeds the detection threshold most; below 0 dB nobody feels it."""

    level_db: float
    frequency_hz: float


@dataclass(frozen=True)
class DeviceDescription:
    """The controller as it introduced itself."""

    address: str
    build: str
    hardware: str
    serial_number: str
    protocol: str
    model_images: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """Figures of one playback; docs/reference/report.md explains each. None: not measured.

    `seconds` is the duration of one pass; `stream_bytes`, and the rates from it, are of the whole .vct file.
    """

    schema: int
    run: Provenance
    version: str
    file: str
    codec: str
    model: str | None
    channels: int
    stream_rate_hz: int
    loops: int
    seconds: float
    stream_bytes: int
    wire_bytes: int
    wire_bytes_back: int
    bits_per_second: float
    bits_per_sample: float
    snr_db: float | None
    snr_db_per_channel: tuple[float | None, ...]
    highpass_hz: float | None
    removed_below: float | None
    lowpass_hz: float | None
    removed_above: float | None
    felt_error: FeltError | None
    quality_note: str | None
    skin: SkinQuality | None
    skin_note: str | None
    latency_ms: Latency
    underruns: int
    packets: int
    lost_packets: int
    bad_frames: int
    bad_frames_back: int
    reconnects: int
    device: DeviceDescription
    sound_card: CardUse | None
    actuator: ActuatorUse
    touch: Touch
    decoded_equals_offline: bool | None
    dac_equals_offline: bool | None
    comparison_note: str | None

    def judged(self) -> Iterator[Judged]:
        """Yield the figures that limits of a bench file judge."""
        yield Judged("latency_ms", self.file, self.latency_ms.end_to_end)
        yield Judged("underruns", self.file, self.underruns)
        yield Judged("lost_percent", self.file, lost_percent(self.lost_packets, self.packets))
        yield Judged("bad_frames", self.file, self.bad_frames + self.bad_frames_back)
        yield from judged_skin(self.skin, self.file)

    @property
    def differs(self) -> bool:
        """Whether a decoded sample or a DAC code differs from the one computed here."""
        return False in (self.decoded_equals_offline, self.dac_equals_offline)

    def write(self, path: Path) -> None:
        """Write the report as JSON. Raises OSError."""
        write_json(path, asdict(self))


@dataclass(frozen=True)
class StrokeReport:
    """Figures of one height profile under a hand; docs/reference/report.md explains each. None: not known."""

    schema: int
    run: Provenance
    version: str
    file: str
    codec: str
    model: str | None
    channels: int
    length_mm: float
    stream_bytes: int
    bits_per_mm: float
    seconds: float
    fastest_mm_s: float
    positions: int
    underruns: int
    bad_frames: int
    bad_frames_back: int
    skin: SkinQuality | None
    device: DeviceDescription
    sound_card: CardUse | None
    actuator: ActuatorUse
    dac_equals_offline: bool | None

    def judged(self) -> Iterator[Judged]:
        """Yield the figures that limits of a bench file judge.

        Nobody counts lost positions. None was lost where the output is as all of them make it.
        """
        yield Judged("underruns", self.file, self.underruns)
        yield Judged("lost_percent", self.file, 0.0 if self.dac_equals_offline else None)
        yield Judged("bad_frames", self.file, self.bad_frames + self.bad_frames_back)
        yield from judged_skin(self.skin, self.file)

    def write(self, path: Path) -> None:
        """Write the report as JSON. Raises OSError."""
        write_json(path, asdict(self))


@dataclass(frozen=True)
class UnfinishedReport:
    """Figures of a playback that did not come to its end, as far as it came. None: it had not begun."""

    schema: int
    run: Provenance
    version: str
    file: str
    device: Mapping[str, str]
    played_s: float | None
    underruns: int | None
    lost_packets: int | None
    error: str


def write_json(path: Path, document: Any) -> None:
    """Write a report that is ready for JSON, indented, whole or not at all. Raises OSError."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
