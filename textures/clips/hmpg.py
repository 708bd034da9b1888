"""Reads HMPG clips, the binary form of HJIF (ISO/IEC 23090-31): units of packets of bit fields, big-endian."""

from typing import Any

from vibrocast.textures.clips import hjif
from vibrocast.textures.clips.synthesis import MAX_PARTS, Clip

_SPATIAL_MODALITIES = {10: "Vibrotactile Texture", 11: "Stiffness", 12: "Friction"}
_BANDS = ("Transient", "Curve", "VectorialWave", "WaveletWave")
_CURVES = ("Unknown", "Cubic", "Linear", "Akima", "Bezier", "Bspline")
_EFFECTS = ("Basis", "Reference", "Composite")
_SIGNALS = ("Sine", "Square", "Triangle", "SawToothUp", "SawToothDown")
_MAX_PHASE, _MAX_GAIN = 6.28318, 10_000.0
_GAIN_DIGITS = 3
"""Behind the point; further ones are noise, because the reference software computes gains in float32."""
_POSITION, _AMPLITUDE, _FREQUENCY = "relative_position", "amplitude_modulation", "frequency_modulation"


class _Bits:
    """Bit fields, read one after another. Raises ValueError behind the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._position = data, 0

    def number(self, bits: int) -> int:
        """Return the next field, a number without a sign."""
        first, end = self._position, self._position + bits
        if end > 8 * len(self._data):
            raise ValueError("it is cut off")
        self._position = end
        return int.from_bytes(self._data[first // 8 : (end + 7) // 8], "big") >> -end % 8 & (1 << bits) - 1

    def signed(self, bits: int) -> int:
        """Return the next field, a number in two's complement."""
        value = self.number(bits)
        return value - (value >> bits - 1 << bits)

    def scaled(self, bits: int, low: float, high: float) -> float:
        """Return the next field, whose least number stands for `low`, and its greatest for `high`."""
        return low + (high - low) * self.number(bits) / ((1 << bits) - 1)

    def word(self, bits: int, words: tuple[str, ...]) -> Any:
        """Return the word whose number is the next field."""
        number = self.number(bits)
        if number >= len(words):
            raise ValueError(f"{number} is the number of none of {', '.join(words)}")
        return words[number]

    def skip_text(self) -> None:
        """Pass a text."""
        self.number(8 * self.number(8))

    def skip_keywords(self) -> None:
        """Pass the semantic keywords of an effect."""
        self.number(12 * self.number(1))

    def keyframe(self, *fields: str) -> hjif.Keyframe:
        """Return a keyframe that has these fields, in this order."""
        values: dict[str, Any] = {
            name: self.scaled(8, -1, 1) if name == _AMPLITUDE else self.number(16) for name in fields
        }
        return hjif.Keyframe(**values)


class _Stream:
    """A stream, as far as it was read."""

    def __init__(self) -> None:
        self.timescale = 1000
        self.unit_ticks = 0
        """When the unit begins."""
        self.perceptions: dict[int, hjif.Perception] = {}
        self._channels: dict[tuple[int, int], hjif.ClipChannel] = {}
        self._bands: dict[tuple[int, int, int], hjif.Band] = {}
        self._effects: dict[tuple[int, int, int, int], hjif.Effect] = {}
        self._count = 0
        self._readers = {
            2: self._read_perception,
            3: self._read_channel,
            4: self._read_band,
            5: self._read_effects,
            6: self._read_library,
            11: self._read_timing,
        }
        """By the type of a packet. Others are avatars, checksums and texts for people."""

    def read_packets(self, unit: bytes) -> None:
        """Read the packets of a unit. Raises ValueError for one that is cut off."""
        position = 0
        while position < len(unit):
            header = _Bits(unit[position : position + 3])
            kind, length, _ = header.number(6), header.number(17), header.number(1)
            position += 3 + length
            if position > len(unit):
                raise ValueError("it is cut off")
            if kind in self._readers:
                self._readers[kind](_Bits(unit[position - length : position]))

    def _read_timing(self, bits: _Bits) -> None:
        bits.number(32)  # the time at which the stream began
        self.timescale = max(bits.number(32), 1)

    def _read_perception(self, bits: _Bits) -> None:
        number, _ = bits.number(8), bits.number(8)
        bits.skip_text()
        modality, _, _ = bits.number(8), bits.number(8), bits.number(16)
        if bits.number(1):
            bits.skip_text()
        _, exponent = bits.number(8), bits.signed(8)
        self.perceptions[number] = hjif.Perception(_SPATIAL_MODALITIES.get(modality, "Other"), exponent)

    def _read_channel(self, bits: _Bits) -> None:
        number, perception, _ = bits.number(16), bits.number(8), bits.number(8)
        bits.skip_text()
        bits.number(8)
        gain = round(bits.scaled(32, -_MAX_GAIN, _MAX_GAIN), _GAIN_DIGITS)
        channel = self._channels[perception, number] = hjif.ClipChannel(gain)
        self._of(self.perceptions, perception).channels.append(channel)

    def _read_band(self, bits: _Bits) -> None:
        number, perception, channel, _ = bits.number(8), bits.number(8), bits.number(16), bits.number(8)
        band = self._bands[perception, channel, number] = hjif.Band(bits.word(3, _BANDS))
        if band.band_type == "Curve":
            band.curve_type = bits.word(4, _CURVES)
        elif band.band_type == "WaveletWave":
            bits.number(8)
        band.lower_frequency_limit, band.upper_frequency_limit = bits.number(16), bits.number(16)
        self._of(self._channels, (perception, channel)).bands.append(band)

    def _read_library(self, bits: _Bits) -> None:
        perception = self._of(self.perceptions, bits.number(8))
        for _ in range(bits.number(16)):
            effect = self._new_effect(bits)
            bits.skip_keywords()
            bits.number(25)
            if effect.effect_type == "Basis":
                effect.phase, effect.base_signal = bits.scaled(16, 0, _MAX_PHASE), bits.word(4, _SIGNALS)
            for _ in range(bits.number(16)):
                mask = bits.number(3)
                fields = (name for bit, name in enumerate((_POSITION, _AMPLITUDE, _FREQUENCY)) if mask >> bit & 1)
                effect.keyframes.append(bits.keyframe(*fields))
            if bits.number(16):
                raise ValueError("a composite effect is in its library")
            perception.effect_library.append(effect)

    def _read_effects(self, bits: _Bits) -> None:
        bits.number(1)
        address = (bits.number(8), bits.number(16), bits.number(8))
        band = self._of(self._bands, address)
        for _ in range(bits.number(16) if band.band_type != "WaveletWave" else 0):
            effect = self._new_effect(bits)
            effect.position = self.unit_ticks + bits.signed(25)
            known = effect
            if effect.effect_type == "Basis":
                # It goes on in later units under its number, which is that of the library in a reference.
                known = self._effects.setdefault((*address, effect.id), effect)
                self._read_keyframes(bits, band, known)
            if known is effect:
                band.effects.append(effect)

    def _read_keyframes(self, bits: _Bits, band: hjif.Band, effect: hjif.Effect) -> None:
        bits.skip_keywords()
        count = bits.number(16)
        if band.band_type == "VectorialWave":
            effect.phase, effect.base_signal = bits.scaled(16, 0, _MAX_PHASE), bits.word(4, _SIGNALS)
        for _ in range(count):
            if band.band_type == "VectorialWave":
                mask = bits.number(2)
                fields = [_AMPLITUDE] * (mask & 1) + [_POSITION] + [_FREQUENCY] * (mask >> 1)
            else:
                fields = [_AMPLITUDE, _POSITION] + [_FREQUENCY] * (band.band_type == "Transient")
            effect.keyframes.append(bits.keyframe(*fields))

    def _new_effect(self, bits: _Bits) -> hjif.Effect:
        self._count += 1
        if self._count > MAX_PARTS:
            raise ValueError(f"more than {MAX_PARTS} effects")
        return hjif.Effect(id=bits.number(16), effect_type=bits.word(2, _EFFECTS))

    @staticmethod
    def _of(known: dict[Any, Any], number: Any) -> Any:
        """Return what was numbered so before."""
        if number not in known:
            raise ValueError(f"a packet is for {number}, and none before it introduces that")
        return known[number]


def read(data: bytes) -> Clip:
    """Return what an HMPG file describes. Raises ValueError, and TextureError as of HJIF."""
    stream, position = _Stream(), 0
    while position < len(data):
        header = _Bits(data[position : position + 9])
        kind, _, _, duration = header.number(6), header.number(2), header.number(4), header.number(24)
        length = header.number(32)
        position += 9 + length
        if position > len(data):
            raise ValueError("it is cut off")
        if kind in (0, 1):  # initialization and temporal; the others are over position, or silent
            stream.read_packets(data[position - length : position])
        stream.unit_ticks += duration
    return hjif.clip_of(hjif.Document(list(stream.perceptions.values()), stream.timescale))
