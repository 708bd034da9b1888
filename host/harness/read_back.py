"""Reads whole captures back from a controller."""

import numpy as np
from numpy.typing import NDArray

from device_protocol.messages import Tap
from host.controller import Controller


def read_capture(controller: Controller, tap: Tap, channels: int, offset: int = 0) -> NDArray[np.int16]:
    """Return what a tap has captured of the last stream from a sample on: int16 (n, channels).

    Raises as `Controller.read_capture`.
    """
    pieces = [np.zeros((0, channels), np.int16)]
    while True:
        captured = controller.read_capture(tap, offset, controller.capture_room(channels), channels)
        pieces.append(np.frombuffer(captured.data, "<i2").astype(np.int16).reshape(-1, channels))
        offset += len(pieces[-1])
        if not len(pieces[-1]) or offset >= captured.end:
            return np.concatenate(pieces)
