"""The conformance suite that ships, on each controller of conftest.py."""

# ruff: noqa: F403
from vibrocast.harness.conformance.test_capture import *
from vibrocast.harness.conformance.test_configure import *
from vibrocast.harness.conformance.test_flashing import *
from vibrocast.harness.conformance.test_frames import *
from vibrocast.harness.conformance.test_hello import *
from vibrocast.harness.conformance.test_link import *
from vibrocast.harness.conformance.test_messages import *
from vibrocast.harness.conformance.test_output import *
from vibrocast.harness.conformance.test_playing import *
from vibrocast.harness.conformance.test_profiles import *
from vibrocast.harness.conformance.test_queue import *
from vibrocast.harness.conformance.test_real_output import *
from vibrocast.harness.conformance.test_sequence_numbers import *
from vibrocast.harness.conformance.test_states import *
from vibrocast.harness.conformance.test_streams import *
from vibrocast.harness.conformance.test_watchdog import *
