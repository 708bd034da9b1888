"""The report of a playback in words, a line for each figure that it has."""

from collections.abc import Iterator

import click

from vibrocast.codec.stream import CodingQuality, Stream
from vibrocast.codec.threshold import FeltError
from vibrocast.device_protocol.coded_stream import packet_sequence
from vibrocast.host.cli.answers import wants_json
from vibrocast.host.cli.steps import show
from vibrocast.host.figures import FIGURES
from vibrocast.host.report import UP_TO_DAC_CALL, ActuatorUse, LiveFigures, Quality, Report, SkinQuality, Touch
from vibrocast.output.actuator import FOLLOWED_DB
from vibrocast.output.sound_card import CardUse

ANSWERS = {True: "yes", False: "NO", None: "not compared"}
_WHOLE_PERCENT = 99.5  # two digits would be 1e+02
SILENT_DB = -200.0
"""Re detection threshold: below it the output is at rest."""


def summary(report: Report, packets: str | None = None) -> dict[str, object]:
    """Return the lines that a command prints at the end of a playback, by their names; `packets` is one of them."""
    lines = {
        "coded": describe_snr(report.quality) if report.position is None else None,
        "removed": describe_removed(report.quality) if report.position is None else None,
        "felt error": describe_felt_error(report.quality.felt_error)
        if report.stream_bytes and not report.position
        else None,
        "actuator": describe_actuator(report),
        "played": describe_played(report),
        "stream": describe_stream(report),
        "packets": packets,
        "wire": describe_wire(report),
        FIGURES["latency_ms"].label: describe_latency(report),
        FIGURES["underruns"].label: describe_losses(report),
        "sound card": None if report.sound_card is None else describe_card(report.sound_card),
        "limits": describe_limits(report.actuator),
        "touch": None if report.quality.touch is None else describe_touch(report.quality.touch),
        "losses": None if report.live is None else describe_minutes(report.live),
        FIGURES["as_decoded"].label: None
        if report.position
        else describe_comparison(report.decoded_equals_offline, report),
        FIGURES["as_computed"].label: describe_dac(report),
    }
    return {name: line for name, line in lines.items() if line}


def describe_played(report: Report) -> str:
    """Return what was played, for how long, and how, in words."""
    if report.position is not None:
        return (
            f"{report.file}, {report.position.length_mm:.2f} mm, under a hand at up to "
            f"{report.position.fastest_mm_s:.0f} mm/s for {report.seconds:.2f} s"
        )
    times = "live" if report.live is not None else "once" if report.loops == 1 else f"{report.loops} times"
    channels = "1 channel" if report.channels == 1 else f"{report.channels} channels"
    return f"{report.file}, {report.seconds:.2f} s, {channels}, {times}"


def describe_stream(report: Report) -> str | list[str]:
    """Return the size and the rate of what was coded, and by which codec, in words."""
    coded = f"codec {report.codec}" + (f", model {report.model}" if report.model else "")
    if report.position is not None:
        return f"{report.stream_bytes} bytes, {report.position.bits_per_mm:.0f} bit/mm, {coded}"
    if report.live is not None:
        live = report.live
        return [
            f"{live.payload_bits_per_second:.0f} bit/s, with frames {live.wire_bits_per_second:.0f} bit/s "
            f"(+{100 * live.wire_adds:.1f} %)",
            f"packets of {live.packet_ms:.1f} ms, {coded}",
        ]
    rate = f"{report.bits_per_second:.0f} bit/s, {report.bits_per_sample:.2f} bit/sample"
    return f"{report.stream_bytes} bytes, {rate}, {coded}"


def describe_wire(report: Report) -> str:
    """Return what crossed the wire, and what went wrong on it, in words."""
    wire = report.wire
    sizes = "" if wire.bytes_received is None else f"{wire.bytes_sent} bytes sent, {wire.bytes_received} received, "
    repeated = f", repeated {wire.repeated_frames}" if wire.repeated_frames else ""
    reordered = f", reordered {wire.reordered_frames}" if wire.reordered_frames else ""
    return f"{sizes}damaged frames {wire.bad_frames} there, {wire.bad_frames_back} back{repeated}{reordered}"


def describe_latency(report: Report) -> str | None:
    """Return the delay and its parts, in words; None where nothing is known of it."""
    timing = report.timing
    if report.live is not None:
        delay = f"playout delay {report.live.playout_delay_ms:.0f} ms"
        if timing.end_to_end_ms is None:
            return delay
        jitter = "" if report.timing.jitter_ms is None else f", jitter of arrivals {report.timing.jitter_ms:.1f} ms"
        return f"{timing.end_to_end_ms:.1f} ms to the skin{jitter}; {delay}"
    if timing.end_to_end_ms is None:
        return None
    parts = f"{timing.algorithmic_ms:.1f} ms codec + {timing.buffered_ms:.1f} ms buffer"
    return f"{parts}, {timing.end_to_end_ms:.1f} ms to the skin"


def describe_losses(report: Report) -> str:
    """Return what came too late or was lost, in words."""
    if report.position is not None:
        return f"{report.underruns} of {report.position.positions} positions came too late"
    if report.live is None:
        return f"{report.underruns}, lost packets {report.lost_packets}, reconnects {report.reconnects}"
    dropped = report.live.dropped_packets
    unsent = f", {dropped} of them not sent, because too late" if dropped else ""
    restarts = f", restarts {report.live.streams - 1}" if report.live.streams > 1 else ""
    live = report.live
    left_out = f", packets left out as too old {live.left_out_packets}" if live.left_out_packets else ""
    pauses = f", pauses {live.pauses}{left_out}" if live.pauses else ""
    return f"{report.underruns}, lost packets {report.lost_packets} of {report.packets}{unsent}{restarts}{pauses}"


def describe_minutes(live: LiveFigures) -> list[str]:
    """Return a line for each minute of a live stream that lost something."""
    lines = []
    for minute in live.minutes:
        if minute.cause is not None:
            late = "" if minute.host_late_ms is None else f", host up to {minute.host_late_ms:.0f} ms late"
            lost = f"underruns {minute.underruns}, lost packets {minute.lost_packets}, restarts {minute.restarts}"
            lines.append(f"from {minute.from_s:.0f} s: {lost}{late}; cause: {minute.cause}")
    return lines


def warnings(report: Report) -> Iterator[str]:
    """Yield what a person should know of a playback: nothing to feel, a busy computer, a bad wire."""
    if report.quality.touch is not None and report.quality.touch.level_db <= 0:
        yield "nobody would feel this; raise --gain-db, or encode it with the right --unit"
    if (card := report.sound_card) is not None and card.underruns:
        yield f"{card.name} had nothing to play {card.underruns} time(s) and came to rest; close other programs"
    if report.live is not None and (report.wire.repeated_frames or report.wire.reordered_frames):
        yield "frames came twice or out of order; check what stands between this computer and the controller"
    if report.live is not None and (report.wire.bad_frames or report.wire.bad_frames_back):
        yield "frames were damaged on the wire; check cable, connectors and baud rate"
    elif report.live is not None and report.lost_packets:
        least_ms = report.live.playout_delay_ms
        yield f"packets were late or lost on a busy computer or link; pass a --playout-delay-ms above {least_ms:.0f}"


def tell_report(report: Report, packets: str | None = None) -> None:
    """Print a report and warnings; `packets`: of the stream, in words."""
    if not wants_json():
        show(summary(report, packets))
    for warning in warnings(report):
        click.echo(f"warning: {warning}", err=True)


def describe_comparison(equal: bool | None, report: Report) -> str:
    """Return whether what was read back is as computed, or why that is not known."""
    return f"{ANSWERS[equal]}: {report.comparison_note}" if equal is None and report.comparison_note else ANSWERS[equal]


def describe_dac(report: Report) -> str:
    """Return whether the DAC's codes are as computed, and up to where that was seen."""
    answer = describe_comparison(report.dac_equals_offline, report)
    return f"{answer}, {UP_TO_DAC_CALL}" if report.dac_equals_offline else answer


def describe_touch(touch: Touch) -> str:
    """Return how far the skin's vibration exceeds the detection threshold, in words."""
    if touch.level_db > 0:
        return f"peak {touch.level_db:+.0f} dB re detection threshold at {touch.frequency_hz:.0f} Hz"
    level = f"peak {touch.level_db:.0f} dB at {touch.frequency_hz:.0f} Hz" if touch.level_db > SILENT_DB else "silence"
    return f"nothing exceeds the detection threshold ({level})"


def describe_packets(stream: Stream, given_samples: int) -> str:
    """Return how long the packets of a stream are, and how often one can be decoded alone, in words.

    `given_samples`: samples of a packet before it was split for the controller; 0 = none was.
    """
    packet_samples = stream.packet_samples
    packet_s = packet_samples / stream.header.rate_hz
    alone = [number for number, packet in enumerate(stream.packets) if packet_sequence(packet)[1]]
    often = f"one in {packet_s * (alone[1] - alone[0]):.2f} s" if len(alone) > 1 else "only the first"
    longer = given_samples / packet_samples
    split = f", split from {1000 * packet_s * longer:.1f} ms for this controller" if longer > 1 else ""
    return f"{1000 * packet_s:.1f} ms each, {often} can be decoded alone{split}"


def describe_snr(quality: CodingQuality | Quality) -> str:
    """Return the SNR of a coded recording in words."""
    if quality.snr_db is None:
        return "SNR unknown (silent, lossless, or coded before)"
    return f"SNR {quality.snr_db:.2f} dB"


def describe_removed(quality: CodingQuality | Quality) -> str:
    """Return the parts of the energy that were removed before coding, in words; empty for none."""
    removed = []
    if quality.highpass_hz is not None:
        removed.append(f"{_percent(quality.removed_below)} of the energy below {quality.highpass_hz:g} Hz")
    if quality.lowpass_hz is not None:
        removed.append(f"{_percent(quality.removed_above)} of the rest above {quality.lowpass_hz:g} Hz")
    return ", ".join(removed)


def _percent(part: float | None) -> str:
    """Return a part of the energy, 0 to 1, in percent."""
    percent = 100 * (part or 0.0)
    return f"{percent:.2g} %" if percent < _WHOLE_PERCENT else f"{percent:.0f} %"


def describe_felt_error(error: FeltError | None) -> str:
    """Return in words how far the error exceeds the detection threshold, where it does so most."""
    if error is None:
        return "unknown (no error, no unit, or coded before)"
    level = f"at most {error.level_db:+.0f} dB re threshold, at {error.frequency_hz:.0f} Hz"
    felt = level if error.level_db > 0 else f"none is felt: {level}"
    return f"{felt}; the texture there {error.texture_db:+.0f} dB"


def describe_skin(skin: SkinQuality | None, note: str | None) -> list[str]:
    """Return the SNR at the skin that the threshold of touch weights, the gain, and what limits the actuator."""
    if skin is None:
        return ["not aligned: the skin does not move as the texture does"]
    parts = []
    if skin.weighted_snr_db is not None:
        parts.append(f"{skin.weighted_snr_db:.1f} dB with the codec")
    if skin.weighted_playing_snr_db is not None:
        parts.append(f"{skin.weighted_playing_snr_db:.1f} dB without")
    ratio = f"weighted SNR {', '.join(parts)}" if parts else "weighted SNR unknown"
    gain = f", gain {skin.gain:.2f}" if skin.gain is not None else ""
    return [f"{ratio}{gain}", *([note] if note else [])]


def describe_actuator(report: Report) -> list[str]:
    """Return lines with the band that the actuator follows, and the quality at the skin."""
    use = report.actuator
    band = "in no band" if use.follows_hz is None else "from {:.0f} to {:.0f} Hz".format(*use.follows_hz)
    skin = describe_skin(report.quality.skin, report.quality.skin_note)
    return [f"{use.name} follows within {FOLLOWED_DB:g} dB {band}", *skin]


def describe_limits(use: ActuatorUse) -> str:
    """Return how many DAC samples each limit of an actuator held back, in words."""
    return (
        f"stroke {use.clipped_samples}, voltage {use.voltage_limited}, slew {use.slew_limited}, "
        f"power {use.power_limited} DAC samples held back"
    )


def describe_card(card: CardUse) -> list[str]:
    """Return lines with how a sound card plays."""
    channels = ", ".join(map(str, card.channels))
    return [
        f"{card.name}, {card.backend}, channels {channels}",
        f"{card.rate_hz} Hz, {card.full_scale_volts:g} V at full scale",
        f"period {card.period_ms:g} ms, latency {card.latency_ms:g} ms, underruns {card.underruns}",
    ]
