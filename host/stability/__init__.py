"""Stability maps that need the host's player, and the report that joins them with those of evaluation."""

from vibrocast.evaluation.stability import trials
from vibrocast.host.controller import ControllerError

CLEAR_ERRORS = (*trials.CLEAR_ERRORS, ControllerError)
"""Errors that tell a person what to do, those of controllers included."""
