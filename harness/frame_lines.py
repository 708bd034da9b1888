"""Frames of a trace as lines for a person: time, direction, message and its fields."""

from vibrocast.device_protocol.messages import (
    COUNTERS,
    Configure,
    HelloResponse,
    Message,
    PacketMessage,
    Status,
)
from vibrocast.device_protocol.trace import TracedFrame


def line(frame: TracedFrame, began_ns: int) -> str:
    """Return a frame as a line; its time is in seconds since `began_ns`."""
    way = "host -> controller" if frame.from_host else "controller -> host"
    head = f"{(frame.time_ns - began_ns) / 1e9:12.6f}  {way:18}"
    found = frame.message()
    if found is None:
        return f"{head}  DAMAGED or unknown, {len(frame.encoded)} bytes"
    sequence, message = found
    number = f"#{sequence}" if sequence else ""
    return f"{head}  {number:6}  {type(message).__name__:14}  {_fields(message)}".rstrip()


def _fields(message: Message) -> str:
    if isinstance(message, Status):
        counts = [f"{name} {count}" for name in COUNTERS if (count := getattr(message, name))]
        return ", ".join(
            [
                f"{message.state.name.lower()}, stream {message.stream}, position {message.position}",
                f"credit until {message.credit_until}, buffered {message.buffered_samples}",
                *counts,
            ]
        )
    if isinstance(message, PacketMessage):
        sizes = [len(packet) for packet in message.packets]
        return f"stream {message.stream}, {len(sizes)} packet(s) of {sum(sizes)} bytes, iteration {message.iteration}"
    if isinstance(message, HelloResponse):
        board = f", serial number {message.serial_number}" if message.serial_number else ""
        return f"{message.hardware}, {message.build}{board}, actuator {message.actuator.name}"
    if isinstance(message, Configure):
        return f"stream {message.stream}, {message.packets} packets, loops {message.loops}, gain {message.gain:g}"
    values = {
        name: f"{len(value)} bytes" if isinstance(value, bytes) else value for name, value in vars(message).items()
    }
    return ", ".join(f"{name} {getattr(value, 'name', value)}" for name, value in values.items())
