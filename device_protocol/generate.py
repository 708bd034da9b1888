"""Writes the files that depend on the messages: C, JavaScript, tables of the protocol's page.

Run it after a change: `python -m vibrocast.device_protocol.generate`.
"""

import argparse
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from textwrap import wrap

from vibrocast import pages
from vibrocast.device_protocol import coded_stream, frames, layout, messages, model_image
from vibrocast.device_protocol.layout import Fixed, Flag, Part, Rest, Tag, WireField, wire_fields
from vibrocast.device_protocol.messages import FROM_HOST, RESPONSES, Described, Message

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "reference" / "protocol.md"
SCRIPT = ROOT / "docs" / "javascripts" / "messages.js"
FIRMWARE = ROOT / "firmware"
_NUMBERS = {"uint8_t": 1, "uint16_t": 2, "uint32_t": 4, "uint64_t": 8, "int64_t": 8}
_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "i64": "int64_t", "f32": "uint32_t"}
NESTED = (
    messages.Limits,
    messages.ActuatorDescription,
    messages.CodecDescription,
    messages.ImageDescription,
    messages.CodingDescription,
    messages.QueuedStream,
    messages.OutputFaults,
    messages.FrameFaults,
)
_STRUCTS = {
    messages.Status: "vc_status_report",
    messages.Limits: "vc_controller_limits",
    messages.StreamSetup: "vc_configure",
    messages.Queue: "vc_configure",
}
"""Structs whose usual name the core already has, or that another message shares."""


def generated_files() -> dict[Path, str]:
    """Return the required content of every generated file."""
    return {
        FIRMWARE / "include" / "vibrocast" / "protocol.h": _in_c_file("protocol.h"),
        FIRMWARE / "src" / "controller" / "vc_messages.h": _in_c_file("messages.h"),
        FIRMWARE / "src" / "controller" / "vc_messages.c": _in_c_file("messages.c"),
        SCRIPT: script(),
        PAGE: page(PAGE.read_text(encoding="utf-8")),
    }


def _in_c_file(name: str) -> str:
    """Return a file of the firmware, from the template of the same name next to this module."""
    with_body = tuple(message for message in FROM_HOST if wire_fields(message))
    owners = (
        messages.StreamSetup if issubclass(owner, messages.StreamSetup) else owner
        for owner in (*with_body, *NESTED, *RESPONSES)
    )
    return pages.render(
        Path(__file__).with_name(f"{name}.jinja"),
        coded_stream=coded_stream,
        frames=frames,
        layout=layout,
        messages=messages,
        model_image=model_image,
        from_host=FROM_HOST,
        responses=RESPONSES,
        with_body=with_body,
        nested=NESTED,
        owners=tuple(dict.fromkeys(owners)),
        snake=snake,
        struct=_struct,
        structure=_structure,
        statements=_statements,
        checks=_checks,
        writer=_writer,
        size=_size,
        has_list=lambda message: any(field.is_tuple for field in wire_fields(message)),
    )


# ---- fields in C ----


def snake(owner: type) -> str:
    """Return the name of a class in snake case."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", owner.__name__).lower()


def _struct(owner: type) -> str:
    return _STRUCTS.get(owner, f"vc_{snake(owner)}")


@dataclass
class CField:
    """A field in C: members of its struct; statements that take it from `fields` into the struct at `place`, and that
    write it from there; the terms of its bytes in a value."""

    members: list[str]
    read: Sequence[str] = ()
    write: Sequence[str] = ()
    size: Sequence[str] = ()


def _in_c(field: WireField, struct: str) -> CField:
    """Return a field in C. `struct`: its struct, followed by the operator."""
    name = field.name
    place = struct + name
    piece, write_piece = [f"vc_piece {name};"], f"write_piece(writer, {place});"
    match field.wire:
        case Fixed() if field.type is bytes:
            size = layout.SHA256_BYTES
            read = [f"{place} = vc_take_piece(&fields, {size}).bytes;"]
            return CField([f"const uint8_t *{name};"], read, [f"write_sha256(writer, {place});"], [str(size)])
        case Fixed():
            wire = field.wire.name
            kind, bits = _TYPES[wire], "_float_bits" * (wire == "f32")
            size = _NUMBERS[kind]
            cast = "" if kind == "uint64_t" else f"({kind})"
            read = [f"{place}{bits} = {cast}vc_take_number(&fields, {size});"]
            write = [f"vc_frame_write_number(writer, {place}{bits}, {size});"]
            return CField([f"{kind} {name}{bits};"], read, write, [str(size)])
        case Flag():
            read = ["flags = (unsigned)vc_take_number(&fields, 1);", f"{place} = (uint8_t)flags;"]
            return CField([f"uint8_t {name};"], read, [f"vc_frame_write_number(writer, {place}, 1);"], ["1"])
        case Part(name="varint"):
            return CField([f"uint32_t {name};"], [f"{place} = (uint32_t)vc_take_varint(&fields, VC_VARINT_BITS);"])
        case Part(name="counted"):
            write = [f"vc_frame_write_number(writer, {place}.length, 1);", write_piece]
            return CField(piece, write=write, size=["1", f"{place}.length"])
        case Rest(name="text"):
            return CField(piece, write=[write_piece], size=[f"{place}.length"])
        case Rest(name="items"):
            return CField(piece, [f"{place} = take_items(&fields);"])
        case Part():
            return CField(piece, [f"{place} = vc_take_piece(&fields, fields.rest.length);"], [write_piece])
        case Tag(number=number) if field.is_tuple:
            kind, count = _struct(field.item), f"{name.removesuffix('s')}_count"
            loop = f"for (i = 0; i < {struct}{count}; i++)"
            write = [loop, f"    write_{snake(field.item)}(writer, {number}, &{place}[i]);"]
            return CField([f"const {kind} *{name};", f"unsigned {count};"], write=write)
        case Tag(number=number) if field.is_optional:
            write = [f"if ({place} != NULL)", f"    write_{snake(field.item)}(writer, {number}, {place});"]
            return CField([f"const {_struct(field.item)} *{name}; /* NULL: none */"], write=write)
        case Tag(number=number) if field.item in NESTED:
            write = [f"write_{snake(field.item)}(writer, {number}, &{place});"]
            return CField([f"{_struct(field.item)} {name};"], write=write)
        case Tag(number=number):
            read = [f"value = &{place};", f"tag = {number};"]
            return CField(piece, read, [f"write_tag(writer, {number}, {place}.length);", write_piece])


def _fields(owner: type) -> list[WireField]:
    """Return the fields of a class, except the samples of a CaptureData, which the caller writes."""
    return [field for field in wire_fields(owner) if owner is not messages.CaptureData or field.name != "data"]


def _statements(owner: type, struct: str, direction: str) -> list[str]:
    """Return the statements that `read` or `write` the fields of a class."""
    statements: list[str] = []
    for field in _fields(owner):
        found = getattr(_in_c(field, struct), direction)
        if not found:
            raise NotImplementedError(f"{owner.__name__}.{field.name}: state in _in_c how C must {direction} it")
        statements += found
    return statements


def _structure(owner: type) -> str:
    members = [f"    {member}" for field in _fields(owner) for member in _in_c(field, "").members]
    about = wrap(f"/* {' '.join((owner.__doc__ or '').split())} */", 120, subsequent_indent=" * ")
    return "\n".join([*about, "typedef struct {", *members, f"}} {_struct(owner)};", ""])


def _checks(message: type[Message]) -> list[tuple[str, str]]:
    """Return the wrong values of a message, and their rejections: expressions in C."""
    checks = []
    for field in wire_fields(message):
        place = f"message->body.{snake(message)}.{field.name}"
        text = f'"{message.__name__}: {field.name}'
        if isinstance(field.wire, Fixed) and field.wire.check is layout.check_factor:
            no_factor = f'vc_reject(rejection, VC_BAD_VALUE, {text} is not a finite factor of at least 0")'
            checks.append((f"!is_factor({place}_float_bits)", no_factor))
        elif isinstance(field.wire, Fixed) and issubclass(field.type, IntEnum):
            last = len(field.type) - 1
            unknown = f'vc_reject_numbers(rejection, VC_BAD_VALUE, {text} # is none of 0 to #", {place}, {last})'
            checks.append((f"{place} > {last}", unknown))
        elif isinstance(field.wire, Tag) and field.type is str:
            no_text = f'vc_reject(rejection, VC_MALFORMED, {text} is not UTF-8")'
            checks.append((f"!vc_is_utf8({place})", no_text))
    return checks


def _writer(message: type[Message]) -> str:
    parameters = f"vc_frame_writer *writer, uint16_t sequence, const {_struct(message)} *message"
    return f"void vc_write_{snake(message)}({parameters})"


def _size(owner: type) -> str:
    """Return the number of bytes of a tag's value, an expression in C."""
    return " + ".join(term for field in wire_fields(owner) for term in _in_c(field, "value->").size)


# ---- JavaScript ----


def fixed_fields(owner: type) -> list[tuple[WireField, str]]:
    """Return each field but those in tags, and how it is read: its number of bytes, or the name of its kind."""
    found = []
    for field in wire_fields(owner):
        match field.wire:
            case Fixed() if field.type is bytes:
                found.append((field, str(layout.SHA256_BYTES)))
            case Flag():
                found.append((field, "u8"))
            case Fixed(name=kind) | Rest(name=kind) | Part(name=kind):
                found.append((field, kind))
    return found


def script() -> str:
    """Return the layouts of all messages for browsers, from the template next to this module."""
    return pages.render(
        Path(__file__).with_name("messages.js.jinja"),
        messages=messages,
        all_messages=messages.ALL,
        nested=NESTED,
        fields=fixed_fields,
        tags=lambda owner: [field for field in wire_fields(owner) if isinstance(field.wire, Tag)],
        script_types=_script_types,
    )


_SCRIPT_TYPES = {"items": "Uint8Array[]", "bytes": "Uint8Array", "text": "string", "counted": "string"}


def _script_types(owner: type) -> list[tuple[str, str]]:
    """Return the name and the JSDoc type of each field."""
    fixed = {
        field.name: "Uint8Array" if kind.isdigit() else _SCRIPT_TYPES.get(kind, "number")
        for field, kind in fixed_fields(owner)
    }
    plain = {str: "string", bytes: "Uint8Array"}
    tags = {
        field.name: plain.get(field.item, field.item.__name__) + "[]" * field.is_tuple + " | null" * field.is_optional
        for field in wire_fields(owner)
        if isinstance(field.wire, Tag)
    }
    return [*fixed.items(), *tags.items()]


# ---- docs/reference/protocol.md ----


def page(text: str) -> str:
    """Return the protocol's page with its tables between the markers."""
    heads = ("type", "message", "fixed part", "TLVs or rest")
    values = [
        (
            message.__name__,
            f"0x{field.wire.number:02x} {field.wire.description.split(',')[0]}",
            _cells(wire_fields(field.item)),
        )
        for message in RESPONSES
        for field in wire_fields(message)
        if isinstance(field.wire, Tag) and field.item in NESTED
    ]
    tables = {
        "requests": _table((*heads, "answer"), [(*_message_row(message), message.ANSWER) for message in FROM_HOST]),
        "responses": _table(heads, [_message_row(message) for message in RESPONSES]),
        "values": _table(("message", "tag", "value"), values),
        "errors": _table(("code", "name", "meaning"), _meanings(messages.ErrorCode)),
        "states": _table(("number", "state", "meaning"), _meanings(messages.State)),
    }
    for name, table in tables.items():
        before, marker, rest = text.partition(f"<!-- generated: {name} -->\n")
        _, end, after = rest.partition("\n<!-- end -->")
        if not end:
            raise ValueError(
                f"{PAGE} has no place for a table: add the lines <!-- generated: {name} --> and <!-- end -->"
            )
        text = before + marker + table + end + after
    return text


def _table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = ["".join(f"| {cell} " if cell else "| " for cell in row) + "|" for row in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def _meanings(members: Iterable[Described]) -> list[tuple[str, str, str]]:
    return [(str(member.value), member.name, member.description) for member in members]


def _message_row(message: type[Message]) -> tuple[str, str, str, str]:
    fields = wire_fields(message)
    tags = "; ".join(f"0x{f.wire.number:02x} {f.wire.description}" for f in fields if isinstance(f.wire, Tag))
    rest = "".join(f"rest: {f.wire.description}" for f in fields if isinstance(f.wire, Rest))
    fixed = _cells([field for field in fields if not isinstance(field.wire, Tag | Rest)])
    return f"0x{message.TYPE:02X}", message.__name__, fixed, tags + rest


def _cells(fields: list[WireField]) -> str:
    cells = []
    for field in fields:
        match field.wire:
            case Fixed(name=wire):
                cells.append(f"{field.name} {wire}")
            case Flag():
                cells.append("flags u8")
            case Part(name="varint"):
                cells.append(f"{field.name} varint")
            case Part(name="counted"):
                cells.append(f"{field.name}'s length u8, {field.name}")
            case Rest(description=description):
                cells.append(f"then the {description}")
    return ", ".join(cells)


if __name__ == "__main__":
    argparse.ArgumentParser(
        description="Write the C sources of the messages, and the tables of docs/reference/protocol.md."
    ).parse_args()
    for path, contents in generated_files().items():
        path.write_text(contents, encoding="utf-8")
