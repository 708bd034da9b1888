/* The quantiser offset of a rate-controlled stream's packets: one number by which each packet moves the quality of all
 * channels.
 *
 * A packet carries it in front of its blocks, as a difference from the packet before. */
#ifndef VIBROCAST_QUANTISER_OFFSET_H
#define VIBROCAST_QUANTISER_OFFSET_H

#include "common.h"

/* Quantiser offsets are within +-VC_MAX_QUANTISER_OFFSET, in a unit that each codec has: all octaves of steps in 1/16
 * octave. */
#define VC_MAX_QUANTISER_OFFSET (21 * 16)

typedef struct {
    int32_t value; /* of the last packet; 0 = the stream's own quality, more is coarser */
    uint16_t same; /* probability that a packet has that of the one before */
} vc_quantiser_offset;

/* Reads the end of a configuration, whose other fields take `fields_length` bytes: nothing, or one byte, 1, which says
 * that packets carry their quantiser offset. Returns 0 where it is neither. */
int vc_rate_control_read(const uint8_t *bytes, size_t length, size_t fields_length, int *rate_controlled);

/* At a refresh. */
void vc_quantiser_offset_reset(vc_quantiser_offset *quantiser_offset);

/* Both make the packet's quantiser offset the last one; `value`: what is beyond +-VC_MAX_QUANTISER_OFFSET counts as
 * that. */
void vc_quantiser_offset_encode(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset, int32_t value);
/* Encodes the number of fours nearest `quantiser_offset`, and returns `lambda`, the weight of a bit against squared
 * error, moved by what is left, which need not be told. */
uint32_t vc_quantiser_offset_encode_fours(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset, int32_t value,
                                          uint32_t lambda);
void vc_quantiser_offset_decode(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset);

#endif
