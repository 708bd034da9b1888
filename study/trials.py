"""A study as its parts see it: stimuli, screens that a participant meets, answers, and the session between them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from vibrocast.codec.stream import Stream
from vibrocast.errors import VibrocastError


class Rejected(VibrocastError):
    """A request of a participant or experimenter that does not fit the screen; the message says why."""


@dataclass(frozen=True)
class Stimulus:
    """One coded texture, ready to play.

    Attributes:
        key: Texture and condition, such as "wood/linear 14"; nobody who is blind sees it.
        texture: Name of the texture.
        condition: Name of the condition.
        role: "condition", "reference", "hidden reference" or "anchor".
        stream: The coded stream, its level matched at the skin.
        loops: How often it plays to fill the study's duration.
        gain_db: The change of level that matched it.
        facts: Figures for results and report: snr_db, st_sim, spqi, third_octave_db, bits_per_second, level_db
            (over the detection threshold), limited (part of DAC samples that a limit changed). None where undefined.
    """

    key: str
    texture: str
    condition: str
    role: str
    stream: Stream = field(repr=False)
    loops: int
    gain_db: float
    facts: Mapping[str, float | None]

    @property
    def seconds(self) -> float:
        """The duration in s."""
        return self.loops * self.stream.seconds


@dataclass(frozen=True)
class Interval:
    """A stimulus within a trial.

    `label`: its blind name on the button. `stimulus`: the key of its Stimulus; None = silence. `gain_db`: the change of
    level that a staircase asks for.
    """

    label: str
    stimulus: str | None
    gain_db: float = 0.0


@dataclass(frozen=True)
class Choices:
    """The participant gives one of some answers, by button or by the keys 1, 2, 3 ..."""

    options: tuple[str, ...]


@dataclass(frozen=True)
class Sliders:
    """The participant gives a whole number from `low` to `high` for each label.

    `words`: names of equal ranges of the scale, from low to high, such as "bad" to "excellent".
    """

    labels: tuple[str, ...]
    low: int = 0
    high: int = 100
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Trial:
    """One trial.

    Attributes:
        number: From 1 in a run, practice included.
        total: Trials of the run; None in a staircase, which ends by itself.
        phase: "practice" or "main".
        block: From 1; a break lies between blocks.
        texture: Name of the texture.
        intervals: In the order of presentation.
        question: For the participant.
        response: How the participant answers.
        max_plays: How often each interval may be played; None = without limit.
        in_order: Whether `play` plays all intervals, one after the other; with `switches`, only the first time.
        switches: Whether a press on another label continues at the same place, without a gap.
        pause_s: Silence between intervals that play by themselves.
        max_seconds: Time to answer after the last interval began; None = without limit.
        feedback: Whether the page says afterwards if the answer was correct.
        facts: What the method needs to know when the answer comes, and what goes into the results: condition,
            correct (index of the right choice), level_db of a staircase and so on.
    """

    number: int
    total: int | None
    phase: str
    block: int
    texture: str
    intervals: tuple[Interval, ...]
    question: str
    response: Choices | Sliders
    max_plays: int | None = None
    in_order: bool = False
    switches: bool = False
    pause_s: float = 0.5
    max_seconds: float | None = None
    feedback: bool = False
    facts: Mapping[str, str | float | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Message:
    """A text with one button: the welcome, instructions, the end. `kind`: "welcome", "instructions" or "end"."""

    kind: str
    title: str
    text: str


@dataclass(frozen=True)
class Break:
    """A rest. The participant may go on after `seconds`."""

    seconds: float
    done: int
    total: int | None


@dataclass(frozen=True)
class Question:
    """A question of the experimenter before or after the trials. `options`: none = the answer is a line of text."""

    name: str
    text: str
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Paused:
    """The experimenter has paused the run."""

    text: str = "Please wait."


Screen: TypeAlias = Message | Question | Trial | Break | Paused


@dataclass(frozen=True)
class Answer:
    """An answer to a trial.

    Attributes:
        values: The index of the choice, from 0; or a value for each slider.
        reaction_s: From the start of the interval that was the last to be played for the first time.
        plays: How often each label was played.
    """

    values: tuple[int, ...]
    reaction_s: float
    plays: Mapping[str, int]


@dataclass(frozen=True)
class State:
    """A run as the experimenter sees it. `now_playing`: a blind label, None at rest. `warnings`: newest last."""

    participant: int
    screen: str
    trial: int
    total: int | None
    block: int
    paused: bool
    ended: bool
    now_playing: str | None
    level_db: float | None
    device: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Played:
    """One presentation as the device played it, for the log.

    Attributes:
        stimulus: Key of the stimulus.
        stream_sha256: Of the bytes of the .vct file, in hex.
        started_utc: When it began at the skin, ISO 8601 with microseconds.
        latency_ms: From the request to the skin, as far as the device states it.
        gain_db: The level that was sent, re the recording.
        limited: DAC samples that a limit changed.
        underruns: Counted by the device.
        seconds: For how long it played.
        as_computed: Whether the DAC's codes that were read back are those computed here, bit for bit. None: not known,
            as of a stimulus that was stopped, or on a sound card.
    """

    stimulus: str
    stream_sha256: str
    started_utc: str
    latency_ms: float | None
    gain_db: float
    limited: int
    underruns: int
    seconds: float
    as_computed: bool | None = None


class StimulusPlayer(ABC):
    """Plays stimuli on a device for a run. Calls return at once; another thread plays."""

    def __init__(self) -> None:
        self._played: list[Played] = []

    @abstractmethod
    def prepare(self, stimuli: Sequence[Stimulus]) -> None:
        """Do all that would delay a first presentation. Raises ControllerError, TransportError."""

    @abstractmethod
    def start(self, stimulus: Stimulus) -> None:
        """Play from the beginning; what plays before ramps down. Raises ControllerError, TransportError."""

    def switch(self, stimulus: Stimulus) -> None:
        """Go on at the same place in another stimulus, without a gap where the device can; else as `start`."""
        self.start(stimulus)

    @abstractmethod
    def stop(self) -> None:
        """Bring the actuator to rest. Never raises for a device that is gone."""

    @abstractmethod
    def playing(self) -> str | None:
        """Return the key of the stimulus that plays, None at rest. Raises what went wrong in the other thread."""

    def take_played(self) -> list[Played]:
        """Return what has been played since the last call."""
        played, self._played = self._played, []
        return played

    def close(self) -> None:
        """Bring the actuator to rest; nothing is played after this."""
        self.stop()


RESULT_COLUMNS = (
    "study",
    "participant",
    "trial",
    "phase",
    "block",
    "method",
    "texture",
    "condition",
    "comparison",
    "label",
    "presentation",
    "response",
    "value",
    "correct",
    "level_db",
    "reversal",
    "reaction_s",
    "plays",
    "answered_utc",
)
"""The columns of results.csv, one row for each rated or chosen stimulus of a trial.

`condition`: of the stimulus that the row rates. `comparison`: of the one it was compared with. `label`: the blind name.
`presentation`: labels with their conditions in order, such as "A=linear 14 B=reference". `response`: in words; `value`:
the number (grade 0 to 3, slider 0 to 100, index of the choice). `correct`: 0 or 1, empty where nothing is right or
wrong. `level_db`, `reversal`: of a staircase. `plays`: of this stimulus.
"""
