"""The plan file of `vibrocast plan`: how each texture of a scene is coded, sent and played (docs/planning.md)."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec import Framing, Setting
from vibrocast.codec.encoding import Encoding, measure_encoding
from vibrocast.codec.live_format import recording_format
from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.codec.stream import as_stream
from vibrocast.codec.threshold import DETECTION_THRESHOLD
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.files import InputFileError, atomic_write
from vibrocast.host.harness.bench_file import (
    Bench,
    BenchActuator,
    BenchController,
    actuator_toml,
    read_actuator,
    read_address,
)
from vibrocast.host.planner.scene import Source, read_options
from vibrocast.textures import Profile, Recording
from vibrocast.toml_tables import Table, number, read_toml

FORMAT = 1
MAX_RATE = 10_000_000
MAX_BUFFER_MS = 2000
LOW_CUT_ORDER = 4
SETTING_MODE = "setting"
CAPPED_MODE = "capped"
RATE_MODES = (SETTING_MODE, CAPPED_MODE)


class PlanError(InputFileError):
    """A plan file that is wrong, or does not fit what is there; the message says what to do."""


@dataclass(frozen=True)
class Forecast:
    """What a plan says of a texture; measured when it was planned, on the texture itself, unless told otherwise.

    `payload_bps`, `wire_bps`: packets alone, and in their frames. `instructions_per_second`, `load_percent`,
    `flash_bytes`, `ram_bytes`: of the decoder, from this project's tables (docs/firmware.md), None where they were not
    measured; load is of the whole controller's processor. `snr_db`, `spqi`, `third_octave_distance_db`: as
    evaluation.metrics measures the decoded signal in the band worth coding. `error_over_threshold_db`: the loudest
    part of the error at the skin, relative to the detection threshold. `delay_ms`: from a sample at the host to the
    skin, packet, codec, buffer, link and compensation together.
    """

    payload_bps: float
    wire_bps: float
    instructions_per_second: float | None
    load_percent: float | None
    flash_bytes: int | None
    ram_bytes: int | None
    snr_db: float | None
    spqi: float | None
    third_octave_distance_db: float | None
    error_over_threshold_db: float | None
    delay_ms: float


@dataclass(frozen=True)
class PlannedTexture:
    """How one texture is coded and sent.

    `hand_speed_mm_s`: under which a height profile is swept; of a profile over position, the greatest.
    `over_position`: the stream is a profile, its `rate` in samples per metre; otherwise in Hz. `lowest`, `highest`:
    the band worth coding, in Hz, or in periods per metre. `packet_samples`, `refresh_packets`: as codec.Framing.
    `rate_mode`: one of RATE_MODES; "setting": every packet by the setting; "capped": every packet with an SNR of
    `packet_snr_db`, or as near to it as `capped_rate_bps` lets it, frames included (codec.CappedRate). `buffer_ms`: how
    long packets lie on the controller before they are needed. `sha256`: of the texture's files, as Source gives it;
    None = of no matter.
    """

    name: str
    source: Source
    controller: str
    hand_speed_mm_s: float
    over_position: bool
    codec: str
    model: str | None
    setting: Setting
    rate: int
    lowest: float
    highest: float
    packet_samples: int
    refresh_packets: int
    rate_mode: str
    buffer_ms: float
    forecast: Forecast
    sha256: str | None = None
    capped_rate_bps: float | None = None
    packet_snr_db: float | None = None

    @property
    def target(self) -> RateTarget | None:
        """What the stream is rate-controlled to hold; None where every packet is by the setting."""
        if self.rate_mode == SETTING_MODE:
            return None
        return RateTarget(capped_rate_bps=self.capped_rate_bps, snr_db=self.packet_snr_db)

    def recording(self) -> Recording:
        """Load the texture and bring it to the stream's rate and band. Raises TextureError, PlanError."""
        self._check_files()
        return prepared(
            self.source.load(self.hand_speed_mm_s), self.hand_speed_mm_s, self.over_position, self.rate, self.lowest
        )

    def _check_files(self) -> None:
        """Raise PlanError where the texture's files are gone, or are not what was planned for."""
        for file in self.source.files:
            if not file.is_file():
                raise PlanError(f"{self.name}: {file} does not exist; bring it back, or plan the scene again")
        if self.sha256 is not None and self.sha256 != self.source.sha256():
            files = ", ".join(map(str, self.source.files))
            raise PlanError(f"{self.name}: {files} changed after this was planned; plan the scene again")

    def encode(self, recording: Recording | None = None) -> Encoding:
        """Code the texture as planned; `recording`: as `recording` returns it, where that has been done.

        Raises CodecError, ModelError, PlanError, TextureError.
        """
        prepared_recording = recording or self.recording()
        model = None if self.model is None else models.find(self.model)
        framing = Framing(self.packet_samples, self.refresh_packets)
        return encode(prepared_recording, self.codec, self.setting, model, framing, self.over_position, self.target)


@dataclass(frozen=True)
class PlannedController:
    """A controller of the plan, by the name that its textures and actuators give; the rest as in the scene."""

    name: str
    address: str
    clock_hz: float | None = None


@dataclass(frozen=True)
class Plan:
    """A plan, as `write_plan` writes it and `read_plan` reads it.

    `scene`: the scene's file. `threshold_path`: rows of the detection threshold, as in the scene.
    """

    scene: Path
    controllers: tuple[PlannedController, ...]
    actuators: tuple[BenchActuator, ...]
    textures: tuple[PlannedTexture, ...]
    threshold_path: Path = DETECTION_THRESHOLD

    def texture(self, name: str) -> PlannedTexture:
        """Return the texture of that name. Raises PlanError."""
        for texture in self.textures:
            if texture.name == name:
                return texture
        raise PlanError(
            f"the plan has no texture {name!r}; choose from {', '.join(each.name for each in self.textures)}"
        )

    def bench(self) -> Bench:
        """Return controllers, actuators and the textures over time as a bench; a texture raises as its `recording`."""
        controllers = tuple(BenchController(each.name, each.address) for each in self.controllers)
        over_time = tuple(each.recording for each in self.textures if not each.over_position)
        return Bench(controllers, self.actuators, textures=over_time)


def prepared(
    loaded: Recording | Profile, hand_speed_mm_s: float, over_position: bool, rate: int, lowest: float
) -> Recording:
    """Return a texture at the stream's rate, and without what lies below its band. Raises TextureError.

    What is above the band goes with the resampling. Below `lowest`, a Butterworth high-pass of order LOW_CUT_ORDER
    run in both directions, without delay, whose corner (-6 dB) lies an octave lower: it takes 0.03 dB at `lowest`; 0 =
    nothing is taken away. A profile over position has its rate per metre for hertz.
    """
    from scipy import signal

    if isinstance(loaded, Profile):
        # Over position, a metre takes the place of a second: as if swept at 1000 mm/s.
        loaded = loaded.recording(1000.0 if over_position else hand_speed_mm_s)
    recording = textures.resample(loaded, rate)
    if lowest <= 0:
        return recording
    sections = signal.butter(LOW_CUT_ORDER, lowest / 2, "highpass", fs=rate, output="sos")
    longest = len(recording.samples) - 1
    cut = signal.sosfiltfilt(sections, recording.samples, axis=0, padlen=min(longest, 3 * (2 * LOW_CUT_ORDER + 1)))
    return Recording(np.ascontiguousarray(cut), recording.rate_hz, recording.unit, recording.name)


def encode(
    recording: Recording,
    codec_name: str,
    setting: Setting,
    model: models.Model | None,
    framing: Framing,
    over_position: bool,
    target: RateTarget | None = None,
) -> Encoding:
    """Code a recording by a setting, cut into packets for a live stream, or for a profile. Raises CodecError.

    `target`: what a live stream is rate-controlled to hold; None = every packet is by the setting.
    """
    unit = PROFILE_UNIT if over_position else recording.unit
    samples, rate = recording.samples, round(recording.rate_hz)
    tables = None if model is None else codec.Model(model.tables, model.analysis)
    source = codec.Source(samples, rate, codec_name, unit, True, tables, framing=framing)
    if target is None:
        coded = source.encode(setting)
    else:
        coded = source.encode_rate_controlled(setting, target.policy(recording_format(recording)), framing)
    return measure_encoding(recording, as_stream(coded, unit, None if model is None else model.image))


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan as TOML; files are named from its folder. Raises OSError."""
    folder = path.parent

    def from_folder(file: Path) -> str:
        return os.path.relpath(file, folder)

    # The one that ships is found wherever it is installed.
    threshold = None if plan.threshold_path == DETECTION_THRESHOLD else from_folder(plan.threshold_path)
    parts = [
        "# Made by `vibrocast plan`; what each key means is in docs/planning.md.",
        _lines({"format": FORMAT, "scene": from_folder(plan.scene), "threshold": threshold}),
    ]
    for controller in plan.controllers:
        parts.append("[[controllers]]\n" + _lines(asdict(controller)))
    for actuator in plan.actuators:
        channel = "" if actuator.channel is None else f"channel = {actuator.channel}\n"
        parts.append(actuator_toml(actuator.model, actuator.controller) + channel)
    for texture in plan.textures:
        source = texture.source
        values = {
            "name": texture.name,
            "file": [from_folder(file) for file in source.files] or None,
            "generate": source.kind,
            **{f.name: getattr(texture, f.name) for f in fields(texture) if f.name not in _TABLES},
        }
        parts.append("[[textures]]\n" + _lines(values))
        for key, table in (("options", source.options), ("setting", texture.setting)):
            parts.append(f"[textures.{key}]\n" + _lines(table))
        forecast = {
            name: float(f"{value:.6g}") if isinstance(value, float) else value
            for name, value in asdict(texture.forecast).items()
        }
        parts.append("[textures.forecast]\n" + _lines(forecast))
    with atomic_write(path) as partial:
        partial.write_text("\n".join(parts), encoding="utf-8")


_TABLES = ("name", "source", "setting", "forecast")


def _lines(values: Mapping[str, Any]) -> str:
    """Return key = value lines; None is left out."""
    # Texts, numbers, lists and truth values in JSON are the same in TOML.
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items() if value is not None)


def read_plan(path: Path) -> Plan:
    """Read a plan file. Raises PlanError, and OSError where it cannot be read."""
    document = read_toml(path, "plan", PlanError)
    lists = {key: document.pop(key, None) for key in ("controllers", "actuators", "textures")}
    tables: dict[str, list[Table]] = {}
    for kind, given in lists.items():
        if not isinstance(given, list) or not given or not all(isinstance(table, dict) for table in given):
            raise PlanError(f"{path}: a plan has tables [[{kind}]]; make it with `vibrocast plan`")
        tables[kind] = [Table(path, f"[[{kind}]] {place}", table, PlanError) for place, table in enumerate(given, 1)]
    head = Table(path, "the plan", document, PlanError)
    head.whole("format", FORMAT, FORMAT)
    scene = path.parent / head.text("scene")
    threshold = head.text("threshold", None)
    threshold_path = DETECTION_THRESHOLD if threshold is None else path.parent / threshold
    head.end()
    controllers = tuple(_controller(table) for table in tables["controllers"])
    names = [controller.name for controller in controllers]
    actuators = tuple(read_actuator(table, names) for table in tables["actuators"])
    planned = tuple(_texture(table, names) for table in tables["textures"])
    for kind, given_names in (("controllers", names), ("textures", [texture.name for texture in planned])):
        if twice := sorted({name for name in given_names if given_names.count(name) > 1}):
            raise PlanError(f"{path}: two [[{kind}]] are named {twice[0]!r}; give each its own name")
    return Plan(scene, controllers, actuators, planned, threshold_path)


def _controller(table: Table) -> PlannedController:
    controller = PlannedController(
        table.text("name"),
        table.take("address", read_address, "an address such as 'sim'"),
        table.number("clock_hz", None),
    )
    table.end()
    return controller


def _texture(table: Table, controllers: list[str]) -> PlannedTexture:
    name = table.text("name")
    files = table.take("file", _paths, "a list of files", ())
    kind = table.word("generate", sorted(textures.GENERATORS), None)
    if (not files) == (kind is None):
        raise table.reject("give either file or generate")
    options = table.take("options", dict, "a table of what the file or generator does not say", {})
    codec_name = table.word("codec", sorted(codec.CODECS))
    read = PlannedTexture(
        name=name,
        source=Source(
            tuple(table.path.parent / file for file in files),
            kind,
            read_options(Table(table.path, f"options of {name}", options, PlanError), generated=not files),
        ),
        controller=table.word("controller", controllers),
        hand_speed_mm_s=table.within("hand_speed_mm_s", 0, 1e6, "speed of the hand in mm/s"),
        over_position=table.switch("over_position"),
        codec=codec_name,
        model=table.text("model", None),
        setting=table.take("setting", partial(_setting, codec_name), f"a setting of {codec_name}", {}),
        rate=table.whole("rate", 1, MAX_RATE),
        lowest=table.within("lowest", 0, MAX_RATE, "lowest frequency worth coding"),
        highest=table.within("highest", 0, MAX_RATE, "highest frequency worth coding"),
        packet_samples=table.whole("packet_samples", 1, 1 << 20),
        refresh_packets=table.whole("refresh_packets", 0, 1 << 20),
        rate_mode=table.word("rate_mode", RATE_MODES),
        buffer_ms=table.within("buffer_ms", 0, MAX_BUFFER_MS, "margin of packets in ms"),
        forecast=table.take("forecast", _forecast, "the table that `vibrocast plan` wrote"),
        sha256=table.text("sha256", None),
        capped_rate_bps=table.within("capped_rate_bps", 1, 1e9, "bits per second on the wire", None),
        packet_snr_db=table.within("packet_snr_db", 0, 120, "SNR of a packet in dB", None),
    )
    table.end()
    if read.lowest >= read.rate / 2:
        raise table.reject(f"lowest = {read.lowest:g} must be below half of rate = {read.rate}")
    capped = read.rate_mode == CAPPED_MODE
    if {read.capped_rate_bps is not None, read.packet_snr_db is not None} != {capped}:
        raise table.reject(f"capped_rate_bps and packet_snr_db are of rate_mode = {CAPPED_MODE!r}, which needs both")
    if capped and read.over_position:
        raise table.reject(f"a profile over position has no rate to cap: rate_mode = {SETTING_MODE!r}")
    return read


def _forecast(value: Any) -> Forecast:
    for each in value.values():
        number(each)
    return Forecast(**{**dict.fromkeys(field.name for field in fields(Forecast)), **value})


def _setting(codec_name: str, value: Any) -> Setting:
    given = {name: tuple(part) if isinstance(part, list) else part for name, part in value.items()}
    return codec.CODECS[codec_name].complete(given)


def _paths(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(file, str) and "\0" not in file for file in value):
        raise TypeError(value)
    return tuple(value)
