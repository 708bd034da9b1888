"""Tests of the errors: their texts, their exit codes, and the options that a command names in them."""

import pickle

import click
import pytest

from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import VibrocastError
from vibrocast.extras import MissingExtraError
from vibrocast.host.cli.command_line import main
from vibrocast.host.cli.errors import explained, option_names
from vibrocast.textures import TextureError


@pytest.mark.parametrize(("kind", "exit_code"), [(TextureError, 2), (TransportError, 3), (MissingExtraError, 2)])
def test_states_problem_cause_and_action(kind: type[VibrocastError], exit_code: int) -> None:
    error = kind("`axis`=q", "not one of X, Y, Z", "give `reduce`", parameter=("axis", "reduce"))
    assert str(error) == "`axis`=q: not one of X, Y, Z; give `reduce`"
    assert str(kind("it broke")) == "it broke"
    assert str(kind("it broke", action="mend it")) == "it broke; mend it"
    again = pickle.loads(pickle.dumps(error))  # as from a worker
    assert (str(again), again.parameter, again.exit_code) == (str(error), ("axis", "reduce"), exit_code)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("encode", "give --rate-hz, --model or `highpass_hz=None`; `sixteen_bit` and `unit`"),
        ("bench", "give `rate_hz`, `model` or --keep-dc; `sixteen_bit` and `unit`"),
        (
            "render",
            "give `vibrocast encode --rate-hz`, --model or `highpass_hz=None`; `sixteen_bit` and `unit`",
        ),
        ("decode", "give `rate_hz`, --model or `highpass_hz=None`; `sixteen_bit` and `unit`"),
    ],
)
def test_a_command_names_its_options(name: str, text: str) -> None:
    """Where it has them, and only in place of the parameters that the error states."""
    error = TextureError(
        "give `rate_hz`, `model` or `highpass_hz=None`; `sixteen_bit` and `unit`",
        parameter=("rate_hz", "model", "highpass_hz=None", "sixteen_bit"),
    )
    told = explained(error, option_names(main.get_command(click.Context(main), name)))
    assert (told.message, told.exit_code) == (text, 2)
