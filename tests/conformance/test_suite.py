"""The conformance suite that ships, on each controller of conftest.py."""

# ruff: noqa: F403
from vibrocast.host.conformance.test_capture import *
from vibrocast.host.conformance.test_configure import *
from vibrocast.host.conformance.test_flashing import *
from vibrocast.host.conformance.test_frames import *
from vibrocast.host.conformance.test_hello import *
from vibrocast.host.conformance.test_link import *
from vibrocast.host.conformance.test_messages import *
from vibrocast.host.conformance.test_output import *
from vibrocast.host.conformance.test_playing import *
from vibrocast.host.conformance.test_profiles import *
from vibrocast.host.conformance.test_sequence_numbers import *
from vibrocast.host.conformance.test_states import *
from vibrocast.host.conformance.test_streams import *
from vibrocast.host.conformance.test_watchdog import *
