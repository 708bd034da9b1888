"""`vibrocast upload`: several controllers at once, the slots as a list, wrong combinations."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command import answer, fails, failure, succeeds
from vibrocast import models
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.pty_port import PtyPort


@pytest.fixture
def board() -> Iterator[str]:
    """The address of a simulated controller that keeps its flash from command to command."""
    with PtyPort(Controller()) as port:
        yield f"serial:{port.name}"


def test_several_controllers_get_a_line_each_and_one_that_fails_holds_none_up() -> None:
    told = failure(3, "upload", "eva-16-4", "--device", "sim", "--device", "serial:nowhere", "--device", "sim")
    assert "1 of 3 controllers failed: serial:nowhere" in told["error"]
    assert told["sim"]["model"] == told["sim (2)"]["model"] == "eva-16-4"
    assert "cannot open serial port nowhere" in told["serial:nowhere"]["error"]
    assert "sim (2)  eva-16-4 1 runs from slot" in succeeds("flash", "eva-16-4", "--device", "sim", "--device", "sim")


def test_slots_are_listed_for_people_and_programs() -> None:
    assert "no model image in any slot" in succeeds("upload", "--list")
    slots = answer("upload", "--list")["slots"]
    assert [slot["slot"] for slot in slots] == [0, 1] and {slot["state"] for slot in slots} == {"empty"}


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["eva-16-4", "--list"],
        ["--list", "--rollback"],
        ["--list", "--no-confirm"],
        ["--erase", "--verify"],
        ["eva-16-4", "--verify", "--no-confirm"],
        ["--read-back", "model.bin", "--device", "sim", "--device", "sim"],
    ],
    ids=" ".join,
)
def test_one_thing_is_done_at_a_time(arguments: list[str]) -> None:
    assert "give" in fails(2, "upload", *arguments)


def test_an_actuator_is_uploaded_signed_and_no_model(board: str, tmp_path: Path) -> None:
    own, signed = tmp_path / "own.toml", tmp_path / "own.vcmi"
    own.write_text('name = "own"\nmodel = "piezo-stack"\nvolts_limit = 70\n')
    assert "own 1 runs from slot 0" in succeeds("upload", own, "--device", board)
    assert answer("status", "--device", board)["actuator"]["name"] == "own"
    succeeds("keys", "new", tmp_path / "key.pem")
    succeeds("keys", "sign", own, "--key", tmp_path / "key.pem", "--number", 1, "--out", signed)
    for given in (own, signed):
        assert "holds an actuator and no model" in fails(2, "decode", tmp_path / "a.vct", "a.wav", "--model", given)


def test_nothing_to_go_back_to_is_an_error() -> None:
    assert "no other slot holds a verified model image; upload one" in fails(1, "upload", "--rollback")


def test_a_model_is_compared_read_back_and_erased(board: str, tmp_path: Path) -> None:
    at = ("--device", board)
    assert "no slot holds this model" in fails(1, "upload", "eva-16-4", "--verify", *at)
    assert "runs no model image" in fails(1, "upload", "--read-back", tmp_path / "model.bin", *at)
    succeeds("upload", "mdct-textures", *at)
    succeeds("upload", "eva-16-4", *at)
    told = answer("upload", "eva-16-4", "--verify", *at)
    assert (told["slot"], told["state"], told["bytes"]) == (1, "confirmed", len(models.find("eva-16-4").image))
    assert "slot 0 holds mdct-textures, verified" in succeeds("upload", "mdct-textures", "--verify", *at)
    succeeds("upload", "--read-back", tmp_path / "model.bin", *at)
    assert (tmp_path / "model.bin").read_bytes() == models.find("eva-16-4").image
    assert answer("upload", "--erase", *at)["erased"] == [0]
    assert [slot["state"] for slot in answer("upload", "--list", *at)["slots"]] == ["empty", "confirmed"]
    assert "no other slot" in fails(1, "upload", "--rollback", *at)
