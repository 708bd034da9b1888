"""Reads back from a controller what its captures hold of the last stream."""

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.messages import CaptureData, CaptureRead, Tap
from vibrocast.host.controller import Controller


def oldest(controller: Controller, tap: Tap) -> int:
    """Return the number of the first sample that a tap still has. Raises as `Controller.request`."""
    return controller.request(CaptureRead(tap, 0, 1), CaptureData).offset


def read_capture(controller: Controller, tap: Tap, channels: int) -> tuple[int, NDArray[np.int16]]:
    """Return the number of the first sample that a tap still has, and all from there on: int16 (n, channels).

    Raises as `Controller.read_capture`.
    """
    first = offset = oldest(controller, tap)
    pieces = [np.zeros((0, channels), np.int16)]
    while True:
        captured = controller.read_capture(tap, offset, controller.capture_room(channels), channels)
        pieces.append(np.frombuffer(captured.data, "<i2").astype(np.int16).reshape(-1, channels))
        offset += len(pieces[-1])
        if not len(pieces[-1]) or offset >= captured.end:
            return first, np.concatenate(pieces)
