"""The bench file: which controllers, actuators, sensors and textures a bench has, in TOML (docs/harness.md)."""

import contextlib
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import MISSING, asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from vibrocast import textures
from vibrocast.device_protocol.messages import ActuatorDescription
from vibrocast.files import InputFileError
from vibrocast.host import devices
from vibrocast.host.controller import Controller
from vibrocast.host.end_to_end import actuator_model
from vibrocast.output import actuator_files
from vibrocast.output.actuator import Actuator
from vibrocast.textures import Recording
from vibrocast.toml_tables import Table, read_toml, text

SENSOR_KINDS = ("accelerometer", "laser")
SENSOR_PLACEHOLDERS = ("file", "seconds")
SUFFIXES = (".wav", ".csv", ".txt", ".tsv", ".npy", ".npz")
DEFAULT_TEXTURE = "wood"


class BenchFileError(InputFileError):
    """A bench file that is wrong; the message names file, table and key, and says what to do."""


@dataclass(frozen=True)
class BenchController:
    """A controller of the bench. `address`: as `host.devices.connect` takes it."""

    name: str
    address: str


@dataclass(frozen=True)
class BenchActuator:
    """An actuator behind a controller. `controller`: name; `channel`: from 1, None = every channel."""

    model: Actuator
    controller: str
    channel: int | None


@dataclass(frozen=True)
class Sensor:
    """A sensor on an actuator, read by a program that records into a file.

    `command`: program and arguments, with {file} and {seconds} to be filled in. `suffix`: of the file's name, one of
    SUFFIXES. `rate_hz`, `unit` (one of textures.INPUT_UNITS), `axis`, `reduce`: as `textures.load` takes them.
    `sensitivity`: what one `unit` makes in the file's numbers, where full scale of a WAV file or of integers is 1.
    """

    name: str
    kind: str
    controller: str
    channel: int
    command: tuple[str, ...]
    suffix: str
    rate_hz: float | None
    unit: str | None
    sensitivity: float | None
    axis: str | None
    reduce: str | None = None


@dataclass(frozen=True)
class Bench:
    """What a bench has; `controllers` has at least one entry, and `first` is the one under test."""

    controllers: tuple[BenchController, ...]
    actuators: tuple[BenchActuator, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    textures: tuple[Callable[[], Recording], ...] = field(default=(), repr=False)

    @property
    def first(self) -> BenchController:
        """The controller under test."""
        return self.controllers[0]

    def actuator(self, controller: str, channel: int = 1) -> Actuator | None:
        """Return the model of the actuator on a channel; None where the bench file says nothing of it."""
        models = {each.channel: each.model for each in self.actuators if each.controller == controller}
        return models.get(channel, models.get(None))

    def scene(self) -> tuple[Recording, ...]:
        """Return the textures, loaded or made; a generated one where the bench names none. Raises BenchFileError."""
        if not self.textures:
            return (textures.GENERATORS[DEFAULT_TEXTURE](),)
        return tuple(load() for load in self.textures)


def read_bench(path: Path) -> Bench:
    """Read a bench file. Raises BenchFileError, and OSError where it cannot be read."""
    document = read_toml(path, "bench file", BenchFileError)
    names: list[str] = []
    readers = {
        "controllers": _controller,
        "actuators": lambda table: read_actuator(table, names),
        "sensors": lambda table: _sensor(table, names),
        "textures": _texture,
    }
    if unknown := sorted(set(document) - set(readers)):
        raise BenchFileError(f"{path}: there is no {unknown[0]}; choose from {', '.join(readers)}")
    read: dict[str, list[Any]] = {}
    for kind, reader in readers.items():
        tables = document.get(kind, [])
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise BenchFileError(f"{path}: {kind} must be tables: begin each with [[{kind}]]")
        read[kind] = [
            reader(Table(path, f"[[{kind}]] {number}", table, BenchFileError)) for number, table in enumerate(tables, 1)
        ]
        names = names or [entry.name for entry in read["controllers"]]
    if not names:
        raise BenchFileError(f"{path}: names no controller; add [[controllers]] with a name and an address")
    for kind in ("controllers", "sensors"):
        names = [entry.name for entry in read[kind]]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise BenchFileError(f"{path}: two [[{kind}]] are named {twice[0]!r}; give each its own name")
    for kind in ("actuators", "sensors"):
        places: set[tuple[str, int | None]] = set()
        for number, entry in enumerate(read[kind], 1):
            place = (entry.controller, entry.channel)
            if place in places:
                raise BenchFileError(
                    f"{path}: [[{kind}]] {number}: there is another one on that channel; leave one out"
                )
            places.add(place)
    return Bench(**{kind: tuple(entries) for kind, entries in read.items()})


def chosen(bench: Bench | None, device: str | None) -> Bench:
    """Return the bench with the controller that `device` names, by name or address, as the first; None = as it is.

    Without a bench, one with that controller alone. Raises BenchFileError for what is neither.
    """
    if bench is None:
        bench = Bench((BenchController("controller", "sim"),))
        if device is None:
            return bench
    elif device is None:
        return bench
    for each in bench.controllers:
        if device in (each.name, each.address):
            return replace(bench, controllers=(each, *(other for other in bench.controllers if other is not each)))
    _check_address(device)
    return replace(bench, controllers=(BenchController(bench.first.name, device), *bench.controllers[1:]))


@contextlib.contextmanager
def connect(bench: Bench, controller: BenchController) -> Iterator[Controller]:
    """Open a session with a controller of the bench; a simulated one has the actuator that the bench has there.

    Raises as `host.devices.connect`.
    """
    with devices.connect(controller.address, actuator=bench.actuator(controller.name)) as session:
        yield session


def actuator_of(bench: Bench, controller: BenchController, description: ActuatorDescription) -> Actuator:
    """Return the model of the actuator on a controller's first channel: the bench's, or as the controller says.

    `description`: the controller's own, whose DAC it is.
    """
    model = bench.actuator(controller.name) or actuator_model(description)
    return replace(model, dac_bits=description.dac_bits, dac_rate_hz=description.dac_rate_hz)


def driven_actuator(bench: Bench, controller: BenchController, description: ActuatorDescription) -> Actuator:
    """Return the model that a controller itself works with, whose limits and compensation make its DAC's codes."""
    if controller.address in devices.SIMULATED and controller.address not in devices.FIRMWARE:
        return actuator_of(bench, controller, description)
    return actuator_model(description)


def _check_address(address: str) -> str:
    if address not in devices.SIMULATED and not devices.ADDRESS.fullmatch(address):
        raise BenchFileError(
            f"{address!r} is no controller: give a name in the bench file, {', '.join(devices.SIMULATED)}, "
            "serial:PORT or usb:VID:PID"
        )
    return address


def _controller(table: Table) -> BenchController:
    entry = BenchController(table.text("name"), table.take("address", read_address, "an address such as 'sim'"))
    table.end()
    return entry


def _controller_of(table: Table, controllers: list[str]) -> str:
    """Return the name of a controller; that of the only one if not given."""
    return str(table.word("controller", controllers, controllers[0] if len(controllers) == 1 else MISSING))


def read_actuator(table: Table, controllers: list[str]) -> BenchActuator:
    """Return an actuator behind one of the controllers of these names, as its table says: see docs/harness.md."""
    model = actuator_files.of_table(table)
    entry = BenchActuator(model, _controller_of(table, controllers), table.whole("channel", 1, 16, None))
    table.end()
    return entry


def _sensor(table: Table, controllers: list[str]) -> Sensor:
    entry = Sensor(
        name=table.text("name"),
        kind=table.word("kind", SENSOR_KINDS),
        controller=_controller_of(table, controllers),
        channel=table.whole("channel", 1, 16, 1),
        command=table.take("command", _command, "a list of a program and its arguments, {file} among them"),
        suffix=table.word("suffix", SUFFIXES, ".wav"),
        rate_hz=table.number("rate_hz", None),
        unit=table.word("unit", textures.INPUT_UNITS, None),
        sensitivity=table.number("sensitivity", None),
        axis=table.word("axis", textures.AXES, None),
        reduce=table.word("reduce", textures.REDUCTIONS, None),
    )
    if entry.sensitivity is not None and entry.unit is None:
        raise table.reject("sensitivity needs its unit: add unit, such as 'm/s^2'")
    table.end()
    return entry


def _texture(table: Table) -> Callable[[], Recording]:
    """Return what loads or makes a texture: that, and a wrong table, raises BenchFileError."""
    file = table.text("file", None)
    if file is None:
        make = textures.GENERATORS[table.word("generate", sorted(textures.GENERATORS))]
        options = {
            "seconds": table.number("seconds", None),
            "hand_speed_mm_s": table.number("hand_speed_mm_s", None),
            "seed": table.whole("seed", 0, 2**32 - 1, None),
        }
        table.end()
        return lambda: _loaded(
            table, partial(make, **{key: value for key, value in options.items() if value is not None})
        )
    path = table.path.parent / file
    if not path.exists():
        raise table.reject(f"file {path} does not exist")
    options = {
        "rate_hz": table.number("rate_hz", None),
        "unit": table.word("unit", textures.INPUT_UNITS, None),
        "full_scale": table.number("full_scale", None),
        "axis": table.word("axis", textures.AXES, None),
        "reduce": table.word("reduce", textures.REDUCTIONS, None),
        "key": table.text("key", None),
        "hand_speed_mm_s": table.number("hand_speed_mm_s", None),
    }
    table.end()
    return lambda: _loaded(table, partial(textures.load_for_actuators, path, **options))


def _loaded(table: Table, load: Callable[[], Recording]) -> Recording:
    try:
        return load()
    except textures.TextureError as error:
        raise table.reject(str(error)) from error


def read_address(value: Any) -> str:
    """Return an address as `host.devices.connect` takes it. Raises TypeError or BenchFileError."""
    return _check_address(text(value))


def _command(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(part, str) and part for part in value):
        raise TypeError(value)
    if "\0" in "".join(value):
        raise ValueError(value)
    named = {found for part in value for found in re.findall(r"\{(\w*)\}", part)}
    if "file" not in named or named - set(SENSOR_PLACEHOLDERS):
        raise ValueError(value)
    return tuple(value)


def actuator_toml(actuator: Actuator, controller: str) -> str:
    """Return the table of a bench file that names this actuator behind a controller."""
    values = {"controller": controller, **asdict(actuator)}
    # Texts and numbers in JSON are the same in TOML.
    lines = [f"{key} = {json.dumps(value)}" for key, value in values.items() if value is not None]
    return "\n".join(["[[actuators]]", *lines, ""])
