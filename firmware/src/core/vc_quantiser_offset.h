/* The quantiser offset of a rate-controlled stream's packets: one number by which each packet moves the quality of all
 * channels.
 *
 * A packet carries it in front of its blocks, as a difference from the packet before. */
#ifndef VIBROCAST_QUANTISER_OFFSET_H
#define VIBROCAST_QUANTISER_OFFSET_H

#include "vc_common.h"

/* Quantiser offsets are within +-VC_MAX_QUANTISER_OFFSET, in a unit that each codec has: all octaves of steps in 1/16
 * octave. */
#define VC_MAX_QUANTISER_OFFSET (21 * 16)

typedef struct {
    int32_t value; /* of the last packet; 0 = the stream's own quality, more is coarser */
    uint16_t same; /* probability that a packet has that of the one before */
} vc_quantiser_offset;

/* Reads the end of a configuration, whose other fields take `fields_length` bytes: nothing, or one byte of 1, if
 * packets carry their quantiser offset. Returns 0 for other bytes. */
int vc_rate_control_read(const uint8_t *bytes, size_t length, size_t fields_length, int *rate_controlled);

/* At a refresh. */
void vc_quantiser_offset_reset(vc_quantiser_offset *quantiser_offset);

/* Both store the packet's quantiser offset as the last one. `value`: limited to +-VC_MAX_QUANTISER_OFFSET. */
void vc_quantiser_offset_encode(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset, int32_t value);
/* Encodes the multiple of four nearest `value`. Returns `lambda`, the weight of a bit against squared error, adjusted
 * by the remainder, which is not coded. */
uint32_t vc_quantiser_offset_encode_fours(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset, int32_t value,
                                          uint32_t lambda);
void vc_quantiser_offset_decode(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset);

#endif
