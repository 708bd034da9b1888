/* Why the controller refuses what the host asks; see refusal.h. */
#include "refusal.h"

#include "common.h"

#define MAX_DIGITS 20 /* of 2^64 - 1 */

int vc_refusal_add_piece(vc_refusal *refusal, vc_piece text)
{
    size_t length = vc_text_cut(text, VC_REFUSAL_TEXT_BYTES - (size_t)refusal->length);
    if (length > 0)
        memcpy(refusal->text + refusal->length, text.bytes, length);
    refusal->length = (uint16_t)(refusal->length + length);
    return refusal->code;
}

int vc_refusal_add(vc_refusal *refusal, const char *text)
{
    return vc_refusal_add_piece(refusal, vc_text_piece(text));
}

int vc_refusal_add_hex(vc_refusal *refusal, const uint8_t *bytes, size_t length)
{
    uint8_t digits[2];
    vc_piece piece = {digits, 2};
    size_t i;
    for (i = 0; i < length; i++) {
        digits[0] = (uint8_t)"0123456789abcdef"[bytes[i] >> 4];
        digits[1] = (uint8_t)"0123456789abcdef"[bytes[i] & 0x0Fu];
        vc_refusal_add_piece(refusal, piece);
    }
    return refusal->code;
}

static void add_number(vc_refusal *refusal, uint64_t number)
{
    uint8_t digits[MAX_DIGITS];
    unsigned at = MAX_DIGITS;
    vc_piece piece;
    do {
        digits[--at] = (uint8_t)('0' + number % 10);
        number /= 10;
    } while (number > 0);
    piece.bytes = digits + at;
    piece.length = MAX_DIGITS - at;
    vc_refusal_add_piece(refusal, piece);
}

int vc_refuse_numbers(vc_refusal *refusal, enum vc_error_code code, const char *text, uint64_t first, uint64_t second)
{
    vc_piece character = {(const uint8_t *)text, 1};
    refusal->code = (uint16_t)code;
    refusal->length = 0;
    for (; *character.bytes != 0; character.bytes++) {
        if (*character.bytes == '#') {
            add_number(refusal, first);
            first = second;
        } else {
            vc_refusal_add_piece(refusal, character);
        }
    }
    return refusal->code;
}

int vc_refuse(vc_refusal *refusal, enum vc_error_code code, const char *text)
{
    refusal->code = (uint16_t)code;
    refusal->length = 0;
    return vc_refusal_add(refusal, text);
}
