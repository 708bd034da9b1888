"""The controller behind a real pseudo-terminal, a socket and a USB device: plugged, unplugged, opened and closed."""

import os
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.simulated_device.bench import stream
from vibrocast.device_protocol.messages import State, Status
from vibrocast.device_protocol.transports import SerialTransport, TransportError, UsbTransport, open_transport
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import PlaybackSettings, Progress, play
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.pty_port import PtyPort
from vibrocast.simulated_device.socket_port import SocketPort
from vibrocast.simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort


@pytest.fixture
def pty_port() -> Iterator[PtyPort]:
    with PtyPort(Controller()) as port:
        yield port


@pytest.fixture(params=[PtyPort, SocketPort], ids=["pty", "socket"])
def port(request: pytest.FixtureRequest) -> Iterator[PtyPort | SocketPort]:
    """Each port that a serial transport opens."""
    with request.param(Controller()) as opened:
        yield opened


@pytest.fixture
def socket_port() -> Iterator[SocketPort]:
    with SocketPort(Controller()) as port:
        yield port


@pytest.fixture
def usb_port() -> Iterator[UsbPort]:
    with UsbPort(Controller()) as port:
        yield port


@pytest.mark.parametrize("another", [False, True], ids=["gone", "of another process"])
def test_the_link_of_a_controller_that_was_killed_is_replaced_and_no_other(another: bool, tmp_path: Path) -> None:
    """The system may have given its pseudo-terminal to another process."""
    link, left = tmp_path / "port", tmp_path / f"vibrocast-{2**22 + 1}-left"  # more than any process has
    link.symlink_to(left)
    if another:
        left.symlink_to("/dev/null")
    with PtyPort(Controller(), link) as port:
        with Host(SerialTransport(str(link))) as host:
            assert isinstance(host.request_status(), Status)
        with pytest.raises(FileExistsError, match=rf"{port.name}: .* a controller runs behind it; end that"):
            PtyPort(Controller(), link)
    link.write_text("kept")
    with pytest.raises(FileExistsError, match="a file has this name"):
        PtyPort(Controller(), link)
    assert link.read_text() == "kept"
    with pytest.raises(FileNotFoundError) as raised:
        PtyPort(Controller(), tmp_path / "none" / "port")
    assert raised.value.filename == str(tmp_path / "none" / "port")


def test_pty_unplugged_breaks_the_transport_and_comes_back_under_the_same_name(pty_port: PtyPort) -> None:
    with Host(SerialTransport(pty_port.name)) as host:
        pty_port.unplug()
        assert not Path(pty_port.name).exists()
        with pytest.raises(TransportError):
            host.request_status()
        with pytest.raises(TransportError):
            host.reconnect(0.0)
        pty_port.plug()
        host.reconnect(5.0)
        assert isinstance(host.request_status(), Status)


class FailingController(Controller):
    """A controller with a fault that strikes on request."""

    faulty = False

    def advance(self, now_us: int) -> None:
        if self.faulty:
            raise RuntimeError("out of order")
        super().advance(now_us)


@pytest.mark.parametrize("kind", [PtyPort, SocketPort, UsbPort])
def test_port_goes_away_with_a_controller_that_fails_and_says_why(
    kind: type[PtyPort] | type[SocketPort] | type[UsbPort],
) -> None:
    controller = FailingController()
    with pytest.raises(TransportError, match="out of order"), kind(controller) as port:
        over_usb = isinstance(port, UsbPort)
        host = Host(UsbTransport(VENDOR_ID, PRODUCT_ID, port) if over_usb else SerialTransport(port.name))
        controller.faulty = True
        with pytest.raises(TransportError, match="broke off"):
            host.request_status()
        if isinstance(port, PtyPort):
            port.unplug()
    if isinstance(port, PtyPort):
        port.close()
        assert not Path(port.name).exists()


def connected(port: SocketPort) -> socket.socket:
    address, _, number = port.name.removeprefix("socket://").partition(":")
    return socket.create_connection((address, int(number)), timeout=10)


def test_socket_listens_to_this_machine_alone(socket_port: SocketPort) -> None:
    assert socket_port.name.startswith("socket://127.0.0.1:")


def test_port_survives_hosts_that_open_and_close_it_while_playing(port: PtyPort | SocketPort) -> None:
    played = stream(1.0)

    def leave(progress: Progress) -> None:
        raise KeyError("the host has had enough")

    for _ in range(2):
        with Host(SerialTransport(port.name)) as host:
            assert isinstance(host.request_status(), Status)
            with pytest.raises(KeyError):
                play(host, played, PlaybackSettings(progress=leave))


def test_port_survives_a_host_that_never_reads_and_garbage(port: PtyPort | SocketPort) -> None:
    garbage = [os.urandom(300) + b"\0" for _ in range(200)]
    if isinstance(port, SocketPort):
        with connected(port) as rude:
            rude.sendall(b"".join(garbage))
    else:
        file = os.open(port.name, os.O_RDWR | os.O_NOCTTY)
        for piece in garbage:
            os.write(file, piece)
        os.close(file)
    # The next host comes at once, while the garbage is still being read.
    with Host(SerialTransport(port.name)) as host:
        assert host.request_status().bad_frames > 0


def test_socket_survives_a_host_that_is_cut_off(socket_port: SocketPort) -> None:
    rude = connected(socket_port)
    rude.sendall(b"x")
    rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing resets the connection
    rude.close()
    with Host(SerialTransport(socket_port.name)) as host:
        assert isinstance(host.request_status(), Status)


def test_socket_serves_one_host_at_a_time(socket_port: SocketPort) -> None:
    with Host(SerialTransport(socket_port.name)) as host:
        assert isinstance(host.request_status(), Status)
        with pytest.raises(TransportError, match="no other program"):
            Host(SerialTransport(socket_port.name))
        assert isinstance(host.request_status(), Status)
        host.reconnect(5.0)
        assert isinstance(host.request_status(), Status)


@pytest.mark.parametrize(
    "url", ["socket://127.0.0.1", "socket://127.0.0.1:x", "socket://127.0.0.1:99999", "no-such://x"]
)
def test_url_that_is_no_port_is_an_error(url: str) -> None:
    with pytest.raises(TransportError, match="cannot open serial port"):
        open_transport(f"serial:{url}")


def test_stream_plays_through_stalls_and_busy_endpoints(usb_port: UsbPort) -> None:
    played = stream(1.0)
    faults: list[Callable[[], None]] = [usb_port.stall, lambda: usb_port.keep_busy(0.05)]

    def disturb(progress: Progress) -> None:
        if faults and progress.position_s > 0.2:
            faults.pop()()

    with Host(UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)) as host:
        result = play(host, played, PlaybackSettings(buffer_s=0.8, capture=True, progress=disturb))
    assert not faults
    assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, played.decoded)
