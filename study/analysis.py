"""Analyses the answers of a study: reads the results of all participants, and computes every figure of the report."""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.errors import InputError
from vibrocast.study import statistics, stimuli
from vibrocast.study.methods import GRADES, MAIN, design, staircase_of, staircases_of
from vibrocast.study.session import LOG, RESULTS, RUN
from vibrocast.study.simulation import SIMULATED
from vibrocast.study.staircases import Staircase
from vibrocast.study.statistics import Correlation, Effect, Interval, PairedTest
from vibrocast.study.study_file import HIDDEN_REFERENCE, Study, read_study
from vibrocast.study.trials import RESULT_COLUMNS, Stimulus

STUDY_FILE, STIMULI = "study.toml", "stimuli"
RATED = ("degradation", "mushra")
DETECTED = ("same_different", "abx", "two_alternative")
METRICS = {"snr_db": "SNR, dB", "st_sim": "ST-SIM", "spqi": "SPQI", "third_octave_db": "third-octave distance, dB"}
POWER = 0.8
ALPHA = 0.05
PLANNED_PARTICIPANTS = (5, 10, 15, 20, 30, 40)
"""Of the table of power."""
FAILED = "device failed"
"""The event of the log when a device is gone."""

Row = Mapping[str, str]


@dataclass(frozen=True)
class Participant:
    """One participant's answers.

    `rows`: of the main trials. `events`: of the log. `is_whole`: whether all trials are answered.
    """

    number: int
    rows: tuple[Row, ...]
    events: tuple[Mapping[str, Any], ...]
    is_simulated: bool
    is_whole: bool

    def of(self, texture: str, condition: str) -> list[Row]:
        """Return the rows of one stimulus."""
        return [row for row in self.rows if (row["texture"], row["condition"]) == (texture, condition)]


@dataclass(frozen=True)
class Rating:
    """The ratings of one stimulus.

    `counts`: of each grade, or of each fifth of the scale. `by_participant`: means. `difference`: from the hidden
    reference, within participants; None for the hidden reference itself, or without one.
    """

    texture: str
    condition: str
    role: str
    mean: Interval
    counts: tuple[int, ...]
    by_participant: Mapping[int, float]
    difference: Interval | None = None
    test: PairedTest | None = None


@dataclass(frozen=True)
class Detection:
    """How well people distinguished a stimulus from its reference. `correct`: part of the answers that were right.

    `sensitivity`: d', by differencing in same-different trials and ABX; `independent`: d' by independent observation;
    `yes_no`: z(H) - z(F) of same-different trials, None for other methods.
    """

    texture: str
    condition: str
    trials: int
    correct: float
    sensitivity: Interval
    independent: Interval
    yes_no: Interval | None


@dataclass(frozen=True)
class Preference:
    """The Bradley-Terry strength of one condition, log units. `wins`: how often it was chosen, of `trials`."""

    texture: str
    condition: str
    strength: Interval
    wins: int
    trials: int


@dataclass(frozen=True)
class Threshold:
    """A staircase and its estimate. `levels_db`, `correct`: trial by trial."""

    participant: int
    texture: str
    condition: str
    trials: int
    threshold_db: Interval
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
    model: Mapping[str, Effect] | None = None
    detections: tuple[Detection, ...] = ()
    preferences: tuple[Preference, ...] = ()
    thresholds: tuple[Threshold, ...] = ()
    correlations: Mapping[str, Correlation] | None = None

    @property
    def is_simulated(self) -> bool:
        """Whether simulated observers gave all answers."""
        return all(each.is_simulated for each in self.participants)

    @property
    def counted(self) -> tuple[Participant, ...]:
        """The participants whose answers count."""
        return tuple(each for each in self.participants if each.number not in self.excluded)


def read_results(folder: Path) -> Analysis:
    """Read a results folder without analysing it. Raises InputError for a folder without results, or of two studies."""
    study = read_study(folder / STUDY_FILE, with_files=False) if (folder / STUDY_FILE).is_file() else None
    paths = sorted(folder.glob(f"participant_*/{RESULTS}"))
    if study is None or not paths:
        raise InputError(f"{folder}: no results of a study; give the folder of --out of `vibrocast study run`")
    warnings: list[str] = []
    participants: list[Participant] = []
    for path in paths:
        participant, flaws = _read_participant(path, study)
        if any(participant.number == each.number for each in participants):
            raise InputError(f"{path.parent}: participant {participant.number} is there twice; move one folder away")
        warnings += flaws
        participants.append(participant)
    simulated = sum(each.is_simulated for each in participants)
    if 0 < simulated < len(participants):
        warnings.insert(0, f"{simulated} of {len(participants)} participants are simulated observers, not people")
    return Analysis(study, stimuli.load(folder / STIMULI), tuple(participants), {}, tuple(warnings))


def _read_participant(path: Path, study: Study) -> tuple[Participant, list[str]]:
    """Return one participant's answers, and the flaws of the files in words."""
    try:
        run = json.loads((path.parent / RUN).read_text(encoding="utf-8"))
        number, sha256, device = int(run["participant"]), run["study_sha256"], run["device"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path.parent / RUN}: damaged or missing ({error}); move that folder away") from error
    if sha256 != study.sha256:
        raise InputError(f"{path.parent}: answers to another study file; move that folder away")
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = list(csv.reader(line.replace("\0", "") for line in file))
    if not lines or lines[0] != list(RESULT_COLUMNS):
        raise InputError(f"{path}: other columns than those of a run; move that folder away")
    rows: dict[tuple[str, str], Row] = {}
    for line in lines[1:]:
        row = dict(zip(RESULT_COLUMNS, line, strict=False))
        if len(line) == len(RESULT_COLUMNS) and _fits(row, study, number):
            rows.setdefault((row["trial"], row["label"]), row)
    damaged = len(lines) - 1 - len(rows)
    main = tuple(row for row in rows.values() if row["phase"] == MAIN)
    events = _read_log(path.parent / LOG)
    missing = _missing(list(rows.values()), study, number)
    flaws = []
    if damaged:
        flaws.append(f"participant {number}: {damaged} damaged or repeated line(s) of {RESULTS} left out")
    if missing:
        flaws.append(f"participant {number}: not finished, {missing}; the answers so far count")
    if failures := sum(each.get("event") == FAILED for each in events):
        flaws.append(f"participant {number}: the device failed {failures} time(s)")
    return Participant(number, main, events, device == SIMULATED, not missing), flaws


def _fits(row: Row, study: Study, number: int) -> bool:
    """Return whether a row of results can be an answer of this participant in this study."""
    identity = {"study": study.name, "participant": str(number), "method": study.method}
    highest = {"degradation": len(GRADES) - 1, "mushra": 100}.get(study.method, 1)
    return (
        all(row[key] == value for key, value in identity.items())
        and row["texture"] in {each.name for each in study.textures}
        and row["condition"] in {each.name for each in study.conditions}
        and _is_number(row["value"])
        and 0 <= float(row["value"]) <= highest
        and (study.method not in (*DETECTED, "staircase") or row["correct"] in ("0", "1"))
        and (study.method != "staircase" or _is_number(row["level_db"]))
    )


def _read_log(path: Path) -> tuple[Mapping[str, Any], ...]:
    """Return the events of a log; a line that is cut or damaged does not count."""
    events = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict):
            events.append(event)
    return tuple(events)


def _missing(rows: Sequence[Row], study: Study, number: int) -> str | None:
    """Return which trials of a run have no answer, in words; None for a run that is whole."""
    first = design(study, number).next_trial([])
    if first is not None and first.total is not None:
        answered = len({row["trial"] for row in rows})
        return None if answered >= first.total else f"{answered} of {first.total} trials"
    pairs = staircases_of(study, number)
    finished = sum(_is_finished([row for row in rows if (row["texture"], row["condition"]) == pair], study)
                   for pair in pairs)  # fmt: skip
    return None if finished == len(pairs) else f"{finished} of {len(pairs)} staircases"


def _is_finished(rows: Sequence[Row], study: Study) -> bool:
    """Return whether a staircase has all its answers."""
    assert study.staircase is not None, "the study file is checked"
    return _replayed(rows, study).done or len(rows) >= study.staircase.max_trials


def _replayed(rows: Sequence[Row], study: Study) -> Staircase:
    """Return a staircase after these answers."""
    staircase = staircase_of(study)
    for row in rows:
        staircase.update(row["correct"] == "1")
    return staircase


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def analyse(folder: Path) -> Analysis:
    """Return every figure of a study. Raises InputError as `read_results`."""
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
        own = [float(row["value"]) for row in each.of(texture, condition)]
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
    return Rating(texture, condition, role, mean, counts, by_participant)


def _tested(group: Sequence[Rating], hidden: str | None) -> list[Rating]:
    """Return the ratings of a texture with their paired tests against the hidden reference, Holm's correction made."""
    against = next((each for each in group if each.condition == hidden), None)
    if against is None:
        return list(group)
    tests, differences = {}, {}
    for each in group:
        if each is not against:
            both = [number for number in each.by_participant if number in against.by_participant]
            values = [each.by_participant[number] for number in both]
            own = [against.by_participant[number] for number in both]
            tests[each.condition] = statistics.paired_test(values, own)
            differences[each.condition] = statistics.mean_interval(np.subtract(values, own))
    corrected = statistics.holm([test.p for test in tests.values()])
    tests = {name: replace(test, holm_p=p) for (name, test), p in zip(tests.items(), corrected, strict=True)}
    return [replace(each, difference=differences.get(each.condition), test=tests.get(each.condition)) for each in group]


def _correlations(read: Analysis, ratings: Sequence[Rating]) -> dict[str, Correlation]:
    """Return how mean ratings go with each metric."""
    found = {}
    for metric in METRICS:
        pairs = metric_pairs(read, ratings, metric)
        found[metric] = statistics.correlation([x for _, x, _ in pairs], [y for _, _, y in pairs])
    return found


def metric_pairs(read: Analysis, ratings: Sequence[Rating], metric: str) -> list[tuple[str, float, float]]:
    """Return texture, metric and mean rating of each stimulus that has both, the hidden reference left out."""
    facts = {(each.texture, each.condition): each.facts for each in read.stimuli}
    pairs = []
    for each in ratings:
        value = facts.get((each.texture, each.condition), {}).get(metric)
        if each.role != HIDDEN_REFERENCE and value is not None and each.mean.value is not None:
            pairs.append((each.texture, value, each.mean.value))
    return pairs


# ---- other methods ----


def _detections(read: Analysis) -> list[Detection]:
    """Return d' of each condition. Of same-different trials, the same pairs of a texture count for all conditions."""
    found = []
    method = read.study.method
    reference = read.study.reference.name if read.study.reference else ""
    for texture in read.study.textures:
        for name in (each.name for each in read.study.conditions if each.name != reference):
            counts, right, total = [], 0, 0
            for each in read.counted:
                own, same = each.of(texture.name, name), each.of(texture.name, reference)
                if not own:  # another participant's texture
                    continue
                correct = sum(row["correct"] == "1" for row in own)
                right, total = right + correct, total + len(own)
                false_alarms = sum(row["correct"] == "0" for row in same)
                counts.append(
                    [correct, len(own), false_alarms, len(same)] if method == "same_different" else [correct, len(own)]
                )
            if total:
                d = statistics.sensitivity(method, counts)
                independent = statistics.sensitivity(method, counts, model="independent")
                yes_no = statistics.sensitivity(method, counts, model="yes_no") if method == "same_different" else None
                found.append(Detection(texture.name, name, total, right / total, d, independent, yes_no))
    return found


def _preferences(read: Analysis) -> list[Preference]:
    """Return the strength of each condition in each texture."""
    names = [each.name for each in read.study.conditions]
    found = []
    for texture in read.study.textures:
        wins = np.zeros((len(read.counted), len(names), len(names)))
        for place, each in enumerate(read.counted):
            for row in each.rows:
                if row["texture"] == texture.name and row["comparison"] in names:
                    first, second = names.index(row["condition"]), names.index(row["comparison"])
                    chosen, other = (first, second) if row["value"] == "0" else (second, first)
                    wins[place, chosen, other] += 1
        wins = wins[np.any(wins, axis=(1, 2))]  # of those who met the texture
        total = wins.sum(axis=0)
        if total.sum():
            met = total + total.T
            found += [
                Preference(texture.name, name, strength, int(total[at].sum()), int(met[at].sum()))
                for at, (name, strength) in enumerate(zip(names, _strengths(wins), strict=True))
            ]
    return found


def _strengths(wins: NDArray[np.float64]) -> list[Interval]:
    """Return Bradley-Terry strengths from wins (participants, items, items).

    The intervals are percentiles of a bootstrap over participants; a single participant gives none.
    """
    strengths = statistics.bradley_terry(wins.sum(axis=0))
    if len(wins) < 2:
        return [Interval(float(value), None, None) for value in strengths]
    people = np.random.default_rng(0).integers(len(wins), size=(statistics.BOOTSTRAPS, len(wins)))
    drawn = statistics.bradley_terry(np.array([wins[each].sum(axis=0) for each in people]))
    tail = (1 - statistics.CONFIDENCE) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail], axis=0)
    return [Interval(*map(float, each)) for each in zip(strengths, low, high, strict=True)]


def _thresholds(read: Analysis) -> list[Threshold]:
    """Return each staircase, with its estimate."""
    found = []
    for each in read.counted:
        tracks: dict[tuple[str, str], list[Row]] = {}
        for row in each.rows:
            tracks.setdefault((row["texture"], row["condition"]), []).append(row)
        for (texture, condition), rows in tracks.items():
            estimate = _replayed(rows, read.study).threshold()
            levels_db = tuple(float(row["level_db"]) for row in rows)
            answers = tuple(row["correct"] == "1" for row in rows)
            found.append(Threshold(each.number, texture, condition, len(rows), estimate, levels_db, answers))
    return found


# ---- in words ----


def findings(read: Analysis) -> list[str]:
    """Return the message of the study: a sentence or two for each condition. No text calls two stimuli the same."""
    lines = []
    if read.ratings and not any(each.test for each in read.ratings):
        lines.append("No hidden reference was rated, so there is no test; means alone do not show who noticed it.")
    lines += [_rating_in_words(read, each, each.test) for each in read.ratings if each.test is not None]
    lines += [_detection_in_words(each) for each in read.detections]
    for texture, group in groupby(read.preferences, key=lambda each: each.texture):
        ranked = sorted(group, key=lambda each: -(each.strength.value or 0.0))
        lines.append(f"{texture}, most preferred first: {', '.join(each.condition for each in ranked)}.")
    for (texture, condition), (mean, count) in mean_thresholds(read).items():
        text = "too few reversals" if mean.value is None else f"mean threshold {_in_words(mean, '.1f')} dB"
        lines.append(f"{texture}, {condition}: {text}, {count} staircase(s).")
    return lines


def mean_thresholds(read: Analysis) -> dict[tuple[str, str], tuple[Interval, int]]:
    """Return the mean threshold of each texture and condition over its staircases, and how many have one."""
    pairs = dict.fromkeys((each.texture, each.condition) for each in read.thresholds)
    found = {}
    for pair in pairs:
        values = [each.threshold_db.value for each in read.thresholds if (each.texture, each.condition) == pair]
        known = [value for value in values if value is not None]
        found[pair] = statistics.mean_interval(known), len(known)
    return found


def _rating_in_words(read: Analysis, rating: Rating, test: PairedTest) -> str:
    name, p, difference = f"{rating.texture}, {rating.condition}", test.holm_p, rating.difference
    if p is None or difference is None or difference.value is None:
        return f"{name}: too few answers for a test."
    found = f"The mean differs by {_in_words(difference, '+.2f')} from the hidden reference"
    figures = f"(p {'< 0.001' if p < 0.001 else f'= {p:.3f}'}{_effect(test)})"
    if p < ALPHA:
        worse = difference.value > 0 if read.study.method == "degradation" else difference.value < 0
        verdict = "noticed" if worse else "rated better than the hidden reference"
        return f"{name}: {verdict}. {found} {figures}."
    return f"{name}: not shown to be noticed. {found} {figures}. {_could_find(read, test)}"


def _detection_in_words(found: Detection) -> str:
    name, d = f"{found.texture}, {found.condition}", found.sensitivity
    if d.value is None:
        return f"{name}: too few answers for a d'."
    value = f"d' is {_in_words(d, '.2f')}"
    if d.low is not None and d.low > 0:
        return f"{name}: noticed. {value}."
    room = "" if d.high is None else f" A d' of {d.high:.2f} would agree with these answers too."
    return f"{name}: not shown to be noticed. {value}.{room}"


def _in_words(interval: Interval, form: str) -> str:
    if interval.low is None or interval.high is None:
        return f"{interval.value:{form}}"
    return f"{interval.value:{form}} ({interval.low:{form}} to {interval.high:{form}})"


def _effect(test: PairedTest) -> str:
    return "" if test.effect.value is None else f", d = {test.effect.value:.2f}"


def _could_find(read: Analysis, test: PairedTest) -> str:
    """Return which effect the study could have found."""
    least = statistics.detectable_effect(test.count, POWER, ALPHA / _tests_of_texture(read))
    if least is None:
        return "Fewer than three participants show nothing."
    return f"{test.count} participants find an effect of d = {least:.2f} in {100 * POWER:.0f} % of such studies."


def _participants_needed(test: PairedTest, tests: int) -> int | None:
    """Return how many participants find an effect like this one; None without an effect, or for more than 100."""
    effect = test.effect.value
    return None if effect is None else statistics.participants_needed(effect, POWER, ALPHA / tests)


def _tests_of_texture(read: Analysis) -> int:
    """Return by how many tests Holm's correction divides the level of the smallest p."""
    tested = [each.texture for each in read.ratings if each.test is not None]
    return max([tested.count(texture) for texture in tested], default=1)


def tables(read: Analysis) -> dict[str, list[dict[str, Any]]]:
    """Return the report's tables by the name of their CSV file, without empty ones."""
    tests = _tests_of_texture(read)
    found: dict[str, list[dict[str, Any]]] = {
        "stimuli": [
            {"stimulus": each.key, **_columns(each, "role", "gain_db"), **each.facts}
            | {"stream_sha256": stimuli.stream_sha256(each.stream)}
            for each in read.stimuli
        ],
        "played": _as_played(read),
        "participants": [
            {
                "participant": each.number,
                "simulated": each.is_simulated,
                "whole": each.is_whole,
                "counted": each.number not in read.excluded,
                "rows": len(each.rows),
            }
            for each in read.participants
        ],
        "means": [
            _columns(each, "texture", "condition", "role", "mean")
            | {"participants": len(each.by_participant)}
            | {f"count_{number}": count for number, count in enumerate(each.counts)}
            for each in read.ratings
        ],
        "tests": [
            _columns(each, "texture", "condition")
            | {"participants": each.test.count}
            | _columns(each, "difference")
            | _columns(each.test, "t", "p", "holm_p", "effect")
            | {"participants_needed": _participants_needed(each.test, tests)}
            for each in read.ratings
            if each.test is not None
        ],
        "power": [
            {
                "participants": people,
                "effect_of_one_test": statistics.detectable_effect(people, POWER, ALPHA),
                f"effect_of_{tests}_tests": statistics.detectable_effect(people, POWER, ALPHA / tests),
            }
            for people in (PLANNED_PARTICIPANTS if read.ratings else ())
        ],
        "mixed_model": [{"condition": name, **effect._asdict()} for name, effect in (read.model or {}).items()],
        "correlations": [
            {"metric": metric, "stimuli": each.count, **_columns(each, "pearson", "spearman")}
            for metric, each in (read.correlations or {}).items()
        ],
        "sensitivities": [
            _columns(each, "texture", "condition", "trials", "correct", "sensitivity", "independent")
            | ({} if each.yes_no is None else _columns(each, "yes_no"))
            for each in read.detections
        ],
        "preferences": [_columns(each) for each in read.preferences],
        "mean_thresholds": [
            {"texture": texture, "condition": condition, "staircases": count, **_cells("threshold_db", mean)}
            for (texture, condition), (mean, count) in mean_thresholds(read).items()
        ],
        "thresholds": [
            _columns(each, "participant", "texture", "condition", "trials", "threshold_db") for each in read.thresholds
        ],
    }
    return {name: rows for name, rows in found.items() if rows}


def _as_played(read: Analysis) -> list[dict[str, Any]]:
    """Return how the logs say that each stimulus was played.

    `other_stream`: presentations whose stream was not the prepared one; a staircase changes its level.
    `not_as_computed`: presentations whose DAC codes were not those computed from the stream.
    """
    rows = []
    events = [event for each in read.participants for event in each.events if event.get("event") == "played"]
    for stimulus in read.stimuli:
        own = [event for event in events if event.get("stimulus") == stimulus.key]
        if own:
            gains_db = _numbers(own, "gain_db")
            latencies_ms = _numbers(own, "latency_ms")
            sha256 = stimuli.stream_sha256(stimulus.stream)
            rows.append(
                {
                    "stimulus": stimulus.key,
                    "presentations": len(own),
                    "gain_db_least": min(gains_db, default=None),
                    "gain_db_most": max(gains_db, default=None),
                    "limited_samples_most": max(_numbers(own, "limited"), default=None),
                    "underruns": sum(_numbers(own, "underruns")),
                    "latency_ms_median": float(np.median(latencies_ms)) if latencies_ms else None,
                    "other_stream": sum(event.get("stream_sha256") != sha256 for event in own),
                    "not_as_computed": sum(event.get("as_computed") is False for event in own),
                }
            )
    return rows


def _numbers(events: Sequence[Mapping[str, Any]], key: str) -> list[float]:
    values = [event.get(key) for event in events]
    return [value for value in values if isinstance(value, int | float) and math.isfinite(value)]


def _columns(record: Any, *names: str) -> dict[str, Any]:
    """Return fields of a dataclass as columns, all if none is named; an Interval fills three of them."""
    columns: dict[str, Any] = {}
    for name in names or [each.name for each in fields(record)]:
        value = getattr(record, name)
        columns |= _cells(name, value) if isinstance(value, Interval) else {name: value}
    return columns


def _cells(name: str, interval: Interval) -> dict[str, float | None]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
