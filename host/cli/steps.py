"""Steps that several subcommands share: check arguments, encode with a progress bar, print facts."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import click

from vibrocast import models, progress, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, Encoding, encode_recording
from vibrocast.codec.stream import CodingQuality
from vibrocast.codec.threshold import TACTILE_BAND_HZ
from vibrocast.host import profiles
from vibrocast.host.cli.answers import add, wants_json
from vibrocast.host.cli.options import QualityOptions
from vibrocast.host.printable import plain
from vibrocast.host.report import Report
from vibrocast.host.skin_quality import SkinQuality
from vibrocast.output.sound_card import CardUse

_Argument = TypeVar("_Argument")


def needed(argument: _Argument | None, name: str) -> _Argument:
    """Return an argument that only --plan makes up for. Raises click.UsageError."""
    if argument is None:
        raise click.UsageError(f"missing {name}; pass it, or --plan")
    return argument


def files_of(model: models.Model | None) -> list[Path]:
    """Return the files that a model was read from, as far as another could be written over them."""
    return [model.path] if model else []


def encoded(
    recording: textures.Recording,
    quality: QualityOptions,
    unit: str | None,
    live: bool,
    runtime: str | None = None,
    packet_s: float | None = None,
) -> Encoding:
    """Encode a recording, whose --unit this is, show how far it is, and say what was not met."""
    with progress.bar("encoding") as update:
        encoding = encode_recording(
            recording, live=live, progress=update, runtime=runtime, packet_s=packet_s, **quality.arguments(unit)
        )
    return _noted(encoding)


def encoded_profile(recording: textures.Recording, quality: QualityOptions, slowest_mm_s: float) -> Encoding:
    """Encode a height profile as a spatial stream, show how far it is, and say what was not met."""
    if quality.rate_bps is not None or quality.stream_rate_hz != DEFAULT_STREAM_RATE_HZ:
        raise click.UsageError(
            "a profile has no time, so no rates; give --snr-db and --slowest-hand-speed-mm-s instead"
        )
    arguments = quality.arguments()
    del arguments["rate_bps"], arguments["stream_rate_hz"], arguments["highpass_hz"]  # heights keep their own rules
    with progress.bar("encoding") as update:
        return _noted(profiles.encode(recording, slowest_mm_s, progress=update, **arguments))


def _noted(encoding: Encoding) -> Encoding:
    """Return an encoding, and say on stderr what it did not meet."""
    if note := encoding.quality.note:
        click.echo(f"note: {note}", err=True)
    return encoding


def describe_quality(quality: CodingQuality | Report, skin: bool = False) -> str:
    """Return the SNR of a coded recording, that in the tactile band, and the energy that was removed, in words.

    `skin`: the SNR as displacement as well, where it is known.
    """
    if quality.snr_db is None:
        text = "SNR unknown (silent, lossless, or coded before)"
    else:
        text = f"SNR {quality.snr_db:.2f} dB"
        if quality.tactile_snr_db is not None:
            text += f" ({quality.tactile_snr_db:.2f} dB within {TACTILE_BAND_HZ[0]:g} to {TACTILE_BAND_HZ[1]:g} Hz)"
        if skin and isinstance(quality, CodingQuality) and quality.skin_snr_db is not None:
            text += f", as displacement {quality.skin_snr_db:.2f} dB{_weighted(quality.weighted_skin_snr_db)}"
    if quality.highpass_hz is None:
        return text
    return (
        f"{text}, {100 * (quality.removed_energy or 0.0):.2g} % of the energy removed below {quality.highpass_hz:g} Hz"
    )


def _weighted(weighted_db: float | None) -> str:
    """Return the SNR that the threshold of touch weights, in words, to stand behind the plain one."""
    return "" if weighted_db is None else f" ({weighted_db:.2f} dB weighted by the threshold of touch)"


ANSWERS = {True: "yes", False: "NO", None: "not compared"}


def describe_skin(skin: SkinQuality | None, note: str | None) -> str:
    """Return the SNR and the gain at the skin, and why the SNR differs from that of the codec, in words."""
    if skin is None:
        return "not compared: the skin hardly moves as the texture does"
    ratio = f"SNR {skin.snr_db:.2f} dB{_weighted(skin.weighted_snr_db)}" if skin.snr_db is not None else "SNR unknown"
    alone = f", without the codec {skin.playing_snr_db:.2f} dB" if skin.playing_snr_db is not None else ""
    gain = f", gain {skin.gain:.2f}" if skin.gain is not None else ""
    return f"{ratio}{alone}{gain}" + (f"; {note}" if note else "")


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
