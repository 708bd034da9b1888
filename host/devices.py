"""Controllers by the address that a person gives: opens them, lists them, and tells what they are."""

import contextlib
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import numpy as np
import usb.core
import usb.util

from vibrocast import extras
from vibrocast.device_protocol.messages import ActuatorDescription, HelloResponse, SlotState
from vibrocast.device_protocol.trace import TappedTransport
from vibrocast.device_protocol.transports import (
    SERIAL_FORM,
    USB_FORM,
    VENDOR_INTERFACE_CLASS,
    SerialTransport,
    Transport,
    TransportError,
    UsbTransport,
    libusb_backend,
    open_transport,
    usb_address,
)
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.output.actuator import (
    ACTUATORS,
    MAX_FULL_SCALE_VOLTS,
    MIN_FULL_SCALE_VOLTS,
    Actuator,
    actuator_differences,
)
from vibrocast.progress import notes
from vibrocast.simulated_device.device import Device

if TYPE_CHECKING:
    from vibrocast.output.sound_card import Card
    from vibrocast.simulated_device.controller import Controller as SimulatedController

_Opened = TypeVar("_Opened")

GROUP = "vibrocast.devices"
_ENTRIES = {entry.name: entry for entry in sorted(entry_points(group=GROUP))}
FIRMWARE = tuple(_ENTRIES)
"""Addresses of controllers made of the C firmware; they last as long as a session, and have their actuator compiled in.
Each is an entry point of GROUP, which names a FirmwareDevice."""
IN_THIS_PROCESS = {
    "sim": "simulated controller behind a serial port",
    "sim-usb": "simulated controller behind a simulated USB device",
}
"""Addresses of controllers that this program simulates, and what each is."""
SIMULATED = (*IN_THIS_PROCESS, *FIRMWARE)
"""Addresses of all that need no hardware."""
ADDRESS = re.compile("serial:.+|usb:[0-9a-fA-F]{1,4}:[0-9a-fA-F]{1,4}(:.+)?|audio:.+")
"""Those of hardware."""
FORMS = f"{SERIAL_FORM}, {USB_FORM} or audio:CARD[:CHANNELS][@VOLTS]"
"""How they are written."""

_AUDIO = re.compile(r"audio:(?P<card>.+?)(:(?P<channels>\d+(,\d+)*))?(@(?P<volts>[^@]+))?")
# As many channels as the controller in this process has.
_CARD_CHANNELS = 8


class EmulatedBoard(Device, Protocol):
    """A controller on an emulated processor, whose `counter` counts instructions and cycles."""

    @property
    def processor(self) -> Any:
        """A `vibrocast.harness.boards.emulator.Processor`."""


class Process(Protocol):
    """A controller in a process of its own, which ends with the context. `name`: of its serial port."""

    name: str

    def __enter__(self) -> Self:
        """Return the process."""

    def __exit__(self, *error: object) -> None:
        """End the process."""


@dataclass(frozen=True, kw_only=True)
class FirmwareDevice:
    """A controller made of the C firmware: `board` starts it on an emulated processor, or `process` in one of its own.

    Either raises BuildError. `channels`: of its actuator. The planner needs `core`, such as M4F,
    its clock in Hz, and bytes of flash and RAM; None = a scene states them.
    """

    summary: str
    board: Callable[[], EmulatedBoard] | None = None
    process: Callable[[], Process] | None = None
    channels: int
    core: str | None = None
    clock_hz: float | None = None
    flash_bytes: int | None = None
    ram_bytes: int | None = None


def firmware_device(address: str) -> FirmwareDevice:
    """Return one of FIRMWARE."""
    found = _ENTRIES[address].load()
    assert isinstance(found, FirmwareDevice), f"the entry point {address} of {GROUP} names no FirmwareDevice"
    return found


@contextlib.contextmanager
def connect(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Iterator[Controller]:
    """Open a session with the controller at `address`, as `reach` does. Raises TransportError and ControllerError."""
    with reach(address, runtime, actuator) as transport:
        yield Controller(transport)


@dataclass(frozen=True)
class Session:
    """An open session with the controller at an address, for whatever plays.

    `driven`: the actuator by which the controller computes its DAC's codes; `skin`: the one that moves the skin.
    `unknown_note`: why the controller's codes cannot be compared with those computed here; None if they can.
    """

    controller: Controller
    address: str
    driven: Actuator
    skin: Actuator
    unknown_note: str | None = None


def session_with(controller: Controller, address: str, actuator: Actuator | None = None) -> Session:
    """Return the session with a controller; `actuator`: the one behind it, None = as the controller says.

    A controller that takes any actuator drives this one, and so does one that describes it. For others it is the model
    of the skin alone. Raises ControllerError where no actuator can be as the controller says.
    """
    described = controller.description.actuator
    skin = None if actuator is None else behind_dac(address, actuator, described)
    if skin is not None and (takes_actuator(address) or description_of(skin) == described):
        return Session(controller, address, skin, skin)
    driven = actuator_model(described)
    if skin is not None and (differences := actuator_differences(skin, driven)):
        notes.warning(
            "the controller drives %s, and %s is said to be behind it: %s; build it with this actuator, or leave out "
            "--actuator",
            driven.name,
            skin.name,
            "; ".join(differences),
        )
    unknown = f"the limits of {described.name} are unknown; give its file as --actuator"
    return Session(controller, address, driven, skin or driven, None if known_model(described) else unknown)


@contextlib.contextmanager
def open_session(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Iterator[Session]:
    """Open a session as `connect` does, and as `session_with` says. Raises as both."""
    with connect(address, runtime, actuator) as controller:
        yield session_with(controller, address, actuator)


def description_of(actuator: Actuator) -> ActuatorDescription:
    """Return how a controller describes an actuator that it drives."""
    lower_hz, upper_hz = actuator.band_hz
    return ActuatorDescription(
        name=actuator.name,
        stroke_um=float(np.float32(actuator.stroke_um)),
        volts=float(np.float32(actuator.volts)),
        lower_hz=float(np.float32(lower_hz)),
        upper_hz=float(np.float32(upper_hz)),
        slew_volts_per_second=float(np.float32(actuator.slew_volts_per_second)),
        dac_bits=actuator.dac_bits,
        dac_rate_hz=actuator.dac_rate_hz,
    )


def known_model(description: ActuatorDescription) -> Actuator | None:
    """Return which of ACTUATORS a controller describes, with its DAC and volts at full scale; None if none of them."""
    known = ACTUATORS.get(description.name)
    if known is None or not 0 < description.volts < math.inf:
        return None
    # The shortest number of those that are sent as this one, which has seven digits.
    volts = float(str(np.float32(description.volts)))
    if volts != float(str(np.float32(known.volts))):
        known = known.with_full_scale(volts / 2)
    known = replace(known, dac_bits=description.dac_bits, dac_rate_hz=description.dac_rate_hz)
    return known if description_of(known) == description else None


def actuator_model(description: ActuatorDescription) -> Actuator:
    """Return the model of the actuator that a controller describes: the known one, or one built from its band.

    That is a low-pass, or a resonance where it does not reach down to rest. Raises ControllerError where no actuator
    can be such.
    """
    if known := known_model(description):
        return known
    lower_hz, upper_hz = description.lower_hz, description.upper_hz
    if not (
        0 < description.stroke_um < math.inf
        and 0 < description.volts < math.inf
        and 0 <= description.slew_volts_per_second < math.inf
        and 0 <= lower_hz < upper_hz < math.inf
    ):
        raise ControllerError(f"the controller announces an impossible actuator ({description}); update its firmware")
    resonance_hz = math.sqrt(lower_hz * upper_hz)
    return Actuator(
        name=description.name,
        stroke_um=description.stroke_um,
        volts=description.volts,
        corner_hz=resonance_hz or upper_hz,
        quality=resonance_hz / (upper_hz - lower_hz) if resonance_hz else None,
        slew_volts_per_second=description.slew_volts_per_second or description.volts * description.dac_rate_hz,
        volts_limit=description.volts / 2,
        power_limit=1.0,
        dac_bits=description.dac_bits,
        dac_rate_hz=description.dac_rate_hz,
    )


def unique_names(addresses: Sequence[str]) -> dict[str, str]:
    """Return a name for each address, itself or with its number behind it where it is there again, and the address."""
    counts: Counter[str] = Counter()
    names = {}
    for address in addresses:
        counts[address] += 1
        names[address if counts[address] == 1 else f"{address} ({counts[address]})"] = address
    return names


@contextlib.contextmanager
def open_all(
    sessions: Mapping[str, AbstractContextManager[_Opened]],
) -> Iterator[tuple[dict[str, _Opened], dict[str, Exception]]]:
    """Open sessions, such as `connect` gives; yield those that are open, and by name why others are not.

    Those that fail while they are closed are among the latter too, then.
    """
    opened: dict[str, _Opened] = {}
    failures: dict[str, Exception] = {}
    try:
        for name, session in sessions.items():
            try:
                opened[name] = session.__enter__()
            except (ControllerError, TransportError) as error:
                failures[name] = error
        yield opened, failures
    finally:
        for name in opened:
            try:
                sessions[name].__exit__(None, None, None)
            except (ControllerError, TransportError) as error:
                failures[name] = error


@contextlib.contextmanager
def reach(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Iterator[Transport]:
    """Open the way to the controller at `address`: one of SIMULATED, or hardware as FORMS says.

    A controller that is simulated or on a sound card lives as long as the way is open. `runtime`: by which it
    decodes, None = the default. `actuator`: its own if it `takes_actuator`, None = the default of sim and sim-usb.
    Raises TransportError, and MissingExtraError without the extra of sound cards.
    """
    with contextlib.ExitStack() as stack:
        transport: Transport
        if address in FIRMWARE:
            decoding_runtime(address, runtime)
            transport = SerialTransport(stack.enter_context(_firmware(address)))
        elif address in SIMULATED:
            from vibrocast.simulated_device.serial_port import serial_port
            from vibrocast.simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort

            if address == "sim":
                port = serial_port(simulated(runtime, actuator))
                stack.enter_context(port)
                transport = SerialTransport(port.name)
            else:
                usb_port = UsbPort(simulated(runtime, actuator))
                transport = UsbTransport(VENDOR_ID, PRODUCT_ID, stack.enter_context(usb_port))
        elif is_sound_card(address):
            transport = _sound_card(address, runtime, actuator)
        else:
            transport = open_transport(address)
        yield TappedTransport(stack.enter_context(transport), address)


def simulated(runtime: str | None = None, actuator: Actuator | None = None) -> "SimulatedController":
    """Return the simulated controller, decoding by `runtime` and with `actuator`, as in `reach`."""
    # Takes longer to load than all the rest, and only here is it needed.
    from vibrocast.simulated_device.controller import Controller, Settings

    settings = Settings(runtime=runtime)
    return Controller(settings if actuator is None else replace(settings, actuator=actuator))


def is_sound_card(address: str) -> bool:
    """Return whether an address names a sound card."""
    return address.startswith("audio:")


def takes_actuator(address: str) -> bool:
    """Return whether the controller at an address can be given any actuator; all others have theirs compiled in."""
    return address in IN_THIS_PROCESS or is_sound_card(address)


def on_sound_card(actuator: Actuator, rate_hz: int, full_scale_volts: float | None = None) -> Actuator:
    """Return an actuator whose DAC is a sound card; None = the actuator's highest volts are digital full scale."""
    volts = actuator.volts / 2 if full_scale_volts is None else full_scale_volts
    return replace(actuator.with_full_scale(volts), dac_bits=16, dac_rate_hz=rate_hz)


def behind_dac(address: str, actuator: Actuator, dac: ActuatorDescription) -> Actuator:
    """Return an actuator with the DAC that the controller at an address describes; of a sound card, with its volts."""
    if is_sound_card(address):
        actuator = actuator.with_full_scale(_volts(address, actuator))
    return replace(actuator, dac_bits=dac.dac_bits, dac_rate_hz=dac.dac_rate_hz)


def _parsed(address: str) -> re.Match[str]:
    match = _AUDIO.fullmatch(address)
    if match is None:
        raise TransportError(f"{address!r} names no sound card; give audio:CARD[:CHANNELS][@VOLTS]")
    return match


def _volts(address: str, actuator: Actuator) -> float:
    """Return the actuator's volts at digital full scale of a sound card. Raises TransportError."""
    text = _parsed(address)["volts"]
    if text is None:
        return actuator.volts / 2
    try:
        volts = float(text)
    except ValueError:
        volts = math.nan
    if not MIN_FULL_SCALE_VOLTS <= volts <= MAX_FULL_SCALE_VOLTS:
        raise TransportError(
            f"{address}: @{text} is no voltage; give the volts at the actuator for digital full scale, from "
            f"{MIN_FULL_SCALE_VOLTS:g} to {MAX_FULL_SCALE_VOLTS:g}"
        )
    return volts


def sound_card_of(address: str, actuator: Actuator | None) -> "tuple[Card, tuple[int, ...], Actuator]":
    """Return the card at an address, its channels from 1, and the actuator as the card drives it.

    Raises TransportError and MissingExtraError.
    """
    from vibrocast.output import sound_card

    if actuator is None:
        raise TransportError(
            f"{address}: nothing says which actuator is behind the sound card",
            action="name one by `actuator`, or by [[actuators]] in the bench file",
            parameter="actuator",
        )
    match = _parsed(address)
    volts = _volts(address, actuator)
    card = sound_card.find(match["card"])
    all_channels = range(1, min(card.channels or 2, _CARD_CHANNELS) + 1)
    channels = [int(number) for number in match["channels"].split(",")] if match["channels"] else list(all_channels)
    if len(channels) > _CARD_CHANNELS:
        raise TransportError(f"{address}: {len(channels)} channels; name at most {_CARD_CHANNELS}")
    return card, tuple(channels), on_sound_card(actuator, card.rate_hz, volts)


def _sound_card(address: str, runtime: str | None, actuator: Actuator | None) -> Transport:
    """Return the controller on a sound card, not yet running. Raises TransportError and MissingExtraError."""
    from vibrocast.simulated_device.sound_card_port import SoundCardPort

    card, channels, driven = sound_card_of(address, actuator)
    try:
        return SoundCardPort(card, channels, driven, runtime)
    except (ValueError, OverflowError) as error:
        raise TransportError(
            f"{address}: no controller can drive this actuator at {card.rate_hz} Hz: {error}"
        ) from error


def decoding_runtime(address: str, runtime: str | None) -> str | None:
    """Return by which of codec.RUNTIMES a controller decodes, where `runtime` is wished; None = as an image says.

    Raises TransportError where it cannot.
    """
    if address not in FIRMWARE:
        return runtime
    if runtime == "onnx":
        raise TransportError(
            f"{address} decodes by the integer core alone; leave out `runtime`, or play on sim", parameter="runtime"
        )
    return "core"


@contextlib.contextmanager
def _firmware(address: str) -> Iterator[str]:
    """Run one of FIRMWARE and yield its serial port. Raises TransportError and MissingExtraError."""
    from vibrocast.firmware.native_core import BuildError
    from vibrocast.simulated_device.serial_port import has_pseudo_terminals, serial_port

    device = firmware_device(address)
    if device.process is not None and not has_pseudo_terminals():
        raise TransportError(
            f"{address} cannot run: its serial port is a pseudo-terminal, which this system lacks; use sim or an "
            "emulated board"
        )
    try:
        port = serial_port(emulated(address)) if device.process is None else device.process()
    except BuildError as error:
        raise TransportError(str(error)) from error
    with port:
        yield port.name


def is_emulated(address: str) -> bool:
    """Return whether an address is that of an emulated processor."""
    return address in FIRMWARE and firmware_device(address).board is not None


def emulated(address: str) -> EmulatedBoard:
    """Return the board at an address that `is_emulated`. Raises TransportError and MissingExtraError."""
    from vibrocast.firmware.native_core import BuildError

    start = firmware_device(address).board
    assert start is not None
    try:
        return start()
    except BuildError as error:
        raise TransportError(str(error)) from error


def available() -> dict[str, str]:
    """Return the addresses that may be controllers, each with a description."""
    from serial.tools import list_ports

    found = IN_THIS_PROCESS | {address: firmware_device(address).summary for address in FIRMWARE}
    for port in list_ports.comports():
        found[f"serial:{port.device}"] = "serial port" if port.description == "n/a" else port.description
    # Without libusb there are no USB devices to list; `connect` says what to do then.
    backend = libusb_backend()
    found |= _sound_cards()
    for device in usb.core.find(find_all=True, backend=backend) if backend else ():
        # A device that cannot be read, or has no vendor interface, is of no use.
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            for configuration in device:
                if usb.util.find_descriptor(configuration, bInterfaceClass=VENDOR_INTERFACE_CLASS) is not None:
                    found[usb_address(device)] = "vendor interface"
    return found


def _sound_cards() -> dict[str, str]:
    from vibrocast.output import sound_card

    if advice := extras.advice("audio"):
        return {"audio:CARD": f"a sound card; {advice}"}
    return {
        f"audio:{card.name}": f"sound card, {card.backend}, {card.channels or 'any number of'} channels, "
        f"{card.rate_hz} Hz" + (", the default" if card.default else "")
        for card in sound_card.cards()
    }


def slots(hello: HelloResponse) -> list[dict[str, Any]]:
    """Return what each slot for a model image holds, ready for JSON."""
    return [
        {
            "slot": image.slot,
            "state": image.state.name.lower(),
            "name": image.name or None,
            "version": image.version or None,
            "number": image.number or None,
            "sha256": None if image.state == SlotState.EMPTY else image.sha256.hex(),
        }
        for image in hello.images
    ]


def facts(controller: Controller) -> dict[str, Any]:
    """Return what a controller is and what it is doing, ready for JSON. Raises as `Controller.request_status`."""
    status = controller.request_status()
    facts = {
        **described(controller.description),
        "status": {**asdict(status), "state": status.state.name.lower()},
    }
    use = controller.sound_card
    return facts if use is None else {**facts, "sound_card": asdict(use)}


def described(hello: HelloResponse) -> dict[str, Any]:
    """Return what a controller says of itself, ready for JSON, where a number that is none stands in words."""
    actuator = {
        name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in asdict(hello.actuator).items()
    }
    return {
        "build": hello.build,
        "hardware": hello.hardware,
        "serial_number": hello.serial_number or "none",
        "protocol": f"{hello.major}.{hello.minor}",
        "codecs": [name for _, name in hello.codecs],
        "model_images": hello.image_lines,
        "public_key": hello.public_key.hex() or "none: model images need no signature",
        "actuator": actuator,
        "limits": asdict(hello.limits),
    }
