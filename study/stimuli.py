"""Prepares the stimuli of a study: codes each texture under each condition, and matches their levels at the skin."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import models
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream, read_stream
from vibrocast.codec.threshold import MAX_HZ, MIN_HZ, read_threshold, threshold_amplitude
from vibrocast.device_protocol.messages import Status
from vibrocast.errors import InputError, located
from vibrocast.files import atomic_folder
from vibrocast.host.stream_session import check_unit
from vibrocast.output.actuator import SKIN_OVERSAMPLING, Actuator, Codes
from vibrocast.output.rendering import LimitCounts, render
from vibrocast.study.study_file import REFERENCE, Condition, Study
from vibrocast.study.trials import Stimulus
from vibrocast.textures import Recording

Samples = NDArray[np.float64]

UNCODED_SNR_DB = 60.0
"""A condition without a codec is coded by the default one to this SNR, because every device plays coded streams. The
error lies 60 dB below the texture, below the detection threshold of all that is not 60 dB above it."""
MAX_STREAM_SNR_DB = 45.0
"""Where 60 dB cannot be reached within the 16 bits of a stream, at least this."""
STIMULI = "stimuli.json"
_GAIN_STEPS_DB = range(-1, -61, -1)
_MATCHED_DB = 0.1
_MAX_MATCHINGS = 8


@dataclass(frozen=True)
class Problem:
    """Stimuli of one texture that cannot be compared: why, and what to do."""

    texture: str
    text: str


def prepare(study: Study, actuator: Actuator, progress: Callable[[float], None] | None = None) -> tuple[Stimulus, ...]:
    """Code each texture under each condition, and bring all to the level of the texture's reference at the skin.

    The level is that of `skin_level_db`. The reference, or the first condition without one, keeps the recording's level
    and `gain_db` of the study. The metrics of the others compare with it, as the participants do. Raises InputError,
    which names texture and condition, and CodecError of `check_unit`.
    """
    prepared: list[Stimulus] = []
    recordings = study.recordings()
    count = sum(len(study.conditions_of(name)) for name in recordings)
    for name, recording in recordings.items():
        check_unit(recording.unit, "drive" if recording.drive else None)
        cut = _cut(recording, study.stimulus_seconds)
        ordered = sorted(study.conditions_of(name), key=lambda each: each.role != REFERENCE)
        first: Stimulus | None = None
        for condition in ordered:
            with located(f"texture {name}, condition {condition.name}"):
                stimulus = _stimulus(study, actuator, cut, name, condition, first)
            first = first or stimulus
            prepared.append(stimulus)
            if progress is not None:
                progress(len(prepared) / count)
    return tuple(prepared)


def _cut(recording: Recording, seconds: float) -> Recording:
    """Return the first seconds of a recording; a shorter one as it is."""
    samples = recording.samples[: math.ceil(seconds * recording.rate_hz)]
    return replace(recording, samples=samples)


def _stimulus(
    study: Study, actuator: Actuator, recording: Recording, texture: str, condition: Condition, first: Stimulus | None
) -> Stimulus:
    """Return one stimulus, as loud at the skin as the texture's first one and compared with it. Raises ValueError."""
    filtered = recording if condition.lowpass_hz is None else _low_passed(recording, condition.lowpass_hz)
    coded, reference = _coded(study, filtered, condition)
    loops = max(1, math.ceil(study.stimulus_seconds / coded.seconds - 1e-6))
    if first is not None:
        reference = replace(reference, samples=first.stream.with_gain(-first.gain_db).decode())
    target_db = first.facts["level_db"] if first is not None and study.match_levels else None
    decoded = coded.decode()
    gain_db = study.gain_db
    stream, codes, counts = _played(coded, gain_db, actuator, loops)
    for _ in range(_MAX_MATCHINGS):
        off_db = 0.0 if target_db is None else target_db - skin_level_db(codes, actuator)
        if not abs(off_db) > _MATCHED_DB / 2 or not math.isfinite(off_db):
            break
        gain_db += off_db
        stream, codes, counts = _played(coded, gain_db, actuator, loops)
    if condition.gain_db:
        gain_db += condition.gain_db
        stream, codes, counts = _played(coded, gain_db, actuator, loops)
    facts = {
        **_quality(reference.samples, decoded, reference, loops),
        "bits_per_second": coded.bits_per_second if condition.is_coded else None,
        "level_db": skin_level_db(codes, actuator),
        "limited": limited_part(counts, codes),
    }
    return Stimulus(
        f"{texture}/{condition.name}", texture, condition.name, condition.role, stream, loops, gain_db, facts
    )


def _coded(study: Study, recording: Recording, condition: Condition) -> tuple[Stream, Recording]:
    """Return a recording coded under a condition, and the coder's input at the stream's rate."""
    if condition.is_coded:
        model = None if condition.model is None else models.find(condition.model)
        encoding = encode_recording(
            recording,
            stream_rate_hz=study.stream_rate_hz,
            codec_name=condition.codec,
            setting=condition.setting or None,
            rate_bps=condition.rate_bps,
            snr_db=condition.snr_db,
            touch=condition.touch,
            model=model,
        )
    else:
        flat = partial(encode_recording, recording, stream_rate_hz=study.stream_rate_hz, touch=0)
        try:
            encoding = flat(snr_db=UNCODED_SNR_DB)
        except ValueError:  # 16 bits do not reach it in every channel
            encoding = flat(snr_db=MAX_STREAM_SNR_DB)
    return encoding.stream, encoding.recording


def _low_passed(recording: Recording, corner_hz: float) -> Recording:
    """Return a recording through a fourth-order Butterworth low-pass, forwards and backwards, so without delay."""
    from scipy import signal

    if corner_hz >= recording.rate_hz / 2:
        raise ValueError(f"lowpass_hz = {corner_hz:g}: at or above half of {recording.rate_hz:g} Hz; lower it")
    sections = signal.butter(4, corner_hz, fs=recording.rate_hz, output="sos")
    return replace(recording, samples=np.asarray(signal.sosfiltfilt(sections, recording.samples, axis=0)))


def _played(coded: Stream, gain_db: float, actuator: Actuator, loops: int) -> tuple[Stream, Codes, LimitCounts]:
    """Return a stream at a level, and its DAC codes with the limits that acted."""
    stream = coded.with_gain(gain_db)
    delay = stream.delay_samples
    codes, counts = render(stream.header, stream.decode_integers(), delay, actuator, loops=loops)
    return stream, codes, counts


def limited_samples(counts: LimitCounts | Status) -> int:
    """Return how many DAC samples the limits changed; a sample that two limits changed counts twice."""
    return counts.compensation_clipped + counts.voltage_limited + counts.slew_limited + counts.power_limited


def limited_part(counts: LimitCounts, codes: Codes) -> float:
    """Return the part of DAC samples that a limit changed, 0 to 1, by `limited_samples`."""
    return min(1.0, limited_samples(counts) / max(1, codes.size))


def skin_level_db(codes: Codes, actuator: Actuator) -> float:
    """Return the level at the skin in dB over the detection threshold, of the loudest channel.

    DAC codes int16 (n, channels) go through the model of the actuator. The mean power of each component from MIN_HZ to
    MAX_HZ counts relative to that of a sine at the detection threshold there, and the sum is the level. So 0 dB is a
    vibration as strong as a sine at its threshold. -inf for silence.
    """
    displacement_um = actuator.displacement_um(codes, SKIN_OVERSAMPLING)
    spectrum = np.fft.rfft(displacement_um, axis=0)
    frequency_hz = np.asarray(
        np.fft.rfftfreq(len(displacement_um), 1 / (SKIN_OVERSAMPLING * actuator.dac_rate_hz)), np.float64
    )
    felt = (frequency_hz >= MIN_HZ) & (frequency_hz <= MAX_HZ)
    power = 2 * np.abs(spectrum[felt]) ** 2 / len(displacement_um) ** 2
    threshold = threshold_amplitude(read_threshold(), frequency_hz[felt], "um")[:, None] ** 2 / 2
    level = float(np.max(np.sum(power / threshold, axis=0), initial=0.0))
    return 10 * math.log10(level) if level > 0 else -math.inf


def _quality(reference: Samples, decoded: Samples, recording: Recording, loops: int) -> dict[str, float | None]:
    """Return SNR, ST-SIM, SPQI and third-octave distance of decoded samples; None without the extra that measures."""
    from vibrocast.codec import metrics

    perceptual = find_spec("vibromaf") is not None
    length = min(len(reference), len(decoded))
    pair = [np.tile(each[:length], (loops, 1)) for each in (reference, decoded)]
    quality = metrics.measure(pair[0], pair[1], recording.rate_hz, recording.unit, perceptual)
    return {
        "snr_db": quality.snr_db,
        "st_sim": quality.st_sim_2800,
        "spqi": quality.spqi,
        "third_octave_db": quality.third_octave_distance_db,
    }


def problems(study: Study, actuator: Actuator, stimuli: Sequence[Stimulus]) -> list[Problem]:
    """Return why stimuli cannot be compared: limits that act unequally, or levels that nobody feels."""
    found = []
    for texture in dict.fromkeys(each.texture for each in stimuli):
        group = [each for each in stimuli if each.texture == texture]
        limited = {each.condition: each.facts["limited"] or 0.0 for each in group}
        if max(limited.values()) - min(limited.values()) > study.max_limited_difference:
            least, most = (f(limited, key=lambda name: limited[name]) for f in (min, max))
            found.append(
                Problem(
                    texture,
                    f"limits of {actuator.name} change {100 * limited[most]:.1f} % of the samples of {most} and "
                    f"{100 * limited[least]:.1f} % of those of {least}, so people would compare limits; "
                    f"{_advice(study, actuator, group)}",
                )
            )
        if unfelt := [each.condition for each in group if not (each.facts["level_db"] or -math.inf) > 0]:
            found.append(
                Problem(texture, f"nobody would feel {', '.join(unfelt)}; raise gain_db, or check unit and full_scale")
            )
    return found


def _advice(study: Study, actuator: Actuator, group: Sequence[Stimulus]) -> str:
    """Return which gain_db of the study lets the limits act alike."""
    for change_db in _GAIN_STEPS_DB:
        parts = []
        for each in group:
            _, codes, counts = _played(each.stream, float(change_db), actuator, each.loops)
            parts.append(limited_part(counts, codes))
        if max(parts) - min(parts) <= study.max_limited_difference / 2:
            return f"set gain_db = {study.gain_db + change_db:g}"
    return "give an actuator with a larger stroke"


def save(folder: Path, stimuli: Sequence[Stimulus], actuator: Actuator) -> None:
    """Write the stimuli, so that runs play the very streams that were checked on an actuator. Raises OSError."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with atomic_folder(folder) as partial:
        rows = []
        for number, each in enumerate(stimuli, 1):
            file = f"{number:03}.vct"
            each.stream.save(partial / file)
            row = {key: value for key, value in vars(each).items() if key != "stream"}
            row["facts"] = {key: _finite(value) for key, value in each.facts.items()}
            rows.append({**row, "file": file, "stream_sha256": stream_sha256(each.stream)})
        document = {"actuator": asdict(actuator), "stimuli": rows}
        (partial / STIMULI).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def load(folder: Path, actuator: Actuator | None = None) -> tuple[Stimulus, ...]:
    """Read the stimuli that `save` wrote. Raises InputError for a folder without, or one for another actuator."""
    path = folder / STIMULI
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if actuator is not None and document["actuator"] != asdict(actuator):
            raise ValueError("levels were matched for another actuator")
        return tuple(_loaded(folder, row) for row in document["stimuli"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not the stimuli of a study ({error}); prepare them again in another folder"
        ) from error


def _loaded(folder: Path, row: Mapping[str, Any]) -> Stimulus:
    stream = read_stream(folder / str(row["file"]), None)
    if stream_sha256(stream) != row["stream_sha256"]:
        raise ValueError(f"{row['file']} has changed")
    fields = {key: row[key] for key in ("key", "texture", "condition", "role", "loops", "gain_db", "facts")}
    return Stimulus(stream=stream, **fields)


def stream_sha256(stream: Stream) -> str:
    """Return the hash of a stream's file, in hex: the log and the list of stimuli name it by this."""
    return sha256(bytes(stream)).hexdigest()


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
