"""The conformance suite that ships, on each controller of conftest.py."""

# ruff: noqa: F403
from host.conformance.test_capture import *
from host.conformance.test_configure import *
from host.conformance.test_flashing import *
from host.conformance.test_frames import *
from host.conformance.test_hello import *
from host.conformance.test_link import *
from host.conformance.test_messages import *
from host.conformance.test_playing import *
from host.conformance.test_profiles import *
from host.conformance.test_sequence_numbers import *
from host.conformance.test_states import *
from host.conformance.test_streams import *
from host.conformance.test_watchdog import *
