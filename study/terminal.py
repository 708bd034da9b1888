"""The terminal mode of a study: the same run as on the pages, in lines of text."""

import time
from collections.abc import Callable

from vibrocast.study.session import Session
from vibrocast.study.trials import Break, Choices, Message, Paused, Question, Rejected, Sliders, Trial

Ask = Callable[[str], str]
Tell = Callable[[str], None]


def run_in_terminal(session: Session, ask: Ask, tell: Tell, sleep: Callable[[float], None] = time.sleep) -> None:
    """Lead a participant through a run to its end. `ask` shows a prompt and returns a line; `tell` shows a line.

    Raises whatever `ask` raises at the end of input or Ctrl-C; the answers so far are on disk.
    """
    while not session.has_ended:
        screen = session.screen()
        try:
            if isinstance(screen, Message):
                tell(f"{screen.title}\n{screen.text}")
                ask("Enter to go on: ")
                session.go_on()
            elif isinstance(screen, Question):
                session.reply(_reply(screen, ask, tell))
            elif isinstance(screen, Break):
                tell(f"Break: {screen.seconds:.0f} s.")
                sleep(screen.seconds)
                ask("Enter to go on: ")
                session.go_on()
            elif isinstance(screen, Paused):
                for warning in session.state().warnings[-1:]:
                    tell(warning)
                ask("Paused. Enter to resume: ")
                session.resume()
            else:
                _trial(session, screen, ask, tell)
        except Rejected as reason:
            tell(str(reason))
    end = session.screen()
    if isinstance(end, Message):
        tell(end.text)


def _reply(question: Question, ask: Ask, tell: Tell) -> str:
    """Return the answer to a question: a line, or the option of a number."""
    tell(question.text)
    if not question.options:
        return ask("> ")
    for number, option in enumerate(question.options, 1):
        tell(f"  {number}  {option}")
    text = ask(f"1 to {len(question.options)}: ").strip()
    if not text.isdecimal() or not 1 <= int(text) <= len(question.options):
        raise Rejected(f"give a number from 1 to {len(question.options)}")
    return question.options[int(text) - 1]


def _trial(session: Session, trial: Trial, ask: Ask, tell: Tell) -> None:
    """Play and ask until the trial is answered, or the screen has changed."""
    total = "" if trial.total is None else f" of {trial.total}"
    tell(f"Trial {trial.number}{total}: {trial.question}")
    response = trial.response
    options = response.options if isinstance(response, Choices) else ()
    for number, option in enumerate(options, 1):
        tell(f"  {number}  {option}")
    labels = {each.label[0].upper(): each.label for each in trial.intervals}
    plays_all = trial.in_order and not trial.switches
    for key, label in {"": "all"}.items() if plays_all else labels.items():
        tell(f"  p {key}  play {label}".replace("p  ", "p "))
    if isinstance(response, Sliders):
        low, high, count = response.low, response.high, len(response.labels)
        tell(f"  {count} numbers from {low} to {high}, of {', '.join(response.labels)}: the answer")
    tell("  q  pause")
    while session.screen() == trial:
        words = ask("> ").split()
        try:
            if words == ["q"]:
                session.pause()
            elif words[:1] == ["p"]:
                wanted = words[1].upper() if len(words) > 1 else next(iter(labels))
                session.play(labels.get(wanted, wanted))
                session.wait_until_quiet()
            else:
                _answer(session, trial, words, tell)
        except Rejected as reason:
            tell(str(reason))


def _answer(session: Session, trial: Trial, words: list[str], tell: Tell) -> None:
    """Give an answer in numbers. Raises Rejected."""
    if not words or not all(word.isdecimal() and len(word) <= 6 for word in words):
        raise Rejected("give p to play, or the number of an answer")
    values = tuple(map(int, words))
    correct = session.answer(tuple(value - 1 for value in values) if isinstance(trial.response, Choices) else values)
    if correct is not None:
        tell("Correct." if correct else "Not correct.")
