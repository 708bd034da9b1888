"""One loop for many controllers: each plays bit for bit what was sent and fails alone; interruptions stop them all."""

from collections.abc import Callable

import numpy as np
import pytest

from tests.conftest import coded, noise, session
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import player
from vibrocast.host.controller import Controller, Sleep, Steps
from vibrocast.host.event_loop import run_all
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import render
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink, SimulatedTime

CHANNELS = 4
SECONDS = 1.5


def stream() -> Stream:
    return coded(noise(SECONDS, CHANNELS, rms=5.0), step=0.5)


def several(count: int) -> tuple[dict[str, FaultyWire], dict[str, Controller]]:
    """Return wires to controllers in one simulated time, and sessions over them."""
    time = SimulatedTime()
    wires = {str(number): FaultyWire(SimulatedController()) for number in range(count)}
    return wires, {name: session(MemoryLink(wire, time=time)) for name, wire in wires.items()}


def play_on(
    controllers: dict[str, Controller],
    stream: Stream,
    fail: Callable[[str, player.Progress], None] = lambda name, now: None,
    buffer_s: float = player.BUFFER_S,
) -> dict[str, player.PlaybackResult | Exception]:
    def steps(name: str) -> Steps[player.PlaybackResult]:
        settings = player.PlaybackSettings(
            buffer_s=buffer_s, reconnect_s=0.5, capture=True, progress=lambda now: fail(name, now)
        )
        return player.play_steps(controllers[name], stream, settings)

    return run_all({name: (controller, steps(name)) for name, controller in controllers.items()})


def check_played(result: object, stream: Stream) -> None:
    expected, _ = render(stream.header, stream.decode_integers(), stream.delay_samples, PIEZO_STACK)
    assert isinstance(result, player.PlaybackResult), result
    assert result.underruns == result.lost_packets == 0
    np.testing.assert_array_equal(result.dac_codes, expected)


def test_of_five_controllers_three_play_on_while_one_is_unplugged_and_one_stops() -> None:
    played = stream()
    wires, controllers = several(5)

    def fail(name: str, now: player.Progress) -> None:
        if name == "1" and now.position_s > 0.3:
            wires[name].change(Fault(cut=True, for_s=60.0))
        if name == "3" and now.position_s > 0.3:
            raise RuntimeError("made up")

    results = play_on(controllers, played, fail)
    assert list(results) == list(wires)
    assert isinstance(results["1"], TransportError)
    assert isinstance(results["3"], RuntimeError)
    assert controllers["3"].request_status().state == State.STOPPED
    for name in ("0", "2", "4"):
        check_played(results[name], played)


@pytest.mark.parametrize("at", ["0", "1"])
def test_an_interruption_stops_every_controller(at: str) -> None:
    _, controllers = several(2)

    def interrupt(name: str, now: player.Progress) -> None:
        if name == at and now.position_s > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play_on(controllers, stream(), interrupt)
    assert [each.request_status().state for each in controllers.values()] == [State.STOPPED, State.STOPPED]


def test_a_pause_reads_nothing_and_the_others_go_on() -> None:
    wires, controllers = several(2)
    order: list[str] = []

    def pauses() -> Steps[None]:
        wires["0"].change(Fault(cut=True, for_s=0.5))
        yield Sleep(1.0)
        order.append("paused")

    def polls() -> Steps[None]:
        yield from controllers["1"].poll_steps(0.4)
        order.append("polled")

    run_all({"pauses": (controllers["0"], pauses()), "polls": (controllers["1"], polls())})
    assert order == ["polled", "paused"]
