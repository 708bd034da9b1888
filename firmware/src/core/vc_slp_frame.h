/* Shared by encoder and decoder of `slp`: configuration, syntax of a frame, transform, filter and steps. */
#ifndef VIBROCAST_SLP_FRAME_H
#define VIBROCAST_SLP_FRAME_H

#include "vc_quantiser_offset.h"
#include "vc_slp.h"

#define VC_SLP_MAX_FRAME 128
#define VC_SLP_MAX_ORDER 16
#define VC_SLP_MAX_PACKET_FRAMES 4095
#define VC_SLP_MAX_REFLECTION 15 /* largest code: a coefficient of sin(code pi / 32) */
#define VC_SLP_STEP_CODES (21 * 8)
#define VC_SLP_RATE_CODES 142 /* eighths of an octave above 1 Hz */
#define VC_SLP_MAX_LEVEL (1 << 24)
/* Limits of the filter's state and of the residual, in 1/256 of a least significant bit: eight and 64 times full scale.
 * They leave forward errors, up to residual + order x state, room in 32 bits. */
#define VC_SLP_MAX_STATE (1 << 26)
#define VC_SLP_MAX_RESIDUAL (1 << 29)

#define VC_SLP_NEIGHBOUR_CONTEXTS 48
#define VC_SLP_LEVEL_PROBABILITIES 288 /* of all contexts: six decisions of each by neighbours */
#define VC_SLP_UNARY_LIMIT 15

typedef struct {
    uint32_t frame, packet_frames;
    unsigned order, channels;
    int rate_controlled;               /* packets carry their quantiser offset */
    uint32_t shaping;                  /* weight of the detection threshold in the steps, in 1/256 */
    uint16_t rate_code;                /* 8 log2 of the sampling rate in Hz */
    uint16_t contexts;                 /* of magnitudes: VC_SLP_NEIGHBOUR_CONTEXTS, or `frame`: one a bin */
    int32_t log_step[VC_MAX_CHANNELS]; /* log2, in 1/256, of the signal's step in 1/256 of a least significant bit */
} vc_slp_configuration;

/* Adaptive probabilities, shared by all channels of a stream, restarted at a refresh. */
typedef struct {
    uint16_t level[VC_SLP_LEVEL_PROBABILITIES]; /* of the first decision in all contexts, then of the next one */
    uint16_t silent[4];                         /* by the two frames before */
    uint16_t changed[2];                        /* by the frame before */
    uint16_t reflection_differs[VC_SLP_MAX_ORDER], reflection_sign[VC_SLP_MAX_ORDER];
    uint16_t reflection_above[VC_SLP_MAX_REFLECTION];
    uint8_t frames; /* of all channels since the refresh, as far as they decide on the adaptation */
} vc_slp_model;

/* The state of a channel from frame to frame, which restarts at a refresh. Rows of magnitudes have two bins of padding
 * on each side. */
typedef struct {
    uint8_t now[VC_SLP_MAX_FRAME + 4], last[VC_SLP_MAX_FRAME + 4];
    uint16_t average[VC_SLP_MAX_FRAME + 4]; /* running average of each bin's magnitudes, in 1/256 */
    uint8_t silent_history;                 /* of the last two frames, one bit each */
    uint8_t changed;                        /* the predictor, in the last frame */
    int8_t reflections[VC_SLP_MAX_ORDER];
    int32_t log_steps[VC_SLP_MAX_FRAME];    /* of each bin under this predictor, at a quantiser offset of 0 */
    int32_t backward[VC_SLP_MAX_ORDER + 1]; /* the filter's state: backward prediction errors of the last sample */
} vc_slp_channel;

/* One frame as it is coded. */
typedef struct {
    int silent;
    int8_t reflections[VC_SLP_MAX_ORDER];
    int32_t levels[VC_SLP_MAX_FRAME];
} vc_slp_frame;

int vc_slp_configuration_read(vc_slp_configuration *configuration, const uint8_t *bytes, size_t length,
                              unsigned channels);
void vc_slp_model_reset(vc_slp_model *model, const vc_slp_configuration *configuration);
void vc_slp_channel_reset(vc_slp_channel *channel, const vc_slp_configuration *configuration, unsigned number);

/* Codes one frame with the range coder: into it from `frame` if `encoding`, else from it into `frame`. */
void vc_slp_code_frame(vc_range_coder *coder, int encoding, vc_slp_model *model, vc_slp_channel *channel,
                       const vc_slp_configuration *configuration, unsigned number, vc_slp_frame *frame);

/* Steps of the bins of a channel under a predictor, log2 in 1/256; and such a step at a quantiser offset. */
void vc_slp_log_steps(const vc_slp_configuration *configuration, unsigned number, const int8_t *reflections,
                      int32_t *log_steps);
int32_t vc_slp_step(int32_t log_step, const vc_quantiser_offset *quantiser_offset);

/* The residual's coefficient of a level. */
int32_t vc_slp_reconstruct(int32_t level, int32_t step);

/* Orthonormal DCT-II of `frame` values, and its inverse. */
void vc_slp_dct(const int32_t *values, uint32_t frame, int32_t *spectrum);
void vc_slp_inverse_dct(const int32_t *spectrum, uint32_t frame, int32_t *values);

/* Lattice filter A(z) or 1 / A(z) of a predictor over a frame, from signal to residual and back. `backward`: its state,
 * order + 1 values, which both update in the same way. */
void vc_slp_analyse(const vc_slp_configuration *configuration, const int8_t *reflections, int32_t *backward,
                    const int32_t *samples, int32_t *residual);
void vc_slp_synthesise(const vc_slp_configuration *configuration, const int8_t *reflections, int32_t *backward,
                       const int32_t *residual, int32_t *samples);

/* log2(value) in 1/256, straight lines between powers of two; 0 for 0. */
int32_t vc_slp_log2(uint64_t value);

extern const uint16_t vc_slp_threshold[57]; /* see generate_tables.py */

#endif
