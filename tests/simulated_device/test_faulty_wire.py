"""A wire with faults: each kind, its time, its direction, and the same again from the same seed."""

from pathlib import Path

import pytest

from tests.simulated_device.bench import Echo
from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.errors import InputError
from vibrocast.simulated_device import faulty_wire
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire, RemoteDevice, read_faults

FRAMES = [bytes([number, 1, 2, 3, 0]) for number in range(1, 201)]


def carried(*faults: Fault, seed: int = 1) -> tuple[list[tuple[int, bytes]], bytes]:
    """Send a frame each ms; return what arrived at the controller, and what came back."""
    echo = Echo()
    wire, back = FaultyWire(echo, faults, seed), b""
    for number in range(1000):
        if number < len(FRAMES):
            wire.receive(FRAMES[number], 1000 * number)
        else:
            wire.advance(1000 * number)
        back += wire.transmit()
    return echo.received, back


def test_a_wire_without_faults_carries_all_at_once() -> None:
    received, back = carried()
    assert [at for at, _ in received] == [1000 * number for number in range(200)]
    assert back == b"".join(FRAMES)


def test_frames_are_lost_and_damaged_by_seed() -> None:
    lossy = Fault(lost=0.1, direction="to_controller")
    received, back = carried(lossy)
    assert 160 < len(received) < 195
    assert back == b"".join(data for _, data in received)
    assert carried(lossy) == (received, back)
    assert carried(lossy, seed=2) != (received, back)
    flipped, _ = carried(Fault(flipped=0.1, direction="to_controller"))
    assert 5 < sum(data not in FRAMES for _, data in flipped) < 40
    there, back = carried(Fault(lost=0.1, direction="to_host"))
    assert len(there) == 200 > back.count(0)


def test_faults_change_while_bytes_are_on_their_way() -> None:
    echo = Echo()
    wire = FaultyWire(echo, [Fault(bits_per_second=1)])
    wire.receive(FRAMES[0], 0)
    wire.advance(1_000_000)
    assert (echo.received, wire.waiting_bytes) == ([], 5)
    wire.change(Fault(cut=True, for_s=0.5))
    assert wire.is_cut(1_000_000)
    wire.advance(1_001_000)
    wire.receive(FRAMES[1], 1_002_000)
    assert not wire.is_cut(1_500_000)
    wire.receive(FRAMES[2], 1_500_000)
    assert [data for _, data in echo.received] == [FRAMES[0], FRAMES[2]]


def test_delay_and_capacity_make_frames_late_in_their_order() -> None:
    received, _ = carried(Fault(delay_ms=20, jitter_ms=10, direction="to_controller"))
    assert b"".join(data for _, data in received) == b"".join(FRAMES)
    assert received[0][0] >= 20_000 and received[-1][0] <= 199_000 + 31_000
    slow, _ = carried(Fault(bits_per_second=20_000, direction="to_controller"))  # a frame in 2 ms
    assert slow[-1][0] == pytest.approx(400_000, abs=2000)


def test_a_fault_lasts_as_long_as_it_says_and_a_cut_is_told() -> None:
    told: list[bool] = []
    echo = Echo()
    wire = FaultyWire(echo, [Fault(at_s=0.05, for_s=0.1, cut=True)], on_cut=told.append)
    for number, frame in enumerate(FRAMES):
        wire.receive(frame, 7_000_000 + 1000 * number)  # the schedule begins with the first byte
    assert b"".join(data for _, data in echo.received) == b"".join(FRAMES[:50] + FRAMES[150:])
    assert told == [True, False]


def test_a_schedule_is_read_and_its_mistakes_are_named(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text("[[faults]]\nat_s = 2\nfor_s = 0.5\ncut = true\n[[faults]]\nflipped = 0.02\n")
    assert read_faults(path) == (Fault(at_s=2, for_s=0.5, cut=True), Fault(flipped=0.02))
    for text, message in {
        "[[faults]]\nlost = 2\n": "lost",
        "[[faults]]\nloss = 0.1\n": "did you mean lost",
        "[[faults]]\ndirection = 'up'\n": "one of to_controller, to_host, both",
        "": "faults is missing",
    }.items():
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_faults(path)


class Rebooting(Closing):
    """A transport whose device loses its power, and comes back at the second attempt to open it."""

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.has_power = True
        self._attempts = 0

    def write(self, data: bytes) -> None:
        if not self.has_power:
            raise TransportError("it broke off")
        self.written.append(data)

    def read(self, timeout_s: float) -> bytes:
        if not self.has_power:
            raise TransportError("it broke off")
        return b""

    def reopen(self) -> None:
        self._attempts += 1
        if self._attempts < 2:
            raise TransportError("it is absent")
        self.has_power = True

    def close(self) -> None: ...


def test_a_remote_controller_may_lose_its_power_and_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faulty_wire, "_REOPEN_S", 0.0)
    board = Rebooting()
    seen: list[bool] = []
    remote = RemoteDevice(board, seen.append)
    board.has_power = False
    remote.receive(b"a", 0)
    remote.receive(b"b", 0)
    assert seen == [True] and remote.transmit() == b""
    remote.advance(0)
    remote.advance(0)
    remote.receive(b"c", 0)
    assert seen == [True, False] and board.written == [b"c"]
    board.has_power = False
    with pytest.raises(TransportError):
        RemoteDevice(board).receive(b"d", 0)
