"""The bench file: controllers, actuators, sensors and textures of a bench, in TOML (docs/reference/toml_files.md)."""

import contextlib
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, structs
from msgspec import field as table_field

from vibrocast import textures
from vibrocast.device_protocol.transports import SERIAL_FORM, TransportError, serial_port
from vibrocast.errors import InputError, located
from vibrocast.host import devices
from vibrocast.host.devices import Session
from vibrocast.host.figures import BenchLimits, Noted, Value, missed
from vibrocast.output.actuator import Actuator, actuator_differences
from vibrocast.output.actuator_files import ActuatorTable
from vibrocast.textures import Recording, sensitivity
from vibrocast.toml_tables import (
    Table,
    Text,
    check_names,
    check_programs,
    convert,
    one_of,
    read_each,
    read_toml,
    within,
)

SENSOR_KINDS = ("accelerometer", "laser", "loop-back")
_INPUT = f"audio:CARD:CHANNEL or {SERIAL_FORM}"
SENSOR_PLACEHOLDERS = ("file", "seconds")
SUFFIXES = (".wav", ".csv", ".txt", ".tsv", ".npy", ".npz")
RateHz = Annotated[float, within(20, 1e7, "sample rate in Hz")]
Unit = Annotated[str, one_of(textures.INPUT_UNITS)]
Sensitivity = Annotated[Text, Meta(description=f"a text, such as {sensitivity.EXAMPLES}")]
Axis = Annotated[str, one_of(textures.AXES)]
Reduction = Annotated[str, one_of(textures.REDUCTIONS)]
DEFAULT_TEXTURE = "wood"


_ADDRESS = rf"\A({'|'.join(map(re.escape, devices.SIMULATED))}|{devices.ADDRESS.pattern})\Z"
_ADDRESSES = f"{', '.join(devices.SIMULATED)}, {devices.FORMS}"
Address = Annotated[str, Meta(pattern=_ADDRESS, description=f"an address: {_ADDRESSES}")]


FileNames = Annotated[
    str | Annotated[tuple[str, ...], Meta(min_length=1)],
    Meta(description="a file, a folder, or a list of files that are played together"),
]


Program = Annotated[tuple[str, ...], Meta(min_length=1, description="a list of a program and its arguments")]


class BenchController(Table, frozen=True):
    """A controller of the bench. `address`: as `host.devices.connect` takes it."""

    name: Text
    address: Address


class PoweredController(BenchController, frozen=True):
    """A controller whose power a program, `power_cycle` with its arguments, takes away and gives back; None = none."""

    power_cycle: Program | None = None


@dataclass(frozen=True)
class BenchActuator:
    """An actuator behind a controller. `controller`: name; `channel`: from 1, None = every channel."""

    model: Actuator
    controller: str
    channel: int | None


class Sensor(Table, frozen=True, kw_only=True):
    """A sensor on an actuator. `controller`: name; in a file, None = the only one. `axis`: which it measures."""

    name: Text
    kind: Annotated[str, one_of(SENSOR_KINDS)]
    controller: str | None = None
    channel: Annotated[int, within(1, 16, "channel of the controller")] = 1
    axis: Axis | None = None


class ProgramSensor(Sensor, frozen=True, kw_only=True):
    """A sensor that a program records into a file.

    `command`: program and arguments, with {file} and {seconds} to be filled in. `suffix`: of the file's name.
    `rate_hz`, `unit`, `reduce`: as `textures.load` takes them. `sensitivity`: what one `unit` makes in the file's
    numbers, where full scale of a WAV file or of integers is 1.
    """

    command: Program
    suffix: Annotated[str, one_of(SUFFIXES)] = ".wav"
    rate_hz: RateHz | None = None
    unit: Unit | None = None
    sensitivity: Annotated[float, Meta(gt=0, description="sensitivity per unit")] | None = None
    reduce: Reduction | None = None

    def __post_init__(self) -> None:
        named = {found for part in self.command for found in re.findall(r"\{(\w*)\}", part)}
        if "file" not in named or named - set(SENSOR_PLACEHOLDERS) or not all(map(str.isprintable, self.command)):
            raise ValueError("command must be a list of a program and its arguments, {file} among them, or {seconds}")
        if self.sensitivity is not None and self.unit is None:
            raise ValueError("sensitivity needs its unit: add unit, such as 'm/s^2'")


class InputSensor(Sensor, frozen=True, kw_only=True):
    """A sensor at an input of this computer, one of `host.sources.FORMS`.

    `sensitivity`: as `textures.sensitivity.parse` takes it. `volts_full_scale`, `rate_hz`: as of
    `host.sources.open_source`.
    """

    input: Annotated[str, Meta(pattern=r"\A(serial:|audio:).+\Z", description=_INPUT)]
    rate_hz: Annotated[int, within(20, 10**7, "sample rate in Hz")] | None = None
    sensitivity: Sensitivity | None = None
    volts_full_scale: Annotated[float, within(1e-4, 1e4, "volts at digital full scale")] | None = None

    def __post_init__(self) -> None:
        if self.kind == "loop-back":
            raise ValueError("a loop-back records the drive signal, in no unit of a sensor; give command, not input")
        if self.input.startswith("serial:"):
            try:
                serial_port(self.input)
            except TransportError as error:
                raise ValueError(str(error)) from error
        elif self.sensitivity is None or self.volts_full_scale is None:
            raise ValueError(f"{self.input} records volts; give sensitivity, such as '10.2mV/g', and volts_full_scale")
        if self.sensitivity is not None:
            sensitivity.parse(self.sensitivity)


class TextureTable(Table, frozen=True, kw_only=True):
    """An entry of [[textures]]: a file, with facts that it does not state, or a generator with its parameters."""

    file: FileNames | None = None
    generate: Annotated[str, one_of(sorted(textures.GENERATORS))] | None = None
    rate_hz: RateHz | None = None
    full_scale: Annotated[float, within(1e-9, 1e9, "value of 1.0 in the file, in its unit")] | None = None
    unit: Unit | None = None
    columns: Text | None = None
    reduce: Reduction | None = None
    key: Text | None = None
    seconds: Annotated[float, within(0.05, 600, "duration in s")] | None = None
    seed: Annotated[int, within(0, 2**32 - 1)] | None = None

    def options(self) -> dict[str, Any]:
        """Return the arguments of the generator, or of `textures.load`. Raises ValueError for keys of the other."""
        if (self.file is None) == (self.generate is None):
            raise ValueError("give either file or generate")
        given = {key: getattr(self, key) for key in TextureTable.__struct_fields__[2:]}
        given = {key: value for key, value in given.items() if value is not None}
        allowed = ("rate_hz", "seconds", "seed") if self.generate else _KEYS_OF_FILES
        if wrong := [key for key in given if key not in allowed]:
            raise ValueError(f"{wrong[0]} does not go with {'generate' if self.generate else 'file'}; leave one out")
        return given


_KEYS_OF_FILES = ("rate_hz", "full_scale", "unit", "columns", "reduce", "key")


class _BenchTexture(TextureTable, frozen=True, kw_only=True):
    file: Text | None = None
    hand_speed_mm_s: Annotated[float, within(1e-3, 1e4, "speed of the hand in mm/s")] | None = None
    limits: Mapping[str, Any] = table_field(default_factory=dict)

    @property
    def name(self) -> str:
        """By which its limits are found: the generator's, or the file's without its suffix."""
        return self.generate or Path(str(self.file)).stem


class _BenchFile(Table, frozen=True, kw_only=True):
    controllers: Annotated[tuple[PoweredController, ...], Meta(min_length=1)]
    actuators: tuple[ActuatorTable, ...] = ()
    sensors: tuple[dict[str, Any], ...] = ()
    textures: tuple[_BenchTexture, ...] = ()
    limits: Mapping[str, Any] = table_field(default_factory=dict)


@dataclass(frozen=True)
class Bench:
    """The parts of a bench; `controllers` has at least one entry, and `first` is the one under test.

    `texture_names`: of files and generators, in the order of `scene`. `limits`: of a run; `texture_limits`: of each
    texture by its name. `sha256`: of the bench file, hexadecimal; None without one.
    """

    controllers: tuple[BenchController, ...]
    actuators: tuple[BenchActuator, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    textures: tuple[Callable[[], Recording], ...] = field(default=(), repr=False)
    texture_names: tuple[str, ...] = (DEFAULT_TEXTURE,)
    limits: BenchLimits = field(default_factory=BenchLimits)
    texture_limits: Mapping[str, BenchLimits] = field(default_factory=dict)
    sha256: str | None = None

    @property
    def first(self) -> BenchController:
        """The controller under test."""
        return self.controllers[0]

    @property
    def sensor(self) -> Sensor | None:
        """The sensor on the first channel of the controller under test; None where there is none."""
        return next((each for each in self.sensors if (each.controller, each.channel) == (self.first.name, 1)), None)

    def actuator(self, controller: str) -> Actuator | None:
        """Return the model of the actuator on the first channel; None where the bench file says nothing of it."""
        models = {each.channel: each.model for each in self.actuators if each.controller == controller}
        return models.get(1, models.get(None))

    def scene(self) -> tuple[Recording, ...]:
        """Return the textures, loaded or made; a generated one where the bench names none. Raises InputError."""
        if not self.textures:
            return (textures.GENERATORS[DEFAULT_TEXTURE](),)
        return tuple(load() for load in self.textures)

    def missed(self, values: Iterable[Value], texture: str = "", given: Mapping[str, Any] | None = None) -> list[Noted]:
        """Return each limit that a value misses, in words: those of its texture, by name or file, or of the bench.

        `texture`: the one that was played, where the place of a value does not name it. `given`: limits by their names
        that hold in place of others, None = not judged. Raises InputError for wrong ones.
        """
        noted = []
        for value in values:
            limits = self.texture_limits.get(Path(texture or value.place).stem, self.limits)
            if given:
                with located("limits"):
                    limits = convert({**structs.asdict(limits), **given}, BenchLimits)
            noted += missed(limits, [value])
        return noted


def read_bench(path: Path, allow_programs: bool = False) -> Bench:
    """Read a bench file. `allow_programs`: whether its sensors may be programs.

    Raises InputError, and OSError where it cannot be read.
    """
    with located(path):
        file = convert(read_toml(path, "bench file"), _BenchFile)
        names = [each.name for each in file.controllers]
        check_names("controllers", names)
        sensors = read_each("sensors", file.sensors, partial(_sensor, names))
        check_names("sensors", [each.name for each in sensors])
        check_places("sensors", sensors)
        programs = {f"sensor {each.name}": each.command[0] for each in sensors if isinstance(each, ProgramSensor)}
        programs |= {f"controller {each.name}": each.power_cycle[0] for each in file.controllers if each.power_cycle}
        check_programs(programs, allow_programs)
        loaders = read_each("textures", file.textures, partial(_loader, path.parent))
        located_loaders = (
            partial(_loaded, f"{path}: [[textures]] {number}", load) for number, load in enumerate(loaders, 1)
        )
        return Bench(
            file.controllers,
            read_actuators(file.actuators, names),
            sensors,
            tuple(located_loaders),
            tuple(each.name for each in file.textures) or (DEFAULT_TEXTURE,),
            _limits("[limits]", file.limits),
            _texture_limits(file),
            hashlib.sha256(path.read_bytes()).hexdigest(),
        )


def _limits(place: str, table: Mapping[str, Any]) -> BenchLimits:
    """Return the limits of a table. Raises InputError."""
    with located(place):
        return convert(table, BenchLimits)


def _texture_limits(file: _BenchFile) -> dict[str, BenchLimits]:
    """Return the limits of each texture that has its own: these, and those of the bench for the rest.

    Raises InputError, also for two textures of one name with other limits.
    """
    found: dict[str, BenchLimits] = {}
    for number, each in enumerate(file.textures, 1):
        if not each.limits:
            continue
        limits = _limits(f"[[textures]] {number}: [limits]", {**file.limits, **each.limits})
        if found.setdefault(each.name, limits) != limits:
            raise InputError(f"[[textures]] {number}: another {each.name} has other limits; give both the same")
    return found


def _sensor(names: list[str], table: dict[str, Any]) -> Sensor:
    """Return the sensor of a table, on one of the controllers of these names. Raises ValueError."""
    if ("command" in table) == ("input" in table):
        raise ValueError("give either command, a program that records, or input, a sound card or serial port")
    sensor: Sensor = convert(table, ProgramSensor if "command" in table else InputSensor)
    return structs.replace(sensor, controller=one_named(sensor.controller, names))


def one_named(controller: str | None, names: list[str]) -> str:
    """Return the name of a controller; None stands for the only one. Raises ValueError for any other."""
    if controller is None and len(names) == 1:
        return names[0]
    if controller not in names:
        words = f"must be one of {', '.join(names)}"
        raise ValueError(
            f"controller {words}, not {controller!r}" if controller else f"controller is missing; it {words}"
        )
    return controller


def read_actuators(tables: Sequence[ActuatorTable], names: list[str]) -> tuple[BenchActuator, ...]:
    """Return the actuators behind controllers of these names. Raises ValueError."""
    actuators = read_each(
        "actuators",
        tables,
        lambda each: BenchActuator(each.actuator(), one_named(each.controller, names), each.channel),
    )
    check_places("actuators", actuators)
    return actuators


def check_places(kind: str, entries: Sequence[BenchActuator | Sensor]) -> None:
    """Raise ValueError for two entries on one channel."""
    places = [(entry.controller, entry.channel) for entry in entries]
    for number, place in enumerate(places):
        if place in places[:number]:
            raise ValueError(f"[[{kind}]] {number + 1}: there is another one on that channel; leave one out")


def choose_controller(bench: Bench | None, device: str | None) -> Bench:
    """Return the bench with the controller that `device` names, by name or address, as the first; None = as it is.

    Without a bench, one with that controller alone. Raises InputError for any other text.
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
    if not re.search(_ADDRESS, device):
        raise InputError(f"{device!r} is no controller: give a name in the bench file, or {_ADDRESSES}")
    return replace(bench, controllers=(BenchController(bench.first.name, device), *bench.controllers[1:]))


@contextlib.contextmanager
def connect(bench: Bench | None, controller: BenchController, actuator: Actuator | None = None) -> Iterator[Session]:
    """Open a session with a controller; `actuator`: behind it, None = the bench's, or as the controller says.

    Raises as `host.devices.open_session`, and InputError where it drives another actuator than the bench has there.
    """
    behind = actuator if bench is None else actuator or bench.actuator(controller.name)
    with devices.open_session(controller.address, actuator=behind) as opened:
        if bench is not None:
            check_actuator(bench, controller, opened)
        yield opened


def check_actuator(bench: Bench, controller: BenchController, opened: Session) -> None:
    """Raise InputError where a controller drives another actuator than the bench has there.

    A part differs from its data sheet by less than MAX_DIFFERENCE.
    """
    expected = bench.actuator(controller.name)
    if expected is None or devices.takes_actuator(controller.address):
        return
    differences = actuator_differences(expected, opened.driven)
    if differences:
        raise InputError(
            f"{controller.name} drives {opened.driven.name}, and the bench has {expected.name} there: "
            f"{'; '.join(differences)}; correct the actuator of the bench, or connect the right controller"
        )


def _loader(folder: Path, table: _BenchTexture) -> Callable[[], Recording]:
    """Return the function that loads or generates a texture. Raises ValueError for a wrong table."""
    options = table.options()
    if table.hand_speed_mm_s is not None:
        options["hand_speed_mm_s"] = table.hand_speed_mm_s
    if table.generate is not None:
        return partial(textures.GENERATORS[table.generate], **options)
    file = folder / str(table.file)
    if not file.exists():
        raise ValueError(f"file {file} does not exist")
    return partial(textures.load_for_actuators, file, **options)


def _loaded(place: object, load: Callable[[], Recording]) -> Recording:
    with located(place):
        return load()


def actuator_toml(actuator: Actuator, controller: str) -> str:
    """Return the table of a bench file that names this actuator behind a controller."""
    values = {"controller": controller, **asdict(actuator)}
    # Texts and numbers in JSON are the same in TOML.
    lines = [f"{key} = {json.dumps(value)}" for key, value in values.items() if value is not None]
    return "\n".join(["[[actuators]]", *lines, ""])
