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
from vibrocast.host.figures import FIGURES, WIRE_FIGURES, Value, lost_percent
from vibrocast.output.sound_card import CardUse

UP_TO_DAC_CALL = "checked up to the call of the DAC function"
"""How far a comparison with the controller's capture reaches, in words: the port and all behind it are out of sight."""


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


SCHEMA = 5
"""Of the JSON of playbacks."""


@dataclass(frozen=True)
class Timing:
    """Delays in ms, and the controller's clock; None: not known.

    `algorithmic_ms`: of the codec. `buffered_ms`: the mean wait of samples in the controller. `end_to_end_ms`: from
    when a sample is taken to when the skin moves by it. `jitter_ms`: of the arrivals of packets. `drift_ppm`: by how
    much the controller's clock is faster.
    """

    algorithmic_ms: float | None = None
    buffered_ms: float | None = None
    end_to_end_ms: float | None = None
    jitter_ms: float | None = None
    drift_ppm: float | None = None


@dataclass(frozen=True)
class Wire:
    """What crossed the wire: bytes, where they were counted, and frames that went wrong, as `WireFaults` has them."""

    bytes_sent: int | None = None
    bytes_received: int | None = None
    bad_frames: int = 0
    bad_frames_back: int = 0
    repeated_frames: int = 0
    reordered_frames: int = 0


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
class SkinQuality:
    """Quality at the skin, as displacement from 20 to 1000 Hz.

    Each SNR is 10 log10(sum x^2 / sum (x - y)^2), by `codec.threshold.skin_snr_db`. `decoded_snr_db` is that of the
    decoded signal against the texture, `snr_db` that of the skin against the texture. `playing_snr_db` compares the
    skin with the decoded signal, which leaves the codec out. The `weighted_` ones count each frequency in parts of the
    threshold of touch. `gain`: of the skin over the decoded signal, weighted alike; lag and gain are removed before an
    SNR is taken. `st_sim`: of the skin against the texture. None: not known, or an exact copy.
    """

    snr_db: float | None
    decoded_snr_db: float | None
    playing_snr_db: float | None
    st_sim: float | None
    gain: float | None
    weighted_snr_db: float | None
    weighted_decoded_snr_db: float | None
    weighted_playing_snr_db: float | None


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How near the decoded signal and the skin come to the texture; docs/reference/report.md explains each."""

    snr_db: float | None = None
    snr_db_per_channel: tuple[float | None, ...] | None = None
    highpass_hz: float | None = None
    removed_below: float | None = None
    lowpass_hz: float | None = None
    removed_above: float | None = None
    felt_error: FeltError | None = None
    note: str | None = None
    skin: SkinQuality | None = None
    skin_note: str | None = None
    touch: Touch | None = None


@dataclass(frozen=True)
class DeviceDescription:
    """The controller as it introduced itself."""

    address: str
    build: str
    hardware: str
    serial_number: str
    protocol: str
    model_images: tuple[str, ...]


@dataclass
class Minute:
    """A minute of a live stream, from `from_s` on. Counts are of this minute.

    `host_late_ms`: by how much the host handled a block too late, at most, without its waits for the controller;
    `host_jitter_ms`: between the 5 % and the 95 % of these times; None before the first block.
    `restarts`: of the stream; `device_restarts`: of the controller.
    `late_packets`: those that it handled later than half the playout delay.
    `margin_ms`: the least time that packets lay ready at the controller; None where it never played.
    """

    from_s: float
    packets: int = 0
    underruns: int = 0
    lost_packets: int = 0
    dropped_packets: int = 0
    restarts: int = 0
    device_restarts: int = 0
    pauses: int = 0
    bad_frames: int = 0
    bad_frames_back: int = 0
    repeated_frames: int = 0
    reordered_frames: int = 0
    output_gaps: int = 0
    late_packets: int = 0
    host_late_ms: float | None = None
    host_jitter_ms: float | None = None
    margin_ms: float | None = None
    cause: str | None = None


@dataclass(frozen=True)
class LiveFigures:
    """The part of a report that live streams have; docs/reference/report.md explains each. None: not known."""

    packet_ms: float
    playout_delay_ms: float
    payload_bits_per_second: float
    wire_bits_per_second: float
    wire_adds: float
    dropped_packets: int
    streams: int
    pauses: int
    left_out_packets: int
    minutes: tuple[Minute, ...]


@dataclass(frozen=True)
class PositionFigures:
    """The part of a report that profiles under a hand have; docs/reference/report.md explains each."""

    length_mm: float
    bits_per_mm: float
    fastest_mm_s: float
    positions: int


@dataclass(frozen=True, kw_only=True)
class Report:
    """Figures of one playback; docs/reference/report.md explains each. None: not measured, or not of this kind.

    `seconds` is the duration of one pass; `stream_bytes`, and the rates from it, are of the whole .vct file.
    """

    schema: int = SCHEMA
    run: Provenance = field(default_factory=Provenance)
    version: str = field(default_factory=lambda: version("vibrocast"))
    file: str
    codec: str
    model: str | None
    channels: int
    stream_rate_hz: int | None = None
    loops: int = 1
    seconds: float
    stream_bytes: int | None = None
    bits_per_second: float | None = None
    bits_per_sample: float | None = None
    underruns: int
    packets: int
    lost_packets: int
    reconnects: int = 0
    wire: Wire = Wire()
    quality: Quality = Quality()
    timing: Timing = Timing()
    device: DeviceDescription
    sound_card: CardUse | None
    actuator: ActuatorUse
    decoded_equals_offline: bool | None = None
    dac_equals_offline: bool | None = None
    comparison_note: str | None = None
    live: LiveFigures | None = None
    position: PositionFigures | None = None
    doubt: str = ""

    def figures(self) -> Iterator[Value]:
        """Yield the figures that limits of a bench file judge, and that a run is compared by.

        Those at the skin of a live stream are computed, so they are known only where the controller has played what
        was computed. Nobody counts lost positions of a hand: none was lost where the output is as all of them make it.
        """
        return (self._doubted(value) for value in self._figures())

    def _doubted(self, value: Value) -> Value:
        """Return a figure with the doubt of the report, where a busy machine can have made it worse."""
        bits_differ = value.key in ("as_decoded", "as_computed") and value.value is False
        is_open = (self.lost_anything or FIGURES[value.key].is_timed) and not bits_differ
        return value._replace(doubt=self.doubt) if is_open and value.key not in WIRE_FIGURES else value

    def _figures(self) -> Iterator[Value]:
        place = self.file if self.live is None else "live"
        lost: float | None = lost_percent(self.lost_packets, self.packets)
        if self.position is not None:
            lost = 0.0 if self.dac_equals_offline else None
        if self.live is not None:  # a file waits in the controller's buffer, on purpose
            yield Value("latency_ms", place, self.timing.end_to_end_ms)
            yield Value("jitter_ms", place, self.timing.jitter_ms)
            yield Value("drift_ppm", place, self.timing.drift_ppm)
        yield Value("as_decoded", place, self.decoded_equals_offline)
        yield Value("as_computed", place, self.dac_equals_offline)
        yield Value("underruns", place, self.underruns)
        yield Value("lost_percent", place, lost)
        yield Value("bad_frames", place, self.wire.bad_frames + self.wire.bad_frames_back)
        yield Value("repeated_frames", place, self.wire.repeated_frames)
        yield Value("reordered_frames", place, self.wire.reordered_frames)
        skin = self.quality.skin if self.live is None or self.dac_equals_offline else None
        for key in ("snr_db", "playing_snr_db", "st_sim", "gain"):
            yield Value(key, place, getattr(skin, key, None))

    @property
    def lost_anything(self) -> bool:
        """Whether packets came too late, or the output ran empty."""
        return bool(self.lost_packets or self.underruns)

    @property
    def differs(self) -> bool:
        """Whether a decoded sample or a DAC code differs from the one computed here."""
        return False in (self.decoded_equals_offline, self.dac_equals_offline)

    def write(self, path: Path) -> None:
        """Write the report as JSON. Raises OSError."""
        write_json(path, asdict(self))


@dataclass(frozen=True, kw_only=True)
class UnfinishedReport:
    """Figures of a playback that did not come to its end, as far as it came. None: it had not begun."""

    schema: int = SCHEMA
    run: Provenance
    version: str = field(default_factory=lambda: version("vibrocast"))
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
