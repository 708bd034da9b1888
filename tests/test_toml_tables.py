"""TOML files as structs: every mistake is one line that names table and key, and says what is right."""

from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from vibrocast.errors import InputError, located
from vibrocast.toml_tables import Table, Text, convert, one_of, read_toml, within


class Drive(Table, frozen=True):
    rate_hz: Annotated[float, within(20, 1e6, "sample rate in Hz")] = 2800.0
    gains: tuple[Annotated[int, within(1, 9)], ...] = ()
    mode: Literal["slow", "fast"] = "slow"

    def __post_init__(self) -> None:
        if self.mode == "fast" and len(self.gains) > 1:
            raise ValueError("mode = 'fast' takes one gain - at most")


class Board(Table, frozen=True, kw_only=True):
    name: Text
    kind: Annotated[str, one_of(("lra", "voice-coil"))] = "lra"
    drive: Drive = Drive()


class File(Table, frozen=True):
    boards: Annotated[tuple[Board, ...], Meta(min_length=1)]
    on: bool = True


BOARD = {"name": "left"}


def test_defaults_are_filled_in_and_whole_numbers_are_numbers() -> None:
    board = convert({"name": "left", "drive": {"rate_hz": 8000, "gains": [1, 2]}}, Board)
    assert board == Board(name="left", drive=Drive(8000.0, (1, 2)))
    assert isinstance(board.drive.rate_hz, float)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "boards is missing; it must be tables: begin each with [[boards]]"),
        ({"boards": []}, "boards must be tables: begin each with [[boards]], not []"),
        ({"boards": [BOARD], "one": True}, "there is no key one; did you mean on?"),
        ({"boards": [BOARD], "colour": 1}, "there is no key colour; choose from boards, on"),
        ({"boards": [BOARD], "on": 1}, "on must be true or false, not 1"),
        ({"boards": [BOARD, {}]}, "[[boards]] 2: name is missing; it must be a text in one line"),
        ({"boards": [{"name": " "}]}, "[[boards]] 1: name must be a text in one line, not ' '"),
        ({"boards": [{"name": "\x1b[31m"}]}, "[[boards]] 1: name must be a text in one line, not '\\x1b[31m'"),
        ({"boards": [BOARD | {"kind": "ear"}]}, "[[boards]] 1: kind must be one of lra, voice-coil, not 'ear'"),
        ({"boards": [BOARD | {"drive": 3}]}, "[[boards]] 1: drive must be a table: begin it with [drive], not 3"),
    ],
)
def test_a_mistake_is_one_line_with_table_and_key(values: object, message: str) -> None:
    with pytest.raises(ValueError) as raised:
        convert(values, File)
    assert str(raised.value) == message


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        ({"rate_hz": 8}, "rate_hz = 8 is out of range: sample rate in Hz, a number from 20 to 1e+06; "
         "are the units mixed up? 8000 would be possible"),
        ({"rate_hz": float("nan")}, "rate_hz must be sample rate in Hz, a number from 20 to 1e+06, not nan"),
        ({"rate_hz": True}, "rate_hz must be sample rate in Hz, a number from 20 to 1e+06, not True"),
        ({"rate_hz": 10**70}, "rate_hz = 1e+70 is out of range: sample rate in Hz, a number from 20 to 1e+06"),
        ({"rate_hz": 10**400},
         "rate_hz must be sample rate in Hz, a number from 20 to 1e+06, not 1" + 79 * "0" + "..."),
        ({"gains": [1, 10]}, "gains = 10 is out of range: a whole number from 1 to 9"),
        ({"gains": [1, "a"]}, "gains must be a list, each a whole number from 1 to 9, not 'a'"),
        ({"gains": [2.5]}, "gains must be a list, each a whole number from 1 to 9, not 2.5"),
        ({"mode": "faster"}, "mode must be one of fast, slow, not 'faster'"),
        ({"mode": "fast", "gains": [1, 2]}, "mode = 'fast' takes one gain - at most"),
        ({"hz": 1, "\n": 2}, "there is no key hz; choose from rate_hz, gains, mode"),
        ({"\n`": 2}, "there is no key \\n`; choose from rate_hz, gains, mode"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_reported_with_the_right_ones(drive: object, message: str) -> None:
    with pytest.raises(ValueError) as raised:
        convert({"boards": [BOARD, BOARD | {"drive": drive}]}, File)
    assert str(raised.value) == f"[[boards]] 2: [drive]: {message}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a = \xff", "not a TOML file: "),
        (b"a = = 1", "not a TOML file: "),
        (b"a = " + 5000 * b"1", "not a TOML file: "),
        (b"a = " + 5000 * b"[", "not a TOML file: "),
        (b"# " + (1 << 20) * b"x", "longer than any"),
    ],
)
def test_other_files_are_rejected(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"^{path}: {message}"), located(path):
        read_toml(path, "scene")
    with pytest.raises(ValueError, match="no file; give a scene in TOML"):
        read_toml(tmp_path, "scene")
