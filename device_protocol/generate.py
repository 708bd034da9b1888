"""Writes what follows from the messages, C sources and tables of docs/protocol.md.

Run it after a change: `python -m vibrocast.device_protocol.generate`.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from textwrap import wrap

from vibrocast.device_protocol import coded_stream, frames, layout, messages, model_image
from vibrocast.device_protocol.layout import Fixed, Flag, Part, Rest, Tag, WireField, wire_fields
from vibrocast.device_protocol.messages import FROM_HOST, RESPONSES, Described, Message

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "protocol.md"
CONTROLLER = ROOT / "firmware" / "controller"
_NUMBERS = {"uint8_t": 1, "uint16_t": 2, "uint32_t": 4, "uint64_t": 8, "int64_t": 8}
_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "i64": "int64_t", "f32": "uint32_t"}
_NESTED = (messages.Limits, messages.ActuatorDescription, messages.CodecDescription, messages.ImageDescription)
_STRUCTS = {messages.Status: "vc_status_report", messages.Limits: "vc_controller_limits"}
"""Where the core has that name already."""


def generated_files() -> dict[Path, str]:
    """Return the contents that every generated file should have."""
    return {
        CONTROLLER / "protocol.h": constants(),
        CONTROLLER / "messages.h": header(),
        CONTROLLER / "messages.c": source(),
        PAGE: page(PAGE.read_text(encoding="utf-8")),
    }


def _joined(blocks: list[str]) -> str:
    return "\n".join(blocks)


# ---- constants ----


def constants() -> str:
    """Return protocol.h."""
    defines = {
        "PROTOCOL_MAJOR": messages.PROTOCOL_MAJOR,
        "PROTOCOL_MINOR": messages.PROTOCOL_MINOR,
        "NOTIFICATION": f"{messages.NOTIFICATION} /* the sequence number of a message that answers no request */",
        "FIRST_UNSEQUENCED": f"0x{messages.FIRST_UNSEQUENCED:02X} /* types from here on have no sequence number */",
        "FIRST_FROM_CONTROLLER": f"0x{messages.FIRST_FROM_CONTROLLER:02X}",
        "VARINT_BITS": layout.VARINT_BITS,
        "PROTOCOL_MAX_PAYLOAD_BYTES": f"{frames.MAX_PAYLOAD_BYTES} /* at most, of any board */",
        "PACKET_OVERHEAD_BYTES": f"{messages.PACKET_OVERHEAD_BYTES} /* of a payload, before its first packet */",
        "CAPTURE_DATA_HEAD_BYTES": messages.SEQUENCED_HEAD.size + messages.CaptureData.FIXED.size,
        "STREAM_MAGIC": f'"{coded_stream.MAGIC.decode()}"',
        "STREAM_VERSION": coded_stream.VERSION,
        "STREAM_MAX_CHANNELS": coded_stream.MAX_CHANNELS,
        "STREAM_MAX_RATE_HZ": f"{coded_stream.MAX_RATE_HZ}u",
        "STREAM_UNIT_BITS": f"0x{coded_stream.UNIT_BITS:02X}u",
        "STREAM_HAS_IMAGE_HASH": f"0x{coded_stream.HAS_IMAGE_HASH:02X}u",
        "STREAM_LENGTH_UNKNOWN": f"0x{coded_stream.LENGTH_UNKNOWN:02X}u",
        "STREAM_VARINT_BITS": coded_stream.VARINT_BITS,
        "PACKET_SEQUENCE_BITS": coded_stream.SEQUENCE_BITS,
        "UNIT_PROFILE": f"{coded_stream.STREAM_UNITS.index(coded_stream.PROFILE_UNIT)}u",
        "IMAGE_HASH_BYTES": coded_stream.IMAGE_HASH_BYTES,
        "IMAGE_MAGIC": f'"{model_image.MAGIC.decode()}"',
        "IMAGE_LAYOUT_VERSION": model_image.LAYOUT_VERSION,
    }
    return f"""/* Constants of messages, streams and model images; written by device_protocol/generate.py. */
#ifndef VIBROCAST_PROTOCOL_H
#define VIBROCAST_PROTOCOL_H

{_joined([f"#define VC_{name} {value}" for name, value in defines.items()])}

/* cffi: begin */
{_enumeration("message_type", "VC_", {_snake(message).upper(): message.TYPE for message in messages.ALL})}
{_enumeration("error_code", "VC_", messages.ErrorCode.__members__)}
{_enumeration("state", "VC_STATE_", messages.State.__members__)}
{_enumeration("tap", "VC_TAP_", messages.Tap.__members__)}
{_enumeration("slot_state", "VC_SLOT_", messages.SlotState.__members__)}
/* cffi: end */

#endif
"""


def _enumeration(name: str, prefix: str, members: Mapping[str, int]) -> str:
    lines = [f"    {prefix}{key} = {int(value)}" for key, value in members.items()]
    return f"enum vc_{name} {{\n" + ",\n".join(lines) + "\n};\n"


# ---- fields in C ----


def _snake(owner: type) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", owner.__name__).lower()


def _struct(owner: type) -> str:
    return _STRUCTS.get(owner, f"vc_{_snake(owner)}")


@dataclass
class CField:
    """A field in C: members of its struct; statements that take it from `fields` into the struct at `place`, and that
    write it from there; the terms of its bytes in a value."""

    members: list[str]
    read: Sequence[str] = ()
    write: Sequence[str] = ()
    size: Sequence[str] = ()


def _in_c(field: WireField, struct: str) -> CField:
    """Return a field in C. `struct`: its struct, with the operator behind it."""
    name = field.name
    place = struct + name
    piece, write_piece = [f"vc_piece {name};"], f"write_piece(writer, {place});"
    match field.wire:
        case Fixed() if field.type is bytes:
            size = layout.SHA256_BYTES
            read = [f"{place} = vc_take_piece(&fields, {size}).bytes;"]
            return CField([f"const uint8_t *{name};"], read, [f"write_sha256(writer, {place});"], [str(size)])
        case Fixed() | Part(name="added"):
            wire = field.wire.name if isinstance(field.wire, Fixed) else "u32"
            kind, bits = _TYPES[wire], "_float_bits" * (wire == "f32")
            size = _NUMBERS[kind]
            cast = "" if kind == "uint64_t" else f"({kind})"
            read = [f"{place}{bits} = {cast}vc_take_number(&fields, {size});"]
            write = [f"vc_frame_write_number(writer, {place}{bits}, {size});"]
            return CField([f"{kind} {name}{bits};"], read, write, [str(size)])
        case Flag():
            read = ["flags = (unsigned)vc_take_number(&fields, 1);", f"{place} = (uint8_t)flags;"]
            return CField([f"uint8_t {name};"], read)
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
            return CField(piece, [f"{place} = vc_take_piece(&fields, fields.rest.length);"])
        case Tag(number=number) if field.is_tuple:
            kind, count = _struct(field.item), f"{name.removesuffix('s')}_count"
            loop = f"for (i = 0; i < {struct}{count}; i++)"
            write = [loop, f"    write_{_snake(field.item)}(writer, {number}, &{place}[i]);"]
            return CField([f"const {kind} *{name};", f"unsigned {count};"], write=write)
        case Tag(number=number) if field.item in _NESTED:
            write = [f"write_{_snake(field.item)}(writer, {number}, &{place});"]
            return CField([f"{_struct(field.item)} {name};"], write=write)
        case Tag(number=number):
            read = [f"value = &{place};", f"tag = {number};"]
            return CField(piece, read, [f"write_tag(writer, {number}, {place}.length);", write_piece])


def _fields(owner: type) -> list[WireField]:
    """Return the fields of a class but for the samples of a CaptureData, which the caller writes."""
    return [field for field in wire_fields(owner) if owner is not messages.CaptureData or field.name != "data"]


def _statements(owner: type, struct: str, direction: str) -> list[str]:
    """Return the statements that `read` or `write` the fields of a class."""
    statements: list[str] = []
    for field in _fields(owner):
        found = getattr(_in_c(field, struct), direction)
        if not found:
            raise NotImplementedError(f"{owner.__name__}.{field.name}: state in _in_c how C is to {direction} it")
        statements += found
    return statements


def _structure(owner: type) -> str:
    members = [f"    {member}" for field in _fields(owner) for member in _in_c(field, "").members]
    about = wrap(f"/* {' '.join((owner.__doc__ or '').split())} */", 120, subsequent_indent=" * ")
    return _joined([*about, "typedef struct {", *members, f"}} {_struct(owner)};", ""])


# ---- messages.h and messages.c ----


def header() -> str:
    """Return messages.h."""
    with_body = [message for message in FROM_HOST if wire_fields(message)]
    return f"""/* Messages between host and controller (docs/protocol.md); written by device_protocol/generate.py.
 *
 * Pieces of a message that was read point into its payload. Texts are UTF-8. A sha256 has {layout.SHA256_BYTES} bytes;
 * NULL writes zeros. Floats are the bits of an IEEE 754 single. A tap, state or code is a number of protocol.h.
 */
#ifndef VIBROCAST_MESSAGES_H
#define VIBROCAST_MESSAGES_H

#include "frames.h"
#include "protocol.h"
#include "rejection.h"

/* cffi: begin */
{_joined([_structure(owner) for owner in (*with_body, *_NESTED, *RESPONSES)])}
/* A message from the host. `type`: enum vc_message_type, which names the member of `body` that counts, if it has one.
 * `sequence`: VC_NOTIFICATION for stream data. */
typedef struct {{
    uint8_t type;
    uint16_t sequence;
    union {{
{_joined([f"        {_struct(message)} {_snake(message)};" for message in with_body])}
    }} body;
}} vc_message;

/* Reads a payload whose type is below VC_FIRST_FROM_CONTROLLER. Returns 0, or the rejection's code: VC_MALFORMED,
 * VC_BAD_VALUE or VC_UNKNOWN_MESSAGE; `sequence` is then the number to answer with (VC_NOTIFICATION where none could be
 * read). Any bytes are safe. */
int vc_message_read(vc_message *message, const uint8_t *payload, size_t length, vc_rejection *rejection);

/* Write a message into a frame that has begun. After a CaptureData the caller writes its samples. */
{_joined([f"{_writer(message)};" for message in RESPONSES])}
void vc_write_rejection(vc_frame_writer *writer, uint16_t sequence, const vc_rejection *rejection);
/* cffi: end */

#endif
"""


def source() -> str:
    """Return messages.c."""
    return f"""/* Messages between host and controller; see messages.h. Written by device_protocol/generate.py. */
#include "messages.h"

#define SIGN_BIT 0x80000000u
#define INFINITY_BITS 0x7F800000u

/* Reads tags to the end; `value`, where there is one, becomes that of the last one that is `wanted`, or keeps NULL.
 * Returns whether every length fits. */
static int read_tags(vc_fields *fields, unsigned wanted, vc_piece *value)
{{
    while (fields->rest.length > 0) {{
        unsigned tag = (unsigned)vc_take_number(fields, 1);
        vc_piece piece = vc_take_piece(fields, (size_t)vc_take_number(fields, 2));
        if (fields->cut)
            return 0;
        if (value != NULL && tag == wanted)
            *value = piece;
    }}
    return !fields->cut;
}}

/* Takes items up to the end, each after its length. */
static vc_piece take_items(vc_fields *fields)
{{
    const vc_piece items = fields->rest;
    while (!fields->cut && fields->rest.length > 0)
        vc_take_piece(fields, (size_t)vc_take_varint(fields, VC_VARINT_BITS));
    return items;
}}

static int is_factor(uint32_t float_bits)
{{
    return float_bits < INFINITY_BITS || float_bits == SIGN_BIT;
}}

int vc_message_read(vc_message *message, const uint8_t *payload, size_t length, vc_rejection *rejection)
{{
    vc_fields fields;
    vc_piece *value = NULL;
    unsigned flags = 0, tag = 0;
    vc_fields_begin(&fields, payload, length);
    message->sequence = VC_NOTIFICATION;
    message->type = (uint8_t)vc_take_number(&fields, 1);
    if (message->type < VC_FIRST_UNSEQUENCED)
        message->sequence = (uint16_t)vc_take_number(&fields, 2);
    if (fields.cut)
        return vc_reject_numbers(rejection, VC_MALFORMED, "a message of # bytes, at least 3 are needed", length, 0);
    switch (message->type) {{
{_joined([_reading(message) for message in FROM_HOST])}
    default:
        return vc_reject_numbers(rejection, VC_UNKNOWN_MESSAGE,
                                 "message type # is not known to protocol version #: update the controller",
                                 message->type, VC_PROTOCOL_MAJOR);
    }}
    if (!fields.cut && flags > 1)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "flags # are set, only # is known", flags, 1);
    if (value != NULL)
        value->bytes = NULL;
    if (!read_tags(&fields, tag, value))
        return vc_reject_numbers(rejection, VC_MALFORMED, "message of type #: a field or tag is cut", message->type, 0);
    if (value != NULL && value->bytes == NULL)
        return vc_reject_numbers(rejection, VC_MALFORMED, "message of type #: tag # is missing", message->type, tag);
    switch (message->type) {{
{_joined([checks for message in FROM_HOST if (checks := _checking(message))])}
    default:
        break;
    }}
    return 0;
}}

static void write_head(vc_frame_writer *writer, uint8_t type, uint16_t sequence)
{{
    vc_frame_write_number(writer, type, 1);
    vc_frame_write_number(writer, sequence, 2);
}}

static void write_tag(vc_frame_writer *writer, uint8_t tag, size_t value_bytes)
{{
    vc_frame_write_number(writer, tag, 1);
    vc_frame_write_number(writer, value_bytes, 2);
}}

static void write_piece(vc_frame_writer *writer, vc_piece piece)
{{
    vc_frame_write(writer, piece.bytes, piece.length);
}}

static void write_sha256(vc_frame_writer *writer, const uint8_t *sha256)
{{
    static const uint8_t zeros[{layout.SHA256_BYTES}];
    vc_frame_write(writer, sha256 != NULL ? sha256 : zeros, sizeof zeros);
}}
{_joined([_writing_nested(owner) for owner in _NESTED])}
{_joined([_writing(message) for message in RESPONSES])}

void vc_write_rejection(vc_frame_writer *writer, uint16_t sequence, const vc_rejection *rejection)
{{
    const vc_error error = {{rejection->code, {{(const uint8_t *)rejection->text, rejection->length}}}};
    vc_write_error(writer, sequence, &error);
}}
"""


def _reading(message: type[Message]) -> str:
    """Return the case that takes a message's fields, all but the values of its tag."""
    struct = f"message->body.{_snake(message)}."
    statements = [line for field in wire_fields(message) for line in _in_c(field, struct).read]
    return _joined(
        [f"    case VC_{_snake(message).upper()}:", *(f"        {line}" for line in (*statements, "break;"))]
    )


def _checking(message: type[Message]) -> str:
    """Return the case that rejects values of a message, if there are any to reject."""
    checks = []
    for field in wire_fields(message):
        place = f"message->body.{_snake(message)}.{field.name}"
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
    if not checks:
        return ""
    lines = [line for wrong, rejected in checks for line in (f"if ({wrong})", f"    return {rejected};")]
    return _joined([f"    case VC_{_snake(message).upper()}:", *(f"        {line}" for line in (*lines, "break;"))])


def _writer(message: type[Message]) -> str:
    parameters = f"vc_frame_writer *writer, uint16_t sequence, const {_struct(message)} *message"
    return f"void vc_write_{_snake(message)}({parameters})"


def _writing(message: type[Message]) -> str:
    index = ["unsigned i;"] if any(field.is_tuple for field in wire_fields(message)) else []
    head = f"write_head(writer, VC_{_snake(message).upper()}, sequence);"
    return _function(_writer(message), [*index, head, *_statements(message, "message->", "write")])


def _writing_nested(owner: type) -> str:
    size = " + ".join(term for field in wire_fields(owner) for term in _in_c(field, "value->").size)
    parameters = f"vc_frame_writer *writer, uint8_t tag, const {_struct(owner)} *value"
    statements = [f"write_tag(writer, tag, {size});", *_statements(owner, "value->", "write")]
    return _function(f"static void write_{_snake(owner)}({parameters})", statements)


def _function(declaration: str, statements: list[str]) -> str:
    return _joined(["", declaration, "{", *(f"    {line}" for line in statements), "}"])


# ---- docs/protocol.md ----


def page(text: str) -> str:
    """Return the protocol's page with its tables between the markers."""
    heads = ("type", "message", "fixed part", "TLVs or rest")
    values = [
        (f"0x{field.wire.number:02x} {field.wire.description.split(',')[0]}", _cells(wire_fields(field.item)))
        for field in wire_fields(messages.HelloResponse)
        if isinstance(field.wire, Tag) and field.item in _NESTED
    ]
    tables = {
        "requests": _table((*heads, "answer"), [(*_message_row(message), message.ANSWER) for message in FROM_HOST]),
        "responses": _table(heads, [_message_row(message) for message in RESPONSES]),
        "values": _table(("tag", "value"), values),
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
    return _joined([lines[0], "|---" * len(heads) + "|", *lines[1:]])


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
            case Part(name="added"):
                cells.append(f"from version 1.1 on {field.name} u32")
            case Part(name="counted"):
                cells.append(f"{field.name}'s length u8, {field.name}")
            case Rest(description=description):
                cells.append(f"then the {description}")
    return ", ".join(cells)


if __name__ == "__main__":
    for path, contents in generated_files().items():
        path.write_text(contents, encoding="utf-8")
