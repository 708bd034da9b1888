"""Transports to a controller, with one small interface: a serial port, or USB bulk endpoints of a vendor interface."""

import contextlib
import errno
import os
import queue
import re
import select
import socket
import threading
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol, Self

import serial
import usb.core
import usb.util

from vibrocast.errors import NO_DEVICE, VibrocastError
from vibrocast.progress import notes

# Of a port whose address names no other (8 data bits, no parity, 1 stop bit, no flow control).
BAUD = 921_600
MIN_BAUD, MAX_BAUD = 1200, 20_000_000
SERIAL_FORM = "serial:PORT[@BAUD]"
USB_FORM = "usb:VID:PID[:SERIAL] (VID and PID hexadecimal)"
UDEV_RULES = Path(__file__).with_name("70-vibrocast.rules")
"""Gives users of Linux access to controllers on USB."""
VENDOR_INTERFACE_CLASS = 0xFF

# The baud rate is the digits behind the last "@"; a PORT that ends so itself needs a baud rate behind it.
_SERIAL = re.compile(r"serial:(?P<port>.+?)(?:@(?P<baud>[0-9]+))?")
_USB = re.compile("usb:(?P<vendor>[0-9a-fA-F]{1,4}):(?P<product>[0-9a-fA-F]{1,4})(?::(?P<number>.+))?")
_WRITE_TIMEOUT_S = 1.0
# A multiple of every bulk packet size (64 and 512), so that no read can overflow.
_USB_READ_BYTES = 4096
_SERIAL_READ_BYTES = 65_536
_BY_ID = Path("/dev/serial/by-id")
"""Where udev of Linux links names that boards keep to the ports at which they are."""
# Bytes that a serial port may write later: two of the longest frames, so that a sender seldom waits.
_MAX_UNSENT_BYTES = 8192
# Time after which the threads of a transport without a file notice that it is closed.
_THREAD_READ_S = 0.05


class TransportError(VibrocastError, OSError):
    """The transport cannot be opened, or failed; the message says what to do."""

    exit_code = NO_DEVICE


class DeviceGone(TransportError):
    """The device is gone with all that it was playing: opening it again would begin from the start."""


class Transport(Protocol):
    """Bytes to and from a controller. Not safe to share between threads.

    A transport for which one thread can wait together with others also has `file` and `unsent`. `file`: readable when
    bytes have come; another object after `reopen`; None if the system has none for this port. `unsent`: bytes written
    that the port has not taken; `read` sends them when `file` is writable.
    """

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises TransportError if the transport fails or takes nothing for a second."""

    def read(self, timeout_s: float) -> bytes:
        """Return the available bytes, as soon as there are any; none after `timeout_s`. Raises TransportError."""

    def reopen(self) -> None:
        """Close the port or device, and open it again. Raises TransportError while it is absent."""

    def close(self) -> None:
        """Release the port; may be called again."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class Closing(ABC):
    """A context manager that calls `close` at its end."""

    @abstractmethod
    def close(self) -> None:
        """Release the port; may be called again."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SerialTransport(Closing):
    """A serial port: a UART, a USB serial port, a pseudo-terminal, or a URL of pyserial, such as socket://HOST:PORT.

    Where the system allows, `write` leaves up to 8 KiB that the port does not take at once to later calls of `read`
    and `write`. It does not set DTR and RTS, which the system raises when a port is opened; pyserial on Windows sets
    both. Raises TransportError if it cannot be opened.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self._port, self._baud = port, baud
        self._is_socket = port.startswith("socket://")
        self._open()
        here = _device_of(port)
        self._lasting_names = {name for name, device in _boards().items() if device == here}

    def _open(self) -> None:
        self.unsent = b""
        self._taken_s = 0.0
        try:
            # Exclusive: two programs on one port would garble each other's frames.
            self._serial = serial.serial_for_url(
                self._port, self._baud, write_timeout=_WRITE_TIMEOUT_S, exclusive=True, do_not_open=True
            )
            # pyserial 3 sets both lines when it opens a port, and has no option to leave them.
            for update in ("_update_dtr_state", "_update_rts_state"):
                setattr(self._serial, update, lambda: None)
            self._serial.open()
        except (OSError, ValueError) as error:
            raise TransportError(
                f"cannot open serial port {self._port}: {error}; check the name (`vibrocast devices` lists the ports, "
                f"and on Linux {_BY_ID} has names that stay), that no other program uses it, and that you may read "
                "and write it"
            ) from error
        # Windows, and some URLs, have no file for which one can wait together with others.
        self.file: Any = None
        with contextlib.suppress(AttributeError, OSError):
            self._serial.fileno()
            self.file = self._serial if os.name == "posix" else None

    def _broken(self, reason: object) -> TransportError:
        return TransportError(
            f"serial port {self._port} broke off ({reason}); check the cable and the controller, and that no other "
            "program uses the port"
        )

    def _takes_nothing(self) -> TransportError:
        return TransportError(
            f"serial port {self._port} took no data for {_WRITE_TIMEOUT_S:g} s; check that it belongs to a controller"
        )

    def write(self, data: bytes) -> None:
        """Send all of `data`; up to 8 KiB may wait for later calls."""
        try:
            if self.file is None:
                self._serial.write(data)
                return
            if not self.unsent:
                self._taken_s = time.monotonic()
            self.unsent += data
            self._hand_on()
            while len(self.unsent) > _MAX_UNSENT_BYTES:
                select.select([], [self._serial], [], _WRITE_TIMEOUT_S)
                self._hand_on()
        except serial.SerialTimeoutException as error:
            raise self._takes_nothing() from error
        except OSError as error:
            raise error if isinstance(error, TransportError) else self._broken(error) from error

    def _hand_on(self) -> None:
        """Write the bytes that the port takes now. Raises TransportError if it takes nothing for a second."""
        try:
            taken = os.write(self._serial.fileno(), self.unsent)
        except BlockingIOError:
            taken = 0
        self.unsent = self.unsent[taken:]
        if taken:
            self._taken_s = time.monotonic()
        elif time.monotonic() > self._taken_s + _WRITE_TIMEOUT_S:
            raise self._takes_nothing()

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have come, and send what an earlier `write` left."""
        try:
            if self.file is None:
                return self._read_with_pyserial(timeout_s)
            if self.unsent:
                self._hand_on()
            if data := self._waiting():
                return data
            readable, writable, _ = select.select([self._serial], [self._serial] if self.unsent else [], [], timeout_s)
            if writable:
                self._hand_on()
            if not readable:
                return b""
            if data := self._waiting():
                return data
        except OSError as error:
            raise error if isinstance(error, TransportError) else self._broken(error) from error
        raise self._broken("its other end was closed")

    def _waiting(self) -> bytes:
        """Return the bytes that have come; none if there are none, or if the port is gone."""
        try:
            return os.read(self._serial.fileno(), _SERIAL_READ_BYTES)
        except BlockingIOError:
            return b""

    def _read_with_pyserial(self, timeout_s: float) -> bytes:
        if self._serial.timeout != timeout_s:
            self._serial.timeout = timeout_s
        first: bytes = self._serial.read(1)
        if not first:
            return b""
        waiting: int = self._serial.in_waiting
        if self._is_socket:
            # pyserial only says that bytes wait, not how many; with this timeout it returns those that do.
            self._serial.timeout, waiting = 0, _SERIAL_READ_BYTES
        rest: bytes = self._serial.read(waiting)
        return first + rest

    def reopen(self) -> None:
        """Close, and open the port again at which the same board is now, as far as the system tells boards apart."""
        self.close()
        device = next((device for name, device in _boards().items() if name in self._lasting_names), None)
        if device is not None and device != _device_of(self._port):
            notes.warning("the board at %s is at %s now", self._port, device)
            self._port = device
        self._open()

    def close(self) -> None:
        """Release the port."""
        self._serial.close()


def _device_of(port: str) -> str:
    """Return the device to which a port's name leads; names of Windows, and URLs, are no paths and stay."""
    return os.path.realpath(port) if os.path.exists(port) else port


def _boards() -> dict[str, str]:
    """Return the device at which each board is, by a name that it keeps: a link, or USB identifiers and serial number.

    A name that several devices have is left out.
    """
    from serial.tools import list_ports

    found = [(str(link), os.path.realpath(link)) for link in _BY_ID.glob("*")]
    found += [
        (f"{port.vid:04x}:{port.pid:04x}:{port.serial_number}", port.device)
        for port in list_ports.comports()
        if port.vid is not None and port.serial_number
    ]
    names = [name for name, _ in found]
    return {name: device for name, device in found if names.count(name) == 1}


class ThreadedTransport(Closing):
    """Another transport behind two threads, which makes it selectable: neither reading nor writing waits.

    It owns the other transport, which may be open already. The next call raises errors of the threads.
    """

    unsent = b""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._threads: list[threading.Thread] = []
        self._start()

    def _start(self) -> None:
        self._ending = False
        self._error: TransportError | None = None
        self._received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._sent: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self.file, self._signal = socket.socketpair()
        self.file.setblocking(False)
        self._signal.setblocking(False)
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._read_all, self._write_all)]
        for thread in self._threads:
            thread.start()

    def _end(self) -> None:
        """End the threads after they have sent all written bytes; may be called again."""
        if self._threads:
            self._ending = True
            self._sent.put(None)
            for thread in self._threads:
                thread.join()
            self._threads = []
            self.file.close()
            self._signal.close()

    def _read_all(self) -> None:
        while not self._ending:
            try:
                data = self._transport.read(_THREAD_READ_S)
            except TransportError as error:
                self._fail(error)
                return
            if data:
                self._received.put(data)
                self._wake()

    def _write_all(self) -> None:
        while (data := self._sent.get()) is not None:
            try:
                self._transport.write(data)
            except TransportError as error:
                self._fail(error)
                return

    def _fail(self, error: TransportError) -> None:
        self._error = error
        self._wake()

    def _wake(self) -> None:
        # A full socket wakes the reader, too.
        with contextlib.suppress(OSError):
            self._signal.send(b"\0")

    def write(self, data: bytes) -> None:
        """Pass the bytes to the writing thread."""
        if self._error is not None:
            raise self._error
        self._sent.put(data)

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that the reading thread has received."""
        if self._threads:
            select.select([self.file], [], [], timeout_s)
            with contextlib.suppress(BlockingIOError):
                self.file.recv(_SERIAL_READ_BYTES)
        pieces = []
        while not self._received.empty():
            pieces.append(self._received.get())
        if self._error is not None and not pieces:
            raise self._error
        return b"".join(pieces)

    def reopen(self) -> None:
        """End the threads, open the same port again and start new ones."""
        self._end()
        try:
            self._transport.reopen()
        except TransportError as error:
            self._error = error
            raise
        self._start()

    def close(self) -> None:
        """End the threads and release the port."""
        self._end()
        self._transport.close()


class UsbTransport(Closing):
    """The bulk endpoints of a USB device's vendor interface (class 0xFF, one bulk IN and one bulk OUT).

    `backend`: a pyusb backend, such as the simulated device's; None = libusb. `serial_number`: None = there is one such
    device only; `reopen` opens no other one. Raises TransportError if there is no such device, or more than one.
    """

    def __init__(self, vendor_id: int, product_id: int, backend: Any = None, serial_number: str | None = None) -> None:
        self._address = f"usb:{vendor_id:04x}:{product_id:04x}"
        self._identifiers = {"idVendor": vendor_id, "idProduct": product_id}
        self._serial_number = serial_number
        self._backend = backend or libusb_backend()
        if self._backend is None:
            raise TransportError("no libusb was found; install the package libusb-package again")
        self._open()

    def _open(self) -> None:
        try:
            device = self._found()
            interface = usb.util.find_descriptor(_configuration(device), bInterfaceClass=VENDOR_INTERFACE_CLASS)
            self._in = interface and _bulk_endpoint(interface, usb.util.ENDPOINT_IN)
            self._out = interface and _bulk_endpoint(interface, usb.util.ENDPOINT_OUT)
            if self._in is None or self._out is None:
                raise TransportError(
                    f"{self._name} is no controller: it lacks a vendor interface with bulk endpoints; give another "
                    "address"
                )
            usb.util.claim_interface(device, interface)
            # A stall, or the data toggle of a program that ended in the middle, must not affect the next program.
            self._in.clear_halt()
            self._out.clear_halt()
        except usb.core.USBError as error:
            hint = _USB_HINTS.get(error.errno, "plug it in again")
            raise TransportError(f"{self._name} cannot be opened ({error}); {hint}") from error
        self._device = device

    @property
    def _name(self) -> str:
        return f"USB device {self._address}" + (f":{self._serial_number}" if self._serial_number else "")

    def _found(self) -> Any:
        """Return the device, whose serial number is known from then on. Raises TransportError and USBError."""
        devices = list(usb.core.find(find_all=True, backend=self._backend, **self._identifiers))
        if not devices:
            raise TransportError(
                f"there is no {self._name}; plug it in and check its identifiers (`vibrocast devices` lists them)"
            )
        numbers: list[str | None] = []
        unreadable: usb.core.USBError | None = None
        for device in devices:
            try:
                numbers.append(usb_serial_number(device))
            except usb.core.USBError as error:  # of another user or, on Windows, open in another program
                numbers.append(None)
                unreadable = error
        chosen = [each for each, number in zip(devices, numbers, strict=True) if self._serial_number in (None, number)]
        if not chosen and unreadable is not None:
            raise unreadable
        if len(chosen) != 1:
            problem = f"there is no {self._name}" if not chosen else f"{len(chosen)} devices are {self._name}"
            known = sorted({f"{self._address}:{number}" for number in numbers if number})
            choice = f"choose one of {', '.join(known)}" if known else "plug in one of them only"
            same = len(known) < len(devices)
            raise TransportError(
                f"{problem}; {choice}" + ("; program a serial number of its own into each board" if same else "")
            )
        self._serial_number = self._serial_number or usb_serial_number(chosen[0]) or None
        return chosen[0]

    def _broken(self, error: Exception) -> TransportError:
        return TransportError(f"{self._name} broke off ({error}); check the cable and the controller")

    def write(self, data: bytes) -> None:
        """Send all of `data` to the bulk OUT endpoint."""
        deadline = time.monotonic() + _WRITE_TIMEOUT_S
        while data:
            try:
                data = data[self._out.write(data, int(_WRITE_TIMEOUT_S * 1000)) :]
            except usb.core.USBError as error:
                self._clear_stall(self._out, error)
            if data and time.monotonic() > deadline:
                raise TransportError(f"{self._name} took no data for {_WRITE_TIMEOUT_S:g} s; reset the controller")

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes of one transfer from the bulk IN endpoint."""
        try:
            # For libusb, 0 means "for ever".
            return bytes(self._in.read(_USB_READ_BYTES, max(1, round(timeout_s * 1000))))
        except usb.core.USBError as error:
            if not isinstance(error, usb.core.USBTimeoutError) and error.errno != errno.ETIMEDOUT:
                self._clear_stall(self._in, error)
            return b""

    def _clear_stall(self, endpoint: Any, error: usb.core.USBError) -> None:
        """Clear a stall of an endpoint; raise TransportError for any other error, or if that fails."""
        if error.errno != errno.EPIPE:
            raise self._broken(error) from error
        try:
            endpoint.clear_halt()
        except usb.core.USBError as failure:
            raise self._broken(failure) from failure

    def reopen(self) -> None:
        """Close, and open the same device again."""
        self.close()
        self._open()

    def close(self) -> None:
        """Release the device."""
        usb.util.dispose_resources(self._device)


_USB_HINTS = {
    errno.EACCES: f"give your user access: on Linux, copy {UDEV_RULES} to /etc/udev/rules.d, add your device's "
    "identifiers, and plug it in again",
    errno.EBUSY: "end the other program that uses it",
}


def usb_serial_number(device: Any) -> str:
    """Return the serial number of a pyusb device; empty if it has none. Raises USBError where it cannot be read."""
    if not device.iSerialNumber:
        return ""
    try:
        number: str = device.serial_number
    except ValueError:
        # No readable string. pyusb also says this where the user may not open the device: this raises that error.
        device.get_active_configuration()
        return ""
    return number if number.isprintable() else ""


def usb_address(device: Any) -> str:
    """Return the address of a pyusb device, with its serial number if it can be read."""
    address = f"usb:{device.idVendor:04x}:{device.idProduct:04x}"
    try:
        number = usb_serial_number(device)
    except usb.core.USBError:
        number = ""
    return f"{address}:{number}" if number else address


def libusb_backend() -> Any:
    """Return the libusb of this environment, as a pyusb backend; None if there is none."""
    import libusb_package

    return libusb_package.get_libusb1_backend()


def serial_port(address: str) -> tuple[str, int]:
    """Return the port, or URL of pyserial, and the baud rate of an address SERIAL_FORM. Raises TransportError."""
    match = _SERIAL.fullmatch(address)
    if match is None:
        raise TransportError(f"{address!r} names no serial port; give {SERIAL_FORM}")
    baud = int(match["baud"] or BAUD)
    if not MIN_BAUD <= baud <= MAX_BAUD:
        raise TransportError(
            f"{address}: {baud} is no baud rate; give {MIN_BAUD} to {MAX_BAUD} behind the @, or leave it out"
        )
    return match["port"], baud


def open_transport(address: str, usb_backend: Any = None) -> Transport:
    """Open a transport at an address: SERIAL_FORM, as SerialTransport does, or USB_FORM. Raises TransportError."""
    if _SERIAL.fullmatch(address):
        return SerialTransport(*serial_port(address))
    if match := _USB.fullmatch(address):
        return UsbTransport(int(match["vendor"], 16), int(match["product"], 16), usb_backend, match["number"])
    raise TransportError(f"{address!r} is no address of a controller; give {SERIAL_FORM} or {USB_FORM}")


def selectable(transport: Transport) -> Transport:
    """Return a transport with a file, if this one lacks it and can get one: over USB, or serial on Windows."""
    if isinstance(transport, UsbTransport) or (isinstance(transport, SerialTransport) and transport.file is None):
        return ThreadedTransport(transport)
    return transport


def _configuration(device: Any) -> Any:
    try:
        return device.get_active_configuration()
    except usb.core.USBError:  # not configured yet
        device.set_configuration()
        return device.get_active_configuration()


def _bulk_endpoint(interface: Any, direction: int) -> Any:
    return usb.util.find_descriptor(
        interface,
        custom_match=lambda endpoint: (
            usb.util.endpoint_direction(endpoint.bEndpointAddress) == direction
            and usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
        ),
    )
