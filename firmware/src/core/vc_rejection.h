/* The reason of a rejection: the code and the text of the Error that answers a request. */
#ifndef VIBROCAST_REJECTION_H
#define VIBROCAST_REJECTION_H

#include "vc_fields.h"
#include "vibrocast/protocol.h"

/* Fits the smallest payload that the protocol allows, header and tag included. */
#define VC_REJECTION_TEXT_BYTES 200

/* cffi: begin */
/* `text`: UTF-8, without a zero behind it; a longer text is cut. */
typedef struct {
    uint16_t code, length;
    char text[200];
} vc_rejection;

/* Begins a rejection. Returns `code`, which is never 0, so a caller may `return vc_reject(...)`. */
int vc_reject(vc_rejection *rejection, enum vc_error_code code, const char *text);
/* The same with numbers in the place of the first and second '#' of `text`. */
int vc_reject_numbers(vc_rejection *rejection, enum vc_error_code code, const char *text, uint64_t first,
                      uint64_t second);

/* Add to the text; these return the code as well. Texts are cut between characters. */
int vc_rejection_add(vc_rejection *rejection, const char *text);
int vc_rejection_add_piece(vc_rejection *rejection, vc_piece text);
int vc_rejection_add_hex(vc_rejection *rejection, const uint8_t *bytes, size_t length);
/* cffi: end */

#endif
