/* Frames on the wire: a payload and its CRC-16, COBS-encoded, closed by a zero byte; docs/reference/protocol.md,
 * "Frames". */
#ifndef VIBROCAST_FRAMES_H
#define VIBROCAST_FRAMES_H

#include "../core/vc_cobs.h"
#include "../core/vc_fields.h"
#include "vibrocast/sizes.h"

#define VC_CRC_BYTES 2
/* The longest frame, without and with the zero that closes it. */
#define VC_ENCODED_BYTES VC_COBS_BYTES(VC_MAX_PAYLOAD_BYTES + VC_CRC_BYTES)
#define VC_FRAME_BYTES (VC_ENCODED_BYTES + 1)

/* cffi: begin */
typedef struct vc_frame_reader vc_frame_reader;

/* Bytes of memory, aligned for uint32_t, for a reader: it holds one frame, whatever it is fed. */
size_t vc_frame_reader_size(void);

void vc_frame_reader_init(vc_frame_reader *reader);

/* Takes bytes up to the end of the first good frame. Returns how many. `payload`: that frame's payload, in the reader
 * and valid until the next call; without a frame its length is 0. Damaged, empty and too long frames are dropped and
 * counted. Call it until all bytes are taken. */
size_t vc_frame_reader_feed(vc_frame_reader *reader, const uint8_t *data, size_t length, vc_piece *payload);

/* Frames dropped so far; stays at 2^32 - 1. */
uint32_t vc_frame_reader_bad_frames(const vc_frame_reader *reader);

/* Writes one frame, its payload in pieces. */
typedef struct {
    vc_cobs_encoder cobs;
    size_t payload_bytes;
    uint16_t crc;
} vc_frame_writer;

/* Begins a frame in frame[0..capacity), which must stay valid until the end. */
void vc_frame_begin(vc_frame_writer *writer, uint8_t *frame, size_t capacity);
void vc_frame_write(vc_frame_writer *writer, const uint8_t *payload, size_t length);
/* A number of 1 to 8 bytes, little endian. */
void vc_frame_write_number(vc_frame_writer *writer, uint64_t number, unsigned bytes);
/* Numbers of two bytes, little endian. */
void vc_frame_write_samples(vc_frame_writer *writer, const int16_t *samples, size_t count);
/* Ends the frame. Returns its bytes, or 0 if they do not fit or the payload has not 1 to VC_MAX_PAYLOAD_BYTES. */
size_t vc_frame_end(vc_frame_writer *writer);
/* cffi: end */

struct vc_frame_reader {
    uint32_t bad_frames;
    uint32_t length;                       /* of `pending` */
    int taken;                             /* `pending` is a payload that was handed out */
    uint8_t pending[VC_ENCODED_BYTES + 1]; /* the frame that comes in; one byte more marks it as too long */
};

#endif
