"""Packets of rate-controlled streams: tried at several quantiser offsets, then coded at the one that is chosen."""

from collections.abc import Callable
from dataclasses import dataclass

from vibrocast.codec.interface import CodecError, RateControl, Signal
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES


@dataclass(frozen=True)
class PacketTrial:
    """A codec.interface.Trial; `code` codes the packet at a quantiser offset and leaves the encoder as it was."""

    samples: Signal
    quantiser_offsets: range
    previous: int
    code: Callable[[int], bytes]

    def packet(self, quantiser_offset: int) -> bytes:
        """Return the packet at one of the quantiser offsets. Raises CodecError on others, and where it does not fit."""
        if quantiser_offset not in self.quantiser_offsets:
            raise CodecError(
                f"a quantiser offset of {quantiser_offset}; "
                f"{self.quantiser_offsets[0]} to {self.quantiser_offsets[-1]} can be chosen here"
            )
        return self.code(quantiser_offset)


def rate_controlled_packet(
    trial: PacketTrial, rate_control: RateControl, code: Callable[[int], bytes]
) -> tuple[int, bytes]:
    """Ask the rate control; return the quantiser offset, and the packet that `code` codes at it, padded as asked.

    `code`: as that of the trial, but the encoder goes on. Raises CodecError on a choice that no packet can have.
    """
    choice = rate_control(trial)
    if choice.quantiser_offset not in trial.quantiser_offsets or choice.min_bytes > MAX_PACKET_BYTES:
        raise CodecError(
            f"a quantiser offset of {choice.quantiser_offset} in {choice.min_bytes} bytes cannot be chosen: it must be "
            f"{trial.quantiser_offsets[0]} to {trial.quantiser_offsets[-1]}, in at most {MAX_PACKET_BYTES} bytes"
        )
    return choice.quantiser_offset, code(choice.quantiser_offset).ljust(choice.min_bytes, b"\0")
