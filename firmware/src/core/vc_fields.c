/* Fields of messages, see vc_fields.h. */
#include "vc_fields.h"

#include "vibrocast/protocol.h"

void vc_fields_begin(vc_fields *fields, const uint8_t *bytes, size_t length)
{
    fields->rest.bytes = bytes;
    fields->rest.length = length;
    fields->cut = 0;
}

vc_piece vc_take_piece(vc_fields *fields, size_t length)
{
    vc_piece piece = {NULL, 0};
    if (fields->cut || length > fields->rest.length) {
        fields->cut = 1;
        return piece;
    }
    piece.bytes = fields->rest.bytes;
    piece.length = length;
    fields->rest.bytes += length;
    fields->rest.length -= length;
    return piece;
}

uint64_t vc_take_number(vc_fields *fields, unsigned bytes)
{
    vc_piece piece = vc_take_piece(fields, bytes);
    return vc_number(piece.bytes, (unsigned)piece.length);
}

uint64_t vc_take_varint(vc_fields *fields, unsigned bits)
{
    uint64_t value = 0;
    unsigned index;
    vc_piece byte;
    for (index = 0; 7 * index < bits; index++) {
        byte = vc_take_piece(fields, 1);
        if (fields->cut)
            return 0;
        value |= (uint64_t)(byte.bytes[0] & 0x7Fu) << 7 * index;
        if (byte.bytes[0] < 0x80u && value >> bits == 0)
            return value;
    }
    fields->cut = 1;
    return 0;
}

int vc_next_item(vc_piece *items, vc_piece *item)
{
    vc_fields fields = {*items, 0};
    if (items->length == 0)
        return 0;
    *item = vc_take_piece(&fields, (size_t)vc_take_varint(&fields, VC_VARINT_BITS));
    *items = fields.rest;
    return 1;
}

uint64_t vc_number(const uint8_t *bytes, unsigned count)
{
    uint64_t number = 0;
    while (count-- > 0)
        number = number << 8 | bytes[count];
    return number;
}

void vc_number_bytes(uint8_t *bytes, uint64_t number, unsigned count)
{
    unsigned i;
    for (i = 0; i < count; i++)
        bytes[i] = (uint8_t)(number >> 8 * i);
}

int vc_same_bytes(const uint8_t *a, const uint8_t *b, size_t length)
{
    size_t i;
    for (i = 0; i < length; i++)
        if (a[i] != b[i])
            return 0;
    return 1;
}

/* Bytes of the character at the start of a text; 0 if there is none (the table of RFC 3629, section 4). */
static size_t character_bytes(vc_piece text)
{
    const uint8_t *bytes = text.bytes;
    uint8_t first = bytes[0], low = 0x80, high = 0xBF;
    size_t length = first < 0x80 ? 1 : first < 0xC2 ? 0 : first < 0xE0 ? 2 : first < 0xF0 ? 3 : first < 0xF5 ? 4 : 0;
    size_t i;
    if (length > text.length)
        return 0;
    if (first == 0xE0)
        low = 0xA0;
    else if (first == 0xED)
        high = 0x9F;
    else if (first == 0xF0)
        low = 0x90;
    else if (first == 0xF4)
        high = 0x8F;
    for (i = 1; i < length; i++, low = 0x80, high = 0xBF)
        if (bytes[i] < low || bytes[i] > high)
            return 0;
    return length;
}

int vc_is_utf8(vc_piece text)
{
    size_t length;
    for (; text.length > 0; text.bytes += length, text.length -= length) {
        length = character_bytes(text);
        if (length == 0)
            return 0;
    }
    return 1;
}

size_t vc_text_cut(vc_piece text, size_t limit)
{
    size_t length = text.length;
    if (length <= limit)
        return length;
    for (length = limit; length > 0 && (text.bytes[length] & 0xC0u) == 0x80u; length--)
        continue;
    return length;
}

vc_piece vc_text_piece(const char *text)
{
    vc_piece piece = {(const uint8_t *)text, 0};
    const volatile char *letter = text; /* else GCC calls strlen, which no port needs to have */
    while (*letter++ != 0)
        piece.length++;
    return piece;
}
