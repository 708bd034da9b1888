"""Tests of the progress of long work on stderr."""

import io

import pytest

from vibrocast import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_long_work_prints_a_line_a_second(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now_s)
    with progress.bar("playing") as update:
        for step in range(11):
            now_s = 100 + 0.25 * step
            update(step / 10, f"step {step}")
    assert capsys.readouterr() == ("", "playing 40 % step 4\nplaying 80 % step 8\n")


def test_a_terminal_has_a_bar_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with progress.bar("flashing") as update:
        update(0.25, "a quarter")
    written = terminal.getvalue()
    assert "flashing a quarter" in written
    assert written.endswith("\x1b[2K")
