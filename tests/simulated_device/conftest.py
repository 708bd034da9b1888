"""The controllers that the tests of one are run on."""

import pytest

from tests.simulated_device.bench import Kind
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.firmware import Firmware


@pytest.fixture(scope="session", params=[Controller, Firmware])
def kind(request: pytest.FixtureRequest) -> Kind:
    """The simulated controller, and the firmware in C."""
    chosen: Kind = request.param
    return chosen
