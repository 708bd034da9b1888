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
    `is_known`: whether `driven` is all that the controller computes by. Otherwise it was built from the controller's
    description, which leaves out some limits, and codes cannot be compared.
    """

    controller: Controller
    address: str
    driven: Actuator
    skin: Actuator
    is_known: bool = True

    @property
    def unknown_note(self) -> str | None:
        """Why the controller's codes cannot be compared with those computed here; None if they can."""
        name = self.controller.description.actuator.name
        return None if self.is_known else f"the limits of {name} are unknown; give its file as --actuator"


def session_with(controller: Controller, address: str, actuator: Actuator | None = None) -> Session:
    """Return the session with a controller; `actuator`: the one behind it, None = as the controller says.

    A controller that takes any actuator drives this one, and so does one that describes it. For others it is the model
    of the skin alone. Raises ControllerError where no actuator can be as the controller says.
    """
    described = controller.description.actuator
    skin = None if actuator is None else devices.behind_dac(address, actuator, described)
    if skin is not None and (devices.takes_actuator(address) or description_of(skin) == described):
        return Session(controller, address, skin, skin)
    driven = actuator_model(described)
    return Session(controller, address, driven, skin or driven, known_model(described) is not None)


@contextlib.contextmanager
def connect(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Iterator[Session]:
    """Open a session as `devices.connect` does, and as `session_with` says. Raises as both."""
    with devices.connect(address, runtime, actuator) as controller:
        yield session_with(controller, address, actuator)


def description_of(actuator: Actuator) -> ActuatorDescription:
    """Return how a controller describes an actuator that it drives."""
    lower_hz, upper_hz = actuator.band_hz
    return ActuatorDescription(
        name=actuator.name,
        stroke_um=float(np.float32(actuator.stroke_um)),
        volts=float(np.float32(actuator.volts)),
        lower_hz=float(np.float32(lower_hz)),
        upper_hz=float(np.float32(upper_hz)),
        slew_volts_per_second=float(np.float32(actuator.slew_volts_per_second)),
        dac_bits=actuator.dac_bits,
        dac_rate_hz=actuator.dac_rate_hz,
    )


def known_model(description: ActuatorDescription) -> Actuator | None:
    """Return which of ACTUATORS a controller describes, with its DAC and volts at full scale; None if none of them."""
    known = ACTUATORS.get(description.name)
    if known is None or not 0 < description.volts < math.inf:
        return None
    # The shortest number of those that are sent as this one, which has seven digits.
    volts = float(str(np.float32(description.volts)))
    if volts != float(str(np.float32(known.volts))):
        known = known.with_full_scale(volts / 2)
    known = replace(known, dac_bits=description.dac_bits, dac_rate_hz=description.dac_rate_hz)
    return known if description_of(known) == description else None


def actuator_model(description: ActuatorDescription) -> Actuator:
    """Return the model of the actuator that a controller describes: the known one, or one built from its band.

    That is a low-pass, or a resonance where it does not reach down to rest. Raises ControllerError where no actuator
    can be such.
    """
    if known := known_model(description):
        return known
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
