"""The report of a playback: figures of stream, device and comparison with the offline decoder, as JSON."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from vibrocast.files import atomic_write
from vibrocast.output.sound_card import CardUse


@dataclass(frozen=True)
class Latency:
    """Delays in ms: of the codec, the mean wait of samples in the controller, and from recorded sample to skin."""

    algorithmic: float
    buffered: float
    end_to_end: float


@dataclass(frozen=True)
class ActuatorUse:
    """The actuator and how many of its samples were held back by each limit, since the stream started.

    `compensation_clipped`: the inverse compensation asked for more than the stroke. The other limits follow it.
    """

    name: str
    clipped_samples: int
    voltage_limited: int
    slew_limited: int
    power_limited: int


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
    protocol: str
    model_images: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """Figures of one playback; docs/reference/report.md explains each. None: not measured.

    `seconds` is the duration of one pass; `stream_bytes`, and the rates from it, are of the whole .vct file.
    """

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
    tactile_snr_db: float | None
    highpass_hz: float | None
    removed_energy: float | None
    quality_note: str | None
    latency_ms: Latency
    underruns: int
    lost_packets: int
    reconnects: int
    device: DeviceDescription
    sound_card: CardUse | None
    actuator: ActuatorUse
    touch: Touch
    decoded_equals_offline: bool | None
    dac_equals_offline: bool | None
    comparison_note: str | None

    @property
    def differs(self) -> bool:
        """Whether a decoded sample or a DAC code differs from the one computed here."""
        return False in (self.decoded_equals_offline, self.dac_equals_offline)

    def as_json(self) -> str:
        """Return the report as a JSON object, indented by two spaces."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"

    def write(self, path: Path) -> None:
        """Write the report as JSON.

        Raises:
            OSError: The file cannot be written.
        """
        with atomic_write(path) as partial:
            partial.write_text(self.as_json(), encoding="utf-8")
