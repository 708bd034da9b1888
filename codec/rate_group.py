"""Streams whose packets are due together, under one constant rate."""

import math
from collections.abc import Callable, Sequence

from vibrocast.codec.interface import Choice, CodecError, Decoder, Signal, Trial
from vibrocast.codec.rate_control import ConstantRate, FrameBytes, Policy


class Group:
    """Several streams whose packets are due together, under one constant rate for the sum of their bytes.

    All have the same quantiser offset. If that means the same step in a physical unit in all of them, the bits go where
    the power is: reverse water-filling (Cover and Thomas, Elements of Information Theory, 2nd ed., 10.3.3). `members`:
    the policies for the streams' encoders, one each.
    """

    def __init__(self, policy: ConstantRate, streams: int) -> None:
        self.policy = policy
        self.members = tuple(_Member(self, index, policy.sent_bytes) for index in range(streams))
        self._trials: dict[int, Trial] = {}
        self._choices: dict[int, Choice] = {}
        self._seconds = math.nan
        self._min_bytes: dict[int, int] = {}
        self._code_next: Callable[[int], None] | None = None

    def code(self, coders: Sequence[Callable[[Signal], list[bytes]]], blocks: Sequence[Signal]) -> list[list[bytes]]:
        """Code one packet of each stream; return the packets.

        `coders`: the `encode` of each encoder, or a function that calls it. `blocks`: one packet's samples of each
        stream. Raises CodecError for blocks that make more than one packet, and as the encoders do.
        """
        packets: list[list[bytes]] = [[] for _ in self.members]
        self._trials, self._choices = {}, {}

        # Each encoder waits for its choice while the next one makes its trial. After the last one, all are chosen.
        def code_from(index: int) -> None:
            if index == len(self.members):
                chosen = self.policy.choose(list(self._trials.values())) if self._trials else []
                self._choices = dict(zip(self._trials, chosen, strict=True))
                return
            packets[index] = coders[index](blocks[index])
            if index not in self._trials:  # it completed no packet
                code_from(index + 1)

        self._code_next = code_from
        try:
            code_from(0)
        finally:
            self._code_next = None
        return packets

    def begin(self, index: int, decoder: Decoder, min_bytes: int, seconds: float) -> None:
        """Begin the stream of one member; see Policy. Raises CodecError if its packets have another duration."""
        if self._min_bytes and not math.isclose(seconds, self._seconds):
            raise CodecError(
                "streams that share a rate need packets of one duration; give all streams the same framing"
            )
        self._seconds = seconds
        self._min_bytes[index] = min_bytes
        self.policy.begin(decoder, sum(self._min_bytes.values()), seconds)

    def choose(self, index: int, trial: Trial) -> Choice:
        """Choose for one member when all have made their trials. Raises CodecError outside `code`."""
        if self._code_next is None or index in self._trials:
            raise CodecError("streams that share a rate are coded together; pass one packet of each to `Group.code`")
        self._trials[index] = trial
        self._code_next(index + 1)
        return self._choices[index]


class _Member(Policy):
    """The policy of one stream of a group."""

    def __init__(self, group: Group, index: int, frame_bytes: FrameBytes) -> None:
        super().__init__()
        self._group, self._index = group, index

    def begin(self, decoder: Decoder, min_bytes: int, seconds: float) -> None:
        """Begin a stream; see Policy."""
        super().begin(decoder, min_bytes, seconds)
        self._group.begin(self._index, decoder, min_bytes, seconds)

    def sent_bytes(self, packet: bytes) -> int:
        """Return the bytes of a packet and its frame."""
        return self._group.policy.sent_bytes(packet)

    def __call__(self, trial: Trial) -> Choice:
        """Choose with the others of the group."""
        return self._group.choose(self._index, trial)
