"""Steps that several subcommands share: check arguments, encode with a progress bar, print facts."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import click

from vibrocast import models, progress, textures
from vibrocast.codec.encoding import (
    DEFAULT_STREAM_RATE_HZ,
    Encoding,
    encode_profile,
    encode_recording,
    profile_recording,
)
from vibrocast.device_protocol.coded_stream import STREAM_SUFFIX
from vibrocast.files import plain
from vibrocast.host.cli.answers import add, wants_json
from vibrocast.host.cli.errors import explained
from vibrocast.host.cli.options import QualityOptions, RecordingOptions

_Outcome = TypeVar("_Outcome")


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
    profile = profile_recording(file, **recording.facts())
    with progress.bar("encoding") as update:
        return _noted(encode_profile(profile, progress=update, **arguments))


def reject_coding_options(file: Path, quality: QualityOptions, recording: RecordingOptions) -> None:
    """Raise click.UsageError for an option that does not apply to a file, which is a .vct file."""
    if file.suffix.lower() != STREAM_SUFFIX:
        return
    facts = replace(recording, unit=None) if recording.unit == "drive" else recording
    values = vars(replace(quality, model=None)) | vars(facts)
    given = [name for name, value in values.items() if value not in (None, {}, False, DEFAULT_STREAM_RATE_HZ)]
    if given:
        option = given[0].removesuffix("_name").replace("_", "-")
        raise click.UsageError(f"{file} is coded already; drop --{option}")


def _noted(encoding: Encoding) -> Encoding:
    """Return an encoding, and say on stderr what it did not meet."""
    if note := encoding.quality.note:
        click.echo(f"note: {note}", err=True)
    return encoding


def lines_of(
    outcomes: Mapping[str, _Outcome | Exception], line: Callable[[_Outcome], str]
) -> tuple[dict[str, str], dict[str, int]]:
    """Return a line for each controller, and the exit codes of those that failed."""
    failures = {name: each for name, each in outcomes.items() if isinstance(each, Exception)}
    lines = {name: f"FAILED: {each}" if isinstance(each, Exception) else line(each) for name, each in outcomes.items()}
    return lines, {name: explained(each, {}).exit_code for name, each in failures.items()}


def show(facts: Mapping[str, object], as_words: bool = True) -> None:
    """Print names and values, one pair a line, a list's items below each other; in JSON, add them to the answer.

    `as_words`: False = the names are addresses, which stand as they are.
    """
    if wants_json():
        add(facts)
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        if isinstance(value, Mapping):
            value = [f"{key.replace('_', ' ')}: {in_words(item)}" for key, item in value.items()]
        lines = value if isinstance(value, list) else [value]
        for index, line in enumerate(lines or ["none"]):
            told = name.replace("_", " ") if as_words else plain(name)
            click.echo(f"{told if index == 0 else '':{width}}  {plain(in_words(line))}")


def in_words(value: object) -> str:
    """Return a value as a person reads it: no Python names, six digits at most."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
