"""The controller's clock seen from the host: offset and drift from Status round trips."""

from dataclasses import dataclass

import numpy as np

from device_protocol.messages import Status
from host.controller import Controller

# Round trips kept: those that no queue on the way has held up.
_KEPT_PART = 0.25
_FEWEST_KEPT = 8


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
    """Collects Status round trips with a controller: when each was sent and answered, and the device's time between."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._trips: list[tuple[float, float, float]] = []

    def probe(self) -> Status:
        """Make a round trip and return its status. Raises as `Controller.request_status`."""
        sent_s = self._controller.clock()
        status = self._controller.request_status()
        self._trips.append((sent_s, self._controller.clock(), status.device_time_us / 1e6))
        return status

    def fit(self) -> ClockFit:
        """Return the line through the shortest round trips, each taken to be as long there as back.

        Least squares, as in the clock filter of NTP (RFC 5905, section 10), which trusts the shortest of recent trips.
        """
        sent_s, answered_s, device_s = np.array(self._trips).T
        round_trips_s = answered_s - sent_s
        kept = np.argsort(round_trips_s, kind="stable")[: max(_FEWEST_KEPT, round(_KEPT_PART * len(round_trips_s)))]
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
