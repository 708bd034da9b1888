/* The coarseness of a steered stream's packets: one number by which each packet moves the quality of all channels.
 *
 * A packet carries it in front of its blocks, as a difference from the packet before. */
#ifndef VIBROCAST_COARSENESS_H
#define VIBROCAST_COARSENESS_H

#include "common.h"

/* Coarsenesses are within +-VC_MAX_COARSENESS, in a unit that each codec has: all octaves of steps in 1/16 octave. */
#define VC_MAX_COARSENESS (21 * 16)

typedef struct {
    int32_t value; /* of the last packet; 0 = the stream's own quality, more is coarser */
    uint16_t same; /* probability that a packet has that of the one before */
} vc_coarseness;

/* Reads the end of a configuration, whose other fields take `fields_length` bytes: nothing, or one byte, 1, which says
 * that packets carry their coarseness. Returns 0 where it is neither. */
int vc_steering_read(const uint8_t *bytes, size_t length, size_t fields_length, int *steered);

/* At a refresh. */
void vc_coarseness_reset(vc_coarseness *coarseness);

/* Both make the packet's coarseness the last one; `value`: what is beyond +-VC_MAX_COARSENESS counts as that. */
void vc_coarseness_encode(vc_range_coder *coder, vc_coarseness *coarseness, int32_t value);
/* Encodes the number of fours nearest `coarseness`, and returns `lambda`, the weight of a bit against squared error,
 * moved by what is left, which need not be told. */
uint32_t vc_coarseness_encode_fours(vc_range_coder *coder, vc_coarseness *coarseness, int32_t value, uint32_t lambda);
void vc_coarseness_decode(vc_range_coder *coder, vc_coarseness *coarseness);

#endif
