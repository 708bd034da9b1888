"""The controller's clock seen from the host: offset and drift from Status round trips."""

from dataclasses import dataclass

import numpy as np

from vibrocast.device_protocol.messages import Status
from vibrocast.host.controller import ANSWER_TIMEOUT_S, ConnectionLost, Controller

# Round trips kept: those that no queue on the way has held up.
_KEPT_PART = 0.25
_MIN_KEPT = 8
# A read ends this much before its time, because it may take longer than requested: USB counts in whole milliseconds.
_READ_EARLY_S = 0.001
_MIN_READ_S = 1e-6


@dataclass(frozen=True)
class ClockFit:
    """device time = `device_s` + (1 + `drift_ppm` / 1e6) (host time - `host_s`), all in seconds.

    `drift_error_ppm`: standard error of the drift. `round_trip_ms`: the shortest one; half of it bounds the offset's
    error.
    """

    host_s: float
    device_s: float
    drift_ppm: float
    drift_error_ppm: float
    round_trip_ms: float

    def host_time_s(self, device_s: float) -> float:
        """Return the host's time at a time of the device."""
        return self.host_s + (device_s - self.device_s) / (1 + self.drift_ppm / 1e6)


class DeviceClock:
    """Collects Status round trips with a controller, none of which is waited for: a slow link holds nothing up.

    `trips`: of each, by the number it was requested under, when it was requested and answered, and the answer.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._pending: tuple[int, float] | None = None
        self.trips: dict[int, tuple[float, float, Status]] = {}

    def ask(self, number: int) -> None:
        """Ask, unless an answer is still awaited. Raises TransportError."""
        now_s = self._controller.clock()
        if self._pending is None or now_s - self._pending[1] > ANSWER_TIMEOUT_S:
            self._pending = number, now_s
            self._controller.ask_status()

    def sleep(self, seconds: float) -> None:
        """Let time pass and receive answers. Raises as `Controller.poll`."""
        until_s = self._controller.clock() + seconds
        read_until_s = until_s - _READ_EARLY_S
        while self._pending is not None and (left_s := read_until_s - self._controller.clock()) >= _MIN_READ_S:
            answer = self._controller.poll(left_s)
            if isinstance(answer, Status):
                number, requested_s = self._pending
                self.trips[number] = requested_s, self._controller.clock(), answer
                self._pending = None
        self._controller.sleep(max(0.0, until_s - self._controller.clock()))

    def fit(self) -> ClockFit:
        """Return the line through the shortest round trips, each taken to be as long there as back.

        Raises ControllerError where nothing was answered in time.
        Least squares, as in the clock filter of NTP (RFC 5905, section 10), which trusts the shortest of recent trips.
        """
        if not self.trips:
            raise ConnectionLost(
                "the controller does not answer in time; check the cable, and that no other program uses it"
            )
        sent_s, answered_s, device_s = np.array(
            [(sent_s, answered_s, status.device_time_us / 1e6) for sent_s, answered_s, status in self.trips.values()]
        ).T
        round_trips_s = answered_s - sent_s
        kept = np.argsort(round_trips_s, kind="stable")[: max(_MIN_KEPT, round(_KEPT_PART * len(round_trips_s)))]
        middle_s = (sent_s[kept] + answered_s[kept]) / 2
        host_s, offset_s = float(np.mean(middle_s)), device_s[kept] - middle_s
        spread = float(np.sum(np.square(middle_s - host_s)))
        slope = float(np.sum((middle_s - host_s) * offset_s)) / spread if spread else 0.0
        residual_s = offset_s - np.mean(offset_s) - slope * (middle_s - host_s)
        freedom = max(1, len(kept) - 2)
        error = float(np.sqrt(np.sum(np.square(residual_s)) / freedom / spread)) if spread else 0.0
        return ClockFit(
            host_s=host_s,
            device_s=host_s + float(np.mean(offset_s)),
            drift_ppm=1e6 * slope,
            drift_error_ppm=1e6 * error,
            round_trip_ms=1e3 * float(np.min(round_trips_s)),
        )
