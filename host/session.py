"""A session with a controller: its address, and the models of its actuator, which are asked once when it opens."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vibrocast.device_protocol.messages import ActuatorDescription
from vibrocast.host import devices
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.output.actuator import ACTUATORS, Actuator


@dataclass(frozen=True)
class Session:
    """An open session with the controller at an address, for whatever plays.

    `driven`: the actuator by which the controller computes its DAC's codes; `skin`: the one that moves the skin.
    """

    controller: Controller
    address: str
    driven: Actuator
    skin: Actuator


def session_with(controller: Controller, address: str, actuator: Actuator | None = None) -> Session:
    """Return the session with a controller; `actuator`: the one behind it, None = as the controller says.

    A controller that takes any actuator drives this one; for others it is the model of the skin alone. Raises
    ControllerError where no actuator can be as the controller says.
    """
    if actuator is None:
        driven = skin = actuator_model(controller.description.actuator)
    else:
        skin = devices.behind_dac(address, actuator, controller.description.actuator)
        takes = devices.takes_actuator(address)
        driven = skin if takes else actuator_model(controller.description.actuator)
    return Session(controller, address, driven, skin)


@contextlib.contextmanager
def connect(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Iterator[Session]:
    """Open a session as `devices.connect` does, and as `session_with` says. Raises as both."""
    with devices.connect(address, runtime, actuator) as controller:
        yield session_with(controller, address, actuator)


def actuator_model(description: ActuatorDescription) -> Actuator:
    """Return the model of the actuator that a controller describes.

    Known by its name, with the controller's DAC and volts at full scale, or else built from its band: a low-pass,
    or a resonance where it does not reach down to rest. Raises ControllerError where no actuator can be such.
    """
    if description.name in ACTUATORS and 0 < description.volts < math.inf:
        known = ACTUATORS[description.name]
        # The shortest number of those that are sent as this one, which has seven digits.
        volts = float(str(np.float32(description.volts)))
        if volts != float(str(np.float32(known.volts))):
            known = known.with_full_scale(volts / 2)
        return replace(known, dac_bits=description.dac_bits, dac_rate_hz=description.dac_rate_hz)
    lower_hz, upper_hz = description.lower_hz, description.upper_hz
    if not (
        0 < description.stroke_um < math.inf
        and 0 < description.volts < math.inf
        and 0 <= description.slew_volts_per_second < math.inf
        and 0 <= lower_hz < upper_hz < math.inf
    ):
        raise ControllerError(f"the controller announces an impossible actuator ({description}); update its firmware")
    resonance_hz = math.sqrt(lower_hz * upper_hz)
    return Actuator(
        name=description.name,
        stroke_um=description.stroke_um,
        volts=description.volts,
        corner_hz=resonance_hz or upper_hz,
        quality=resonance_hz / (upper_hz - lower_hz) if resonance_hz else None,
        slew_volts_per_second=description.slew_volts_per_second or description.volts * description.dac_rate_hz,
        volts_limit=description.volts / 2,
        power_limit=1.0,
        dac_bits=description.dac_bits,
        dac_rate_hz=description.dac_rate_hz,
    )
