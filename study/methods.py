"""The methods of a study: each makes its trials, and turns answers into rows of results."""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vibrocast.study.designs import balanced_order, balanced_share, shuffled
from vibrocast.study.staircases import Bayesian, Staircase, TransformedUpDown
from vibrocast.study.study_file import ANCHOR, CONDITION, HIDDEN_REFERENCE, REFERENCE, Study
from vibrocast.study.trials import Answer, Choices, Interval, Sliders, Trial

PRACTICE, MAIN = "practice", "main"
GRADES = ("same", "possibly same", "possibly different", "different")
"""The four grades of Okamoto and Yamada, IEEE Trans. Haptics 6(1), 2013: 0 to 3."""
QUALITIES = ("bad", "poor", "fair", "good", "excellent")
"""The ranges of the scale of ITU-R BS.1534-3."""
# Each draw has its own random numbers, so that one choice does not move another.
_CONDITIONS, _TEXTURES, _PRACTICE, _LABELS, _SIDES, _SHARES, _TRIALS = range(7)


@dataclass(frozen=True)
class Answered:
    """A trial, and the answer that is on disk."""

    trial: Trial
    answer: Answer


class Design(ABC):
    """The trials of one participant, one after the other, from seed, participant and answers alone."""

    question = ""

    def __init__(self, study: Study, participant: int) -> None:
        self.study, self.participant = study, participant

    @abstractmethod
    def next_trial(self, history: Sequence[Answered]) -> Trial | None:
        """Return the trial after those that are answered; None after the last."""

    def rows(self, trial: Trial, answer: Answer, history: Sequence[Answered]) -> list[dict[str, object]]:
        """Return the method's columns of the results, a row for each rated stimulus."""
        assert isinstance(trial.response, Choices), "other methods override this"
        chosen = answer.values[0]
        right = trial.facts.get("correct")
        return [
            {
                "condition": trial.facts["condition"],
                "comparison": trial.facts.get("comparison"),
                "label": trial.intervals[-1].label,
                "response": trial.response.options[chosen],
                "value": chosen,
                "correct": None if right is None else int(chosen == right),
                "plays": answer.plays.get(trial.intervals[-1].label, 0),
            }
        ]

    def _place(self, texture: str) -> int:
        return [each.name for each in self.study.textures].index(texture)

    def _random(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.study.seed, self.participant, *purpose])

    def _trial(
        self, texture: str, intervals: Sequence[Interval], response: Choices | Sliders, **details: object
    ) -> Trial:
        """Return a trial that is not numbered yet."""
        study = self.study
        fields: dict[str, object] = {
            "max_plays": study.max_plays,
            "pause_s": study.pause_seconds,
            "max_seconds": study.max_seconds,
            **details,
        }
        question = study.question or self.question
        return Trial(0, None, MAIN, 1, texture, tuple(intervals), question, response, **fields)  # type: ignore[arg-type]


class FixedDesign(Design):
    """A method whose trials are known before the first answer.

    `rated`: the roles of the conditions that are rated. `reference`: the name of the reference.
    """

    rated: tuple[str, ...] = (CONDITION, HIDDEN_REFERENCE, ANCHOR)

    def __init__(self, study: Study, participant: int) -> None:
        super().__init__(study, participant)
        self.reference = next(iter(study.of_role(REFERENCE)), "")
        main = list(self._main_trials())
        if study.order == "random":
            main = shuffled(main, [study.seed, participant, _TRIALS])
        practice = shuffled(main, [study.seed, participant, _PRACTICE])[: study.practice_trials]
        numbered = [replace(each, phase=PRACTICE, feedback=study.feedback_in_practice) for each in practice]
        numbered += [replace(each, block=2 + place // study.trials_per_block) for place, each in enumerate(main)]
        if not practice:
            numbered = [replace(each, block=each.block - 1) for each in numbered]
        total = len(numbered)
        self._trials = [replace(each, number=number, total=total) for number, each in enumerate(numbered, 1)]

    def next_trial(self, history: Sequence[Answered]) -> Trial | None:
        """Return the trial after those that are answered; None after the last."""
        return self._trials[len(history)] if len(history) < len(self._trials) else None

    @abstractmethod
    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        """Return the trials of a texture in one repetition, with its conditions in their balanced order."""

    def _main_trials(self) -> Iterator[Trial]:
        """Return all trials: in each repetition all textures, of each texture all conditions in one go."""
        study = self.study
        names = textures_of(study, self.participant)
        # Participants with other textures share a row, so that each texture meets all rows.
        shares = len(study.textures) if study.textures_per_participant else 1
        for repetition in range(study.repetitions):
            row = (self.participant - 1) // shares + repetition
            for texture in balanced_order(names, row, [study.seed, _TEXTURES]):
                rated = study.of_role(*self.rated, texture=texture)
                conditions = balanced_order(rated, row, [study.seed, _CONDITIONS, self._place(texture)])
                yield from self._trials_of(texture, conditions, repetition)


class Degradation(FixedDesign):
    """4-grade degradation against a reference that is played first (Okamoto and Yamada 2013)."""

    question = "Is A the same as the reference?"

    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        for name in names:
            intervals = _intervals(texture, ("Reference", "A"), (self.reference, name))
            facts = {"condition": name, "comparison": self.reference}
            yield self._trial(texture, intervals, Choices(GRADES), facts=facts)


class SameDifferent(FixedDesign):
    """Two intervals, the same or different; as many trials are the same as are different."""

    question = "Are the two the same?"
    rated = (CONDITION, ANCHOR)

    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        others = [other for name in names for other in (name, self.reference)]
        seed = [self.study.seed, self.participant, _SIDES, repetition, self._place(texture)]
        for number, other in enumerate(shuffled(others, seed)):
            pair = self.reference, other
            turned = self._random(_LABELS, repetition, self._place(texture), number).integers(2)
            intervals = _intervals(texture, "12", pair[::-1] if turned else pair)
            facts = {"condition": other, "comparison": self.reference, "correct": int(other != self.reference)}
            yield self._trial(texture, intervals, Choices(("same", "different")), in_order=True, facts=facts)


class Abx(FixedDesign):
    """A and B differ, and X is one of them."""

    question = "Is X the same as A or as B?"
    rated = (CONDITION, ANCHOR)

    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        for number, name in enumerate(names):
            random = self._random(_LABELS, repetition, self._place(texture), number)
            pair = self.reference, name
            pair = pair[::-1] if random.integers(2) else pair
            right = int(random.integers(2))
            intervals = _intervals(texture, "ABX", (*pair, pair[right]))
            facts = {"condition": name, "comparison": self.reference, "correct": right}
            options = Choices(("X is A", "X is B"))
            yield self._trial(texture, intervals, options, switches=True, facts=facts)


class TwoAlternative(FixedDesign):
    """Two intervals, the reference and a condition in either order: two-alternative forced choice."""

    question = "Which one feels more distorted?"
    rated = (CONDITION, ANCHOR)

    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        for number, name in enumerate(names):
            right = int(self._random(_LABELS, repetition, self._place(texture), number).integers(2))
            pair = self.reference, name
            intervals = _intervals(texture, "12", pair if right else pair[::-1])
            facts = {"condition": name, "comparison": self.reference, "correct": right}
            yield self._trial(texture, intervals, Choices(("1", "2")), in_order=True, facts=facts)


class Mushra(FixedDesign):
    """All conditions of a texture on one page, with hidden reference and two anchors.

    After ITU-R BS.1534-3, with the strict timing of Muschter et al. (IEEE Trans. Haptics 14(2), 2021): all stimuli play
    once in a fixed order; then each may be played `max_plays` times.
    """

    question = "How well does each one keep the reference?"

    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        labels = [chr(ord("A") + place) for place in range(len(names))]
        intervals = _intervals(texture, ("Reference", *labels), (self.reference, *names))
        facts = {"condition": None, "comparison": self.reference}
        sliders = Sliders(tuple(labels), words=QUALITIES)
        yield self._trial(texture, intervals, sliders, in_order=True, switches=True, facts=facts)

    def rows(self, trial: Trial, answer: Answer, history: Sequence[Answered]) -> list[dict[str, object]]:
        """Return a row for each slider."""
        conditions = {each.label: _condition(each) for each in trial.intervals}
        assert isinstance(trial.response, Sliders)
        return [
            {
                "condition": conditions[label],
                "comparison": trial.facts["comparison"],
                "label": label,
                "response": QUALITIES[min(value // 20, len(QUALITIES) - 1)],
                "value": value,
                "plays": answer.plays.get(label, 0),
            }
            for label, value in zip(trial.response.labels, answer.values, strict=True)
        ]


class PairedComparison(FixedDesign):
    """All pairs of conditions, each in both orders over two repetitions or two participants."""

    question = "Which one do you prefer?"

    def _trials_of(self, texture: str, names: Sequence[str], repetition: int) -> Iterator[Trial]:
        pairs = list(itertools.combinations([each.name for each in self.study.conditions], 2))
        seed = [self.study.seed, self.participant, _SIDES, repetition, self._place(texture)]
        for number in shuffled(range(len(pairs)), seed):
            # Half of the pairs are turned around, and the other half for the next participant or repetition.
            turned = (number + self.participant + repetition) % 2 == 1
            pair = pairs[number][::-1] if turned else pairs[number]
            facts = {"condition": pair[0], "comparison": pair[1]}
            yield self._trial(texture, _intervals(texture, "AB", pair), Choices(("A", "B")), facts=facts)


class AdaptiveDesign(Design):
    """A staircase for each texture and condition, one after the other: the interval that vibrates is to be found."""

    question = "Which one vibrates?"

    def __init__(self, study: Study, participant: int) -> None:
        super().__init__(study, participant)
        assert study.staircase is not None, "the study file is checked"
        self._rule = study.staircase
        pairs = staircases_of(study, participant)
        self._order = (
            shuffled(pairs, [study.seed, participant, _TRIALS])
            if study.order == "random"
            else balanced_order(pairs, participant - 1, [study.seed, _CONDITIONS])
        )

    def next_trial(self, history: Sequence[Answered]) -> Trial | None:
        """Return the next trial of the staircase under way, or the first of the next one; None after the last."""
        for block, (texture, name) in enumerate(self._order, 1):
            staircase = self._replayed(texture, name, history)
            answered = sum(self._is_of(each.trial, texture, name) for each in history)
            if staircase.done or answered >= self._rule.max_trials:
                continue
            level_db = float(staircase.level())
            right = int(self._random(_LABELS, len(history)).integers(2))
            sound = Interval(str(1 + right), f"{texture}/{name}", level_db)
            silence = Interval(str(2 - right), None)
            facts = {"condition": name, "correct": right, "level_db": level_db}
            intervals = (silence, sound) if right else (sound, silence)
            trial = self._trial(texture, intervals, Choices(("1", "2")), in_order=True, facts=facts)
            return replace(trial, number=len(history) + 1, block=block)
        return None

    def rows(self, trial: Trial, answer: Answer, history: Sequence[Answered]) -> list[dict[str, object]]:
        """Return the row of a trial, with level and reversal; `history` does not hold the trial yet."""
        (row,) = super().rows(trial, answer, history)
        texture, name = trial.texture, str(trial.facts["condition"])
        before = self._replayed(texture, name, history)
        after = self._replayed(texture, name, [*history, Answered(trial, answer)])
        return [{**row, "level_db": trial.facts["level_db"], "reversal": int(after.reversals > before.reversals)}]

    @staticmethod
    def _is_of(trial: Trial, texture: str, name: str) -> bool:
        return (trial.texture, trial.facts["condition"]) == (texture, name)

    def _replayed(self, texture: str, name: str, history: Sequence[Answered]) -> Staircase:
        """Return a staircase after all its answers so far."""
        staircase = staircase_of(self.study)
        for each in history:
            if self._is_of(each.trial, texture, name):
                staircase.update(each.answer.values[0] == each.trial.facts["correct"])
        return staircase


def staircases_of(study: Study, participant: int) -> list[tuple[str, str]]:
    """Return texture and condition of each staircase of a participant, in the order of the study file."""
    names = textures_of(study, participant)
    return [(texture, name) for texture in names for name in study.of_role(CONDITION, texture=texture)]


def staircase_of(study: Study) -> Staircase:
    """Return the staircase that a study asks for, before its first answer."""
    rule = study.staircase
    assert rule is not None, "the study file is checked"
    if rule.rule == "bayesian":
        return Bayesian(rule.lowest_db, rule.highest_db, max_trials=rule.max_trials)
    return TransformedUpDown(
        down=int(rule.rule[0]),
        start=rule.start_db,
        steps=tuple(rule.steps_db),
        lowest=rule.lowest_db,
        highest=rule.highest_db,
        reversals=rule.reversals,
    )


DESIGNS: Mapping[str, type[Design]] = {
    "degradation": Degradation,
    "same_different": SameDifferent,
    "abx": Abx,
    "two_alternative": TwoAlternative,
    "mushra": Mushra,
    "paired_comparison": PairedComparison,
    "staircase": AdaptiveDesign,
}


def design(study: Study, participant: int) -> Design:
    """Return the trials of a participant, from 1."""
    return DESIGNS[study.method](study, participant)


def textures_of(study: Study, participant: int) -> list[str]:
    """Return the names of the textures that a participant meets, in the order of the study file."""
    names = [each.name for each in study.textures]
    count = study.textures_per_participant or len(names)
    return balanced_share(names, count, participant - 1, [study.seed, _SHARES])


def _intervals(texture: str, labels: Sequence[str], names: Sequence[str]) -> tuple[Interval, ...]:
    """Return an interval for each label and condition of a texture."""
    return tuple(Interval(label, f"{texture}/{name}") for label, name in zip(labels, names, strict=True))


def _condition(interval: Interval) -> str:
    """Return the condition's name of an interval, "silence" for none."""
    return "silence" if interval.stimulus is None else interval.stimulus.partition("/")[2]


def presentation(trial: Trial) -> str:
    """Return labels with their conditions in order, for the results."""
    return " ".join(f"{each.label}={_condition(each)}" for each in trial.intervals)
