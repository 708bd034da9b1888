/* The header of a coded stream, and the heads of its packets; docs/reference/bitstream.md. */
#ifndef VIBROCAST_STREAM_HEADER_H
#define VIBROCAST_STREAM_HEADER_H

#include "vc_fields.h"
#include "vibrocast/output.h"
#include "vibrocast/protocol.h"
#include "vc_rejection.h"

#define VC_LENGTH_UNKNOWN UINT64_MAX

/* cffi: begin */
/* All facts that a decoder needs before the first packet; holds no pointers. */
typedef struct {
    uint8_t codec;    /* identifier, 1 to 15 */
    uint64_t samples; /* per channel; VC_LENGTH_UNKNOWN for a live stream */
    vc_output_stream output;
    uint8_t needs_image; /* 0 or 1: `image_hash` begins the SHA-256 of the model image that the stream needs */
    uint8_t image_hash[4];
    uint8_t configuration_length;
    uint8_t configuration[255]; /* the codec's own */
} vc_stream_header;

/* Reads `data`, all of it, as a header. Returns 0, or the rejection's code, VC_BAD_VALUE. Any bytes are safe. */
int vc_stream_header_read(vc_stream_header *header, const uint8_t *data, size_t length, vc_rejection *rejection);

/* Reads the head of a packet. Returns 0, or -1 for a packet that no decoder takes. Any bytes are safe. */
int vc_packet_sequence(const uint8_t *packet, size_t length, uint32_t *sequence, int *refresh);
/* cffi: end */

#endif
