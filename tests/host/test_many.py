"""Many controllers at once: each plays bit for bit what was sent, and fails alone."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial

import numpy as np
import pytest

from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.transports import TransportError, UsbTransport
from vibrocast.host import player
from vibrocast.host.controller import ConnectionLost, Controller
from vibrocast.host.many import on_all
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import render
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort
from vibrocast.textures import Recording

CHANNELS = 4
SECONDS = 1.5


def stream() -> Stream:
    samples = 5.0 * np.random.default_rng(1).standard_normal((round(SECONDS * 2800), CHANNELS))
    return encode_recording(Recording(samples, 2800.0, "um", "noise"), setting={"step": 0.5}, live=True).stream


@contextmanager
def session(port: UsbPort) -> Iterator[Controller]:
    with UsbTransport(VENDOR_ID, PRODUCT_ID, port) as transport:
        yield Controller(transport)


@pytest.mark.slow
def test_of_eight_controllers_six_play_on_while_one_is_unplugged_and_one_stalls() -> None:
    sent = stream()
    decoder = sent.decoder()
    expected, _ = render(sent.header, sent.decode_integers(), decoder.delay_samples, PIEZO_STACK)
    with ExitStack() as stack:
        ports = [stack.enter_context(UsbPort(SimulatedController())) for _ in range(8)]

        def fail(name: str, now: player.Progress) -> None:
            if name == "2" and now.position_s > 0.3:
                ports[2].unplug()
            if name == "5" and now.position_s > 0.3:
                ports[5].keep_busy(60.0)

        def play(name: str, controller: Controller, check: Callable[[], None]) -> player.PlaybackResult:
            def note(now: player.Progress) -> None:
                check()
                fail(name, now)

            return player.play(
                controller,
                sent.header,
                sent.packets,
                decoder.packet_samples,
                buffer_s=1.0,  # a computer that is busy with other tests
                reconnect_s=0.5,
                capture=True,
                progress=note,
            )

        sessions: dict[str, Callable[[], AbstractContextManager[Controller]]] = {
            str(number): partial(session, port) for number, port in enumerate(ports)
        }
        results = on_all(sessions, play)
    assert list(results) == [str(number) for number in range(8)]
    assert isinstance(results["2"], TransportError)
    assert isinstance(results["5"], ConnectionLost | TransportError)
    for name in set(results) - {"2", "5"}:
        result = results[name]
        assert isinstance(result, player.PlaybackResult), result
        assert result.underruns == result.lost_packets == 0
        np.testing.assert_array_equal(result.dac_codes, expected)


INTERRUPTED_WORK = """
import os, signal, sys, threading, time
from contextlib import nullcontext
from vibrocast.host.many import Interrupted, on_all

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it


def work(name, session, check):
    try:
        while True:
            check()
            time.sleep(0.01)
    except Interrupted:
        time.sleep(0.3)
        os.write(1, b"stopped\\n")  # at once: print writes the line and its end apart, and both threads write
        raise

threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    on_all(dict.fromkeys(("one", "other"), lambda: nullcontext(None)), work)
except KeyboardInterrupt:
    print("interrupted", flush=True)
os._exit(0)
"""


def test_interrupted_it_waits_until_every_controller_has_been_stopped() -> None:
    run = subprocess.run([sys.executable, "-c", INTERRUPTED_WORK], capture_output=True, text=True, timeout=30)
    assert run.stdout.split() == ["stopped", "stopped", "interrupted"], run.stderr
