/* Reads fields from the front of bytes: numbers and texts, with every length checked.
 *
 * An incomplete field sets `cut`, and so does each one after it; their values are 0 and NULL. So a reader takes all
 * fields and then looks at `cut` once.
 */
#ifndef VIBROCAST_FIELDS_H
#define VIBROCAST_FIELDS_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
/* Bytes, or a text without a zero behind it. Somebody else owns the memory. */
typedef struct {
    const uint8_t *bytes;
    size_t length;
} vc_piece;

/* Takes the first item off items that were read, each after its length as a varint; returns 0 when there are no more.
 */
int vc_next_item(vc_piece *items, vc_piece *item);
/* cffi: end */

typedef struct {
    vc_piece rest;
    int cut;
} vc_fields;

void vc_fields_begin(vc_fields *fields, const uint8_t *bytes, size_t length);

/* A number of 1 to 8 bytes, little endian. */
uint64_t vc_take_number(vc_fields *fields, unsigned bytes);

/* `length` bytes, in place. */
vc_piece vc_take_piece(vc_fields *fields, size_t length);

/* A LEB128 number below 2^bits, in no more bytes than `bits` needs; `bits`: at most 63. */
uint64_t vc_take_varint(vc_fields *fields, unsigned bits);

/* The number of 1 to 8 bytes, little endian, at `bytes`; and its bytes. */
uint64_t vc_number(const uint8_t *bytes, unsigned count);
void vc_number_bytes(uint8_t *bytes, uint64_t number, unsigned count);

int vc_same_bytes(const uint8_t *a, const uint8_t *b, size_t length);

/* Whether a text is UTF-8 (RFC 3629): no byte out of place, no longer form than needed, no surrogate. */
int vc_is_utf8(vc_piece text);

/* Bytes of the longest beginning of a UTF-8 text that has at most `limit` bytes and cuts no character. */
size_t vc_text_cut(vc_piece text, size_t limit);

/* A text that a zero ends. */
vc_piece vc_text_piece(const char *text);

#endif
