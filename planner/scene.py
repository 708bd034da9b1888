"""The scene file in TOML: textures, hand, actuators, controllers, link, targets (docs/reference/toml_files.md)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, structs

from vibrocast import textures
from vibrocast.codec.threshold import read_threshold, threshold_file
from vibrocast.device_protocol.transports import BAUD
from vibrocast.errors import InputError, located
from vibrocast.host import devices
from vibrocast.host.bench_file import (
    BenchActuator,
    BenchController,
    TextureTable,
    one_named,
    read_actuators,
)
from vibrocast.host.figures import FIGURES, Figure
from vibrocast.output.actuator import PIEZO_STACK, Actuator, actuator_differences
from vibrocast.output.actuator_files import ActuatorTable
from vibrocast.textures import Profile, Recording, TextureError
from vibrocast.textures.dataset import entries
from vibrocast.textures.files import is_profile
from vibrocast.textures.recording import MAX_CHANNELS
from vibrocast.toml_tables import Table, Text, check_names, convert, one_of, read_each, read_toml, within

CORES = ("M4F", "M7", "M33")
"""Processors for which decoding has been measured (docs/benchmarks/firmware.md)."""
LINK_BYTES_PER_SECOND = {"serial": BAUD / 10, "usb-full-speed": 1_216_000.0, "usb-high-speed": 53_248_000.0}
"""A serial byte takes a start bit, eight bits of data and a stop bit. USB: the most that bulk transfers carry, 19
packets of 64 bytes in a frame of 1 ms, 13 of 512 in a microframe of 125 us (USB 2.0, tables 5-9 and 5-10)."""
LINK_DELAYS_MS = {"serial": 1.0, "usb-full-speed": 1.0, "usb-high-speed": 0.125, "simulated": 0.0}
"""From the host's write to the controller: USB takes data once a frame or microframe; serial adapters are on USB."""

HAND_SPEEDS_MM_S = (1.0, 2000.0)
"""Hands explore surfaces at some 10 to 300 mm/s. The range is wider, but rejects metres given as millimetres."""

MAX_DELAY_MS = 10_000.0

MAX_TRACKED_MM_S = 300.0
"""Highest hand speed at which controllers render profiles by position (vibrocast/profile.h)."""


class SceneController(BenchController, frozen=True, kw_only=True):
    """A controller of the scene.

    `core`: one of CORES, with its `clock_hz`; None = a computer, which decodes every codec and whose load is not
    limited. `flash_bytes`, `ram_bytes`: None = not limited. `channels`: actuators that it drives. `reads_position`: it
    knows where the hand is, by a sensor or from the host.
    """

    core: Annotated[str, one_of(CORES)] | None = None
    clock_hz: Annotated[float, within(1e6, 5e9, "clock of the processor in Hz")] | None = None
    flash_bytes: Annotated[float, within(16_384, 2**40, "flash memory in bytes")] | None = None
    ram_bytes: Annotated[float, within(8_192, 2**40, "working memory in bytes")] | None = None
    channels: Annotated[int, within(1, MAX_CHANNELS, "channels that it drives")]
    reads_position: bool = False

    def __post_init__(self) -> None:
        if self.core is not None and self.clock_hz is None:
            raise ValueError(f"core {self.core} needs its clock_hz, such as clock_hz = 168_000_000")
        if self.core is None and self.clock_hz is not None:
            raise ValueError(f"clock_hz needs a core: add core, one of {', '.join(CORES)}")


@dataclass(frozen=True)
class Link:
    """The link that all controllers share. `bytes_per_second`: infinite if not limited. `delay_ms`: one way."""

    bytes_per_second: float
    delay_ms: float


@dataclass(frozen=True)
class SceneTexture:
    """A texture of the scene, the controller that plays it, and what was loaded."""

    name: str
    controller: str
    loaded: Recording | Profile

    @property
    def channels(self) -> int:
        """Actuators that it moves."""
        return 1 if isinstance(self.loaded, Profile) else self.loaded.channels


@dataclass(frozen=True)
class Measure:
    """A measure of quality that a scene may require.

    `figure`: that states it. `digits`: decimals of a proposed target.
    """

    figure: Figure
    digits: int


MEASURES = {
    "snr_db": Measure(FIGURES["snr_db"], 1),
    "spqi": Measure(FIGURES["spqi"], 2),
    "third_octave_distance_db": Measure(FIGURES["third_octave_distance_db"], 1),
    "imperceptible": Measure(FIGURES["error_over_threshold_db"], 1),
}
"""By the keys of [asked]."""


class Asked(Table, frozen=True, kw_only=True):
    """The requirements of every texture. Exactly one of the first four is given.

    `snr_db`: of the decoded signal in the band worth coding, in its own unit, as `vibrocast play` prints it. `spqi`,
    `third_octave_distance_db`: as evaluation.metrics measures them. `imperceptible`: the error at the skin
    is below the detection threshold, or what the texture masks, by MARGIN_DB of planner.band. `waveform`: excludes
    parametric coding; None in the file = unless `third_octave_distance_db` is required. `rate_limit_bps`: of the bytes
    on the wire, of each stream. `delay_limit_ms`: to the skin; None = no packet is longer than those of a live stream.
    """

    snr_db: Annotated[float, within(0, 90, "signal-to-noise ratio in dB")] | None = None
    spqi: Annotated[float, within(0.01, 1, "SPQI, 1 for an exact copy")] | None = None
    third_octave_distance_db: (
        Annotated[float, within(0.01, 60, "third-octave distance in dB, 0 for an exact copy")] | None
    ) = None
    imperceptible: bool = False
    waveform: bool | None = None
    rate_limit_bps: Annotated[float, within(50, 1e9, "bits per second on the wire, of one stream")] | None = None
    delay_limit_ms: Annotated[float, within(1, MAX_DELAY_MS, "delay to the skin in ms")] | None = None

    def __post_init__(self) -> None:
        targets = self._targets
        if len(targets) != 1:
            problem = f"{' and '.join(targets)} are given" if targets else "no quality is given"
            raise ValueError(
                f"{problem}; give one of snr_db, spqi, third_octave_distance_db and imperceptible = true (nobody feels "
                "the error)"
            )
        # SPQI rates an independent realisation of the same noise no better than silence (docs/reference/metrics.md).
        blind = self.third_octave_distance_db is not None
        if self.waveform is None:
            structs.force_setattr(self, "waveform", not blind)
        if not self.waveform and not blind:
            raise ValueError(
                f"waveform = false contradicts {targets[0]}, which parametric coding never meets; require "
                "third_octave_distance_db, or leave waveform out"
            )

    @property
    def measure(self) -> str:
        """The required quality, a key of MEASURES."""
        return self._targets[0]

    @property
    def _targets(self) -> list[str]:
        return [key for key in MEASURES if getattr(self, key) is not None and getattr(self, key) is not False]


Weight = Annotated[float, within(0, 1e6, "weight of one such unit")]


class Weights(Table, frozen=True):
    """The weight of one unit of each cost; kilobytes are those of flash and RAM together.

    By default 1 kbit/s counts as 10 million instructions a second, 100 kB, or 100 ms.
    """

    per_kilobit_per_second: Weight = 1.0
    per_million_instructions_per_second: Weight = 0.1
    per_kilobyte: Weight = 0.01
    per_millisecond: Weight = 0.01

    def __post_init__(self) -> None:
        if not any(structs.astuple(self)):
            raise ValueError("all weights are 0, so all settings cost the same; give one above 0")


@dataclass(frozen=True)
class Scene:
    """A scene, read and checked. `hand_speed_mm_s`: least and greatest. `threshold_path`: rows of b(F)."""

    path: Path
    hand_speed_mm_s: tuple[float, float]
    textures: tuple[SceneTexture, ...]
    controllers: tuple[SceneController, ...]
    actuators: tuple[BenchActuator, ...]
    link: Link
    asked: Asked
    weights: Weights
    threshold_path: Path

    def controller(self, name: str) -> SceneController:
        """Return the controller of that name."""
        return next(each for each in self.controllers if each.name == name)

    def only(self, names: Sequence[str]) -> "Scene":
        """Return the scene with the textures of these names alone; all where none is given. Raises InputError."""
        known = {texture.name: texture for texture in self.textures}
        for name in names:
            if name not in known:
                raise InputError(f"{self.path}: there is no texture {name!r}; choose from {', '.join(known)}")
        return replace(self, textures=tuple(known[name] for name in names or known))

    def actuator(self, texture: SceneTexture) -> Actuator:
        """Return the actuator to plan a texture for: the one with the widest band of those that play it."""
        models = {each.channel: each.model for each in self.actuators if each.controller == texture.controller}
        played = [models.get(channel, models.get(None)) for channel in range(1, texture.channels + 1)]
        return max((model for model in played if model is not None), key=lambda model: model.band_hz[1])


def _known(address: str) -> dict[str, Any]:
    """Return core, clock, flash, RAM and channels of a controller that needs no hardware; empty for any other."""
    if address in devices.FIRMWARE:
        device = devices.firmware_device(address)
        names = ("core", "clock_hz", "flash_bytes", "ram_bytes", "channels")
        return {name: value for name in names if (value := getattr(device, name)) is not None}
    return {"channels": 8} if address in devices.SIMULATED else {}


class _Texture(TextureTable, frozen=True, kw_only=True):
    name: Text | None = None
    controller: str | None = None


_SPEED = "speed of the hand in mm/s"


class _Hand(Table, frozen=True):
    # No tuple[float, float]: msgspec 0.22 crashes on a union of a fixed-length tuple and a number with limits.
    speed_mm_s: Annotated[
        Annotated[float, within(*HAND_SPEEDS_MM_S, _SPEED)]
        | Annotated[
            tuple[Annotated[float, within(0, HAND_SPEEDS_MM_S[1], _SPEED)], ...], Meta(min_length=2, max_length=2)
        ],
        Meta(description="a speed in mm/s, or the lowest and the highest: [20, 100]"),
    ]

    def __post_init__(self) -> None:
        low, high = self.range
        if low > high:
            raise ValueError(f"speed_mm_s: the lowest speed, {low:g}, is above the highest, {high:g}; swap them")
        if high < HAND_SPEEDS_MM_S[0]:
            raise ValueError(
                f"speed_mm_s: the highest speed, {high:g}, is below {HAND_SPEEDS_MM_S[0]:g} mm/s; raise it"
            )

    @property
    def range(self) -> tuple[float, float]:
        """The lowest and the highest speed; a hand may rest."""
        if isinstance(self.speed_mm_s, tuple):
            return self.speed_mm_s[0], self.speed_mm_s[1]
        return self.speed_mm_s, self.speed_mm_s


class _Skin(Table, frozen=True):
    threshold: Text | None = None


class _Link(Table, frozen=True):
    kind: Annotated[str, one_of(LINK_DELAYS_MS)] | None = None
    delay_ms: Annotated[float, within(0, 5_000, "delay one way in ms")] | None = None
    bytes_per_second: Annotated[float, within(10, 1e10, "bytes per second that the link carries")] | None = None

    def link(self, controllers: Sequence[SceneController]) -> Link:
        """Return the link; missing values are those usual for these controllers."""
        simulated = {controller.address for controller in controllers} <= set(devices.SIMULATED)
        kind = self.kind or ("simulated" if simulated else "serial")
        delay_ms = LINK_DELAYS_MS[kind] if self.delay_ms is None else self.delay_ms
        return Link(self.bytes_per_second or LINK_BYTES_PER_SECOND.get(kind, math.inf), delay_ms)


class _SceneFile(Table, frozen=True, kw_only=True):
    textures: Annotated[tuple[_Texture, ...], Meta(min_length=1)]
    controllers: Annotated[tuple[SceneController, ...], Meta(min_length=1)]
    actuators: Annotated[tuple[ActuatorTable, ...], Meta(min_length=1)]
    hand: _Hand
    skin: _Skin = _Skin()
    link: _Link = _Link()
    asked: Asked
    weights: Weights = Weights()


def read_scene(path: Path) -> Scene:
    """Read a scene file and all of its textures. Raises InputError, and OSError where the file cannot be read."""
    with located(path):
        document = read_toml(path, "scene")
        given = document.get("controllers")
        for table in given if isinstance(given, list) else ():
            if isinstance(table, dict):
                table.update(_known(str(table.get("address"))) | table)
        file = convert(document, _SceneFile)
        names = [each.name for each in file.controllers]
        check_names("controllers", names)
        threshold_path = threshold_file(file.skin.threshold, path.parent)
        with located("[skin]"):
            read_threshold(threshold_path)
        scene = Scene(
            path=path,
            hand_speed_mm_s=file.hand.range,
            textures=(),
            controllers=file.controllers,
            actuators=read_actuators(file.actuators, names),
            link=file.link.link(file.controllers),
            asked=file.asked,
            weights=file.weights,
            threshold_path=threshold_path,
        )
        _check_channels(scene)
        _check_actuators(scene)
        found = tuple(chain.from_iterable(read_each("textures", file.textures, partial(_textures, scene))))
        check_names("textures", [texture.name for texture in found])
        return replace(scene, textures=found)


def _check_actuators(scene: Scene) -> None:
    """Raise ValueError for an actuator behind firmware that has another one compiled in."""
    firmware = {each.name: each.address for each in scene.controllers if each.address in devices.FIRMWARE}
    for number, entry in enumerate(scene.actuators, 1):
        if entry.controller not in firmware:
            continue
        if differences := actuator_differences(entry.model, PIEZO_STACK):
            raise ValueError(
                f"[[actuators]] {number}: {firmware[entry.controller]} drives {PIEZO_STACK.name}, compiled in: "
                f"{'; '.join(differences)}; plan for that, or for sim"
            )


def _check_channels(scene: Scene) -> None:
    """Raise ValueError for an actuator on a channel that its controller does not have."""
    for number, entry in enumerate(scene.actuators, 1):
        channels = scene.controller(entry.controller).channels
        if entry.channel is not None and entry.channel > channels:
            raise ValueError(
                f"[[actuators]] {number}: channel {entry.channel}, but {entry.controller} has {channels} channels; "
                "give another channel"
            )


def _textures(scene: Scene, table: _Texture) -> list[SceneTexture]:
    """Return the textures of a table: one, or all recordings of a folder. Raises ValueError."""
    controller = one_named(table.controller, [each.name for each in scene.controllers])
    make = partial(_texture, scene, controller)
    options = table.options()
    if table.generate is not None:
        made = textures.GENERATORS[table.generate](hand_speed_mm_s=scene.hand_speed_mm_s[1], **options)
        return [make(table.name or table.generate, made)]
    files = (table.file,) if isinstance(table.file, str) else table.file or ()
    paths = [scene.path.parent / file for file in files]
    if len(paths) == 1 and paths[0].is_dir():
        prefix = f"{table.name}/" if table.name else ""
        return [make(prefix + entry.name, load([entry.path], options)) for entry in entries(paths[0])]
    for path in paths:
        if not path.exists():
            raise ValueError(f"file {path} does not exist; correct its path, which starts at the scene's folder")
    return [make(table.name or "+".join(path.stem for path in paths), load(paths, options))]


def _texture(scene: Scene, controller: str, name: str, loaded: Recording | Profile) -> SceneTexture:
    """Return a texture, checked against the controller that plays it. Raises ValueError."""
    low, high = scene.hand_speed_mm_s
    texture = SceneTexture(name, controller, loaded)
    plays = scene.controller(controller)
    if texture.channels > plays.channels:
        raise ValueError(
            f"{name} has {texture.channels} channels, {controller} drives {plays.channels}; leave some out, or give "
            "another controller"
        )
    models = {each.channel for each in scene.actuators if each.controller == controller}
    if missing := [channel for channel in range(1, texture.channels + 1) if not {channel, None} & models]:
        raise ValueError(
            f"{name} needs an actuator on channel {missing[0]} of {controller}, and the scene has none; add it to "
            "[[actuators]]"
        )
    if isinstance(texture.loaded, Profile) and low != high and not plays.reads_position:
        raise ValueError(
            f"{name} is a height profile, and the hand moves at {low:g} to {high:g} mm/s, but {controller} does not "
            "know where the hand is; set its reads_position = true, or give one speed"
        )
    if isinstance(texture.loaded, Profile) and plays.reads_position and high > MAX_TRACKED_MM_S:
        raise ValueError(
            f"{name} is rendered by the hand's position up to {MAX_TRACKED_MM_S:g} mm/s, and the hand moves at up to "
            f"{high:g}; lower speed_mm_s"
        )
    return texture


def load(files: Sequence[Path], options: Mapping[str, Any]) -> Recording | Profile:
    """Load files that play together, as the channels of one recording; a lone height profile as such.

    `options`: arguments of `textures.load`. A high-pass removes the band below touch from acceleration, as `vibrocast
    encode` does. It comes before resampling and padding, because these would turn an offset into a step. Raises
    TextureError.
    """
    if len(files) == 1 and is_profile(files[0]):
        return textures.load_profile(files[0])
    return together([_highpassed(path, options) for path in files])


def _highpassed(path: Path, options: Mapping[str, Any]) -> Recording:
    loaded = textures.load_for_actuators(path, **options)
    if loaded.rate_hz <= 2 * textures.HIGHPASS_HZ:
        return loaded  # `band_of` rejects this rate
    return textures.highpass(loaded, textures.highpass_of(options.get("unit"))).recording


def together(recordings: list[Recording]) -> Recording:
    """Return recordings as the channels of one, the shorter ones silent at their end. Raises TextureError."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for other in recordings[1:]:
        if (other.rate_hz, other.unit) != (first.rate_hz, first.unit):
            raise TextureError(
                f"{other.name} is {other.rate_hz:g} Hz in {other.unit}, {first.name} {first.rate_hz:g} Hz in "
                f"{first.unit}; bring files that are played together to one rate and one unit"
            )
    longest = max(len(each.samples) for each in recordings)
    padded = [np.pad(each.samples, ((0, longest - len(each.samples)), (0, 0))) for each in recordings]
    return Recording(np.hstack(padded), first.rate_hz, first.unit, "+".join(each.name for each in recordings))
