"""The scene file: textures, hand speeds, actuators, controllers, link and targets, in TOML (docs/planning.md)."""

import hashlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from vibrocast import textures
from vibrocast.codec import CodecError
from vibrocast.codec.threshold import DETECTION_THRESHOLD, read_threshold
from vibrocast.device_protocol.transports import BAUD
from vibrocast.files import InputFileError
from vibrocast.host.harness.bench_file import BenchActuator, read_actuator, read_address
from vibrocast.output.actuator import Actuator
from vibrocast.textures import Profile, Recording, TextureError
from vibrocast.textures.dataset import DatasetError, traces
from vibrocast.textures.files import TEXT_SUFFIXES
from vibrocast.textures.recording import MAX_CHANNELS
from vibrocast.toml_tables import Table, number, read_toml

CORES = ("M4F", "M7", "M33")
"""Processors for which decoding has been measured (docs/firmware.md)."""
LINKS = ("serial", "usb-full-speed", "usb-high-speed", "simulated")
USB_BYTES_PER_SECOND = {"usb-full-speed": 1_216_000.0, "usb-high-speed": 53_248_000.0}
"""The most that bulk transfers carry: 19 packets of 64 bytes in a frame of 1 ms, 13 of 512 in a microframe of 125 us
(USB 2.0 specification, tables 5-9 and 5-10)."""
LINK_DELAYS_MS = {"serial": 1.0, "usb-full-speed": 1.0, "usb-high-speed": 0.125, "simulated": 0.0}
"""From the host's write to the controller: USB takes data once a frame or microframe, a serial adapter is on USB."""
_BITS_PER_SERIAL_BYTE = 10  # a start bit, eight bits of data, a stop bit

HAND_SPEEDS_MM_S = (1.0, 2000.0)
"""Hands explore surfaces at some 10 to 300 mm/s; faster and slower ones are taken, metres for millimetres are not."""

MAX_TRACKED_MM_S = 300.0
"""To which hand speed profiles are rendered by position (firmware/core/profile.h)."""

# What a value of the file means, and the range that it can have: beyond it lies a slip of units.
_CONTROLLER_RANGES = {
    "clock_hz": (1e6, 5e9, "clock of the processor in Hz"),
    "flash_bytes": (16_384, 2**40, "flash memory in bytes"),
    "ram_bytes": (8_192, 2**40, "working memory in bytes"),
}
_TEXTURE_RANGES = {
    "rate_hz": (20, 1e7, "sample rate in Hz"),
    "full_scale": (1e-9, 1e9, "value of 1.0 in the file, in its unit"),
    "seconds": (0.05, 600, "duration in s"),
}
_ACTUATOR_RANGES = {
    "stroke_um": (0.1, 20_000, "stroke from end to end in um"),
    "volts": (0.1, 2_000, "voltage range in V"),
    "corner_hz": (2, 5_000, "-3 dB frequency or resonance in Hz"),
    "quality": (0.1, 300, "Q of the resonance"),
    "slew_volts_per_second": (10, 1e9, "slew limit in V/s"),
    "volts_limit": (0.05, 2_000, "voltage limit from rest in V"),
    "power_limit": (1e-4, 1, "mean of the squared drive, full scale = 1"),
}
_ASKED_RANGES = {
    "snr_db": (0, 90, "signal-to-noise ratio in dB"),
    "spqi": (0.01, 1, "SPQI, 1 for an exact copy"),
    "third_octave_distance_db": (0.01, 60, "third-octave distance in dB, 0 for an exact copy"),
    "rate_limit_bps": (50, 1e9, "bits per second on the wire, of one stream"),
    "delay_limit_ms": (1, 10_000, "delay to the skin in ms"),
}
_SINGLE_TABLES = ("hand", "skin", "link", "asked", "weights")
_TABLE_LISTS = ("textures", "controllers", "actuators")
_WEIGHTS = ("per_kilobit_per_second", "per_million_instructions_per_second", "per_kilobyte", "per_millisecond")


class SceneError(InputFileError):
    """A scene that is wrong; the message names file, table and key, and says what to do."""


@dataclass(frozen=True)
class SceneController:
    """A controller of the scene.

    `address`: as `host.devices.connect` takes it. `core`: one of CORES, with its `clock_hz`; None = a computer, which
    decodes every codec and whose load is not limited. `flash_bytes`, `ram_bytes`: None = not limited. `channels`:
    actuators that it drives. `reads_position`: it knows where the hand is, by a sensor or from the host.
    """

    name: str
    address: str
    core: str | None
    clock_hz: float | None
    flash_bytes: float | None
    ram_bytes: float | None
    channels: int
    reads_position: bool


@dataclass(frozen=True)
class Link:
    """The link that all controllers share. `bytes_per_second`: None = not limited. `delay_ms`: one way."""

    kind: str
    bytes_per_second: float | None
    delay_ms: float


@dataclass(frozen=True)
class Source:
    """Where a texture comes from: files that are played together, one after another on the channels, or a generator.

    `options`: keyword arguments of `textures.load`, or of the generator `kind`.
    """

    files: tuple[Path, ...]
    kind: str | None
    options: Mapping[str, Any]

    def load(self, hand_speed_mm_s: float) -> Recording | Profile:
        """Load or make the texture; a lone height profile as such. Raises TextureError.

        Of acceleration from files, the band below touch is removed, as `coding.encode` does: before anything resamples
        or lengthens it, which would make an offset a step.
        """
        if self.kind is not None:
            return textures.GENERATORS[self.kind](hand_speed_mm_s=hand_speed_mm_s, **self.options)
        if len(self.files) == 1 and (profile := _profile(self.files[0])) is not None:
            return profile
        return together([self._highpassed(path) for path in self.files])

    def _highpassed(self, path: Path) -> Recording:
        loaded = textures.load_for_actuators(path, **self.options)
        if loaded.rate_hz <= 2 * textures.HIGHPASS_HZ:
            return loaded  # no controller plays it, as the planner says
        return textures.highpass(loaded, textures.highpass_of(self.options.get("unit"))).recording

    def sha256(self) -> str | None:
        """Return the SHA-256 of the files' bytes, one after another, in hexadecimal; None without files."""
        if not self.files:
            return None
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(path.read_bytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class SceneTexture:
    """A texture of the scene, the controller that plays it, and what was loaded."""

    name: str
    source: Source
    controller: str
    loaded: Recording | Profile

    @property
    def channels(self) -> int:
        """Actuators that it moves."""
        return 1 if isinstance(self.loaded, Profile) else self.loaded.channels


@dataclass(frozen=True)
class Asked:
    """What is asked of every texture. Of the first four, one is given.

    `snr_db`: of the decoded signal in the band worth coding, in its own unit, as `vibrocast play` tells it. `spqi`,
    `third_octave_distance_db`: as evaluation.metrics measures them. `imperceptible`: the error at the skin
    is below the detection threshold by the margin of host.planner.band. `waveform`: whether a description will not do.
    `rate_limit_bps`: of the bytes on the wire, of each stream. `delay_limit_ms`: to the skin.
    """

    snr_db: float | None
    spqi: float | None
    third_octave_distance_db: float | None
    imperceptible: bool
    waveform: bool
    rate_limit_bps: float | None
    delay_limit_ms: float | None

    @property
    def measure(self) -> str:
        """Name of the quality that is asked: "snr_db", "spqi", "third_octave_distance_db" or "imperceptible"."""
        given = (name for name in ("snr_db", "spqi", "third_octave_distance_db") if getattr(self, name) is not None)
        return next(given, "imperceptible")


@dataclass(frozen=True)
class Weights:
    """What one unit of each cost counts; kilobytes are those of flash and RAM together."""

    per_kilobit_per_second: float
    per_million_instructions_per_second: float
    per_kilobyte: float
    per_millisecond: float


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

    def actuator(self, texture: SceneTexture) -> Actuator:
        """Return the actuator that a texture is planned for: of those that play it, the one with the widest band."""
        models = {each.channel: each.model for each in self.actuators if each.controller == texture.controller}
        played = [models.get(channel, models.get(None)) for channel in range(1, texture.channels + 1)]
        return max((model for model in played if model is not None), key=lambda model: model.band_hz[1])


# What is known of the controllers that need no hardware: core, clock, flash, RAM, channels (firmware/build.py).
_KNOWN: Mapping[str, Mapping[str, Any]] = {
    "sim": {"channels": 8},
    "sim-usb": {"channels": 8},
    "host": {"channels": 8},
    "cortex-m4": {"core": "M4F", "clock_hz": 168e6, "channels": 4},
    "cortex-m7": {"core": "M7", "clock_hz": 480e6, "channels": 4},
    "cortex-m33": {"core": "M33", "clock_hz": 150e6, "channels": 4},
    "stm32f405": {"core": "M4F", "clock_hz": 168e6, "flash_bytes": 2**20, "ram_bytes": 192 * 1024, "channels": 2},
}
_LINK_OF = {"sim": "simulated", "sim-usb": "simulated", "host": "simulated"}


def read_scene(path: Path) -> Scene:
    """Read a scene file and all of its textures. Raises SceneError, and OSError where the file cannot be read."""
    document = read_toml(path, "scene", SceneError)
    singles = {key: document.pop(key) for key in _SINGLE_TABLES if key in document}
    for key, value in singles.items():
        if not isinstance(value, dict):
            raise SceneError(f"{path}: {key} must be a table: begin it with [{key}]")
    if unknown := sorted(set(document) - set(_TABLE_LISTS)):
        known = ", ".join((*_TABLE_LISTS, *_SINGLE_TABLES))
        raise SceneError(f"{path}: there is no {unknown[0]}; choose from {known}")
    tables: dict[str, list[Table]] = {}
    for kind in _TABLE_LISTS:
        given = document.get(kind, [])
        if not isinstance(given, list) or not all(isinstance(table, dict) for table in given):
            raise SceneError(f"{path}: {kind} must be tables: begin each with [[{kind}]]")
        if not given:
            raise SceneError(f"{path}: names no {kind}; add [[{kind}]]")
        tables[kind] = [Table(path, f"[[{kind}]] {place}", table, SceneError) for place, table in enumerate(given, 1)]

    def single(key: str) -> Table:
        return Table(path, f"[{key}]", singles.get(key, {}), SceneError)

    controllers = tuple(_controller(table) for table in tables["controllers"])
    names = [controller.name for controller in controllers]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SceneError(f"{path}: two [[controllers]] are named {twice[0]!r}; give each its own name")
    link = _link(single("link"), controllers)
    scene = Scene(
        path=path,
        hand_speed_mm_s=_hand_speeds(single("hand")),
        textures=(),
        controllers=controllers,
        actuators=_actuators(tables["actuators"], controllers),
        link=link,
        asked=_asked(single("asked"), link),
        weights=_weights(single("weights")),
        threshold_path=_threshold(single("skin")),
    )
    found = [texture for table in tables["textures"] for texture in _textures(table, scene)]
    all_names = [texture.name for texture in found]
    if twice := sorted({name for name in all_names if all_names.count(name) > 1}):
        raise SceneError(f"{path}: two [[textures]] are named {twice[0]!r}; give each its own name")
    return replace(scene, textures=tuple(found))


def together(recordings: list[Recording]) -> Recording:
    """Return recordings as the channels of one, the shorter ones silent at their end. Raises TextureError."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for other in recordings[1:]:
        if (other.rate_hz, other.unit) != (first.rate_hz, first.unit):
            raise TextureError(
                f"{other.name}: {other.rate_hz:g} Hz in {other.unit}, {first.name} beside it {first.rate_hz:g} Hz in "
                f"{first.unit}; what is played together must agree"
            )
    import numpy as np

    longest = max(len(each.samples) for each in recordings)
    padded = [np.pad(each.samples, ((0, longest - len(each.samples)), (0, 0))) for each in recordings]
    return Recording(np.hstack(padded), first.rate_hz, first.unit, "+".join(each.name for each in recordings))


def _controller(table: Table) -> SceneController:
    name = table.text("name")
    address = table.take("address", read_address, "an address such as 'sim'")
    known = _KNOWN.get(address, {})
    core = table.word("core", CORES, known.get("core"))
    given = {
        key: table.within(key, low, high, meaning, known.get(key))
        for key, (low, high, meaning) in _CONTROLLER_RANGES.items()
    }
    channels = table.whole("channels", 1, MAX_CHANNELS, known.get("channels", MISSING))
    controller = SceneController(
        name, address, core, **given, channels=channels, reads_position=table.switch("reads_position", False)
    )
    table.end()
    if core is not None and controller.clock_hz is None:
        raise table.reject(f"core {core} needs its clock_hz, such as clock_hz = 168_000_000")
    if core is None and controller.clock_hz is not None:
        raise table.reject(f"clock_hz needs the core that it drives: add core, one of {', '.join(CORES)}")
    return controller


def _link(table: Table, controllers: tuple[SceneController, ...]) -> Link:
    addresses = {controller.address for controller in controllers}
    usual = "simulated" if addresses <= set(_KNOWN) else "serial"
    kind = table.word("kind", LINKS, usual)
    baud = table.within("baud", 1200, 2e7, "bits per second of the serial line", None)
    delay_ms = table.within("delay_ms", 0, 5_000, "delay one way in ms", LINK_DELAYS_MS[kind])
    given = table.within("bytes_per_second", 10, 1e10, "bytes per second that the link carries", None)
    table.end()
    if baud is not None and kind != "serial":
        raise table.reject(f"baud is of a serial line, and this link is {kind}; leave one of them out")
    if baud is not None and given is not None:
        raise table.reject("baud and bytes_per_second both say what the link carries; leave one out")
    if given is None and kind == "serial":
        given = (baud or BAUD) / _BITS_PER_SERIAL_BYTE
    return Link(kind, given if given is not None else USB_BYTES_PER_SECOND.get(kind), delay_ms)


def _hand_speeds(table: Table) -> tuple[float, float]:
    value = table.take("speed_mm_s", _one_or_two, "a speed in mm/s, or the least and the greatest: [20, 100]")
    table.end()
    low, high = value
    meaning = "speed of the hand in mm/s"
    table.check("speed_mm_s", high, *HAND_SPEEDS_MM_S, meaning)
    if low != 0:  # a hand may rest
        table.check("speed_mm_s", low, *HAND_SPEEDS_MM_S, meaning)
    if low > high:
        raise table.reject(f"speed_mm_s: the least speed, {low:g}, is above the greatest, {high:g}; swap them")
    return low, high


def _one_or_two(value: Any) -> tuple[float, float]:
    if isinstance(value, list):
        low, high = value
        return number(low), number(high)
    return number(value), number(value)


def _actuators(tables: list[Table], controllers: tuple[SceneController, ...]) -> tuple[BenchActuator, ...]:
    places: set[tuple[str, int | None]] = set()
    actuators = []
    for table in tables:
        for key, (low, high, meaning) in _ACTUATOR_RANGES.items():
            table.check_given(key, low, high, meaning)
        entry = read_actuator(table, [controller.name for controller in controllers])
        place = (entry.controller, entry.channel)
        if place in places:
            raise table.reject("there is another one on that channel; leave one out")
        places.add(place)
        controller = next(each for each in controllers if each.name == entry.controller)
        if entry.channel is not None and entry.channel > controller.channels:
            raise table.reject(f"channel {entry.channel}, but {controller.name} has {controller.channels} channels")
        actuators.append(entry)
    return tuple(actuators)


def _asked(table: Table, link: Link) -> Asked:
    given = {key: table.within(key, low, high, meaning, None) for key, (low, high, meaning) in _ASKED_RANGES.items()}
    imperceptible = table.switch("imperceptible", False)
    # SPQI takes another take of the same noise for no better than silence (docs/metrics.md).
    blind = given["third_octave_distance_db"] is not None
    waveform = table.switch("waveform", not blind)
    table.end()
    targets = [key for key in ("snr_db", "spqi", "third_octave_distance_db") if given[key] is not None]
    targets += ["imperceptible"] * imperceptible
    if len(targets) != 1:
        said = f"{' and '.join(targets)} are" if targets else "none is"
        raise table.reject(
            f"one quality must be asked, and {said} given: keep one of snr_db, spqi, third_octave_distance_db and "
            "imperceptible = true (as little as nobody can feel)"
        )
    if not waveform and not blind:
        raise table.reject(
            f"waveform = false contradicts {targets[0]}, which no description meets: ask for third_octave_distance_db, "
            "or leave waveform out"
        )
    asked = Asked(**given, imperceptible=imperceptible, waveform=waveform)
    if asked.delay_limit_ms is not None and asked.delay_limit_ms <= link.delay_ms:
        raise table.reject(
            f"delay_limit_ms = {asked.delay_limit_ms:g} cannot be kept on a link of {link.delay_ms:g} ms: ask for "
            "more, or give another link"
        )
    if asked.rate_limit_bps is not None and link.bytes_per_second is not None:
        carried_bps = 8 * link.bytes_per_second
        if asked.rate_limit_bps > carried_bps:
            raise table.reject(
                f"rate_limit_bps = {asked.rate_limit_bps:.9g} is above the {carried_bps:.9g} bit/s that the link "
                "carries: ask for less, or give another link"
            )
    return asked


def _weights(table: Table) -> Weights:
    """Return the weights; not given, 1 kbit/s counts as 10 million instructions a second, 100 kB, or 100 ms."""
    defaults = (1.0, 0.1, 0.01, 0.01)
    given = {
        key: table.within(key, 0, 1e6, "weight of one such unit", default)
        for key, default in zip(_WEIGHTS, defaults, strict=True)
    }
    table.end()
    if not any(given.values()):
        raise table.reject("all weights are 0, so that nothing costs anything: give one above 0")
    return Weights(**given)


def _threshold(table: Table) -> Path:
    file = table.text("threshold", None)
    table.end()
    path = DETECTION_THRESHOLD if file is None else table.path.parent / file
    try:
        read_threshold(path)
    except CodecError as error:
        raise table.reject(str(error)) from error
    return path


def read_options(table: Table, generated: bool) -> dict[str, Any]:
    """Return what a table, which ends with it, says of a file or of a generated texture, as in Source.

    Raises the table's error.
    """
    keys = ("seconds", "rate_hz") if generated else ("rate_hz", "full_scale")
    options = {key: table.within(key, *_TEXTURE_RANGES[key], None) for key in keys}
    if generated:
        options["seed"] = table.whole("seed", 0, 2**32 - 1, None)
        options["rate_hz"] = None if options["rate_hz"] is None else round(options["rate_hz"])
    else:
        options["unit"] = table.word("unit", textures.INPUT_UNITS, None)
        options["axis"] = table.word("axis", textures.AXES, None)
        options["reduce"] = table.word("reduce", textures.REDUCTIONS, None)
        options["key"] = table.text("key", None)
    table.end()
    return {key: value for key, value in options.items() if value is not None}


def _textures(table: Table, scene: Scene) -> list[SceneTexture]:
    """Return the textures of a table: one, or all recordings of a folder."""
    name = table.text("name", None)
    files = table.take("file", _files, "a file, a folder, or a list of files that are played together", None)
    kind = table.word("generate", sorted(textures.GENERATORS), None)
    if (files is None) == (kind is None):
        raise table.reject("give either file or generate")
    names = [controller.name for controller in scene.controllers]
    controller = table.word("controller", names, names[0] if len(names) == 1 else MISSING)
    options = read_options(table, generated=files is None)
    make = partial(_texture, table, scene, controller)
    if files is None:
        return [make(name or kind, Source((), kind, options))]
    paths = [table.path.parent / file for file in files]
    if len(paths) == 1 and paths[0].is_dir():
        try:
            found = traces(paths[0])
        except (DatasetError, OSError) as error:
            raise table.reject(str(error)) from error
        prefix = f"{name}/" if name else ""
        return [make(prefix + trace.name, Source((trace.path,), None, options)) for trace in found]
    for path in paths:
        if not path.exists():
            raise table.reject(f"file {path} does not exist; correct its name, which is found from the scene's folder")
    return [make(name or "+".join(path.stem for path in paths), Source(tuple(paths), None, options))]


def _texture(table: Table, scene: Scene, controller: str, name: str, source: Source) -> SceneTexture:
    """Return a texture, loaded and checked against the controller that plays it."""
    low, high = scene.hand_speed_mm_s
    try:
        texture = SceneTexture(name, source, controller, source.load(high))
    except (TextureError, TypeError) as error:
        raise table.reject(str(error)) from error
    plays = scene.controller(controller)
    if texture.channels > plays.channels:
        raise table.reject(
            f"{name} has {texture.channels} channels, {controller} drives {plays.channels}: leave some out, or give "
            "another controller"
        )
    models = {each.channel for each in scene.actuators if each.controller == controller}
    if missing := [channel for channel in range(1, texture.channels + 1) if not {channel, None} & models]:
        raise table.reject(
            f"{name} moves the actuator on channel {missing[0]} of {controller}, which the scene does not have: add it "
            "to [[actuators]]"
        )
    if isinstance(texture.loaded, Profile) and low != high and not plays.reads_position:
        raise table.reject(
            f"{name} is a height profile, and the hand moves at {low:g} to {high:g} mm/s: only a controller that knows "
            f"where the hand is can play it (reads_position = true of {controller}); or give one speed"
        )
    if isinstance(texture.loaded, Profile) and plays.reads_position and high > MAX_TRACKED_MM_S:
        raise table.reject(
            f"{name} is rendered by the hand's position up to {MAX_TRACKED_MM_S:g} mm/s, and the hand moves at up to "
            f"{high:g}: give a slower one"
        )
    if isinstance(texture.loaded, Profile) and not plays.reads_position and high == 0:
        raise table.reject(f"{name} is a height profile under a hand that rests: give a speed above 0")
    return texture


def _files(value: Any) -> tuple[str, ...]:
    files = value if isinstance(value, list) else [value]
    if not files or not all(isinstance(file, str) and file.strip() and "\0" not in file for file in files):
        raise TypeError(value)
    return tuple(files)


def _profile(path: Path) -> Profile | None:
    """Return the height profile in a file, None where it is something else."""
    if path.suffix.lower() not in TEXT_SUFFIXES or not path.is_file():
        return None
    try:
        return textures.load_profile(path)
    except TextureError:
        return None
