/* Shared by encoder and decoder of `dct`: reconstruction levels, and the adaptive model of range coding. */
#ifndef VIBROCAST_DCT_MODEL_H
#define VIBROCAST_DCT_MODEL_H

#include "vc_common.h"
#include "vc_dct.h"

#define VC_DCT_MAX_BLOCK 1024
#define VC_DCT_MIN_LEVELS 4u
#define VC_DCT_MAX_LEVELS 65535u
#define VC_DCT_LEVEL_CODES 231u /* of the numbers of levels that packets state */
#define VC_DCT_FADE_SAMPLES 64  /* of a fade at a missing packet, and of the rise after it; no block is shorter */
#define VC_DCT_CONTEXTS 40
#define VC_DCT_ZERO_CONTEXTS 8
#define VC_DCT_UNARY_LIMIT 16u
#define VC_DCT_ADAPTATION 4u /* a decision moves its probability by 1/2^4 of the distance */

typedef struct {
    unsigned channels;
    int whole;                     /* a packet is one transform of any length, which only hosts decode */
    uint32_t block, packet_blocks; /* samples in a block, blocks in a packet */
    uint32_t first, end;           /* coefficients that are coded; the others are 0 */
    int logarithmic, range_coded;
    uint32_t levels;                    /* 0: each packet states its own */
    uint32_t smallest[VC_MAX_CHANNELS]; /* range code of the least magnitude */
} vc_dct_configuration;

int vc_dct_configuration_read(vc_dct_configuration *configuration, const uint8_t *bytes, size_t length,
                              unsigned channels);

/* The quantiser of one channel of a packet; magnitudes in 1/256 of a sample's least significant bit. */
typedef struct {
    int logarithmic;
    uint32_t levels;              /* without the zero that is a value of its own */
    unsigned zeros;               /* 1 when it is one */
    uint32_t centre;              /* levels below this one count downwards */
    int64_t width, steps;         /* linear: a step is width / steps */
    uint32_t bottom, left, right; /* logarithmic: the least magnitude and the greatest ones, in 1/2^20 of an octave */
} vc_dct_quantiser;

void vc_dct_quantiser_init(vc_dct_quantiser *quantiser, int logarithmic, uint32_t levels, unsigned zeros,
                           uint32_t smallest, uint32_t below, uint32_t above);

/* The level that a coded value stands for; values beyond the last stand for the last. */
int32_t vc_dct_level(const vc_dct_quantiser *quantiser, uint32_t value);

/* Values from this one on, without the zero of its own, come in pairs of equal rank on both sides of zero. */
static inline uint32_t vc_dct_first_pair(int logarithmic)
{
    return logarithmic ? 0u : 1u;
}

/* Adaptive model of range coding: probabilities of "zero, where that is a value of its own" and of "the rank, less its
 * low bits, is above n", for each context. Restarts with each packet. */
typedef struct {
    uint16_t zero[VC_DCT_ZERO_CONTEXTS];
    uint16_t above[VC_DCT_CONTEXTS][VC_DCT_UNARY_LIMIT];
    /* Of this block below the bin, of the block before from there on: ranks, those expected where zero came instead. */
    uint16_t ranks[VC_DCT_MAX_BLOCK + 1];
    uint8_t zeros[VC_DCT_MAX_BLOCK];
    uint16_t before; /* rank of the bin below, of the block before */
} vc_dct_model;

/* The place of one value: the contexts of its decisions, and how many low bits of its rank have even odds. */
typedef struct {
    uint16_t *zero, *above;
    unsigned low_bits;
    uint32_t expected; /* rank */
} vc_dct_context;

void vc_dct_model_reset(vc_dct_model *model);
/* Forgets the block before: at the first block of a channel. */
void vc_dct_model_next_channel(vc_dct_model *model);
vc_dct_context vc_dct_context_find(vc_dct_model *model, uint32_t bin, uint32_t block);
void vc_dct_model_set(vc_dct_model *model, uint32_t bin, uint32_t rank, int zero);

extern const int32_t vc_dct_cosine[VC_DCT_MAX_BLOCK + 1]; /* cos(2 pi i / (4 VC_DCT_MAX_BLOCK)) in 1/2^24 */
extern const uint32_t vc_dct_exponential[257];            /* 2^(i / 256) in 1/2^30 */

#endif
