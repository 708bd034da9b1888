/* Shared by encoder and decoder of `mdct`: configuration, the context model, and the levels coded so far. */
#ifndef VIBROCAST_MDCT_STATE_H
#define VIBROCAST_MDCT_STATE_H

#include "vc_mdct.h"
#include "vc_quantiser_offset.h"

#define VC_MAX_BINS 128 /* of a spectrum */
#define VC_STEP_CODES (21 * 64)
#define VC_STEP_CODE_BITS 11 /* of the 16 in the configuration; above them, the fill */
/* The section of a step shape. */
#define VC_SHAPE_NODES 7       /* at 0, 1/32, 1/16 ... 1/2 and 1 of half the rate */
#define VC_SHAPE_BYTES 2       /* 2 bits for each node, and for the unit */
#define VC_SHAPE_UNIT_CODES 14 /* step codes in the smallest unit */
/* Coefficients, in 1/256 of a sample's least significant bit, stay within this: 21 times full scale, by
 * 4 / pi * sqrt(2 * 128). */
#define VC_MAX_COEFFICIENT (1 << 28)

#define VC_INPUTS 2 /* contexts that predict each decision */
#define VC_CONTEXTS 256
#define VC_KINDS 4 /* of decisions: "not zero", "more than 1", "more than 2", and all further ones */
#define VC_UNARY_LIMIT 15
#define VC_SILENCE_CONTEXTS 16

typedef struct {
    uint32_t hop, packet_blocks;
    unsigned channels;
    int rate_controlled;    /* packets carry their quantiser offset */
    size_t rotation;        /* where the section of a rotation begins (vc_mdct_rotation.h); 0 = there is none */
    uint32_t longest_delay; /* of a channel, in samples, by the rotation */
    unsigned finest;        /* the channel of the smallest step, which all coded channels have with a rotation */
    uint16_t step_code[VC_MAX_CHANNELS];
    uint8_t fill[VC_MAX_CHANNELS];  /* magnitude that replaces a level of 0, in 1/128 step */
    uint8_t shaped;                 /* steps differ over frequency */
    uint16_t shape[VC_SHAPE_NODES]; /* step codes by which steps are coarser at the nodes */
} vc_mdct_configuration;

/* Sets of weights: blocks before this one, at most 11, by the quarter of the spectrum. */
#define VC_MAX_AGE 11
#define VC_WEIGHT_SETS ((VC_MAX_AGE + 1) * 4)

/* Magnitudes of which the reconstruction differs from the level, and classes of the expected magnitude for it. */
#define VC_CENTROID_LEVELS 3
#define VC_CENTROID_CLASSES 16

/* Where tables hold the centroids, [2][VC_CENTROID_LEVELS][VC_CENTROID_CLASSES]; the cells come first. */
#define VC_CENTROIDS_AT                                                                                                \
    (VC_KINDS * 2 * VC_INPUTS * VC_CONTEXTS + 2 * VC_KINDS * 2 * VC_WEIGHT_SETS * VC_INPUTS + VC_SILENCE_CONTEXTS)

/* Adaptive state that is shared by all channels of a stream and restarts at a refresh. A quantiser is one of the two
 * that dependent quantisation alternates between. */
typedef struct {
    const uint8_t *tables;
    uint16_t probability[VC_KINDS][2][VC_INPUTS][VC_CONTEXTS]; /* 0 = not begun */
    uint8_t count[VC_KINDS][2][VC_INPUTS][VC_CONTEXTS];        /* of the decisions a probability has learned from */
    int16_t weight[VC_KINDS][2][VC_WEIGHT_SETS][VC_INPUTS];    /* in 1/16384 */
    uint16_t silence[VC_SILENCE_CONTEXTS];
} vc_model;

/* For each centroid: the sum of differences from the level, in 1/256 step, and their number. */
typedef struct {
    int64_t sum[2][VC_CENTROID_LEVELS][VC_CENTROID_CLASSES];
    uint32_t count[2][VC_CENTROID_LEVELS][VC_CENTROID_CLASSES];
} vc_centroid_sums;

/* Greatest magnitude that a history keeps. */
#define VC_MAX_KEPT_MAGNITUDE 126u
/* Bins of padding on each side of a row. */
#define VC_PADDING 2

/* Magnitudes coded so far in one channel, which make the contexts. */
typedef struct {
    uint8_t rows[4][VC_MAX_BINS + 2 * VC_PADDING];  /* this block, the last one, and the two before */
    uint16_t average[VC_MAX_BINS + 2 * VC_PADDING]; /* running average of each bin, in 1/256 */
    uint16_t mean[VC_MAX_BINS + 2 * VC_PADDING];    /* slower, from the first block on a true mean, in 1/512 */
    uint32_t block_sum;                             /* of the last block */
    uint32_t blocks;                                /* so far, at most MEAN_BLOCKS of vc_mdct_model.c */
    uint8_t silent_history;                         /* of the last two blocks, one bit each */
} vc_history;

/* The bins below one in the same block. */
typedef struct {
    uint32_t nearest; /* three magnitudes as the history keeps them, 8 bits each, the nearest lowest */
    uint32_t sum;     /* of all their magnitudes */
} vc_below;

/* The part of a coefficient's contexts that does not depend on the bins below it. */
typedef struct {
    uint32_t magnitude; /* expected, in 1/1024 step, without the bins below */
    uint32_t loudness;  /* the part that grows with the loudness of the block, in 1/1024 step; here at the mean one */
    int32_t mean_below; /* the mean loudness of the bins below, as vc_sixteenths, for the ratio to it */
    uint8_t mean_class;
    uint8_t quarter; /* of the spectrum */
    uint8_t set;
} vc_bin;

/* Contexts of one coefficient, shared by all its decisions. */
typedef struct {
    unsigned index[VC_INPUTS];
    unsigned set; /* of weights */
    unsigned centroid_class;
} vc_contexts;

/* The step of a step code below VC_STEP_CODES: 64 codes an octave, from 64 on. */
static inline int32_t vc_step_of(uint32_t code)
{
    return (int32_t)((64 + (code & 63)) << (code >> 6));
}

/* Step codes by which the step of bin k is coarser: between the nodes, linear over frequency. */
static inline int32_t vc_shape_at(const vc_mdct_configuration *configuration, uint32_t k)
{
    const uint32_t middle = (2 * k + 1) * (256 / configuration->hop); /* in 1/512 of half the rate */
    const unsigned node = middle < 16 ? 0 : vc_floor_log2(middle) - 3;
    const unsigned width_bits = node == 0 ? 4 : node + 3;
    const uint32_t above = middle - (node == 0 ? 0 : 1u << width_bits);
    const uint32_t low = configuration->shape[node], high = configuration->shape[node + 1];
    return (int32_t)((low * ((1u << width_bits) - above) + high * above) >> width_bits);
}

/* The step code of a coded channel in a packet of this quantiser offset, in 1/4 octave, without its shape. */
static inline int32_t vc_flat_code(const vc_mdct_configuration *configuration, unsigned channel,
                                   int32_t quantiser_offset)
{
    return configuration->step_code[configuration->rotation ? configuration->finest : channel] + 16 * quantiser_offset;
}

/* The step of bin k with such a step code, in 1/256 of a sample's least significant bit; within the steps that there
 * are. */
static inline int32_t vc_bin_step(const vc_mdct_configuration *configuration, int32_t flat_code, uint32_t k)
{
    const int32_t code = flat_code + (configuration->shaped ? vc_shape_at(configuration, k) : 0);
    return vc_step_of(code < 0 ? 0 : code < VC_STEP_CODES ? (uint32_t)code : VC_STEP_CODES - 1);
}

int vc_configuration_read(vc_mdct_configuration *configuration, const uint8_t *bytes, size_t length, unsigned channels);

/* The payload of a model image is tables. */
int vc_model_check_tables(const uint8_t *tables, size_t length);
void vc_model_reset(vc_model *model, const uint8_t *tables);
/* Begins all cells, for encoders; decoders begin each when it is first used, so that a refresh takes little time. */
void vc_model_begin(vc_model *model);
void vc_model_export(const vc_model *model, uint8_t *tables);
/* Puts the means of these sums into tables, as the centroids. */
void vc_centroids_export(const vc_centroid_sums *sums, uint8_t *tables);

void vc_history_reset(vc_history *history);
void vc_history_next_block(vc_history *history, uint32_t hop);

/* A magnitude, in quantiser steps, as the history keeps it. */
static inline uint32_t vc_kept_magnitude(uint32_t magnitude)
{
    return magnitude < VC_MAX_KEPT_MAGNITUDE ? magnitude : VC_MAX_KEPT_MAGNITUDE;
}

/* Records the magnitude of bin k of the current block; returns it as kept. */
static inline uint32_t vc_history_set(vc_history *history, uint32_t k, uint32_t magnitude)
{
    const uint32_t kept = vc_kept_magnitude(magnitude);
    history->rows[0][k + VC_PADDING] = (uint8_t)kept;
    return kept;
}

/* Moves to the next bin: `magnitude`, as kept, is that of the bin left. */
static inline void vc_below_add(vc_below *below, uint32_t magnitude)
{
    below->nearest = (below->nearest << 8 | magnitude) & 0xFFFFFFu;
    below->sum += magnitude;
}

/* The part of bin k's contexts that all ways through the block share. `means_below`: the sum of the history's means
 * below it, which grows by its own. */
void vc_bin_find(vc_bin *bin, const vc_history *history, uint32_t hop, uint32_t k, uint32_t *means_below);

/* Number of steps, four an octave from 4 up and one a unit below: a logarithm of x with two bits of mantissa. */
static inline unsigned vc_fine_class(uint32_t x)
{
    unsigned exponent;
    if (x < 4)
        return x;
    exponent = vc_floor_log2(x);
    return 4 * exponent - 8 + (x >> (exponent - 2));
}

/* Sixteenths of an octave, and steps of 1/16 within one: a logarithm of x, 1 to 2^27. */
static inline uint32_t vc_sixteenths(uint32_t x)
{
    const unsigned exponent = vc_floor_log2(x);
    return 16 * exponent + ((x << 4 >> exponent) & 15u);
}

uint32_t vc_silence_predict(const vc_model *model, const vc_history *history);
void vc_silence_update(vc_model *model, const vc_history *history, int silent);

/* Dependent quantisation: state after an index, the quantiser of a state, and the level (in steps) of an index. */
static inline unsigned vc_next_state(unsigned state, uint32_t index)
{
    /* The 4-state trellis of dependent quantisation in VVC (ITU-T H.266, 8.7.3). */
    static const uint8_t next[4][2] = {{0, 2}, {2, 0}, {1, 3}, {3, 1}};
    return next[state][index & 1u];
}

static inline int32_t vc_clamped(int32_t value, int32_t limit)
{
    return value > limit ? limit : value < -limit ? -limit : value;
}

static inline unsigned vc_quantiser_of(unsigned state)
{
    return state >> 1;
}

static inline uint32_t vc_level_of(uint32_t index, unsigned quantiser)
{
    return index == 0 ? 0 : 2 * index - quantiser;
}

/* What to add to the magnitude of a level, in 1/256 step: it then is the mean of those that are coded by the level. */
static inline int8_t vc_level_offset(const vc_model *model, unsigned quantiser, unsigned class, uint32_t level)
{
    const unsigned row = quantiser * VC_CENTROID_LEVELS + (level < VC_CENTROID_LEVELS ? level : VC_CENTROID_LEVELS) - 1;
    return level == 0 ? 0 : (int8_t)model->tables[VC_CENTROIDS_AT + row * VC_CENTROID_CLASSES + class];
}

/* The coefficient of a level with its sign and its offset, in 1/256 of a least significant bit. */
static inline int32_t vc_reconstruct(int32_t level, int32_t offset, int32_t step)
{
    const int64_t value = ((int64_t)level * 256 + (level < 0 ? -offset : offset)) * step / 256;
    return (int32_t)(value > VC_MAX_COEFFICIENT    ? VC_MAX_COEFFICIENT
                     : value < -VC_MAX_COEFFICIENT ? -VC_MAX_COEFFICIENT
                                                   : value);
}

extern const int16_t vc_stretch[2048];       /* ln(p / (1 - p)) at p = (i + 1/2) / 2048, in 1/256 */
extern const uint16_t vc_squash[1024];       /* 65536 / (1 + exp(-d / 256)) at d = 4 i - 2046 */
extern const uint16_t vc_initial[256];       /* vc_squash at 16 times an int8_t: the value of a byte of the tables */
extern const uint16_t vc_learning[256];      /* 65536 / (i + 1.6): how far a probability moves after i decisions */
extern const uint16_t vc_rate[1024];         /* of a 1 with the probability vc_squash, in 1/256 bit */
extern const uint16_t vc_share[VC_MAX_BINS]; /* 79 * 512 / (k + 1), rounded down */
extern const uint16_t vc_ratio[65];          /* 16 * 2^(i / 16) */
extern const uint8_t vc_ratio_class[65]; /* how many of 16, 21 1/3, 26 2/3, 32, 37 1/3, 42 2/3 and 48 are at most i */
extern const uint16_t vc_mean_rate[25];  /* 4096 / i */
extern const uint8_t vc_builtin_tables[];

#endif
