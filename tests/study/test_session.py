"""A run: its screens, its rules, its files, and how it goes on after a crash."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.study.small_study import stimuli_of, study_of, text_of
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import InputError
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.study import stimuli
from vibrocast.study.device_player import SilentPlayer
from vibrocast.study.methods import DESIGNS
from vibrocast.study.session import LOG, RESULTS, RUN, Session
from vibrocast.study.study_file import METHODS, Study, read_study
from vibrocast.study.trials import Break, Choices, Message, Paused, Question, Rejected, Sliders, Stimulus, Trial

QUESTIONS = """
[[questions]]
name = "hand"
text = "Which hand do you use?"
options = ["left", "right"]
[[questions]]
name = "comment"
text = "Anything to add?"
when = "after"
"""


class LostPlayer(SilentPlayer):
    """A device that is gone from its n-th presentation on."""

    def __init__(self, lasts: int) -> None:
        super().__init__()
        self.left = lasts
        self.stops = 0

    def start(self, stimulus: Stimulus) -> None:
        self.left -= 1
        if self.left < 0:
            raise TransportError("the cable was pulled; plug it in")
        super().start(stimulus)

    def stop(self) -> None:
        self.stops += 1
        super().stop()


def opened(study: Study, folder: Path, out: Path, player: SilentPlayer | None = None, participant: int = 1) -> Session:
    stimuli = stimuli_of(study.method, folder)
    return Session(study, stimuli, participant, out, player or SilentPlayer(), sleep=lambda _: None)


def play_all(session: Session, trial: Trial) -> None:
    for each in trial.intervals[:1] if trial.in_order else trial.intervals:
        session.play(each.label)
        session.wait_until_quiet()


def some_answer(trial: Trial) -> tuple[int, ...]:
    if isinstance(trial.response, Sliders):
        return tuple(range(len(trial.response.labels)))
    return (trial.number % len(trial.response.options),)


def step(session: Session) -> None:
    """Do whatever the present screen asks for."""
    screen = session.screen()
    if isinstance(screen, Trial):
        play_all(session, screen)
        session.answer(some_answer(screen))
    elif isinstance(screen, Question):
        session.reply(screen.options[0] if screen.options else "nothing")
    elif isinstance(screen, Message | Break):
        session.go_on()


def next_trial(session: Session) -> Trial:
    """Go on to the next trial, and return it."""
    while not isinstance(screen := session.screen(), Trial):
        step(session)
    return screen


def run_through(session: Session) -> list[Trial]:
    trials = []
    while not session.has_ended:
        screen = session.screen()
        if isinstance(screen, Trial):
            trials.append(screen)
        step(session)
    return trials


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / RESULTS).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("method", METHODS)
def test_a_run_logs_what_it_plays_and_goes_on_with_the_same_trials_when_it_is_opened_again(
    method: str, folder: Path, tmp_path: Path
) -> None:
    study = study_of(folder, method)
    whole = opened(study, folder, tmp_path / "whole")
    expected = run_through(whole)
    whole.close()
    rows = rows_of(tmp_path / "whole")
    assert len(rows) == sum(len(each.response.labels) if isinstance(each.response, Sliders) else 1 for each in expected)
    assert {(row["method"], row["texture"]) for row in rows} == {(method, "rough"), (method, "wood")}
    events = [json.loads(line) for line in (tmp_path / "whole" / LOG).read_text().splitlines()]
    played = [(event["stimulus"], len(event["stream_sha256"])) for event in events if event["event"] == "played"]
    shown = [each.stimulus for trial in expected for each in trial.intervals if each.stimulus]
    assert played == [(stimulus, 64) for stimulus in shown]
    if method != "staircase":
        assert set(shown) == {each.key for each in stimuli_of(method, folder)}
    trials: list[Trial] = []
    for _ in range(1000):
        session = opened(study, folder, tmp_path / "parts")
        if session.has_ended:
            session.close()
            break
        trials.append(next_trial(session))
        step(session)
        session.close()
    assert trials == expected
    columns = ("trial", "condition", "presentation", "value", "correct", "level_db", "reversal")
    first, second = ([[row[key] for key in columns] for row in each] for each in (rows, rows_of(tmp_path / "parts")))
    assert first == second


# The others show what they are: an open reference, or silence and a texture.
@pytest.mark.parametrize("method", sorted(set(METHODS) - {"staircase", "degradation"}))
def test_labels_tell_nothing_of_conditions(method: str, folder: Path) -> None:
    study = study_of(folder, method)
    firsts = {
        DESIGNS[method](study, participant).next_trial([]).intervals[-1].stimulus  # type: ignore[union-attr]
        for participant in range(1, 30)
    }
    assert len(firsts) > 1


def test_each_interval_must_be_felt_before_an_answer_counts(folder: Path, tmp_path: Path) -> None:
    session = opened(study_of(folder, "degradation", "max_plays = 2\n"), folder, tmp_path)
    trial = next_trial(session)
    session.play("Reference")
    session.wait_until_quiet()
    with pytest.raises(Rejected, match="A not played yet"):
        session.answer((0,))
    session.play("A")
    session.wait_until_quiet()
    for wrong in ((4,), (-1,), (), (0, 0), (True,), ("1",)):
        with pytest.raises(Rejected, match="does not fit"):
            session.answer(wrong)  # type: ignore[arg-type]
    session.play("A")
    session.wait_until_quiet()
    with pytest.raises(Rejected, match="the most in this study"):
        session.play("A")
    with pytest.raises(Rejected, match="no interval"):
        session.play("B")
    with pytest.raises(Rejected):
        session.go_on()
    with pytest.raises(Rejected):
        session.reply("x")
    session.answer((1,))
    assert session.screen() != trial
    session.close()
    (row,) = rows_of(tmp_path)
    assert isinstance(trial.response, Choices)
    assert (row["value"], row["response"]) == ("1", trial.response.options[1]), "counted from zero"


def test_questions_are_asked_once_and_kept(folder: Path, tmp_path: Path) -> None:
    path = folder / "asked.toml"
    path.write_text(text_of("abx").replace("[[textures]]", QUESTIONS + "[[textures]]", 1))
    study = read_study(path)
    session = opened(study, folder, tmp_path)
    session.go_on()
    assert isinstance(session.screen(), Question)
    with pytest.raises(Rejected, match="none of the answers"):
        session.reply("both")
    session.reply("left")
    session.close()
    session = opened(study, folder, tmp_path)
    session.go_on()
    assert isinstance(session.screen(), Message), "the question is answered"
    run_through(session)
    session.close()
    assert [line.split(",")[2:4] for line in (tmp_path / "answers.csv").read_text().splitlines()[1:]] == [
        ["hand", "left"],
        ["comment", "nothing"],
    ]


def test_a_lost_device_pauses_the_run_and_pause_and_abort_stop_the_actuator(folder: Path, tmp_path: Path) -> None:
    player = LostPlayer(1)
    session = opened(study_of(folder, "degradation"), folder, tmp_path, player)
    trial = next_trial(session)
    play_all(session, trial)
    assert isinstance(session.screen(), Paused)
    assert "cable" in session.state().warnings[-1]
    assert player.stops > 0
    player.left = 100
    session.resume()
    assert session.screen() == trial
    assert session.plays() == {}
    for action in (session.pause, session.resume, session.abort):
        before = player.stops
        action()
        assert player.stops > before or action == session.resume
    assert session.has_ended and session.state().ended
    with pytest.raises(Rejected):
        session.play("A")
    session.close()


@pytest.mark.parametrize("lost", [1, 30, 200])
def test_an_answer_cut_while_it_was_written_is_asked_again(lost: int, folder: Path, tmp_path: Path) -> None:
    study = study_of(folder, "mushra")
    session = opened(study, folder, tmp_path)
    while session.state().trial < 2:
        step(session)
    session.close()
    data = (tmp_path / RESULTS).read_bytes()
    (tmp_path / RESULTS).write_bytes(data[:-lost])
    session = opened(study, folder, tmp_path)
    assert session.state().trial == 1
    assert "comes again" in session.state().warnings[-1]
    run_through(session)
    session.close()
    assert len(rows_of(tmp_path)) == 2 * 5


def test_results_of_another_study_are_rejected(folder: Path, tmp_path: Path) -> None:
    opened(study_of(folder, "abx"), folder, tmp_path).close()
    with pytest.raises(InputError, match="another study_sha256"):
        opened(study_of(folder, "abx", "pause_seconds = 1\n"), folder, tmp_path)
    with pytest.raises(InputError, match="another participant"):
        opened(study_of(folder, "abx"), folder, tmp_path, participant=2)
    (tmp_path / RUN).write_text("{")
    with pytest.raises(InputError, match="damaged"):
        opened(study_of(folder, "abx"), folder, tmp_path)


def test_a_full_disk_keeps_the_trial(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = opened(study_of(folder, "abx"), folder, tmp_path)
    trial = next_trial(session)
    play_all(session, trial)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            session.answer((0,))
    assert session.screen() == trial
    session.answer((0,))
    assert len(rows_of(tmp_path)) == 1
    session.close()


# ---- a program that is killed ----

PROGRAM = """
import os, signal, sys, time
from pathlib import Path
from tests.study.test_session import KillingPlayer, step
from vibrocast.study import stimuli
from vibrocast.study.session import Session
from vibrocast.study.study_file import read_study
from vibrocast.study.trials import Trial
folder, out, point, how = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), getattr(signal, sys.argv[4])
made = stimuli.load(folder / "stimuli")
session = Session(read_study(folder / "abx.toml"), made, 1, out, KillingPlayer(point, how), sleep=lambda _: None)
try:
    while not session.has_ended:
        screen = session.screen()
        step(session)
        if isinstance(screen, Trial):
            print("acknowledged", screen.number, flush=True)
            session._player.passed()
finally:
    session.close()
"""


class KillingPlayer(SilentPlayer):
    """Kills its own process at one of the points that a run passes: at presentations and after answers."""

    def __init__(self, point: int, how: int) -> None:
        super().__init__()
        self.point, self.how = point, how
        if how == signal.SIGTERM:
            signal.signal(signal.SIGTERM, signal.default_int_handler)

    def start(self, stimulus: Stimulus) -> None:
        super().start(stimulus)
        self.passed()

    def stop(self) -> None:
        super().stop()
        if self.point < 0:
            print("at rest", flush=True)

    def passed(self) -> None:
        """Note a point of the run."""
        if self.point == 0:
            self.point = -1
            os.kill(os.getpid(), self.how)
            time.sleep(5 if self.how == signal.SIGKILL else 0)
        else:
            self.point -= 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("how", ["SIGKILL", "SIGTERM"])
@pytest.mark.parametrize("point", [0, 6, 15])  # of four trials of three presentations and an answer each
def test_no_answer_is_lost_wherever_the_program_is_killed(how: str, point: int, folder: Path, tmp_path: Path) -> None:
    study_of(folder, "abx")
    stimuli.save(folder / "stimuli", stimuli_of("abx", folder), PIEZO_STACK)

    def run(at: int) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", PROGRAM, str(folder), str(tmp_path), str(at), how]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    first = run(point)
    assert first.returncode != 0, first.stderr
    acknowledged = first.stdout.count("acknowledged")
    kept = rows_of(tmp_path) if (tmp_path / RESULTS).exists() else []
    assert acknowledged <= len(kept) <= acknowledged + 1
    assert how != "SIGTERM" or "at rest" in first.stdout
    second = run(-1)
    assert second.returncode == 0, second.stderr
    rows = rows_of(tmp_path)
    assert [row["trial"] for row in rows] == ["1", "2", "3", "4"]
    assert rows[: len(kept)] == kept
