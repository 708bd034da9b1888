"""Live streams of several controllers on one link that share a rate by need; one that fails holds no other up."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from vibrocast import codec
from vibrocast.codec import Signal
from vibrocast.codec.rate_controlled import added_bytes
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.controller import ConnectionLost, ControllerError
from vibrocast.host.live import LiveResult, LiveStream, limit_rate

_Done = TypeVar("_Done")

_SILENCE_S = 1.0
# More than of a lone stream: what waits of the others is not seen.
_DRAINED = 0.5


class LiveGroup:
    """Streams with packets of one length, each on a controller of its own, each rate-controlled by a member of a
    codec.Group.

    Packets that are due together have one quantiser offset, so the bits go where they are needed. Where the link
    carries less than is sent to any of them, the rate of all falls. `failed`: what ended a stream, by its number: an
    error, or that its controller was silent for a second; its share goes to the others.
    """

    def __init__(self, streams: Sequence[LiveStream], group: codec.Group) -> None:
        """Raises CodecError for packets of different length."""
        if len({stream.packet_s for stream in streams}) > 1:
            raise codec.CodecError("streams that share a rate need packets of one length; make their formats alike")
        self.streams = streams
        self.failed: dict[int, Exception] = {}
        self._group = group
        self._target_bps = group.policy.bits_per_second
        self._sent_bps = [0.0] * len(streams)
        self._heard = [(stream.status, stream.controller.clock()) for stream in streams]

    def send(self, blocks: Sequence[Signal]) -> None:
        """Code and send a block (n, channels) of each stream, all of the same n, and receive messages."""
        start = 0
        while start < len(blocks[0]):
            end = start + self.streams[0].left_samples
            self._send_part([block[start:end] for block in blocks])
            start = end
        for number in range(len(self.streams)):
            self._with(number, self._listen)

    def finish(self) -> dict[int, LiveResult]:
        """Send what is left and the end, wait until it has been played; return by number what happened to each.

        Those that have failed are left out.
        """
        left_samples = self.streams[0].left_samples
        self.send([np.zeros((left_samples, stream.format.channels)) for stream in self.streams])
        for number in range(len(self.streams)):
            self._with(number, LiveStream.say_end)
        finished = [self._with(number, LiveStream.finish) for number in range(len(self.streams))]
        return {number: result for number, result in enumerate(finished) if result is not None}

    def _send_part(self, parts: Sequence[Signal]) -> None:
        """Send what completes the next packet of all streams, or less."""
        if len(parts[0]) == self.streams[0].left_samples:
            self._follow_the_link()
        packets = self._group.code([self._coder(number) for number in range(len(self.streams))], parts)
        for number, stream in enumerate(self.streams):
            self._with(number, partial(LiveStream.send_packets, packets=packets[number]))
            if packets[number]:
                sent_bytes = sum(len(packet) + added_bytes(packet) for packet in packets[number])
                self._sent_bps[number] = 8 * sent_bytes / stream.packet_s

    def _follow_the_link(self) -> None:
        """Set the common rate so that what goes to each comes in time, as the last packets had it."""
        policy, alive = self._group.policy, [number for number in range(len(self.streams)) if number not in self.failed]
        carried = [
            self.streams[number].carried_bps / self._sent_bps[number]
            for number in alive
            if self.streams[number].fits(_DRAINED) and self._sent_bps[number]
        ]
        if carried:
            carried_bps = min(carried) * sum(self._sent_bps[number] for number in alive)
            limit_rate(policy, self._target_bps, carried_bps)

    def _coder(self, number: int) -> Callable[[Signal], list[bytes]]:
        return (lambda samples: []) if number in self.failed else self.streams[number].coded

    def _listen(self, stream: LiveStream) -> None:
        """Receive messages of a controller. Raises ConnectionLost where it has been silent."""
        if stream.left_samples == stream.packet_samples:
            stream.keep_up()  # between packets, so that all stay in step if it starts the stream again
        else:
            stream.poll(0)
        number, now_s = self.streams.index(stream), stream.controller.clock()
        status, heard_s = self._heard[number]
        if status is not stream.status:
            self._heard[number] = stream.status, now_s
        elif now_s - heard_s > _SILENCE_S and stream.packets_sent:
            raise ConnectionLost(f"the controller has been silent for {_SILENCE_S:g} s; check that it has power")

    def _with(self, number: int, work: Callable[[LiveStream], _Done]) -> _Done | None:
        """Do something with a stream, unless it has failed; note when it does, and return None."""
        if number in self.failed:
            return None
        try:
            return work(self.streams[number])
        except (TransportError, ControllerError) as error:
            self.failed[number] = error
            return None
