"""Analyses the answers of a study: reads the results of all participants, and computes every figure of the report."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast.host.study import statistics, stimuli
from vibrocast.host.study.methods import GRADES, MAIN, staircase_of
from vibrocast.host.study.session import RESULTS, RUN
from vibrocast.host.study.simulation import SIMULATED
from vibrocast.host.study.statistics import Correlation, Interval, MixedModel, PairedTest
from vibrocast.host.study.study_file import HIDDEN_REFERENCE, Study, read_study
from vibrocast.host.study.trials import RESULT_COLUMNS, Stimulus, StudyError

STUDY_FILE, STIMULI = "study.toml", "stimuli"
RATED = ("degradation", "mushra")
DETECTED = ("same_different", "abx", "two_alternative")
METRICS = {"snr_db": "SNR, dB", "st_sim": "ST-SIM", "spqi": "SPQI", "third_octave_db": "third-octave distance, dB"}
POWER = 0.8
ALPHA = 0.05

Row = Mapping[str, str]


@dataclass(frozen=True)
class Participant:
    """One participant's rows of the main trials. `is_whole`: whether all trials are answered; `note`: of a flaw."""

    number: int
    rows: tuple[Row, ...]
    is_simulated: bool
    note: str | None


@dataclass(frozen=True)
class Rating:
    """The ratings of one stimulus. `counts`: of each grade, or of each fifth of the scale. `by_participant`: means."""

    texture: str
    condition: str
    role: str
    mean: Interval
    counts: tuple[int, ...]
    by_participant: Mapping[int, float]
    test: PairedTest | None


@dataclass(frozen=True)
class Detection:
    """How well people told one stimulus from its reference. `correct`: part of the answers that were right."""

    texture: str
    condition: str
    trials: int
    correct: float
    sensitivity: Interval


@dataclass(frozen=True)
class Preference:
    """The Bradley-Terry strength of one condition, log units. `wins`: how often it was chosen, of `trials`."""

    texture: str
    condition: str
    strength: float
    wins: int
    trials: int


@dataclass(frozen=True)
class Threshold:
    """A staircase. `levels_db`, `correct`: trial by trial."""

    participant: int
    texture: str
    condition: str
    estimate: statistics.Interval
    levels_db: tuple[float, ...]
    correct: tuple[bool, ...]


@dataclass(frozen=True)
class Analysis:
    """All figures of a report. `excluded`: participants by number, with the reason. `model`: of all ratings."""

    study: Study
    stimuli: tuple[Stimulus, ...]
    participants: tuple[Participant, ...]
    excluded: Mapping[int, str]
    warnings: tuple[str, ...]
    ratings: tuple[Rating, ...] = ()
    model: MixedModel | None = None
    detections: tuple[Detection, ...] = ()
    preferences: tuple[Preference, ...] = ()
    thresholds: tuple[Threshold, ...] = ()
    correlations: Mapping[str, Correlation] | None = None

    @property
    def is_simulated(self) -> bool:
        """Whether a simulated observer gave some of the answers."""
        return any(each.is_simulated for each in self.participants)

    @property
    def counted(self) -> tuple[Participant, ...]:
        """The participants whose answers count."""
        return tuple(each for each in self.participants if each.number not in self.excluded)


def read_results(folder: Path) -> Analysis:
    """Read a results folder without analysing it. Raises StudyError for a folder without results, or of two studies."""
    study = read_study(folder / STUDY_FILE, with_files=False) if (folder / STUDY_FILE).is_file() else None
    paths = sorted(folder.glob(f"participant_*/{RESULTS}"))
    if study is None or not paths:
        raise StudyError(f"{folder}: no results of a study; give the folder of --out of `vibrocast study run`")
    warnings: list[str] = []
    participants = []
    for path in paths:
        participant, flaws = _read_participant(path, study)
        warnings += flaws
        participants.append(participant)
    return Analysis(study, stimuli.load(folder / STIMULI), tuple(participants), {}, tuple(warnings))


def _read_participant(path: Path, study: Study) -> tuple[Participant, list[str]]:
    """Return one participant's answers, and the flaws of the file in words."""
    try:
        run = json.loads((path.parent / RUN).read_text(encoding="utf-8"))
        number, sha256, device = int(run["participant"]), run["study_sha256"], run["device"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StudyError(f"{path.parent / RUN}: damaged or missing ({error}); move that folder away") from error
    if sha256 != study.sha256:
        raise StudyError(f"{path.parent}: answers to another study file; move that folder away")
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = list(csv.reader(file))
    if not lines or lines[0] != list(RESULT_COLUMNS):
        raise StudyError(f"{path}: other columns than those of a run; move that folder away")
    rows, flaws = [], 0
    for line in lines[1:]:
        row = dict(zip(RESULT_COLUMNS, line, strict=False))
        if len(line) == len(RESULT_COLUMNS) and _is_number(row["value"]):
            rows.append(row)
        else:
            flaws += 1
    notes = [f"participant {number}: {flaws} damaged line(s) left out"] if flaws else []
    main = tuple(row for row in rows if row["phase"] == MAIN)
    return Participant(number, main, device == SIMULATED, notes[0] if notes else None), notes


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def analyse(folder: Path) -> Analysis:
    """Return every figure of a study. Raises StudyError as `read_results`."""
    read = read_results(folder)
    method = read.study.method
    if method in RATED:
        return _rated(read)
    if method in DETECTED:
        return replace(read, detections=tuple(_detections(read)))
    if method == "paired_comparison":
        return replace(read, preferences=tuple(_preferences(read)))
    return replace(read, thresholds=tuple(_thresholds(read)))


# ---- ratings ----


def _rated(read: Analysis) -> Analysis:
    """Return means, tests, the mixed model and correlations of ratings."""
    hidden = read.study.of_role(HIDDEN_REFERENCE)
    excluded = _unreliable(read, hidden[0]) if read.study.method == "mushra" and hidden else {}
    read = replace(read, excluded=excluded)
    ratings = []
    for texture in read.study.textures:
        group = [_rating(read, texture.name, each.name, each.role) for each in read.study.conditions]
        ratings += _tested([each for each in group if each is not None], hidden[0] if hidden else None)
    rows = [(each, row) for each in read.counted for row in each.rows]
    model = None
    if hidden and rows:
        values = [float(row["value"]) for _, row in rows]
        conditions = [row["condition"] for _, row in rows]
        model = statistics.mixed_model(values, conditions, [each.number for each, _ in rows], hidden[0])
    return replace(read, ratings=tuple(ratings), model=model, correlations=_correlations(read, ratings))


def _unreliable(read: Analysis, hidden: str) -> dict[int, str]:
    """Return the participants that the post-screening of ITU-R BS.1534-3 leaves out."""
    found = {}
    for each in read.participants:
        values = [float(row["value"]) for row in each.rows if row["condition"] == hidden]
        if not statistics.is_reliable(values):
            found[each.number] = "rated the hidden reference below 90 in more than 15 % of the trials"
    return found


def _rating(read: Analysis, texture: str, condition: str, role: str) -> Rating | None:
    """Return the ratings of one stimulus; None for one that nobody rated, such as the open reference."""
    by_participant: dict[int, float] = {}
    values: list[float] = []
    for each in read.counted:
        own = [float(row["value"]) for row in each.rows if (row["texture"], row["condition"]) == (texture, condition)]
        if own:
            by_participant[each.number] = float(np.mean(own))
            values += own
    if not values:
        return None
    if read.study.method == "degradation":
        counts = tuple(sum(value == grade for value in values) for grade in range(len(GRADES)))
    else:
        counts = tuple(int(count) for count in np.histogram(values, bins=5, range=(0, 100))[0])
    mean = statistics.mean_interval(list(by_participant.values()))
    return Rating(texture, condition, role, mean, counts, by_participant, None)


def _tested(group: Sequence[Rating], hidden: str | None) -> list[Rating]:
    """Return the ratings of a texture with their paired tests against the hidden reference, Holm's correction made."""
    against = next((each for each in group if each.condition == hidden), None)
    if against is None:
        return list(group)
    tests = {}
    for each in group:
        if each is not against:
            both = [number for number in each.by_participant if number in against.by_participant]
            pairs = [(each.by_participant[number], against.by_participant[number]) for number in both]
            tests[each.condition] = statistics.paired_test([x for x, _ in pairs], [y for _, y in pairs])
    corrected = statistics.holm([test.p for test in tests.values()])
    tests = {name: replace(test, holm_p=p) for (name, test), p in zip(tests.items(), corrected, strict=True)}
    return [replace(each, test=tests.get(each.condition)) for each in group]


def _correlations(read: Analysis, ratings: Sequence[Rating]) -> dict[str, Correlation]:
    """Return how mean ratings go with each metric, over the coded stimuli."""
    facts = {(each.texture, each.condition): each for each in read.stimuli}
    found = {}
    for metric in METRICS:
        pairs = []
        for each in ratings:
            stimulus = facts.get((each.texture, each.condition))
            value = None if stimulus is None else stimulus.facts.get(metric)
            is_coded = stimulus is not None and stimulus.facts.get("bits_per_second") is not None
            if is_coded and value is not None and each.mean.value is not None:
                pairs.append((value, each.mean.value))
        found[metric] = statistics.correlation([x for x, _ in pairs], [y for _, y in pairs])
    return found


# ---- other methods ----


def _detections(read: Analysis) -> list[Detection]:
    """Return d' of each condition. Of same-different trials, the same pairs of a texture count for all conditions."""
    found = []
    method = read.study.method
    reference = read.study.reference.name if read.study.reference else ""
    for texture in read.study.textures:
        names = dict.fromkeys(
            row["condition"] for each in read.counted for row in each.rows if row["texture"] == texture.name
        )
        for name in names:
            if name == reference:
                continue
            counts, right, total = [], 0, 0
            for each in read.counted:
                own = [row for row in each.rows if (row["texture"], row["condition"]) == (texture.name, name)]
                same = [row for row in each.rows if (row["texture"], row["condition"]) == (texture.name, reference)]
                correct = sum(row["correct"] == "1" for row in own)
                right, total = right + correct, total + len(own)
                false_alarms = sum(row["correct"] == "0" for row in same)
                counts.append(
                    [correct, len(own), false_alarms, len(same)] if method == "same_different" else [correct, len(own)]
                )
            if total:
                d = statistics.sensitivity(method, counts)
                found.append(Detection(texture.name, name, total, right / total, d))
    return found


def _preferences(read: Analysis) -> list[Preference]:
    """Return the strength of each condition in each texture."""
    names = [each.name for each in read.study.conditions]
    found = []
    for texture in read.study.textures:
        wins = np.zeros((len(names), len(names)))
        for each in read.counted:
            for row in each.rows:
                if row["texture"] == texture.name and row["condition"] in names and row["comparison"] in names:
                    first, second = names.index(row["condition"]), names.index(row["comparison"])
                    chosen, other = (first, second) if row["value"] == "0" else (second, first)
                    wins[chosen, other] += 1
        if wins.sum():
            strengths = statistics.bradley_terry(wins)
            met = wins + wins.T
            found += [
                Preference(texture.name, name, float(strengths[at]), int(wins[at].sum()), int(met[at].sum()))
                for at, name in enumerate(names)
            ]
    return found


def _thresholds(read: Analysis) -> list[Threshold]:
    """Return each staircase, with its estimate."""
    found = []
    for each in read.counted:
        tracks: dict[tuple[str, str], list[Row]] = {}
        for row in each.rows:
            tracks.setdefault((row["texture"], row["condition"]), []).append(row)
        for (texture, condition), rows in tracks.items():
            staircase = staircase_of(read.study)
            answers = tuple(row["correct"] == "1" for row in rows)
            for answer in answers:
                staircase.update(answer)
            estimate = staircase.threshold()
            interval = Interval(estimate.value, estimate.low, estimate.high)
            levels = tuple(float(row["level_db"]) for row in rows)
            found.append(Threshold(each.number, texture, condition, interval, levels, answers))
    return found


# ---- in words ----


def findings(read: Analysis) -> list[str]:
    """Return the message of the study: a sentence for each condition."""
    lines = []
    for each in read.ratings:
        test = each.test
        if test is None or each.mean.value is None:
            continue
        name = f"{each.texture}, {each.condition}"
        p = test.holm_p
        if p is None:
            lines.append(f"{name}: too few answers for a test.")
        elif p < ALPHA:
            lines.append(
                f"{name}: noticed. The mean differs by {test.difference:+.2f} from the hidden reference"
                f" (p {_below(p)}{_effect(test)})."
            )
        else:
            lines.append(f"{name}: no difference shown (p {_below(p)}). {_could_find(read, test)}")
    for found in read.detections:
        value, low = found.sensitivity.value, found.sensitivity.low
        name = f"{found.texture}, {found.condition}"
        if value is None:
            lines.append(f"{name}: too few answers for a d'.")
            continue
        verdict = "told from the reference" if low is not None and low > 0.1 else "not shown to be told"
        interval = "" if low is None else f", 95 % interval {low:.2f} to {found.sensitivity.high:.2f}"
        lines.append(f"{name}: {verdict}. d' is {value:.2f}{interval}.")
    for texture in dict.fromkeys(each.texture for each in read.preferences):
        ranked = sorted((each for each in read.preferences if each.texture == texture), key=lambda each: -each.strength)
        lines.append(f"{texture}, most preferred first: {', '.join(each.condition for each in ranked)}.")
    for threshold in read.thresholds:
        value = threshold.estimate.value
        name = f"participant {threshold.participant}, {threshold.texture}, {threshold.condition}"
        lines.append(f"{name}: " + ("too few reversals." if value is None else f"threshold {value:.1f} dB."))
    return lines


def _below(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _effect(test: PairedTest) -> str:
    return "" if test.effect.value is None else f", d = {test.effect.value:.2f}"


def _could_find(read: Analysis, test: PairedTest) -> str:
    """Return which effect the study could have found."""
    tests = max(1, sum(each.test is not None for each in read.ratings) // max(1, len(read.study.textures)))
    least = statistics.detectable_effect(test.count, POWER, ALPHA / tests)
    if least is None:
        return "Fewer than three people show nothing."
    return f"{test.count} people show an effect of d = {least:.2f} or more in {100 * POWER:.0f} % of such studies."


def tables(read: Analysis) -> dict[str, list[dict[str, Any]]]:
    """Return the report's tables by the name of their CSV file."""
    found: dict[str, list[dict[str, Any]]] = {
        "stimuli": [
            {
                "stimulus": each.key,
                "role": each.role,
                "gain_db": each.gain_db,
                **each.facts,
                "stream_sha256": stimuli.stream_sha256(each.stream),
            }
            for each in read.stimuli
        ]
    }
    if read.ratings:
        found["means"] = [
            {"texture": each.texture, "condition": each.condition, "role": each.role, **_cells("mean", each.mean)}
            | {"participants": len(each.by_participant)}
            | {f"count_{number}": count for number, count in enumerate(each.counts)}
            for each in read.ratings
        ]
        found["tests"] = [
            {
                "texture": each.texture,
                "condition": each.condition,
                "participants": each.test.count,
                "difference": each.test.difference,
                "t": each.test.t,
                "p": each.test.p,
                "holm_p": each.test.holm_p,
                **_cells("effect", each.test.effect),
            }
            for each in read.ratings
            if each.test is not None
        ]
    if read.model is not None:
        found["mixed_model"] = [
            {"condition": name, "difference": value, "standard_error": error, "p": p}
            for name, (value, error, p) in read.model.effects.items()
        ]
    if read.correlations is not None:
        found["correlations"] = [
            {"metric": metric, "stimuli": each.count, **_cells("pearson", each.pearson)}
            | _cells("spearman", each.spearman)
            for metric, each in read.correlations.items()
        ]
    if read.detections:
        found["sensitivities"] = [
            {
                "texture": each.texture,
                "condition": each.condition,
                "trials": each.trials,
                "correct": each.correct,
                **_cells("sensitivity", each.sensitivity),
            }
            for each in read.detections
        ]
    if read.preferences:
        found["preferences"] = [dict(vars(each)) for each in read.preferences]
    if read.thresholds:
        found["thresholds"] = [
            {
                "participant": each.participant,
                "texture": each.texture,
                "condition": each.condition,
                "trials": len(each.levels_db),
                **_cells("threshold_db", each.estimate),
            }
            for each in read.thresholds
        ]
    return found


def _cells(name: str, interval: Interval) -> dict[str, float | None]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
