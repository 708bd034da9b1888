/* Shared by encoder and decoder of `eva`: the model in memory, and the configuration. */
#ifndef VIBROCAST_EVA_MODEL_H
#define VIBROCAST_EVA_MODEL_H

#include "vc_eva.h"
#include "vc_mdct_state.h"
#include "vc_quantiser_offset.h"

#define VC_EVA_HOP 16u
#define VC_EVA_LAYOUT_VERSION 2               /* of model images */
#define VC_EVA_DELAY 41u                      /* of the synthesis 28, of the analysis beyond its own column 13 */
#define VC_EVA_MAX_WIDTH 128u                 /* of hidden layers and latents alike */
#define VC_EVA_DECISIONS (VC_UNARY_LIMIT + 1) /* on the magnitude of a level, and its sign */
#define VC_EVA_STAGES 3u
#define VC_EVA_MAX_PACKET_COLUMNS 4095u

/* An inverse GDN. Weights: channels x channels, 0 to 127; multipliers and constants: 4 bytes each, little endian. */
typedef struct {
    const int8_t *weights;
    const uint8_t *multipliers, *constants;
    unsigned shift;
} vc_eva_normalisation;

/* A transposed convolution. Weights: phase by phase outputs x taps x inputs, three taps in the first phase and two in
 * the others; multipliers: 4 bytes each. */
typedef struct {
    const int8_t *weights;
    const uint8_t *multipliers;
} vc_eva_convolution;

/* A model whose bytes have been checked; all pointers lead into them. */
typedef struct {
    uint32_t width, latents;
    const uint8_t *fraction_bits; /* of each latent: 1, the quantiser step, is 2^fraction_bits in its unit */
    const uint8_t *probabilities; /* latents x VC_EVA_DECISIONS, 2 bytes each */
    int adapts;                   /* probabilities are only where those of a stream begin */
    int has_network;
    vc_eva_normalisation normalisations[VC_EVA_STAGES];
    vc_eva_convolution convolutions[VC_EVA_STAGES];
} vc_eva_model;

typedef struct {
    uint32_t packet_columns;
    unsigned channels;
    int rate_controlled;            /* packets carry their quantiser offset */
    int32_t level[VC_MAX_CHANNELS]; /* of a signal of RMS value 1, in 1/256 of a sample's least significant bit */
} vc_eva_configuration;

int vc_eva_model_read(vc_eva_model *model, const uint8_t *bytes, size_t length);
int vc_eva_configuration_read(vc_eva_configuration *configuration, const uint8_t *bytes, size_t length,
                              unsigned channels);

/* The quantiser step of each latent in a packet of this quantiser offset, in 1/16 octave, in 1/4096 of its unit. */
void vc_eva_packet_steps(const vc_eva_model *model, int32_t quantiser_offset, int32_t *steps);

/* The prior's probability of a decision on a latent, in 1/65536: below VC_UNARY_LIMIT that the magnitude of its level
 * is above `decision`, else that the level is negative. */
uint16_t vc_eva_probability(const vc_eva_model *model, uint32_t latent, uint32_t decision);

#endif
