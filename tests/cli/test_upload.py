"""`vibrocast upload`: several controllers at once, the slots as a list, wrong combinations."""

import pytest

from tests.command import answer, fails, failure, succeeds


def test_several_controllers_get_a_line_each_and_one_that_fails_holds_none_up() -> None:
    told = failure(3, "upload", "eva-16-4", "--device", "sim", "--device", "serial:nowhere", "--device", "sim")
    assert "1 of 3 controllers failed: serial:nowhere" in told["error"]
    assert told["sim"]["model"] == told["sim (2)"]["model"] == "eva-16-4"
    assert "cannot open serial port nowhere" in told["serial:nowhere"]["error"]
    assert "sim (2): eva-16-4 1 runs from slot" in succeeds("flash", "eva-16-4", "--device", "sim", "--device", "sim")


def test_slots_are_listed_for_people_and_programs() -> None:
    assert "no model image in any slot" in succeeds("upload", "--list")
    slots = answer("upload", "--list")["slots"]
    assert [slot["slot"] for slot in slots] == [0, 1] and {slot["state"] for slot in slots} == {"empty"}


@pytest.mark.parametrize(
    "arguments", [[], ["eva-16-4", "--list"], ["--list", "--rollback"], ["--list", "--no-confirm"]], ids=" ".join
)
def test_one_thing_is_done_at_a_time(arguments: list[str]) -> None:
    assert "give" in fails(2, "upload", *arguments)


def test_nothing_to_go_back_to_is_an_error() -> None:
    assert "no other slot holds a verified model image; upload one" in fails(1, "upload", "--rollback")
