"""A sensor's program: what it has started ends with the measurement, whatever happens."""

import os
import time
from pathlib import Path

import pytest

from vibrocast.host.bench_file import Sensor
from vibrocast.host.harness import sensors
from vibrocast.host.harness.sensors import SensorError, recorder


def shell(command: str) -> Sensor:
    arguments = ("sh", "-c", command, "{file}")
    return Sensor(name="it", kind="laser", controller="left", command=arguments)


def has_ended(pid_file: Path) -> bool:
    while not pid_file.exists() or not pid_file.read_text().strip():
        time.sleep(0.01)
    pid = int(pid_file.read_text())
    for _ in range(500):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        state = Path(f"/proc/{pid}/stat")
        if state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z":
            return True  # ended; whoever adopted it has not asked yet
        time.sleep(0.01)
    return False


def test_a_program_that_does_not_end_is_ended_with_what_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors, "_ENDS_WITHIN_S", 0.0)
    pid_file = tmp_path / "pid"
    with (
        pytest.raises(SensorError, match="does not end by itself"),
        recorder(shell(f"sleep 1000 & echo $! > {pid_file}; wait"))(0.0) as finish,
    ):
        finish()
    assert has_ended(pid_file)


def test_a_program_ends_where_playing_fails(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    with (
        pytest.raises(KeyboardInterrupt),
        recorder(shell(f"echo $$ > {pid_file}; exec sleep 1000"))(1000.0),
    ):
        while not pid_file.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert has_ended(pid_file)
