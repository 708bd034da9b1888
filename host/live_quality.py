"""The quality of a live stream: of its coding, at the skin, and whether the controller played what was sent."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models
from vibrocast.codec import Signal
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import Tap
from vibrocast.host.end_to_end import Member, actuator_use, at_the_skin, displacement_um, known_actuator
from vibrocast.host.live import LiveResult, LiveStream
from vibrocast.host.skin_quality import COMPARED_S, SkinQuality, compare_channels, limit_note
from vibrocast.host.stream_session import read_capture
from vibrocast.output.rendering import render

_MIN_S = 0.5
_READ_BACK_S = 5.0
"""How long reading the captures back may take."""
_MAX_VALUES = 1 << 23
"""Samples of all channels together whose packets are kept: some 50 minutes at 2800 Hz."""


@dataclass(frozen=True)
class LiveQuality:
    """The quality of a live stream.

    `snr_db`: of the decoded signal; None for silence, an exact copy, and where it was too short. `skin`, `skin_note`:
    as in `host.report.Report`, by the models of output stage and actuator. `decoded_equals_offline`,
    `dac_equals_offline`: whether the controller's captures of the end of the stream are those computed here, bit for
    bit. They are None where packets were lost, nothing is captured, or there are more than _MAX_VALUES.
    """

    snr_db: float | None = None
    skin: SkinQuality | None = None
    skin_note: str | None = None
    decoded_equals_offline: bool | None = None
    dac_equals_offline: bool | None = None

    @property
    def differs(self) -> bool:
        """Whether the controller has played something else than was sent."""
        return False in (self.decoded_equals_offline, self.dac_equals_offline)


class CodedSignal:
    """Keeps the packets of a live stream, and COMPARED_S of its source, up to where it left out packets or began again.

    Nothing is read back of a stream of more than _MAX_VALUES.
    """

    def __init__(self, stream: LiveStream) -> None:
        self._stream = stream
        self._blocks: list[Signal] = []
        self._packets: list[bytes] = []
        self._keeps = True
        stream.on_packets = self._keep

    def blocks(self, blocks: Iterable[Signal]) -> Iterator[Signal]:
        """Yield blocks on their way to the stream."""
        seconds = 0.0
        for block in blocks:
            if self._keeps and seconds < COMPARED_S:
                self._blocks.append(block)
                seconds += len(block) / self._stream.format.rate_hz
            yield block

    def _keep(self, packets: Sequence[bytes]) -> None:
        stream = self._stream
        values = len(self._packets) * stream.packet_samples * stream.format.channels
        self._keeps = self._keeps and not (stream.dropped_packets or stream.earlier or values > _MAX_VALUES)
        if self._keeps:
            self._packets += packets

    def quality(self, member: Member, model: models.Model | None, result: LiveResult) -> LiveQuality:
        """Compare the coded signal with its source, and the controller's captures with both.

        Reads the controller's captures: call it when the stream has ended. Raises CodecError, ControllerError,
        TransportError.
        """
        if not self._packets:
            return LiveQuality()
        header = replace(self._stream.header, samples=None)
        stream = Stream(header, tuple(self._packets), None if model is None else model.image)
        quality = self._of_coding(member, stream)
        if not self._keeps or result.lost_packets or result.underruns or result.streams > 1:
            return quality
        decoded, computed = self._as_sent(member, stream)
        return replace(quality, decoded_equals_offline=decoded, dac_equals_offline=computed)

    def _of_coding(self, member: Member, whole: Stream) -> LiveQuality:
        """Return the quality of coding, and at the skin by models; empty where the stream was too short."""
        header, empty = whole.header, whole.decoder()
        signal = np.concatenate([np.zeros((0, header.channels)), *self._blocks])
        samples = min(len(signal), len(self._packets) * empty.packet_samples - empty.delay_samples)
        if samples < _MIN_S * header.rate_hz:
            return LiveQuality()
        needed = -(-(samples + empty.delay_samples) // empty.packet_samples)
        stream = replace(whole, header=replace(header, samples=samples), packets=whole.packets[:needed])
        decoded, sent = stream.decode(), signal[:samples]
        snr_db = codec.snr_db(sent, decoded)
        if snr_db is not None and not math.isfinite(snr_db):
            snr_db = None
        if header.unit == "full scale":
            return LiveQuality(snr_db)
        actuator = member.skin_model or known_actuator(member)
        if actuator is None:
            return LiveQuality(snr_db)
        moved = at_the_skin(stream, actuator)
        asked_um = [displacement_um(each, header.unit, header.rate_hz, actuator) for each in (sent, decoded)]
        skin = compare_channels(asked_um, header.rate_hz, moved.samples, moved.rate_hz)
        if skin is None:
            return LiveQuality(snr_db)
        use = actuator_use(known_actuator(member) or actuator, actuator, self._stream.status)
        return LiveQuality(snr_db, skin, limit_note(skin, use.gains_db, use.limited_samples))

    def _as_sent(self, member: Member, stream: Stream) -> tuple[bool | None, bool | None]:
        """Return whether the controller decoded the end of the stream and computed its DAC codes as this computer."""
        controller, header = member.controller, stream.header
        if not controller.description.limits.capture_samples:
            return None, None
        offline = stream.decode_integers()
        values = _READ_BACK_S * self._stream.link_bytes_per_second / len(Tap) / offline.itemsize
        newest = int(min(values / header.channels, controller.description.limits.capture_samples))
        as_decoded = _ends_as(member, Tap.DECODED, offline, newest)
        actuator = known_actuator(member)
        if actuator is None:
            return as_decoded, None
        codes, _ = render(header, offline, stream.decoder().delay_samples, actuator)
        return as_decoded, _ends_as(member, Tap.DAC, codes, newest)


def _ends_as(member: Member, tap: Tap, computed: NDArray[np.int16], newest: int) -> bool:
    """Return whether a capture ends as it was computed. `newest`: samples per channel to compare, or fewer."""
    first, kept = read_capture(member.controller, tap, computed.shape[1], newest)
    return first + len(kept) == len(computed) and np.array_equal(kept, computed[first:])
