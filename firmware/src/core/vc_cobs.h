/* Consistent overhead byte stuffing: bytes without a zero among them, so that a zero can close a frame.
 *
 * Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Trans. Networking 7(2), 1999. Portable C99, no
 * allocation, no global state.
 */
#ifndef VIBROCAST_COBS_H
#define VIBROCAST_COBS_H

#include <stddef.h>
#include <stdint.h>

/* Bytes that `length` bytes take at most when they are encoded. */
#define VC_COBS_BYTES(length) ((length) + (length) / 254 + 1)

/* cffi: begin */
/* An encoder that takes its bytes in pieces. */
typedef struct {
    uint8_t *encoded;
    size_t capacity, length; /* length: bytes written, or capacity + 1 where they did not fit */
    size_t code_at;          /* place for the length of the open group */
    int open;                /* a group is open */
} vc_cobs_encoder;

/* Starts encoding into encoded[0..capacity), which must stay valid until the end. */
void vc_cobs_begin(vc_cobs_encoder *encoder, uint8_t *encoded, size_t capacity);
void vc_cobs_put(vc_cobs_encoder *encoder, const uint8_t *data, size_t length);
/* Ends the encoding; returns the bytes written, or 0 if they did not fit. */
size_t vc_cobs_end(vc_cobs_encoder *encoder);

/* Decodes bytes[0..length) in place; writes the bytes that they stood for to `decoded`. Returns 0, or -1 where they are
 * not what an encoder makes (`bytes` is then half overwritten). Any bytes are safe. */
int vc_cobs_decode(uint8_t *bytes, size_t length, size_t *decoded);
/* cffi: end */

#endif
