"""Equal boards on one USB bus: chosen by their serial numbers, at work at once, and never taken for each other."""

import errno
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import usb.core

from tests.simulated_device.bench import stream
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.transports import TransportError, open_transport
from vibrocast.host import devices, player
from vibrocast.host.controller import Controller as Host
from vibrocast.host.event_loop import run_all
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.usb_backend import UsbPort


class UsbBus:
    """A bus, as a backend for pyusb, with the devices of several others."""

    def __init__(self, ports: list[UsbPort]) -> None:
        self.ports = ports

    def enumerate_devices(self) -> Iterator[tuple[UsbPort, str]]:
        for port in self.ports:
            for device in port.enumerate_devices():
                yield port, device

    def open_device(self, place: tuple[UsbPort, str]) -> tuple[UsbPort, int]:
        port, device = place
        return port, port.open_device(device)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return lambda place, *arguments: getattr(place[0], name)(place[1], *arguments)


def deny(device: str) -> int:
    """Open no device, as libusb does for a user without access."""
    raise usb.core.USBError("Access denied (insufficient permissions)", None, errno.EACCES)


@pytest.fixture
def bus_of() -> Iterator[Callable[..., UsbBus]]:
    """Make a bus with a board for each serial number; the controller in it states the same number."""
    with ExitStack() as stack:
        yield lambda *numbers: UsbBus(
            [
                stack.enter_context(UsbPort(Controller(Settings(serial_number=number)), serial_number=number))
                for number in numbers
            ]
        )


def test_two_equal_boards_play_at_once(bus_of: Callable[..., UsbBus]) -> None:
    bus, played = bus_of("left", "right"), stream(1.0)
    with ExitStack() as stack:
        hosts = {
            number: stack.enter_context(Host(open_transport(f"usb:1209:0001:{number}", bus)))
            for number in ("right", "left")
        }
        assert {number: host.description.serial_number for number, host in hosts.items()} == {
            "left": "left",
            "right": "right",
        }
        settings = player.PlaybackSettings(capture=True, buffer_s=1.0)
        work = {number: (host, player.play_steps(host, played, settings)) for number, host in hosts.items()}
        results = run_all(work)
    for result in results.values():
        assert isinstance(result, player.PlaybackResult)
        assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)
        assert result.decoded is not None
        np.testing.assert_array_equal(result.decoded, played.decoded)


@pytest.mark.parametrize(
    ("numbers", "number", "message"),
    [
        (("right", "left"), "", r"2 devices are .*; choose one of usb:1209:0001:left, usb:1209:0001:right$"),
        (("left",), ":up", r"no USB device usb:1209:0001:up; choose one of usb:1209:0001:left$"),
        (("",), ":up", "plug in one of them only"),
        (("", ""), "", "program a serial number of its own into each board"),
        (("same", "same"), "", "program a serial number of its own into each board"),
        (("", "left"), "", "program a serial number of its own into each board"),
    ],
)
def test_a_board_that_cannot_be_chosen_is_an_error(
    bus_of: Callable[..., UsbBus], numbers: tuple[str, ...], number: str, message: str
) -> None:
    with pytest.raises(TransportError, match=message):
        open_transport(f"usb:1209:0001{number}", bus_of(*numbers))


def test_the_only_board_needs_no_choice_and_keeps_its_address_while_others_come(bus_of: Callable[..., UsbBus]) -> None:
    bus = bus_of("left", "right")
    left, right = bus.ports
    right.unplug()
    with Host(open_transport("usb:1209:0001", bus)) as host:
        left.unplug()
        right.plug()
        with pytest.raises(TransportError, match="no USB device usb:1209:0001:left"):
            host.reconnect(0.0)
        left.plug()
        host.reconnect(5.0)
        assert host.description.serial_number == "left"


def test_addresses_are_listed_with_their_serial_numbers(
    bus_of: Callable[..., UsbBus], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = bus_of("left", "right", "", "bell\a")
    monkeypatch.setattr(devices, "libusb_backend", lambda: bus)
    found = [address for address in devices.available() if address.startswith("usb:")]
    assert found == ["usb:1209:0001:left", "usb:1209:0001:right", "usb:1209:0001"]


def test_a_board_that_another_program_keeps_does_not_hide_the_others(
    bus_of: Callable[..., UsbBus], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = bus_of("left", "right")
    monkeypatch.setattr(bus.ports[0], "open_device", deny)
    with Host(open_transport("usb:1209:0001:right", bus)) as host:
        assert host.description.serial_number == "right"
