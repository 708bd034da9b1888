/* Why the controller refuses what the host asks: the code and the text of the Error that answers it. */
#ifndef VIBROCAST_REFUSAL_H
#define VIBROCAST_REFUSAL_H

#include "fields.h"

/* Fits, with what stands around it, in the smallest payload that the protocol allows. */
#define VC_REFUSAL_TEXT_BYTES 200

/* cffi: begin */
/* docs/protocol.md, "Error codes". */
enum vc_error_code {
    VC_UNKNOWN_MESSAGE = 1,
    VC_MALFORMED = 2,
    VC_UNSUPPORTED_VERSION = 3,
    VC_HELLO_FIRST = 4,
    VC_WRONG_STATE = 5,
    VC_BAD_VALUE = 6,
    VC_UNKNOWN_CODEC = 7,
    VC_UNKNOWN_IMAGE = 8,
    VC_BEYOND_LIMITS = 9,
    VC_NO_SUCH_SLOT = 10,
    VC_WRONG_HARDWARE = 11,
    VC_IMAGE_REFUSED = 12,
    VC_FLASH_FAILED = 13
};

/* `text` is UTF-8, without a zero behind it; what does not fit is left out. */
typedef struct {
    uint16_t code, length;
    char text[200];
} vc_refusal;

/* Begins a refusal and returns `code`, which is never 0: `return vc_refuse(...)` says no. */
int vc_refuse(vc_refusal *refusal, enum vc_error_code code, const char *text);
/* The same with numbers in the place of the first and second '#' of `text`. */
int vc_refuse_numbers(vc_refusal *refusal, enum vc_error_code code, const char *text, uint64_t first, uint64_t second);

/* Add to the text; these return the code as well. Texts are cut between characters. */
int vc_refusal_add(vc_refusal *refusal, const char *text);
int vc_refusal_add_piece(vc_refusal *refusal, vc_piece text);
int vc_refusal_add_hex(vc_refusal *refusal, const uint8_t *bytes, size_t length);
/* cffi: end */

#endif
