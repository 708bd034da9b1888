"""Transports over a real pseudo-terminal and over a simulated USB device."""

import errno
import fcntl
import os
import select
import termios
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
import usb.core

from tests.simulated_device.bench import Echo
from vibrocast.device_protocol.transports import (
    UDEV_RULES,
    SerialTransport,
    ThreadedTransport,
    Transport,
    TransportError,
    UsbTransport,
    open_transport,
    selectable,
    serial_port,
)
from vibrocast.simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort


@pytest.fixture
def pseudo_terminal() -> Iterator[tuple[int, str]]:
    """The controller's end of a pseudo-terminal, and the name of the port."""
    controller, port = os.openpty()
    tty.setraw(port)
    os.set_blocking(controller, False)
    yield controller, os.ttyname(port)
    os.close(port)
    os.close(controller)


EVERY_BYTE = bytes(range(256)) * 4


def test_serial_carries_every_byte_both_ways(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    with SerialTransport(port) as transport:
        assert selectable(transport) is transport
        transport.write(EVERY_BYTE)
        assert os.read(controller, 4096) == EVERY_BYTE
        os.write(controller, EVERY_BYTE)
        assert received(transport, len(EVERY_BYTE)) == EVERY_BYTE


def test_serial_port_is_not_shared(pseudo_terminal: tuple[int, str]) -> None:
    with SerialTransport(pseudo_terminal[1]), pytest.raises(TransportError, match="no other program"):
        SerialTransport(pseudo_terminal[1])


def test_serial_port_that_is_not_there() -> None:
    with pytest.raises(TransportError, match="vibrocast devices"):
        open_transport("serial:/dev/no-such-port")


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("serial:/dev/ttyACM0", ("/dev/ttyACM0", 921_600)),
        ("serial:/dev/ttyACM0@115200", ("/dev/ttyACM0", 115_200)),
        ("serial:COM3@57600", ("COM3", 57_600)),
        ("serial:socket://127.0.0.1:7000", ("socket://127.0.0.1:7000", 921_600)),
        ("serial:rfc2217://me@bench:7000", ("rfc2217://me@bench:7000", 921_600)),
        ("serial:rfc2217://bench:7000@9600", ("rfc2217://bench:7000", 9600)),
        ("serial:/dev/serial/by-id/usb-5@left", ("/dev/serial/by-id/usb-5@left", 921_600)),
        ("serial:/dev/tty@5@9600", ("/dev/tty@5", 9600)),
    ],
)
def test_an_address_names_the_port_and_its_baud_rate(address: str, expected: tuple[str, int]) -> None:
    assert serial_port(address) == expected


@pytest.mark.parametrize("baud", ["0", "1199", "20000001"])
def test_a_baud_rate_that_no_port_has_is_rejected(baud: str) -> None:
    with pytest.raises(TransportError, match=f"{baud} is no baud rate; give 1200 to 20000000"):
        open_transport(f"serial:/dev/ttyACM0@{baud}")


def test_the_port_runs_at_the_baud_rate_of_its_address(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    with open_transport(f"serial:{port}@115200"):
        assert termios.tcgetattr(controller)[4:6] == [termios.B115200, termios.B115200]
    with open_transport(f"serial:{port}"):
        assert termios.tcgetattr(controller)[4:6] == [termios.B921600, termios.B921600]


def test_dtr_and_rts_are_left_alone(pseudo_terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    controls = []
    control = fcntl.ioctl

    def noted(file: Any, request: int, *arguments: Any) -> Any:
        controls.append(request)
        return control(file, request, *arguments)

    monkeypatch.setattr(fcntl, "ioctl", noted)
    hangs_up = termios.tcgetattr(pseudo_terminal[0])[2] & termios.HUPCL
    with SerialTransport(pseudo_terminal[1]) as transport:
        transport.write(b"x")
        transport.reopen()
    assert not {termios.TIOCMSET, termios.TIOCMBIS, termios.TIOCMBIC} & set(controls)
    assert termios.tcgetattr(pseudo_terminal[0])[2] & termios.HUPCL == hangs_up
    serial.Serial(pseudo_terminal[1]).close()
    assert termios.TIOCMBIS in controls, "pyserial itself sets them, and this test would see it"


def test_unplugged_serial_port_is_an_error_and_not_a_hang() -> None:
    controller, port = os.openpty()
    transport = SerialTransport(os.ttyname(port))
    os.close(port)
    os.close(controller)
    with pytest.raises(TransportError, match="cable"):
        transport.read(1.0)
    with pytest.raises(TransportError, match="cable"):
        transport.write(b"x")
    with pytest.raises(TransportError, match="cannot open"):
        transport.reopen()
    transport.close()


@pytest.mark.parametrize("name", ["link", "serial number"])
def test_a_board_is_found_again_under_another_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    board, other, again = (os.openpty() for _ in range(3))
    ports = [os.ttyname(port) for _, port in (board, other, again)]
    link = tmp_path / "usb-Maker_Board_17-if00"
    monkeypatch.setattr("vibrocast.device_protocol.transports._BY_ID", tmp_path)

    def plugged(*numbers: tuple[str, str]) -> None:
        link.unlink(missing_ok=True)
        listed = [
            SimpleNamespace(device=port, vid=0x1209, pid=1, serial_number=number)
            for port, number in ((ports[1], "5"), *numbers)
        ]
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: listed if name == "serial number" else [])
        for port, _ in numbers if name == "link" else ():
            link.symlink_to(port)

    plugged((ports[0], "17"))
    transport = SerialTransport(ports[0])
    os.close(board[1])
    os.close(board[0])
    plugged()
    with pytest.raises(TransportError, match="names that stay"):
        transport.reopen()
    plugged((ports[2], "17"))
    transport.reopen()
    os.write(again[0], b"here")
    assert transport.read(1.0) == b"here"
    assert f"the board at {ports[0]} is at {ports[2]} now" in caplog.text
    transport.close()
    for end in (*other, *again):
        os.close(end)


def test_two_boards_of_one_serial_number_are_not_mistaken_for_each_other(
    pseudo_terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = [
        SimpleNamespace(device=port, vid=1, pid=1, serial_number="0001") for port in (pseudo_terminal[1], "/nowhere")
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: listed)
    with SerialTransport(pseudo_terminal[1]) as transport:
        listed.pop(0)
        transport.reopen()
        os.write(pseudo_terminal[0], b"here")
        assert transport.read(1.0) == b"here"


def test_serial_port_that_takes_nothing_is_an_error_and_not_a_hang(
    pseudo_terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.device_protocol.transports._WRITE_TIMEOUT_S", 0.05)
    with SerialTransport(pseudo_terminal[1]) as transport, pytest.raises(TransportError, match="took no data"):
        transport.write(bytes(1_000_000))


def test_serial_port_keeps_what_its_controller_does_not_take_at_once(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    data = bytes(range(256)) * 40
    with SerialTransport(port) as transport:
        written = 0
        while not transport.unsent:
            transport.write(data[:1024])
            written += 1024
        received = b""
        while transport.unsent or len(received) < written:
            received += os.read(controller, 4096)
            assert transport.read(0) == b""
        assert received == (data[:1024] * (written // 1024))


def test_serial_port_without_a_file_is_read_by_pyserial() -> None:
    with SerialTransport("loop://") as transport:
        assert transport.file is None
        assert transport.read(0.01) == b""
        transport.write(EVERY_BYTE)
        assert received(transport, len(EVERY_BYTE)) == EVERY_BYTE
        threaded = selectable(transport)
        assert isinstance(threaded, ThreadedTransport)
        threaded.close()


@pytest.fixture
def usb_port() -> Iterator[UsbPort]:
    """A USB device, 1209:0001, that sends back what it gets."""
    with UsbPort(Echo()) as port:
        yield port


def received(transport: Transport, length: int) -> bytes:
    """Read so many bytes."""
    data = b""
    while len(data) < length:
        data += transport.read(1.0)
    return data


def failing(number: int) -> Callable[..., Any]:
    """Return what fails as libusb does, with this error number."""

    def fail(*_: object) -> None:
        raise usb.core.USBError("made up", errno=number)

    return fail


def test_usb_carries_every_byte_both_ways(usb_port: UsbPort) -> None:
    with open_transport("usb:1209:0001", usb_port) as transport:
        transport.write(EVERY_BYTE)
        assert received(transport, len(EVERY_BYTE)) == EVERY_BYTE
        assert transport.read(0) == b""


def test_threads_give_a_usb_device_a_file_to_wait_for(usb_port: UsbPort) -> None:
    with selectable(open_transport("usb:1209:0001", usb_port)) as transport:
        assert isinstance(transport, ThreadedTransport)
        for _ in range(2):
            transport.write(EVERY_BYTE)
            echoed = b""
            while len(echoed) < len(EVERY_BYTE):
                readable, _, _ = select.select([transport.file], [], [], 10.0)
                assert readable
                echoed += transport.read(0)
            assert echoed == EVERY_BYTE
            transport.reopen()
        is_unplugged_until_it_is_back(transport, usb_port)


def is_unplugged_until_it_is_back(transport: Transport, port: UsbPort) -> None:
    port.unplug()
    with pytest.raises(TransportError, match="cable"):
        while True:
            transport.read(1.0)
    with pytest.raises(TransportError, match="cable"):
        transport.write(b"x")
    with pytest.raises(TransportError, match="plug it in"):
        transport.reopen()
    port.plug()
    transport.reopen()


def test_unplugged_usb_device_is_an_error_until_it_is_back(usb_port: UsbPort) -> None:
    transport = UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)
    is_unplugged_until_it_is_back(transport, usb_port)
    transport.write(b"back")
    assert received(transport, 4) == b"back"
    transport.close()
    transport.close()


def test_stalled_usb_endpoints_are_cleared_in_use_and_when_opened(usb_port: UsbPort) -> None:
    usb_port.stall()
    with UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port) as transport:
        for _ in range(2):
            transport.write(EVERY_BYTE)
            assert received(transport, len(EVERY_BYTE)) == EVERY_BYTE
            usb_port.stall()


def test_usb_endpoint_that_stalls_for_ever_is_an_error_and_not_a_hang(
    usb_port: UsbPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.device_protocol.transports._WRITE_TIMEOUT_S", 0.05)
    monkeypatch.setattr(usb_port, "clear_halt", lambda handle, endpoint: None)
    transport = UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)
    usb_port.stall()
    with pytest.raises(TransportError, match="took no data"):
        transport.write(b"x")
    assert transport.read(0) == b""


def test_usb_device_of_another_user_names_the_remedy(usb_port: UsbPort, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, remedy in (
        (errno.EACCES, r"70-vibrocast\.rules to /etc/udev/rules\.d"),
        (errno.EBUSY, "end the other program"),
    ):
        monkeypatch.setattr(usb_port, "open_device", failing(number))
        with pytest.raises(TransportError, match=remedy):
            UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)
    rules = UDEV_RULES.read_text(encoding="utf-8")
    assert f'ATTR{{idVendor}}=="{VENDOR_ID:04x}", ATTR{{idProduct}}=="{PRODUCT_ID:04x}", TAG+="uaccess"' in rules


@pytest.mark.parametrize("fields", [{"bInterfaceClass": 3}, {"bNumEndpoints": 1}, {"bNumEndpoints": 0}], ids=str)
def test_usb_device_of_another_kind_is_rejected(
    fields: dict[str, int], usb_port: UsbPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    describe = usb_port.get_interface_descriptor

    def described(device: str, interface: int, alternate: int, configuration: int) -> SimpleNamespace:
        found = describe(device, interface, alternate, configuration)
        vars(found).update(fields)
        return found

    monkeypatch.setattr(usb_port, "get_interface_descriptor", described)
    with pytest.raises(TransportError, match="is no controller"):
        UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)


@pytest.mark.parametrize("address", ["", "serial:", "usb:", "usb:1209", "usb:xyz:0001", "usb:12090:0001", "tcp:host"])
def test_address_of_no_kind_is_rejected(address: str) -> None:
    with pytest.raises(TransportError, match=r"give serial:PORT\[@BAUD\] or usb:VID:PID"):
        open_transport(address)
