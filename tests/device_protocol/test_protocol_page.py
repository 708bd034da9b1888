"""The example of docs/reference/protocol.md is what the code packs; test_generate.py holds the tables."""

import re
from pathlib import Path

import pytest

from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    CodingDescription,
    Configure,
    Error,
    ErrorCode,
    Hello,
    Message,
    SinglePacket,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    pack,
    unpack,
)

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "protocol.md").read_text()

EXAMPLE: list[tuple[str, int, Message]] = [
    ("Hello, sequence 0x1234", 0x1234, Hello(2, 1)),
    ("Error, sequence 0x1234", 0x1234, Error(ErrorCode.HELLO_FIRST, "say hello first")),
    ("Configure, sequence 0x1236", 0x1236, Configure(1, b"\xd3\x13\x00", prebuffer_samples=1400, packets=100)),
    (
        "Status, sequence 0x1236",
        0x1236,
        Status(State.BUFFERING, 1, 4_000_000, 0, 6400, 0, 0, 0, 0, 0, 0, 0, 0, coding=CodingDescription(64, 32)),
    ),
    ("StreamData, two packets", 0, StreamData(1, 0, (b"\x01\xaa\xbb", b"\x02\xcc"))),
    ("SinglePacket", 0, SinglePacket(1, b"\x05\xdd")),
    ("Start, sequence 0x1237", 0x1237, Start(0)),
    ("Status, notification", 0, Status(State.PLAYING, 1, 5_000_000, 64, 6400, 320, 0, 0, 0, 0, 0, 0, 0)),
    ("StatusRequest, sequence 0x1238", 0x1238, StatusRequest()),
    ("Stop, sequence 0x1239", 0x1239, Stop()),
]


@pytest.mark.parametrize(("title", "sequence", "message"), EXAMPLE)
def test_example_frames_are_what_the_code_packs(title: str, sequence: int, message: Message) -> None:
    (row,) = re.findall(rf"^\| {re.escape(title)} \| `([0-9a-f ]+)` \|$", PAGE, re.MULTILINE)
    frame = bytes.fromhex(row)
    assert frame == write_frame(pack(message, sequence))
    (payload,) = FrameReader().feed(frame)
    assert unpack(payload) == (sequence, message)
