"""Reads TOML files into msgspec structs; an error is one line, with file, table, key, problem and action."""

import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, inspect

from vibrocast.errors import InputError, located

MAX_BYTES = 1 << 20
_MAX_SHOWN = 80

Given = TypeVar("Given")
Kind = TypeVar("Kind")
Text = Annotated[str, Meta(pattern=r"\A(?=.*\S)[^\x00-\x1f\x7f-\x9f\u2028\u2029]+\Z", description="a text in one line")]


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of a TOML file. Its `__post_init__` may check several keys together, and raises ValueError."""


def one_of(words: Collection[str]) -> Meta:
    """Return the constraint of a text: one of some words."""
    return Meta(pattern=rf"\A({'|'.join(map(re.escape, words))})\Z", description=f"one of {', '.join(words)}")


def within(low: float, high: float, meaning: str = "") -> Meta:
    """Return the constraint of a number: a range. `meaning`: of the number, with its unit, for errors."""
    return Meta(ge=low, le=high, description=meaning or None)


def read_toml(path: Path, name: str) -> dict[str, Any]:
    """Return the content of a TOML file. `name`: of such a file, for errors.

    Raises InputError for any other file, OSError if it cannot be read.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"no file; give a {name} in TOML")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"longer than any {name}; give another file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as reason:
        raise InputError(f"not a TOML file: {reason}") from reason


def check_programs(programs: Mapping[str, str], allowed: bool) -> None:
    """Check that a file may start programs; `programs`: each by the name of the table that has it.

    Raises InputError, which names the first one, unless they are `allowed`.
    """
    for name, program in programs.items():
        if not allowed:
            raise InputError(
                f"{name} starts the program {program!r}; read the file, and pass --allow-programs if you trust it"
            )


def convert(values: object, kind: type[Kind]) -> Kind:
    """Return the content of a TOML file, or a part of it, as a struct. Raises InputError, which names table and key."""
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as reason:
        raise InputError(_explained(str(reason), values, inspect.type_info(kind))) from reason


def read_each(kind: str, tables: Sequence[Given], read: Callable[[Given], Kind]) -> tuple[Kind, ...]:
    """Return `read` of each table [[kind]]; its ValueError becomes an InputError that names the table."""
    results = []
    for number, table in enumerate(tables, 1):
        with located(f"[[{kind}]] {number}"):
            results.append(read(table))
    return tuple(results)


def check_names(kind: str, names: Sequence[str]) -> None:
    """Raise InputError if two tables [[kind]] have the same name."""
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two [[{kind}]] are named {twice[0]!r}; give each its own name")


def _explained(reason: str, value: Any, node: inspect.Type) -> str:
    """Return an error of msgspec, such as "Expected `int`, got `str` - at `$.a[0].b`", in words, with an action."""
    found = re.fullmatch(r"(.*) - at `\$(.*)`", reason, re.DOTALL)
    problem, place = found.groups() if found else (reason, "")
    steps = re.findall(r"\.(\w+)((?:\[\d+\])*)", place)
    parents = steps[:-1] if problem.startswith(("Expected", "Number", "Invalid")) else steps
    where = "".join(f"[[{name}]] {int(index[1:-1]) + 1}: " if index else f"[{name}]: " for name, index in parents)
    fields = _fields(node)
    for name, _ in parents:
        fields = _fields(fields[name].type)
    if parents != steps:
        for part in re.findall(r"\w+", place):
            value = value[int(part) if part.isdecimal() else part]
        return where + _misfit(steps[-1][0], fields[steps[-1][0]].type, value)
    if named := re.fullmatch(r"Object contains unknown field `(.*)`", problem, re.DOTALL):
        near = get_close_matches(named[1], fields, 1)
        meant = f"did you mean {near[0]}?" if near else f"choose from {', '.join(fields)}"
        return f"{where}there is no key {_shown(named[1])[1:-1]}; {meant}"
    if named := re.fullmatch(r"Object missing required field `(.*)`", problem):
        return f"{where}{named[1]} is missing; it must be {_expected(named[1], fields[named[1]].type)}"
    return where + problem


def _misfit(key: str, node: inspect.Type, value: Any) -> str:
    """Return the error for a value that its type rejects; suggest another prefix of the unit if that would fit."""
    number = next((part for part in _parts(node) if isinstance(part, inspect.IntType | inspect.FloatType)), None)
    if number is None or number.ge is None or number.le is None or not _is_number(value):
        return f"{key} must be {_expected(key, node)}, not {_shown(value)}"
    low, high = number.ge, number.le
    if low <= value <= high:
        return f"{key} must be {_expected(key, node)}, not {_shown(value)}"
    meaning = _meanings(node)[-1:]
    meant = [value * factor for factor in (1e3, 1e-3, 1e6, 1e-6) if low <= value * factor <= high]
    slip = f"; are the units mixed up? {meant[0]:.9g} would be possible" if meaning and meant else ""
    return f"{key} = {value:.9g} is out of range: {', '.join([*meaning, _range(number)])}{slip}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _expected(key: str, node: inspect.Type) -> str:
    """Return the values of a key in words."""
    kinds = [part for part in _parts(node) if not isinstance(part, inspect.Metadata | inspect.NoneType)]
    kinds = [part for part in kinds if not isinstance(part, inspect.UnionType)]
    if isinstance(kinds[-1], inspect.StructType):
        return f"a table: begin it with [{key}]" if len(kinds) == 1 else f"tables: begin each with [[{key}]]"
    if isinstance(kinds[0], inspect.LiteralType):
        return f"one of {', '.join(map(str, kinds[0].values))}"
    meanings = _meanings(node)[:1]
    if len(kinds) == 1 and isinstance(kinds[0], inspect.IntType | inspect.FloatType):
        return ", ".join([*meanings, _range(kinds[0])])
    if isinstance(kinds[0], inspect.VarTupleType) and not meanings:
        return f"a list, each {_expected(key, kinds[0].item_type)}"
    names = {inspect.BoolType: "true or false", inspect.StrType: "a text", inspect.DictType: "a table"}
    return "".join(meanings) or names.get(type(kinds[0]), "a list")


def _meanings(node: inspect.Type) -> list[str]:
    """Return the descriptions of a type and of its parts, the outermost first."""
    notes = [part.extra_json_schema or {} for part in _parts(node) if isinstance(part, inspect.Metadata)]
    return [note["description"] for note in notes if "description" in note]


def _range(number: inspect.IntType | inspect.FloatType) -> str:
    kind = "a whole number" if isinstance(number, inspect.IntType) else "a number"
    limits = {"above": number.gt, "from": number.ge, "to": number.le}
    return " ".join([kind, *(f"{word} {limit:g}" for word, limit in limits.items() if limit is not None)])


def _fields(node: inspect.Type) -> dict[str, inspect.Field]:
    """Return the keys of the table that a type stands for."""
    return {
        field.encode_name: field
        for part in _parts(node)
        if isinstance(part, inspect.StructType)
        for field in part.fields
    }


def _parts(node: inspect.Type) -> Iterator[inspect.Type]:
    """Yield a type and its parts, down to tables."""
    yield node
    if isinstance(node, inspect.UnionType):
        inner = node.types
    elif isinstance(node, inspect.VarTupleType):
        inner = (node.item_type,)
    else:
        inner = (node.type,) if isinstance(node, inspect.Metadata) else ()
    for part in inner:
        yield from _parts(part)


def _shown(value: Any) -> str:
    """Return a value in a form short enough for an error."""
    shown = repr(value)
    return shown if len(shown) <= _MAX_SHOWN else f"{shown[:_MAX_SHOWN]}..."
