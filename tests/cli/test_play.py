"""`vibrocast play`: what it answers and leaves where a playback does not come to its end, and on which controllers."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from tests.command import OAK, failure, run
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import devices, event_loop
from vibrocast.host.report import SCHEMA
from vibrocast.output.actuator import Actuator

play = partial(run, "play", OAK)


@pytest.mark.parametrize(
    ("other", "differs", "exit_code"), [("serial:absent", False, 3), ("sim", False, 3), ("sim", True, 1)]
)
def test_several_controllers_end_with_the_exit_code_that_failures_share(
    other: str, differs: bool, exit_code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the answer has an error, which a list could not have."""
    monkeypatch.setattr("vibrocast.host.report.Report.differs", differs)
    told = failure(exit_code, "play", OAK, "--device", "serial:nowhere", "--device", other)
    assert "controllers failed: serial:nowhere" in told["error"]
    absent, second = told["results"]
    assert absent["device"] == {"address": "serial:nowhere"} and "cannot open serial port nowhere" in absent["error"]
    assert absent["run"] == second["run"]


@pytest.mark.parametrize(("cut", "exit_code"), [(KeyboardInterrupt(), 130), (TransportError("the cable is out"), 3)])
def test_a_playback_that_is_cut_leaves_report_and_trace(
    cut: BaseException, exit_code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_all = event_loop.run_all

    def play_and_cut(works: Any) -> Any:
        outcomes = run_all(works)
        if isinstance(cut, Exception):
            return dict.fromkeys(outcomes, cut)
        raise cut

    monkeypatch.setattr("vibrocast.host.event_loop.run_all", play_and_cut)
    report = tmp_path / "cut.json"
    answered = failure(exit_code, "play", OAK, "--report", report)
    told = json.loads(report.read_text())
    assert told["error"] == (str(cut) or "interrupted")
    assert told["device"] == {"address": "sim"} and told["played_s"] == pytest.approx(4.0, abs=0.1)
    assert told["underruns"] >= 0 and told["lost_packets"] >= 0 and told["schema"] == SCHEMA
    assert answered == {**told, "exit_code": exit_code}
    assert (tmp_path / "cut.pcapng").exists()


@pytest.mark.parametrize("command", [("play", OAK), ("live", "rough", "--seconds", "0.3")])
def test_controllers_at_one_address_have_each_its_own_actuator(
    command: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = tmp_path / "two.toml"
    bench.write_text(
        "".join(
            f'[[controllers]]\nname = "{name}"\naddress = "sim"\n'
            f'[[actuators]]\ncontroller = "{name}"\nmodel = "{model}"\n'
            for name, model in (("left", "piezo-stack"), ("right", "lra"))
        )
        + "[limits]\nmax_lost_percent = 100\n"
    )
    opened: list[str] = []
    connect = devices.connect

    def noted(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Any:
        assert actuator is not None
        opened.append(actuator.name)
        return connect(address, runtime, actuator)

    monkeypatch.setattr("vibrocast.host.devices.connect", noted)
    for given, names in ((("right",), ["lra"]), (("sim",), ["piezo-stack"]), ((), ["piezo-stack"])):
        chosen = [part for name in given for part in ("--device", name)]
        result = run(*command, "--bench", bench, *chosen)
        assert (result.exit_code, opened) == (0, names), result.output
        opened.clear()
    if command[0] == "play":
        result = play("--bench", bench, "--device", "left", "--device", "right", "--json")
        assert [each["actuator"]["name"] for each in json.loads(result.stdout)] == ["piezo-stack", "lra"]


@pytest.mark.usefixtures("simulated_time")
def test_a_list_names_what_it_cannot_play_and_says_how_to(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "plain.wav", np.sin(np.arange(800) / 5.0), 2800)
    result = run("play", OAK, "absent.wav", tmp_path / "plain.wav", OAK, "--to", "0.2")
    assert result.exit_code == 2 and "played 2 track(s)" in result.stdout
    assert "absent.wav: no such file or recording; check the name; the list goes on" in result.stderr
    assert "plain.wav: the signal does not state its unit" in result.stderr and "--unit drive" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("error: not all was played: absent.wav, plain.wav")
    assert "give one file" in run("play", OAK, OAK, "--report", "x.json").stderr
