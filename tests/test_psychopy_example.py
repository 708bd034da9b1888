"""The example for PsychoPy runs without PsychoPy, on the simulated controller."""

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[1] / "examples/psychopy_stimulus.py"


def test_the_example_plays_its_stimuli(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE)])
    runpy.run_path(str(EXAMPLE))
    assert capsys.readouterr().out.splitlines() == ["20 dB: 4.0 s, 0 underruns", "5 dB: 4.0 s, 0 underruns"]
    assert "psychopy" not in sys.modules
