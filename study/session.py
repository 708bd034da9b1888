"""One participant's run: screens in order, every answer on disk before the next trial, resumed after a crash."""

import csv
import io
import json
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import InputError
from vibrocast.files import atomic_write
from vibrocast.host.controller import ControllerError
from vibrocast.study.methods import PRACTICE, Answered, design, presentation
from vibrocast.study.study_file import Study
from vibrocast.study.trials import (
    RESULT_COLUMNS,
    Answer,
    Break,
    Choices,
    Interval,
    Message,
    Paused,
    Question,
    Rejected,
    Screen,
    State,
    Stimulus,
    StimulusPlayer,
    Trial,
)

DEVICE_ERRORS = (ControllerError, TransportError)
RESULTS, ANSWERS, LOG, RUN = "results.csv", "answers.csv", "log.jsonl", "run.json"
ANSWER_COLUMNS = ("study", "participant", "question", "answer", "answered_utc")
_POLL_S = 0.005
_WELCOME = "You will feel textures and compare them. There are no right or wrong answers unless the page says so."
_INSTRUCTIONS = "Play each texture. Then answer. You can stop at any time."
_END = "This is the end. Thank you for taking part."


class Session:
    """A run of one participant, as pages and terminal use it; safe to use from several threads.

    A method raises Rejected where it does not fit the screen. A run whose device is gone pauses, with the reason in
    `state().warnings`, until the experimenter resumes it.

    `folder` holds its results; one with earlier answers is resumed after the last of them. `stimuli`: of the study, by
    key. `player`: closed with the session. `device`: for the experimenter. `clock`: seconds; `sleep`: of the thread
    that plays intervals one after the other. Raises InputError for results of another study, participant or method.
    """

    def __init__(
        self,
        study: Study,
        stimuli: Sequence[Stimulus],
        participant: int,
        folder: Path,
        player: StimulusPlayer,
        device: str = "",
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._study, self._participant, self._folder = study, participant, folder
        self._stimuli = {each.key: each for each in stimuli}
        self._player, self._device, self._clock, self._sleep = player, device, clock, sleep
        self._design = design(study, participant)
        self._changed = threading.Condition(threading.RLock())
        self._version = 0
        self._paused = self._ended = self._closed = False
        self._warnings: list[str] = []
        self._queue: list[Interval] = []
        self._now: Interval | None = None
        self._plays: dict[str, int] = {}
        self._heard_s = 0.0
        self._break_until_s: float | None = None
        folder.mkdir(parents=True, exist_ok=True)
        self._check_folder()
        self._history = self._resumed()
        replies, is_damaged = _read_rows(folder / ANSWERS, ANSWER_COLUMNS)
        if is_damaged:
            _write(folder / ANSWERS, ANSWER_COLUMNS, replies)
        self._replies = {row["question"] for row in replies}
        self._messages_left = ["welcome", "instructions"] if not self._history else []
        self._trial = self._design.next_trial(self._history)
        self._check_stimuli()
        self._thread = threading.Thread(target=self._conduct, name="study", daemon=True)
        self._thread.start()
        self._log("resumed" if self._history else "started", trial=len(self._history) + 1)

    # ---- screens ----

    def screen(self) -> Screen:
        """Return the present screen."""
        with self._changed:
            study = self._study
            if self._ended:
                return Message("end", "Stopped", "The experimenter has ended this run.")
            if self._paused:
                return Paused()
            if "welcome" in self._messages_left:
                return Message("welcome", study.title, study.welcome or _WELCOME)
            if question := self._question("before"):
                return question
            if "instructions" in self._messages_left:
                return Message("instructions", "Instructions", study.instructions or _INSTRUCTIONS)
            if self._break_until_s is not None:
                total = None if self._trial is None else self._trial.total
                return Break(max(0.0, self._break_until_s - self._clock()), len(self._history), total)
            if self._trial is not None:
                return self._trial
            return self._question("after") or Message("end", study.title, _END)

    def version(self) -> int:
        """Return a number that changes whenever `screen` or `state` does: pages poll it."""
        with self._changed:
            return self._version

    @property
    def has_ended(self) -> bool:
        """Whether nothing is left to do."""
        screen = self.screen()
        return isinstance(screen, Message) and screen.kind == "end"

    def go_on(self) -> None:
        """Leave a Message, or a Break after its time. Raises Rejected elsewhere."""
        with self._changed:
            screen = self.screen()
            if isinstance(screen, Message) and screen.kind != "end":
                self._messages_left.remove(screen.kind)
            elif isinstance(screen, Break):
                if screen.seconds > 0:
                    raise Rejected(f"the break lasts {screen.seconds:.0f} s more; wait for its end")
                self._break_until_s = None
            else:
                raise Rejected("this screen does not go on by itself; answer it first")
            self._notify()

    def reply(self, text: str) -> None:
        """Answer a Question. Raises Rejected for another screen, an answer that is no option, or a long one."""
        with self._changed:
            screen = self.screen()
            if not isinstance(screen, Question):
                raise Rejected("there is no question on the screen; answer the trial")
            line = " ".join(text.split())
            if len(line) > 1000:
                raise Rejected(f"{len(line)} characters; give at most 1000")
            if screen.options and line not in screen.options:
                raise Rejected(f"{line[:40]!r} is none of the answers; choose one")
            row = self._identity() | {"question": screen.name, "answer": line, "answered_utc": _now_utc()}
            _append(self._folder / ANSWERS, ANSWER_COLUMNS, [row])
            self._replies.add(screen.name)
            self._notify()

    def _question(self, when: str) -> Question | None:
        """Return the first question of that time that is not answered."""
        for each in self._study.questions:
            if each.when == when and each.name not in self._replies:
                return Question(each.name, each.text, each.options)
        return None

    # ---- trials ----

    def play(self, label: str) -> None:
        """Play an interval of the present trial, or all in order; or switch to it. Raises Rejected."""
        with self._changed:
            trial = self._present_trial()
            intervals = {each.label: each for each in trial.intervals}
            if label not in intervals:
                raise Rejected(f"there is no interval {label[:20]!r}; choose one of {', '.join(intervals)}")
            all_first = trial.in_order and (not trial.switches or not self._all_played(trial))
            wanted = list(trial.intervals) if all_first else [intervals[label]]
            if (self._now is not None or self._queue) and (all_first or not trial.switches):
                raise Rejected("an interval is playing; wait for its end")
            most = trial.max_plays
            if most is not None and any(self._plays.get(each.label, 0) >= most for each in wanted):
                raise Rejected(f"it has been played {most} time(s), the most in this study; answer now")
            if self._now is not None:
                self._switch(wanted[0])
            else:
                self._queue = wanted
            self._notify()

    def stop_playing(self) -> None:
        """Bring the actuator to rest; the trial goes on."""
        with self._changed:
            self._queue, self._now = [], None
            self._player.stop()
            self._note_played()
            self._notify()

    def plays(self) -> Mapping[str, int]:
        """Return how often each label of the present trial was played."""
        with self._changed:
            return dict(self._plays)

    def wait_until_quiet(self) -> None:
        """Wait until nothing plays any more, at most a minute."""
        with self._changed:
            self._changed.wait_for(lambda: self._paused or not (self._queue or self._now), 60.0)

    def answer(self, values: tuple[int, ...]) -> bool | None:
        """Store the answer on disk and go on; return whether it was correct, None without feedback.

        Raises Rejected for values that do not fit, or before every interval was played; OSError where the disk is full:
        then the trial stays.
        """
        with self._changed:
            trial = self._present_trial()
            _check_values(trial, values)
            if not self._all_played(trial):
                missing = [each.label for each in trial.intervals if not self._plays.get(each.label)]
                raise Rejected(f"{', '.join(missing)} not played yet; play it first")
            if self._queue:
                raise Rejected("an interval is still to come; wait for its end")
            self.stop_playing()
            answer = Answer(tuple(values), self._clock() - self._heard_s, dict(self._plays))
            rows = [
                self._identity()
                | {
                    "trial": trial.number,
                    "phase": trial.phase,
                    "block": trial.block,
                    "method": self._study.method,
                    "texture": trial.texture,
                    "presentation": presentation(trial),
                    "reaction_s": f"{answer.reaction_s:.3f}",
                    "answered_utc": _now_utc(),
                }
                | row
                for row in self._design.rows(trial, answer, self._history)
            ]
            _append(self._folder / RESULTS, RESULT_COLUMNS, rows)
            self._history.append(Answered(trial, answer))
            self._begin(self._design.next_trial(self._history), trial)
            self._notify()
            right = trial.facts.get("correct")
            return None if not trial.feedback or right is None else values[0] == right

    def _begin(self, trial: Trial | None, before: Trial) -> None:
        """Go to the next trial, with a break before a new block."""
        self._trial, self._plays = trial, {}
        if trial is not None and trial.block != before.block:
            seconds = 0.0 if before.phase == PRACTICE else self._study.break_seconds
            self._break_until_s = self._clock() + seconds
            self._log("break", trial=trial.number)

    def _present_trial(self) -> Trial:
        screen = self.screen()
        if not isinstance(screen, Trial):
            raise Rejected("there is no trial on the screen; reload the page")
        return screen

    def _all_played(self, trial: Trial) -> bool:
        return all(self._plays.get(each.label) for each in trial.intervals)

    # ---- the experimenter ----

    def pause(self) -> None:
        """Stop the actuator and show Paused until `resume`."""
        with self._changed:
            self.stop_playing()
            self._paused = True
            self._log("paused")
            self._notify()

    def resume(self) -> None:
        """Show the trial again, from its beginning."""
        with self._changed:
            self._paused = False
            self._plays = {}
            self._log("resumed", trial=len(self._history) + 1)
            self._notify()

    def abort(self) -> None:
        """Stop the actuator and end the run; all answers stay, and the command goes on if it is started again."""
        with self._changed:
            self.stop_playing()
            self._ended = True
            self._log("aborted")
            self._notify()

    def close(self) -> None:
        """Bring the actuator to rest and release the device; may be called again."""
        with self._changed:
            if self._closed:
                return
            self.stop_playing()
            self._closed = True
            self._log("closed")
            self._notify()
        self._thread.join()
        self._player.close()

    def state(self) -> State:
        """Return what the experimenter sees."""
        with self._changed:
            screen = self.screen()
            trial = self._trial
            stimulus = None if self._now is None else self._stimuli.get(self._now.stimulus or "")
            return State(
                participant=self._participant,
                screen=type(screen).__name__.lower(),
                trial=len(self._history) if trial is None else trial.number,
                total=None if trial is None else trial.total,
                block=0 if trial is None else trial.block,
                paused=self._paused,
                ended=self.has_ended,
                now_playing=None if self._now is None else self._now.label,
                level_db=None if stimulus is None else stimulus.facts.get("level_db"),
                device=self._device,
                warnings=tuple(self._warnings),
            )

    # ---- the thread that plays ----

    def _conduct(self) -> None:
        """Play the queue, one interval after the other, until the session is closed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._queue)
                if self._closed:
                    return
                interval = self._queue.pop(0)
                trial = self._trial
                self._start(interval)
            self._wait_for_end(interval)
            with self._changed:
                more = bool(self._queue)
            if more and trial is not None and trial.pause_s:
                self._sleep(trial.pause_s)

    def _start(self, interval: Interval) -> None:
        self._now = interval
        self._count(interval)
        stimulus = self._stimulus(interval)
        if stimulus is not None:
            try:
                self._player.start(stimulus)
            except DEVICE_ERRORS as error:
                self._fail(error)
        self._notify()

    def _switch(self, interval: Interval) -> None:
        """Go on in another interval, at the same place."""
        self._now = interval
        self._count(interval)
        stimulus = self._stimulus(interval)
        assert stimulus is not None, "only staircases have silence, and they do not switch"
        try:
            self._player.switch(stimulus)
        except DEVICE_ERRORS as error:
            self._fail(error)

    def _count(self, interval: Interval) -> None:
        """Note that an interval begins; the reaction is counted from the last first time."""
        if not self._plays.get(interval.label):
            self._heard_s = self._clock()
        self._plays[interval.label] = self._plays.get(interval.label, 0) + 1

    def _wait_for_end(self, interval: Interval) -> None:
        """Wait until an interval has been played, stopped or replaced by another."""
        silent_s = self._study.stimulus_seconds if interval.stimulus is None else 0.0
        while True:
            with self._changed:
                if self._now is None or self._closed:
                    return
                if silent_s <= 0 and not self._is_playing():
                    self._now = None
                    self._note_played()
                    self._notify()
                    return
            self._sleep(_POLL_S)
            silent_s -= _POLL_S

    def _is_playing(self) -> bool:
        """Return whether the device plays; a device that is gone does not."""
        try:
            return self._player.playing() is not None
        except DEVICE_ERRORS as error:
            self._fail(error)
            return False

    def _stimulus(self, interval: Interval) -> Stimulus | None:
        """Return the stimulus of an interval at its level; None for silence."""
        if interval.stimulus is None:
            return None
        stimulus = self._stimuli[interval.stimulus]
        if not interval.gain_db:
            return stimulus
        stream = stimulus.stream.with_gain(interval.gain_db)
        return replace(stimulus, stream=stream, gain_db=stimulus.gain_db + interval.gain_db)

    def _fail(self, error: Exception) -> None:
        """Pause the run, because the device is gone, and say why to the experimenter."""
        self._queue, self._now = [], None
        self._paused = True
        self._warnings.append(str(error))
        self._player.stop()
        self._log("device failed", reason=str(error))
        self._notify()

    def _note_played(self) -> None:
        """Log what the device has played since the last call."""
        with suppress(*DEVICE_ERRORS):
            for each in self._player.take_played():
                self._log("played", **asdict(each))

    def _notify(self) -> None:
        self._version += 1
        self._changed.notify_all()

    # ---- files ----

    def _identity(self) -> dict[str, object]:
        return {"study": self._study.name, "participant": self._participant}

    def _log(self, event: str, **details: object) -> None:
        trial = len(self._history) + 1
        line = json.dumps({"utc": _now_utc(), "event": event, "trial": trial, **details}, allow_nan=False)
        try:
            with (self._folder / LOG).open("a", encoding="utf-8") as file:
                file.write(line + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:  # a full disk must not keep anyone from stopping the actuator
            self._warnings.append(f"the log cannot be written: {error.strerror}; free some space")

    def _check_folder(self) -> None:
        """Write what run this is; raise InputError where the folder holds another one."""
        path = self._folder / RUN
        run = {
            "study": self._study.name,
            "study_sha256": self._study.sha256,
            "participant": self._participant,
            "method": self._study.method,
            "seed": self._study.seed,
        }
        if path.exists():
            try:
                known = json.loads(path.read_text(encoding="utf-8"))
            except ValueError as error:
                raise InputError(f"{path}: damaged ({error}); give another folder") from error
            differing = [key for key, value in run.items() if known.get(key) != value]
            if differing:
                raise InputError(
                    f"{path}: a run of another {differing[0]}; give another folder or the study file of that run"
                )
            return
        facts = {**run, "device": self._device, "vibrocast": version("vibrocast"), "started_utc": _now_utc()}
        with atomic_write(path) as partial:
            partial.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")

    def _resumed(self) -> list[Answered]:
        """Return the trials that are answered on disk; drop one that was cut while it was written."""
        path = self._folder / RESULTS
        rows, is_damaged = _read_rows(path, RESULT_COLUMNS)
        history: list[Answered] = []
        kept = 0
        while kept < len(rows):
            trial = self._design.next_trial(history)
            if trial is None:
                raise InputError(f"{path}: more trials than the study has; give the study file of that run")
            count = 1 if isinstance(trial.response, Choices) else len(trial.response.labels)
            block = rows[kept : kept + count]
            if len(block) < count:
                is_damaged = True
                break
            if any(row["trial"] != str(trial.number) or row["presentation"] != presentation(trial) for row in block):
                raise InputError(f"{path}: trial {trial.number} is another one; give the study file of that run")
            values = tuple(int(row["value"]) for row in block)
            history.append(Answered(trial, Answer(values, float(block[0]["reaction_s"]), {})))
            kept += count
        if is_damaged:
            self._warnings.append(f"the last answer was cut while it was written; trial {len(history) + 1} comes again")
            _write(path, RESULT_COLUMNS, rows[:kept])
        return history

    def _check_stimuli(self) -> None:
        """Raise InputError unless all stimuli of the first trial are there."""
        wanted = [] if self._trial is None else [each.stimulus for each in self._trial.intervals]
        if missing := [key for key in wanted if key is not None and key not in self._stimuli]:
            raise InputError(f"there is no stimulus {missing[0]!r}; prepare the stimuli of this study file again")


def _check_values(trial: Trial, values: Sequence[int]) -> None:
    """Raise Rejected for values that the response does not take."""
    response = trial.response
    if isinstance(response, Choices):
        count, low, high = 1, 0, len(response.options) - 1
    else:
        count, low, high = len(response.labels), response.low, response.high
    if len(values) != count or not all(type(value) is int and low <= value <= high for value in values):
        raise Rejected(f"the answer does not fit; give {count} whole number(s) from {low} to {high}")


def _read_rows(path: Path, columns: Sequence[str]) -> tuple[list[dict[str, str]], bool]:
    """Return the whole rows of a table, and whether its end is damaged. Raises InputError for another table."""
    if not path.exists():
        return [], False
    text = path.read_bytes().decode("utf-8", errors="replace")
    whole, _, rest = text.rpartition("\n")
    lines = list(csv.reader(io.StringIO(whole)))
    if not lines:
        return [], bool(rest)
    if lines[0] != list(columns):
        raise InputError(f"{path}: other columns than those of a run; give another folder")
    rows = [dict(zip(columns, line, strict=True)) for line in lines[1:] if len(line) == len(columns)]
    return rows, bool(rest) or len(rows) != len(lines) - 1


def _append(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> None:
    """Add rows to a table, and wait until they are on disk; what could not be written whole is taken back."""
    begins = not path.exists() or path.stat().st_size == 0
    with path.open("a", encoding="utf-8", newline="") as file:
        before = file.tell()
        try:
            file.write(as_csv(columns, rows, header=begins))
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):
                os.truncate(path, before)
            raise
    if begins and hasattr(os, "O_DIRECTORY"):
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _write(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> None:
    """Replace a table by whole rows."""
    with atomic_write(path) as partial:
        partial.write_text(as_csv(columns, rows), encoding="utf-8", newline="")


def as_csv(columns: Sequence[str], rows: Sequence[Mapping[str, Any]], header: bool = True) -> str:
    """Return rows as the text of a CSV file; None is an empty field."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _now_utc() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
