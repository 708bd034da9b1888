"""Steps that several subcommands share: check arguments, encode with a progress bar, print facts."""

from collections.abc import Mapping
from pathlib import Path

import click

from vibrocast import models, progress, textures
from vibrocast.codec import profiles
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, Encoding, encode_recording
from vibrocast.codec.stream import CodingQuality
from vibrocast.codec.threshold import FeltError
from vibrocast.files import plain
from vibrocast.host.cli.answers import add, wants_json
from vibrocast.host.cli.options import QualityOptions, RecordingOptions
from vibrocast.host.report import ActuatorUse, Report, StrokeReport
from vibrocast.host.skin_quality import SkinQuality
from vibrocast.output.actuator import FOLLOWED_DB
from vibrocast.output.sound_card import CardUse


def files_of(model: models.Model | None) -> list[Path]:
    """Return the files that a model was read from, as far as another could be written over them."""
    return [model.path] if model else []


def encoded(recording: textures.Recording, quality: QualityOptions, unit: str | None, live: bool) -> Encoding:
    """Encode a recording, whose --unit this is, show how far it is, and say what was not met."""
    with progress.bar("encoding") as update:
        return _noted(encode_recording(recording, live=live, progress=update, **quality.arguments(unit)))


def encoded_profile(file: Path, quality: QualityOptions, recording: RecordingOptions) -> Encoding:
    """Encode a height profile as a spatial stream, show how far it is, and say what was not met."""
    if quality.rate_bps is not None or quality.stream_rate_hz != DEFAULT_STREAM_RATE_HZ:
        raise click.UsageError(
            f"{file}: a height profile has no time, so no rates; give --snr-db, or --hand-speed-mm-s to code it over "
            "time"
        )
    arguments = quality.arguments()
    del arguments["rate_bps"], arguments["stream_rate_hz"], arguments["highpass_hz"]  # heights keep their own rules
    profile = profiles.recording_of(file, **recording.facts())
    with progress.bar("encoding") as update:
        return _noted(profiles.encode(profile, progress=update, **arguments))


def _noted(encoding: Encoding) -> Encoding:
    """Return an encoding, and say on stderr what it did not meet."""
    if note := encoding.quality.note:
        click.echo(f"note: {note}", err=True)
    return encoding


def describe_quality(quality: CodingQuality | Report) -> str:
    """Return the SNR of a coded recording, and the parts of its energy that were removed before, in words."""
    if quality.snr_db is None:
        text = "SNR unknown (silent, lossless, or coded before)"
    else:
        text = f"SNR {quality.snr_db:.2f} dB"
    removed = []
    if quality.highpass_hz is not None:
        removed.append(f"{_percent(quality.removed_below)} of the energy below {quality.highpass_hz:g} Hz")
    if quality.lowpass_hz is not None:
        removed.append(f"{_percent(quality.removed_above)} of the rest above {quality.lowpass_hz:g} Hz")
    return f"{text}; removed: {', '.join(removed)}" if removed else text


def _percent(part: float | None) -> str:
    """Return a part of the energy, 0 to 1, in percent."""
    return f"{100 * (part or 0.0):.2g} %"


def describe_felt_error(error: FeltError | None) -> str:
    """Return in words how far the error exceeds the detection threshold, where it does so most."""
    if error is None:
        return "unknown (no error, no unit, or coded before)"
    level = f"at most {error.level_db:+.0f} dB re threshold, at {error.frequency_hz:.0f} Hz"
    felt = level if error.level_db > 0 else f"none is felt: {level}"
    return f"{felt}; the texture there {error.texture_db:+.0f} dB"


ANSWERS = {True: "yes", False: "NO", None: "not compared"}


def describe_skin(skin: SkinQuality | None, note: str | None) -> str:
    """Return the SNR at the skin that the threshold of touch weights, the gain, and what limits the actuator."""
    if skin is None:
        return "not aligned: the skin does not move as the texture does"
    parts = []
    if skin.weighted_snr_db is not None:
        parts.append(f"{skin.weighted_snr_db:.1f} dB with the codec")
    if skin.weighted_playing_snr_db is not None:
        parts.append(f"{skin.weighted_playing_snr_db:.1f} dB without")
    ratio = f"weighted SNR {', '.join(parts)}" if parts else "weighted SNR unknown"
    gain = f", gain {skin.gain:.2f}" if skin.gain is not None else ""
    return f"{ratio}{gain}" + (f"; {note}" if note else "")


def describe_actuator(report: Report | StrokeReport, note: str | None) -> str:
    """Return in words the band that the actuator follows, and the quality at the skin; `note`: what limits it."""
    use = report.actuator
    band = "in no band" if use.follows_hz is None else "from {:.0f} to {:.0f} Hz".format(*use.follows_hz)
    return f"{use.name} follows within {FOLLOWED_DB:g} dB {band}; {describe_skin(report.skin, note)}"


def describe_limits(use: ActuatorUse) -> str:
    """Return how many DAC samples each limit of an actuator held back, in words."""
    return (
        f"stroke {use.clipped_samples}, voltage {use.voltage_limited}, slew {use.slew_limited}, "
        f"power {use.power_limited} DAC samples held back"
    )


def describe_card(card: CardUse) -> str:
    """Return how a sound card plays, in words."""
    channels = ", ".join(map(str, card.channels))
    return (
        f"{card.name}, {card.backend}, channels {channels}, {card.rate_hz} Hz, {card.full_scale_volts:g} V at full "
        f"scale, period {card.period_ms:g} ms, latency {card.latency_ms:g} ms, underruns {card.underruns}"
    )


def warn_of_underruns(card: CardUse) -> None:
    """Say on stderr that a sound card had nothing to play for a while, where it had."""
    if card.underruns:
        click.echo(
            f"warning: {card.name} had nothing to play {card.underruns} time(s) and came to rest; close other programs",
            err=True,
        )


def show(facts: Mapping[str, object]) -> None:
    """Print names and values, one pair a line, a list's items below each other; in JSON, add them to the answer."""
    if wants_json():
        add(facts)
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        if isinstance(value, Mapping):
            value = [f"{key.replace('_', ' ')}: {in_words(item)}" for key, item in value.items()]
        lines = value if isinstance(value, list) else [value]
        for index, line in enumerate(lines or ["none"]):
            click.echo(f"{name.replace('_', ' ') if index == 0 else '':{width}}  {plain(in_words(line))}")


def in_words(value: object) -> str:
    """Return a value as a person reads it: no Python names, six digits at most."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
