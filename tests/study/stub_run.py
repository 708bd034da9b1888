"""A run of given screens, with an actuator that only notes when it moves and rests: stands in for a real session."""

import json
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from vibrocast.host.controller import ControllerError
from vibrocast.study.server import Aids, serve
from vibrocast.study.session import Session
from vibrocast.study.trials import (
    Break,
    Choices,
    Interval,
    Message,
    Paused,
    Question,
    Rejected,
    Screen,
    Sliders,
    State,
    Trial,
)

CONDITIONS = ("linear 14", "hidden reference zq", "anchor 3k")
GRADES = ("same", "possibly same", "possibly different", "different")
WELCOME = Message("welcome", "Welcome", "You will feel textures.\nAnswer what you feel.")
END = Message("end", "Thank you", "The study has ended.")


def trial(number: int = 1, labels: Sequence[str] = "AB", total: int | None = 3, **others: object) -> Trial:
    """Return a trial whose stimuli are named after their conditions."""
    intervals = tuple(
        Interval(label, f"wood/{CONDITIONS[index % len(CONDITIONS)]}") for index, label in enumerate(labels)
    )
    made = Trial(
        number=number,
        total=total,
        phase="main",
        block=1,
        texture="wood",
        intervals=intervals,
        question="How different are they?",
        response=Choices(GRADES),
        facts={"condition": CONDITIONS[0], "correct": 1.0},
    )
    return replace(made, **others)  # type: ignore[arg-type]


def mushra(number: int = 1, sliders: int = 5, total: int | None = 9, **others: object) -> Trial:
    """Return a trial with a reference and sliders."""
    labels = "ABCDEFGHIJ"[:sliders]
    words = ("bad", "poor", "fair", "good", "excellent")
    return trial(
        number,
        ["reference", *labels],
        total,
        question="How good is each texture, compared with the reference?",
        response=Sliders(tuple(labels), 0, 100, words),
        switches=True,
        **others,
    )


class StubRun(Session):
    """Leads through screens. `file` keeps the number of screens passed and the answers over a restart."""

    def __init__(self, screens: Sequence[Screen], file: Path | None = None) -> None:
        self.screens = [*screens, END]
        self.file = file
        self.answers: list[tuple[int, ...]] = []
        self.replies: list[str] = []
        self.actuator: list[str] = []  # "A" where it begins to move, "rest" where it was brought to rest
        self.warnings: tuple[str, ...] = ()
        self.fails: Exception | None = None
        self._lock = threading.RLock()
        self._index = 0
        self._timeline: list[tuple[str, float, float]] = []
        self._plays: dict[str, int] = {}
        self._changes = 0
        self._paused = False
        self._aborted = False
        if file is not None and file.exists():
            self._index, self.answers = json.loads(file.read_text())
            self.answers = [tuple(each) for each in self.answers]

    def screen(self) -> Screen:
        with self._lock:
            if self._paused:
                return Paused()
            return END if self._aborted else self.screens[self._index]

    def version(self) -> int:
        with self._lock:
            now = time.monotonic()
            return self._changes * 100 + sum((now >= begin) + (now >= end) for _, begin, end in self._timeline)

    def go_on(self) -> None:
        with self._lock:
            if not isinstance(self.screen(), Message | Break) or self.screen() == END:
                raise Rejected("there is nothing to continue")
            self._next()

    def reply(self, text: str) -> None:
        with self._lock:
            if not isinstance(self.screen(), Question):
                raise Rejected("there is no question")
            self.replies.append(text)
            self._next()

    def play(self, label: str) -> None:
        with self._lock:
            current = self._present()
            labels = [interval.label for interval in current.intervals]
            if label not in labels:
                raise Rejected("no such interval")
            felt = len(self._plays) == len(labels)
            all_first = current.in_order and not (current.switches and felt)
            is_busy = any(time.monotonic() < end for _, _, end in self._timeline)
            if is_busy and (all_first or not current.switches):
                raise Rejected("an interval is playing; wait for its end")
            if self.fails is not None:
                if not isinstance(self.fails, ControllerError):
                    raise self.fails
                self._paused = True
                self._changes += 1
                self.warnings += (str(self.fails),)
                return
            self._changes += 1
            begin = time.monotonic()
            self._timeline = []
            seconds = 0.1 if all_first else 60.0
            for each in labels if all_first else [label]:
                self._timeline.append((each, begin, begin + seconds))
                self._plays[each] = self._plays.get(each, 0) + 1
                self.actuator.append(each)
                begin += seconds + current.pause_s

    def stop_playing(self) -> None:
        with self._lock:
            self._changes += 1
            self._timeline = []
            self.actuator.append("rest")

    def answer(self, values: tuple[int, ...]) -> bool | None:
        with self._lock:
            current = self._present()
            if len(self.plays()) < len(current.intervals):
                raise Rejected("feel every texture first")
            self.answers.append(values)
            self._next()
            return values == (1,) if current.feedback else None

    def pause(self) -> None:
        with self._lock:
            self._paused = True
            self._plays = {}
            self.stop_playing()

    def resume(self) -> None:
        with self._lock:
            if not self._paused:
                raise Rejected("the run is not paused")
            self._paused = False
            self.fails = None
            self._changes += 1

    def abort(self) -> None:
        with self._lock:
            self._aborted = True
            self._paused = False
            self.stop_playing()

    def plays(self) -> Mapping[str, int]:
        with self._lock:
            started = [label for label, begin, _ in self._timeline if begin > time.monotonic()]
            return {label: count - started.count(label) for label, count in self._plays.items() if label not in started}

    def state(self) -> State:
        with self._lock:
            now = time.monotonic()
            playing = [label for label, begin, end in self._timeline if begin <= now < end]
            screen = self.screen()
            return State(
                participant=7,
                screen=type(screen).__name__.lower(),
                trial=screen.number if isinstance(screen, Trial) else 0,
                total=screen.total if isinstance(screen, Trial) else 3,
                block=1,
                paused=self._paused,
                ended=screen == END,
                now_playing=playing[0] if playing else None,
                level_db=23.4 if playing else None,
                device="serial:/dev/ttyACM0",
                warnings=self.warnings,
            )

    def _present(self) -> Trial:
        screen = self.screen()
        if not isinstance(screen, Trial):
            raise Rejected("there is no trial")
        return screen

    def _next(self) -> None:
        self.stop_playing()
        self._index += 1
        self._plays = {}
        if self.file is not None:
            self.file.write_text(json.dumps([self._index, self.answers]))


LOST = ControllerError("serial:/dev/ttyACM0 does not answer; check its cable")


@contextmanager
def served(run: Session, aids: Aids | None = None) -> Iterator[tuple[str, str]]:
    """Serve a run in a thread; yield the addresses of participant and experimenter. The run ends with the block."""
    lines: list[str] = []
    both = threading.Event()

    def say(line: str) -> None:
        lines.append(line.split(": ", 1)[1])
        if len(lines) == 2:
            both.set()

    thread = threading.Thread(target=serve, args=(run,), kwargs={"port": 0, "aids": aids or Aids(), "say": say})
    thread.start()
    try:
        assert both.wait(20)
        yield lines[0], lines[1]
    finally:
        run.abort()
        thread.join(20)
        assert not thread.is_alive()
