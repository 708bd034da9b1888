"""Writes HJIF documents as HMPG, for tests: bit by bit, from the layout in ISO/IEC 23090-31."""

from typing import Any

BANDS = ("Transient", "Curve", "VectorialWave", "WaveletWave")
CURVES = ("Unknown", "Cubic", "Linear", "Akima", "Bezier", "Bspline")
EFFECTS = ("Basis", "Reference", "Composite")
SIGNALS = ("Sine", "Square", "Triangle", "SawToothUp", "SawToothDown")
MODALITIES = {"Other": 0, "Vibrotactile": 6, "Stiffness": 11}

Json = dict[str, Any]
Fields = list[tuple[int, int]]


def packed(fields: Fields) -> bytes:
    """Return (bits, value) one after another, the last byte filled with zeros."""
    text = "".join(f"{value % (1 << bits):0{bits}b}" for bits, value in fields if bits)
    return bytes(int(text[place : place + 8].ljust(8, "0"), 2) for place in range(0, len(text), 8))


def scaled(bits: int, value: float, low: float, high: float) -> tuple[int, int]:
    return bits, round((value - low) / (high - low) * ((1 << bits) - 1))


def text(content: str) -> Fields:
    return [(8, len(content)), *((8, ord(letter)) for letter in content)]


def packet(kind: int, fields: Fields) -> bytes:
    payload = packed(fields)
    return packed([(6, kind), (17, len(payload)), (1, 0)]) + payload


def unit(kind: int, duration: int, *packets: bytes) -> bytes:
    payload = b"".join(packets)
    return packed([(6, kind), (2, 0), (4, 0), (24, duration), (32, len(payload)), (4, 0)]) + payload


def wave(effect: Json) -> Fields:
    return [scaled(16, effect.get("phase", 0), 0, 6.28318), (4, SIGNALS.index(effect.get("base_signal", "Sine")))]


def library(number: int, effects: list[Json]) -> bytes:
    fields: Fields = [(8, number), (16, len(effects))]
    for effect in effects:
        fields += [(16, effect["id"]), (2, 0), (1, 0), (25, 0), *wave(effect), (16, len(effect["keyframes"]))]
        for each in effect["keyframes"]:
            fields += [(3, 7), (16, each["relative_position"]), scaled(8, each["amplitude_modulation"], -1, 1)]
            fields += [(16, each["frequency_modulation"])]
        fields += [(16, 0)]
    return packet(6, fields)


def keyframe(kind: str, each: Json) -> Fields:
    amplitude, frequency = each.get("amplitude_modulation"), each.get("frequency_modulation")
    position = (16, each["relative_position"])
    if kind == "VectorialWave":
        mask = (amplitude is not None) + 2 * (frequency is not None)
        fields = [scaled(8, amplitude, -1, 1)] if amplitude is not None else []
        return [(2, mask), *fields, position, *([(16, frequency)] if frequency is not None else [])]
    return [scaled(8, amplitude or 0, -1, 1), position, *([(16, frequency)] if kind == "Transient" else [])]


def hmpg(document: Json, unit_ticks: int) -> bytes:
    """Return a document as a stream of units of so many ticks; each keyframe is in the unit of its time."""
    packets = [packet(11, [(32, 0), (32, document["timescale"]), (24, 0), (24, 0), (1, 0)])]
    packets += [packet(1, text("2023") + text("Main") + [(8, 1)]), packet(63, [(8, 255)])]
    data: dict[int, list[bytes]] = {0: []}
    for number, perception in enumerate(document["perceptions"]):
        count = len(perception["effect_library"])
        modality = MODALITIES[perception["perception_modality"]]
        exponent = perception.get("perception_unit_exponent", 0)
        fields = [(8, number), (8, 0), *text("felt"), (8, modality), (8, 0), (16, count), (1, 1), *text("scheme")]
        packets.append(packet(2, [*fields, (8, -3), (8, exponent), (8, 0), (16, len(perception["channels"]))]))
        packets.append(library(number, perception["effect_library"]))
        for channel_number, channel in enumerate(perception["channels"]):
            fields = [(16, channel_number), (8, number), (8, 0), *text("hand"), (8, 255)]
            packets.append(packet(3, [*fields, scaled(32, channel["gain"], -10_000, 10_000), (32, 0), (8, 0), (32, 0)]))
            for band_number, band in enumerate(channel["bands"]):
                address = [(8, number), (16, channel_number), (8, band_number)]
                kind = band["band_type"]
                own = {"Curve": [(4, CURVES.index(band.get("curve_type", "Unknown")))], "WaveletWave": [(8, 128)]}
                fields = [(8, band_number), (8, number), (16, channel_number), (8, 0), (3, BANDS.index(kind))]
                limits = [(16, band["lower_frequency_limit"]), (16, band["upper_frequency_limit"])]
                packets.append(packet(4, [*fields, *own.get(kind, []), *limits, (16, len(band["effects"]))]))
                for place, effect in enumerate(band["effects"]):
                    for start, fields in pieces(kind, place, effect, unit_ticks).items():
                        data.setdefault(start, []).append(packet(5, [(1, 0), *address, (16, 1), *fields]))
    units = [unit(0, 0, *packets)]
    for start in range(0, max(data) + unit_ticks, unit_ticks):
        units.append(unit(1, unit_ticks, *data[start]) if data.get(start) else unit(3, unit_ticks))
    return b"".join(units)


def pieces(kind: str, place: int, effect: Json, unit_ticks: int) -> dict[int, Fields]:
    """Return the fields of an effect by the start of the unit that has them."""

    def header(start: int) -> Fields:
        number = effect["id"] if effect["effect_type"] == "Reference" else place
        return [(16, number), (2, EFFECTS.index(effect["effect_type"])), (25, effect["position"] - start)]

    if effect["effect_type"] != "Basis":
        start = effect["position"] // unit_ticks * unit_ticks
        return {start: header(start)}
    frames: dict[int, list[Json]] = {}
    for each in effect.get("keyframes", []):
        frames.setdefault((effect["position"] + each["relative_position"]) // unit_ticks * unit_ticks, []).append(each)
    result = {}
    for start, listed in frames.items():
        shape = wave(effect) if kind == "VectorialWave" else []
        keyframes = [field for each in listed for field in keyframe(kind, each)]
        result[start] = [*header(start), (1, 0), (16, len(listed)), *shape, *keyframes]
    return result
