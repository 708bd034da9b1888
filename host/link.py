"""What the link to a controller carries: how long a frame is under way, and how many bytes a second get there."""

from dataclasses import dataclass
from typing import Self

from device_protocol.frames import write_frame
from device_protocol.messages import StatusRequest, StreamData, pack
from host.controller import Controller

# The controller drops data of a stream that is not under way, so a frame of it may be of any length.
_PROBE_BYTES = 128
_PROBES = 3


def added_bytes(packet: bytes) -> int:
    """Return how many bytes a packet's frame, of its own, adds to it: 8 for up to 127 bytes, as policies count them."""
    return len(write_frame(pack(StreamData(0, 0, (packet,))))) - len(packet)


@dataclass
class LinkModel:
    """When frames that are sent now arrive, by the controller's clock.

    `offset_s`: the controller's time when a frame without a byte arrives, less the host's when it was sent. `byte_s`:
    how much later a frame arrives for each of its bytes.
    """

    offset_s: float
    byte_s: float

    @classmethod
    def measured(cls, controller: Controller) -> Self:
        """Measure the link while nothing else is on it. Raises as `Controller.request`.

        A request is timed alone, and behind a frame of data: by how much later it then arrives is what the frame takes
        (the packet pair of Keshav, "A control-theoretic approach to flow control", SIGCOMM 1991). Of each the soonest
        counts: a busy computer, or an answer that was lost, can only make it later.
        """
        stream = (controller.request_status().stream + 1) % 256
        probe = StreamData(stream, 0, (bytes(_PROBE_BYTES),))
        alone_s = [_asked_s(controller) for _ in range(_PROBES)]
        behind_s = []
        for _ in range(_PROBES):
            began_s = controller.clock()
            controller.send(probe)
            behind_s.append(_asked_s(controller, began_s))
        byte_s = max(0.0, min(behind_s) - min(alone_s)) / len(write_frame(pack(probe)))
        return cls(min(alone_s) - byte_s * len(write_frame(pack(StatusRequest(), 1))), byte_s)

    def arrival_s(self, sent_s: float, frame_bytes: int) -> float:
        """Return when, by the controller's clock, a frame has arrived that is sent over an idle link."""
        return sent_s + self.offset_s + frame_bytes * self.byte_s


def _asked_s(controller: Controller, began_s: float | None = None) -> float:
    """Ask for the status; return the controller's time when it was asked, less the host's when that began."""
    began_s = controller.clock() if began_s is None else began_s
    return controller.request_status().device_time_us / 1e6 - began_s
