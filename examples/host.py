"""A host, as docs/how-to/write_a_host.md explains: plays a .vct file once, and saves what the controller decoded."""

import argparse
import random
import struct
import sys
import time
from binascii import crc_hqx  # CRC-16: polynomial 0x1021, not reflected
from pathlib import Path

import serial

HELLO, STATUS_REQUEST, CONFIGURE, START, STOP, CAPTURE_READ, SINGLE_PACKET = 0x01, 0x02, 0x03, 0x04, 0x07, 0x0B, 0x42
HELLO_RESPONSE, STATUS, CAPTURE_DATA, ERROR, ARMED, PLAYING, FINISHED = 0x80, 0x81, 0x82, 0xFF, 2, 3, 5


def varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the LEB128 number at a position, and the position behind it."""
    upper, end = varint(data, at + 1) if data[at] > 0x7F else (0, at + 1)
    return data[at] & 0x7F | upper << 7, end


def packed_varint(value: int) -> bytes:
    """Return a number as LEB128."""
    return bytes([value & 0x7F | 0x80]) + packed_varint(value >> 7) if value > 0x7F else bytes([value])


def read_vct(data: bytes) -> tuple[bytes, int, int, list[bytes]]:
    """Return header, Hz, samples, and the packets as they go on the wire. The CRCs are not checked."""
    rate, at = varint(data, 3)
    samples_and_one, at = varint(data, at)
    if data[0] != 0xD3 or samples_and_one == 0:
        sys.exit("this is no .vct file of a recording")
    at += 2 * ((data[2] >> 4) + 1) + (data[2] & 4)  # gains of the channels, hash of a model image
    at += data[1] & 15 if data[1] & 15 < 15 else 1 + data[at]  # the configuration of the codec
    header, packets = data[:at], list[bytes]()
    while at < len(data):  # flag 8: the rest is one packet
        head, at = (2 * (len(data) - at - 2) + 1, at) if data[2] & 8 else varint(data, at)
        packets.append(packed_varint(2 * len(packets) + head % 2) + data[at : at + head // 2])
        at += head // 2 + 2
    return header, rate // 2 if rate % 2 else 50 * rate, samples_and_one - 1, packets


def payload_of(frame: bytes) -> bytes:
    """Undo COBS, and check the CRC; return b"" for a damaged frame."""
    data, at = b"", 0
    while at < len(frame):
        data += frame[at + 1 : at + frame[at]] + b"\0" * (frame[at] < 255)
        at += frame[at]
    data = data.removesuffix(b"\0")  # the last part stands before no zero
    return data[:-2] if crc_hqx(data[:-2], 0xFFFF) == int.from_bytes(data[-2:], "little") else b""


class Link:
    """A session with a controller at a serial port."""

    def __init__(self, port: str) -> None:
        self.port, self.sequence, self.pending = serial.Serial(port, 921_600, timeout=0.01), 0, b""
        self.port.write(b"\0")  # ends any noise

    def send(self, payload: bytes) -> None:
        """Send a frame: in COBS, parts without zeros, at most 254 bytes each, follow their length + 1."""
        data = payload + crc_hqx(payload, 0xFFFF).to_bytes(2, "little")
        parts = [run[at : at + 254] for run in data.split(b"\0") for at in range(0, len(run) + 1, 254)]
        self.port.write(b"".join(bytes([len(part) + 1]) + part for part in parts) + b"\0")

    def request(self, kind: int, body: bytes, answer: int) -> bytes:
        """Send a request, again while no answer comes, and return the answer's body. Notifications are not needed."""
        self.sequence = self.sequence % 0xFFFF + 1
        for attempt in range(20):
            if kind == HELLO and attempt % 5 == 0:  # an earlier session may have had the number
                self.sequence = random.randint(1, 0xFFFF)
            self.send(struct.pack("<BH", kind, self.sequence) + body)
            until_s = time.monotonic() + 0.1 + len(body) / 11_520
            while time.monotonic() < until_s:
                *frames, self.pending = (self.pending + self.port.read(self.port.in_waiting or 1)).split(b"\0")
                for payload in map(payload_of, frames):
                    if payload[:3] == struct.pack("<BH", answer, self.sequence):
                        return payload[3:]
                    if payload[:3] == struct.pack("<BH", ERROR, self.sequence):
                        sys.exit(f"error {payload[3]}: {payload[8:].decode()}")
        sys.exit("the controller does not answer")


def play(link: Link, header: bytes, rate_hz: int, samples: int, packets: list[bytes]) -> bytes:
    """Play packets, and return the decoded recording: int16, little-endian, channels interleaved."""
    if link.request(HELLO, b"\x02\x01", HELLO_RESPONSE)[1] < 1:
        sys.exit("the controller speaks protocol 2.0, which does not say how long a packet is: update it")
    stream, prebuffer = link.request(STATUS_REQUEST, b"", STATUS)[1], 1
    for _ in range(2):  # the first answer has P, from which the prebuffer of the second follows
        stream = (stream + 1) % 256
        fixed = struct.pack("<BBIIIHf", stream, 1, prebuffer, len(packets), 0, 1, 1.0)
        status = link.request(CONFIGURE, fixed + struct.pack("<BH", 1, len(header)) + header, STATUS)
        (credit,), (packet_samples, delay) = struct.unpack_from("<Q", status, 18), struct.unpack_from("<II", status, 70)
        prebuffer = min(credit, max(2 * packet_samples, 3 * rate_hz // 10))
    link.request(START, bytes(8), STATUS)
    sent, captured, offset = 0, b"", 0
    while True:
        while sent < len(packets) and (sent + 1) * packet_samples <= credit:
            link.send(bytes([SINGLE_PACKET, stream]) + packets[sent])
            sent += 1
        # Each turn sends two requests: no watchdog bites.
        state, _, _, position, until, held = struct.unpack_from("<BBQQQI", link.request(STATUS_REQUEST, b"", STATUS))
        if state not in (ARMED, PLAYING, FINISHED):
            sys.exit(f"the controller stopped in state {state}")
        credit = max(credit, until)
        if state != FINISHED and position + held < sent * packet_samples:
            sent = position // packet_samples  # a packet was lost; the controller drops second copies of others
        answer = link.request(CAPTURE_READ, struct.pack("<BQH", 0, offset, 512), CAPTURE_DATA)
        channels, first, end = struct.unpack_from("<BQQ", answer, 1)
        if first != offset:
            sys.exit("the controller keeps too few samples to read all of them back")
        captured, offset = captured + answer[18:], offset + len(answer[18:]) // (2 * channels)
        if state == FINISHED and offset == end:
            return captured[2 * channels * delay : 2 * channels * (delay + samples)]
        time.sleep(0.005)


def main() -> None:
    """Play a file, and save the samples as raw int16. Multiply them by gain / 32768, from the header."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("port", "coded", "saved"):
        parser.add_argument(name)
    given = parser.parse_args()
    link = Link(given.port)
    try:
        Path(given.saved).write_bytes(play(link, *read_vct(Path(given.coded).read_bytes())))
    finally:
        link.request(STOP, b"", STATUS)


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
