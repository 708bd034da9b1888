"""Packets of steered streams: tried at several coarsenesses, then coded at the one that is chosen."""

from collections.abc import Callable
from dataclasses import dataclass

from vibrocast.codec.core import MAX_PACKET_BYTES
from vibrocast.codec.interface import CodecError, Signal, Steering


@dataclass(frozen=True)
class PacketTrial:
    """A codec.interface.Trial; `code` codes the packet at a coarseness and leaves the encoder as it was."""

    samples: Signal
    coarsenesses: range
    previous: int
    code: Callable[[int], bytes]

    def packet(self, coarseness: int) -> bytes:
        """Return the packet at one of the coarsenesses. Raises CodecError on others, and where it does not fit."""
        if coarseness not in self.coarsenesses:
            raise CodecError(
                f"a coarseness of {coarseness}; {self.coarsenesses[0]} to {self.coarsenesses[-1]} can be chosen here"
            )
        return self.code(coarseness)


def steered_packet(trial: PacketTrial, steering: Steering, code: Callable[[int], bytes]) -> tuple[int, bytes]:
    """Ask the steering; return the coarseness, and the packet that `code` codes at it, padded as asked.

    `code`: as that of the trial, but the encoder goes on. Raises CodecError on a choice that no packet can have.
    """
    choice = steering(trial)
    if choice.coarseness not in trial.coarsenesses or choice.least_bytes > MAX_PACKET_BYTES:
        raise CodecError(
            f"a coarseness of {choice.coarseness} in {choice.least_bytes} bytes cannot be chosen: it must be "
            f"{trial.coarsenesses[0]} to {trial.coarsenesses[-1]}, in at most {MAX_PACKET_BYTES} bytes"
        )
    return choice.coarseness, code(choice.coarseness).ljust(choice.least_bytes, b"\0")
