/* Why the controller refuses what the host asks: the code and the text of the Error that answers it. */
#ifndef VIBROCAST_REFUSAL_H
#define VIBROCAST_REFUSAL_H

#include "fields.h"
#include "protocol.h"

/* Fits, with what stands around it, in the smallest payload that the protocol allows. */
#define VC_REFUSAL_TEXT_BYTES 200

/* cffi: begin */
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
