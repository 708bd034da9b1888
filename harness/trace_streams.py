"""Finds the coded streams in a trace, so that they can be decoded without a controller."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from vibrocast.codec.stream import Stream, shipped_image
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.messages import Configure, PacketMessage
from vibrocast.device_protocol.trace import TracedFrame


@dataclass
class TracedStream:
    """A stream that a host set up. `packets`: of its first pass, by number, as they were sent."""

    number: int
    header: StreamHeader
    packets: dict[int, bytes] = field(default_factory=dict)

    def stream(self) -> Stream:
        """Return the stream up to the first packet that is missing. Raises StreamError, CodecError."""
        first = min(self.packets, default=0)
        packets: list[bytes] = []
        while first + len(packets) in self.packets:
            packets.append(self.packets[first + len(packets)])
        if not packets:
            raise StreamError("the trace holds no packet of the stream; trace the whole command")
        if first:
            raise StreamError(f"the trace holds packets from number {first} on; trace the whole command")
        received = Stream(replace(self.header, samples=None), tuple(packets), shipped_image(self.header))
        samples = min(received.samples, self.header.samples or received.samples)
        return replace(received, header=replace(self.header, samples=samples))


def streams_of(frames: Iterable[TracedFrame]) -> list[TracedStream]:
    """Return the streams of a trace, in their order."""
    found: list[TracedStream] = []
    for frame in frames:
        sequence_and_message = frame.message() if frame.from_host else None
        if sequence_and_message is None:
            continue
        message = sequence_and_message[1]
        try:
            if isinstance(message, Configure):
                if not found or found[-1].number != message.stream:  # sent again
                    found.append(TracedStream(message.stream, StreamHeader.unpack(message.header)[0]))
            elif (
                isinstance(message, PacketMessage)
                and found
                and (message.stream, message.iteration) == (found[-1].number, 0)
            ):
                found[-1].packets |= {packet_sequence(packet)[0]: packet for packet in message.packets}
        except StreamError:
            continue  # the controller rejects it as well
    return found
