"""The glue to TinyUSB against a stand-in of its interface: bytes both ways, and descriptors as a host reads them.

The real stack is not there, so nothing here links with it.
"""

import ctypes
import struct
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from vibrocast.device_protocol.transports import VENDOR_INTERFACE_CLASS
from vibrocast.firmware import build as building

VENDOR, SERIAL = 0, 1
STAND_IN = Path(__file__).parent / "tinyusb"
GLUE = building.ROOT / "ports" / "tinyusb"
DEVICE, CONFIGURATION, INTERFACE, ENDPOINT, ASSOCIATION, BOS, CS_INTERFACE = 1, 2, 4, 5, 11, 15, 36
BULK, INTERRUPT = 2, 3
SERIAL_NUMBER = b"e660c0d1c7"


@pytest.fixture(scope="module")
def glue(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Return the glue, on a board with a serial number."""
    library = tmp_path_factory.mktemp("glue") / f"glue{building._LIBRARY_SUFFIX}"
    sources = [*sorted(GLUE.glob("*.c")), STAND_IN / "stand_in.c"]
    includes = [f"-I{GLUE}", f"-I{STAND_IN}", f"-I{building.ROOT / 'include'}"]
    command = [sys.executable, "-m", "ziglang", "cc", *building.FLAGS, "-shared", "-fPIC", *includes]
    subprocess.run([*command, *map(str, sources), "-o", str(library)], check=True)
    glue = ctypes.CDLL(str(library))
    for name in ("device", "bos", "configuration", "string"):
        getattr(glue, f"tud_descriptor_{name}_cb").restype = ctypes.c_void_p
    for name in ("read", "write"):
        getattr(glue, f"vc_port_{name}").restype = ctypes.c_size_t
    glue.vc_usb_start(SERIAL_NUMBER)
    return glue


def read(glue: ctypes.CDLL, capacity: int = 256) -> bytes:
    data = ctypes.create_string_buffer(capacity)
    count = glue.vc_port_read(data, ctypes.c_size_t(capacity))
    return data.raw[:count]


def host_reads(glue: ctypes.CDLL, way: int) -> bytes:
    data = ctypes.create_string_buffer(4096)
    count = glue.host_read(way, data, 4096)
    return data.raw[:count]


def write(glue: ctypes.CDLL, data: bytes) -> int:
    return int(glue.vc_port_write(data, ctypes.c_size_t(len(data))))


def text(glue: ctypes.CDLL, index: int) -> str | None:
    """Return a string descriptor's text (USB 2.0, 9.6.7)."""
    address = glue.tud_descriptor_string_cb(index, 0x0409)
    if address is None:
        return None
    length, kind = ctypes.string_at(address, 2)
    assert kind == 3
    return ctypes.string_at(address + 2, length - 2).decode("utf-16-le")


def descriptors(data: bytes) -> Iterator[bytes]:
    """Split a run of descriptors by their lengths."""
    while data:
        assert 2 <= data[0] <= len(data)
        yield data[: data[0]]
        data = data[data[0] :]


@pytest.mark.parametrize("way", [VENDOR, SERIAL])
def test_answers_go_where_the_hosts_bytes_came_from(glue: ctypes.CDLL, way: int) -> None:
    before = glue.tasks_run()
    assert glue.host_write(way, b"asked", 5) == 5
    assert read(glue, 3) + read(glue) == b"asked"
    assert read(glue) == b""
    assert glue.tasks_run() == before + 3
    assert write(glue, b"answered") == 8
    assert host_reads(glue, way) == b"answered"
    assert host_reads(glue, 1 - way) == b""


def test_a_host_that_reads_nothing_holds_the_board_back_and_loses_nothing(glue: ctypes.CDLL) -> None:
    glue.host_write(VENDOR, b"?", 1)
    read(glue)
    pattern = bytes(range(256))
    taken = [write(glue, pattern) for _ in range(40)]
    assert taken[0] == 256 and taken[-1] == 0
    received = b""
    while part := host_reads(glue, VENDOR):
        received += part
        write(glue, b"")
        glue.tud_vendor_n_write_flush(0)
    assert received == (pattern * 40)[: sum(taken)]


def test_the_device_states_its_numbers_and_a_serial_number(glue: ctypes.CDLL) -> None:
    data = ctypes.string_at(glue.tud_descriptor_device_cb(), 18)
    length, kind, usb, *classes, control_bytes, vendor, product, _, maker, name, serial, count = struct.unpack(
        "<BBHBBBBHHHBBBB", data
    )
    assert (length, kind, count, control_bytes) == (18, DEVICE, 1, 64)
    assert usb >= 0x0210, "older devices have no BOS"
    assert classes == [239, 2, 1], "several interfaces in associations"
    assert (vendor, product) == (0x1209, 0x0001)
    texts = ["vibrocast", "vibrocast controller", SERIAL_NUMBER.decode()]
    assert [text(glue, index) for index in (maker, name, serial)] == texts
    language = glue.tud_descriptor_string_cb(0, 0)
    assert ctypes.string_at(language, 4) == b"\x04\x03\x09\x04"
    assert text(glue, 0xEE) is None and text(glue, 6) is None


def test_the_configuration_holds_a_serial_port_and_a_vendor_interface(glue: ctypes.CDLL) -> None:
    address = glue.tud_descriptor_configuration_cb(0)
    total = struct.unpack_from("<H", ctypes.string_at(address, 4), 2)[0]
    head, *parts = descriptors(ctypes.string_at(address, total))
    assert (head[1], head[4], head[5]) == (CONFIGURATION, 3, 1)
    interfaces = [part for part in parts if part[1] == INTERFACE]
    assert [part[2] for part in interfaces] == [0, 1, 2]
    control, data, vendor = interfaces
    assert tuple(control[5:8]) == (2, 2, 0) and tuple(data[5:8]) == (10, 0, 0) and vendor[5] == VENDOR_INTERFACE_CLASS
    (association,) = (part for part in parts if part[1] == ASSOCIATION)
    assert tuple(association[2:7]) == (0, 2, 2, 2, 0), "interfaces 0 and 1 are the serial port"
    functional = {part[2]: part for part in parts if part[1] == CS_INTERFACE}
    assert set(functional) == {0, 1, 2, 6} and tuple(functional[6][3:]) == (0, 1)
    endpoints = [part for part in parts if part[1] == ENDPOINT]
    assert [(part[2], part[3]) for part in endpoints] == [
        *((0x81, INTERRUPT), (0x02, BULK), (0x82, BULK), (0x03, BULK), (0x83, BULK)),
    ]
    assert {struct.unpack_from("<H", part, 4)[0] for part in endpoints if part[3] == BULK} == {64}
    # Each interface is followed by as many endpoints as it says.
    for interface in interfaces:
        behind = parts[parts.index(interface) + 1 :]
        until = next((place for place, part in enumerate(behind) if part[1] == INTERFACE), len(behind))
        assert sum(part[1] == ENDPOINT for part in behind[:until]) == interface[4]
    assert text(glue, vendor[8]) == "vibrocast controller (vendor)"
    assert text(glue, control[8]) == "vibrocast controller (serial)"


def test_windows_finds_winusb_for_the_vendor_interface(glue: ctypes.CDLL) -> None:
    """Microsoft OS 2.0 Descriptors Specification (2018), tables 1 to 14."""
    address = glue.tud_descriptor_bos_cb()
    total = struct.unpack_from("<H", ctypes.string_at(address, 4), 2)[0]
    head, capability = descriptors(ctypes.string_at(address, total))
    assert (head[1], head[4]) == (BOS, 1)
    assert tuple(capability[1:4]) == (16, 5, 0)
    assert uuid.UUID(bytes_le=bytes(capability[4:20])) == uuid.UUID("D8DD60DF-4589-4CC7-9CD2-659D9E648A9F")
    version, set_bytes, request, alternate = struct.unpack_from("<IHBB", capability, 20)
    assert (version, alternate) == (0x0603_0000, 0)

    data = ctypes.create_string_buffer(512)
    assert glue.host_vendor_request(request, 7, data) == set_bytes
    assert glue.host_vendor_request(request, 8, data) == -1 and glue.host_vendor_request(request + 1, 7, data) == -1
    glue.host_vendor_request(request, 7, data)
    answer = data.raw[:set_bytes]
    assert struct.unpack_from("<HHIH", answer) == (10, 0, 0x0603_0000, set_bytes)
    assert struct.unpack_from("<HHBBH", answer, 10) == (8, 1, 0, 0, set_bytes - 10)
    assert struct.unpack_from("<HHBBH", answer, 18) == (8, 2, 2, 0, set_bytes - 18), "interface 2 is the vendor's"
    assert struct.unpack_from("<HH", answer, 26) == (20, 3)
    assert answer[30:46] == b"WINUSB".ljust(16, b"\0")
    length, kind, multiple_texts, name_bytes = struct.unpack_from("<HHHH", answer, 46)
    assert (length, kind, multiple_texts) == (set_bytes - 46, 4, 7)
    assert answer[54 : 54 + name_bytes].decode("utf-16-le") == "DeviceInterfaceGUIDs\0"
    (value_bytes,) = struct.unpack_from("<H", answer, 54 + name_bytes)
    value = answer[56 + name_bytes :].decode("utf-16-le")
    assert len(value) * 2 == value_bytes and value.endswith("}\0\0")
    assert uuid.UUID(value.strip("{}\0")).version == 4
