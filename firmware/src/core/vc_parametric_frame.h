/* Shared by encoder and decoder of `parametric`: configuration and the syntax of a frame. */
#ifndef VIBROCAST_PARAMETRIC_FRAME_H
#define VIBROCAST_PARAMETRIC_FRAME_H

#include "vc_mdct_state.h"
#include "vc_parametric.h"

#define VC_PARAMETRIC_MAX_BANDS 35 /* of 128 bins at an eighth of their frequency each */
#define VC_PARAMETRIC_MAX_HARMONICS 8
#define VC_PARAMETRIC_MAX_TIMES 64 /* levels over time in a frame */
#define VC_PARAMETRIC_MAX_PACKET_FRAMES 4095
#define VC_PARAMETRIC_MAX_PACKET_SAMPLES (1ul << 18)
#define VC_PARAMETRIC_PITCHES 512 /* 64 an octave, from 2^-10 of a turn per sample on */
#define VC_PARAMETRIC_OCTAVES 21  /* of levels */
#define VC_PARAMETRIC_ABOVE 12    /* decisions of a number's magnitude */
#define VC_PARAMETRIC_CONTEXTS 3  /* of a number: whether the one before was 0, 1 or more in magnitude */

typedef struct {
    uint32_t hop, packet_frames;
    uint32_t frame_blocks, level_blocks; /* blocks in a frame, and for each level over time */
    unsigned channels, bands, harmonics;
    unsigned level_bits;                        /* a level is 2^-level_bits octaves of amplitude */
    uint8_t edges[VC_PARAMETRIC_MAX_BANDS + 1]; /* first bin of each band; behind the last, hop */
} vc_parametric_configuration;

/* Kinds of numbers, each with probabilities of its own. */
enum {
    VC_PARAMETRIC_TIME,
    VC_PARAMETRIC_FIRST_BAND, /* behind a refresh */
    VC_PARAMETRIC_BAND,
    VC_PARAMETRIC_PITCH,
    VC_PARAMETRIC_FIRST_HARMONIC, /* where ridges begin */
    VC_PARAMETRIC_HARMONIC,
    VC_PARAMETRIC_KINDS
};

/* Adaptive probabilities, shared by all channels of a stream, restarted at a refresh. */
typedef struct {
    uint16_t silent[2], ridges[2]; /* by the frame before */
    uint16_t above[VC_PARAMETRIC_KINDS][VC_PARAMETRIC_CONTEXTS][VC_PARAMETRIC_ABOVE];
    uint16_t negative[VC_PARAMETRIC_KINDS];
} vc_parametric_model;

/* A frame of one channel. Levels count from 1, amplitude 1/4 of a sample's least significant bit; 0 = none at all. */
typedef struct {
    int16_t pitch;                                  /* of the ridges; -1 = none */
    int16_t times[VC_PARAMETRIC_MAX_TIMES];         /* added to all levels of the frame */
    int16_t bands[VC_PARAMETRIC_MAX_BANDS];         /* root mean square of a band's MDCT coefficients */
    int16_t harmonics[VC_PARAMETRIC_MAX_HARMONICS]; /* amplitudes of the ridges' harmonics */
} vc_parametric_frame;

/* The state of a channel from frame to frame. Everything but the phase restarts at a refresh. */
typedef struct {
    int silent, known;         /* the last frame; and whether one that was not silent came before */
    vc_parametric_frame frame; /* the last one that was not silent */
    uint32_t phase;            /* of the ridges at the next sample, in 1/2^32 turn */
} vc_parametric_channel;

int vc_parametric_configuration_read(vc_parametric_configuration *configuration, const uint8_t *bytes, size_t length,
                                     unsigned channels);
void vc_parametric_model_reset(vc_parametric_model *model);
void vc_parametric_channel_reset(vc_parametric_channel *channel);

static inline uint32_t vc_parametric_frame_samples(const vc_parametric_configuration *configuration)
{
    return configuration->frame_blocks * configuration->hop;
}

/* The highest level. */
static inline int32_t vc_parametric_levels(const vc_parametric_configuration *configuration)
{
    return (int32_t)(VC_PARAMETRIC_OCTAVES << configuration->level_bits);
}

/* Returns how far the phase of ridges of a pitch moves from sample to sample, in 1/2^32 turn. */
static inline uint32_t vc_parametric_turn(int32_t pitch)
{
    return (uint32_t)vc_step_of((uint32_t)pitch) << 16;
}

/* Codes one frame with the range coder: into it from `frame` if `encoding`, else from it into `frame`; a silent one has
 * no bands and no ridges. `refresh`: of the packet that it begins. Sets the channel's phase where ridges begin, and at
 * a refresh. */
void vc_parametric_code_frame(vc_range_coder *coder, int encoding, vc_parametric_model *model,
                              vc_parametric_channel *channel, const vc_parametric_configuration *configuration,
                              int refresh, vc_parametric_frame *frame);

#endif
