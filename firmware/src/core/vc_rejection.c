/* The reason for which the controller rejects a request; see vc_rejection.h. */
#include "vc_rejection.h"

#include "vc_common.h"

#define MAX_DIGITS 20 /* of 2^64 - 1 */

int vc_rejection_add_piece(vc_rejection *rejection, vc_piece text)
{
    size_t length = vc_text_cut(text, VC_REJECTION_TEXT_BYTES - (size_t)rejection->length);
    if (length > 0)
        memcpy(rejection->text + rejection->length, text.bytes, length);
    rejection->length = (uint16_t)(rejection->length + length);
    return rejection->code;
}

int vc_rejection_add(vc_rejection *rejection, const char *text)
{
    return vc_rejection_add_piece(rejection, vc_text_piece(text));
}

int vc_rejection_add_hex(vc_rejection *rejection, const uint8_t *bytes, size_t length)
{
    uint8_t digits[2];
    vc_piece piece = {digits, 2};
    size_t i;
    for (i = 0; i < length; i++) {
        digits[0] = (uint8_t)"0123456789abcdef"[bytes[i] >> 4];
        digits[1] = (uint8_t)"0123456789abcdef"[bytes[i] & 0x0Fu];
        vc_rejection_add_piece(rejection, piece);
    }
    return rejection->code;
}

static void add_number(vc_rejection *rejection, uint64_t number)
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
    vc_rejection_add_piece(rejection, piece);
}

int vc_reject_numbers(vc_rejection *rejection, enum vc_error_code code, const char *text, uint64_t first,
                      uint64_t second)
{
    vc_piece character = {(const uint8_t *)text, 1};
    rejection->code = (uint16_t)code;
    rejection->length = 0;
    for (; *character.bytes != 0; character.bytes++) {
        if (*character.bytes == '#') {
            add_number(rejection, first);
            first = second;
        } else {
            vc_rejection_add_piece(rejection, character);
        }
    }
    return rejection->code;
}

int vc_reject(vc_rejection *rejection, enum vc_error_code code, const char *text)
{
    rejection->code = (uint16_t)code;
    rejection->length = 0;
    return vc_rejection_add(rejection, text);
}
