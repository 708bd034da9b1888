"""The quality of a live stream: of its coding, and at the skin by the models of output stage and actuator."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vibrocast import codec, models
from vibrocast.codec import Signal
from vibrocast.codec.stream import Stream
from vibrocast.host.controller import ControllerError
from vibrocast.host.end_to_end import Member, actuator_model, at_the_skin, displacement_um
from vibrocast.host.live import LiveStream
from vibrocast.host.skin_quality import COMPARED_S, SkinQuality, compare_channels, note

_MIN_S = 0.5
_MAX_VALUES = 1 << 23
"""Of all channels together: 64 MB of the source."""


@dataclass(frozen=True)
class LiveQuality:
    """The quality of a live stream.

    `snr_db`: of the decoded signal; None for silence and an exact copy. `skin`, `skin_note`: as in
    `host.report.Report`.
    """

    snr_db: float | None
    skin: SkinQuality | None
    skin_note: str | None


class CodedBeginning:
    """Keeps the beginning of a live stream: up to COMPARED_S, or to where it left out packets or began again."""

    def __init__(self, stream: LiveStream) -> None:
        self._stream = stream
        self._blocks: list[Signal] = []
        self._packets: list[bytes] = []
        self._keeps = True
        stream.on_packets = self._keep

    def blocks(self, blocks: Iterable[Signal]) -> Iterator[Signal]:
        """Yield blocks on their way to the stream."""
        for block in blocks:
            if self._keeps:
                self._blocks.append(block)
            yield block

    def _keep(self, packets: Sequence[bytes]) -> None:
        stream = self._stream
        values = len(self._packets) * stream.packet_samples * stream.format.channels
        too_many = values > _MAX_VALUES or len(self._packets) * stream.packet_s > COMPARED_S
        self._keeps = self._keeps and not (stream.dropped_packets or stream.earlier or too_many)
        if self._keeps:
            self._packets += packets

    def quality(self, member: Member, model: models.Model | None) -> LiveQuality | None:
        """Compare what was coded with its source; None where too little was. Raises CodecError."""
        header = self._stream.header
        image = None if model is None else model.image
        signal = np.concatenate([np.zeros((0, header.channels)), *self._blocks])
        empty = codec.decoder(
            header.codec_identifier, header.configuration, header.channels, None if model is None else model.tables
        )
        samples = min(len(signal), len(self._packets) * empty.packet_samples - empty.delay_samples)
        if samples < _MIN_S * header.rate_hz:
            return None
        needed = -(-(samples + empty.delay_samples) // empty.packet_samples)
        stream = Stream(replace(header, samples=samples), tuple(self._packets[:needed]), image)
        decoded, sent = stream.decode(), signal[:samples]
        snr_db = codec.snr_db(sent, decoded)
        if snr_db is not None and not math.isfinite(snr_db):
            snr_db = None
        if header.unit == "full scale":
            return LiveQuality(snr_db, None, None)
        try:
            actuator = member.skin_model or actuator_model(member.controller.description.actuator)
            moved = at_the_skin(stream, actuator)
        except ControllerError:  # no model fits what the controller says of its actuator
            return LiveQuality(snr_db, None, None)
        asked_um = [displacement_um(each, header.unit, header.rate_hz, actuator) for each in (sent, decoded)]
        skin = compare_channels(asked_um, header.rate_hz, moved.samples, moved.rate_hz)
        limited = (
            sum(getattr(self._stream.status, f"{name}_limited") for name in ("voltage", "slew", "power"))
            + self._stream.status.compensation_clipped
        )
        return LiveQuality(snr_db, skin, None if skin is None else note(snr_db, skin, header.unit, limited))
