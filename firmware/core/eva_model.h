/* What the encoder and the decoder of `eva` share: the model as it lies in memory, and the configuration. */
#ifndef VIBROCAST_EVA_MODEL_H
#define VIBROCAST_EVA_MODEL_H

#include "block_coder.h"
#include "eva.h"

#define VC_EVA_HOP 16u
#define VC_EVA_LAYOUT_VERSION 1 /* of model images */
#define VC_EVA_DELAY 41u        /* of the synthesis 28, of the analysis beyond its own column 13 */
#define VC_EVA_MAX_WIDTH 128u   /* of hidden layers and latents alike */
#define VC_EVA_MAX_RATES 16u
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
    uint32_t width, latents, rates;
    const uint8_t *step_codes; /* rates x latents, 2 bytes each */
    const uint8_t *prior; /* initial tables, or probabilities: rates x latents x (VC_UNARY_LIMIT + 1), 2 bytes each */
    int adapts;           /* which of both */
    int has_network;
    vc_eva_normalisation normalisations[VC_EVA_STAGES];
    vc_eva_convolution convolutions[VC_EVA_STAGES];
} vc_eva_model;

typedef struct {
    uint32_t packet_columns;
    unsigned channels;
    int rate_controlled;               /* packets carry their quantiser offset */
    int32_t level[VC_MAX_CHANNELS];    /* of a signal of RMS value 1, in 1/256 of a sample's least significant bit */
    uint32_t quality[VC_MAX_CHANNELS]; /* in 1/16 of the way from one rate to the next */
} vc_eva_configuration;

int vc_eva_model_read(vc_eva_model *model, const uint8_t *bytes, size_t length);
int vc_eva_configuration_read(vc_eva_configuration *configuration, const vc_eva_model *model, const uint8_t *bytes,
                              size_t length, unsigned channels);

/* The quality of a channel in a packet of this quantiser offset, in 1/4 of the way from one rate to the next; within
 * those that the model has. */
uint32_t vc_eva_packet_quality(const vc_eva_model *model, const vc_eva_configuration *configuration, unsigned channel,
                               int32_t quantiser_offset);

/* Quantiser steps of all latents at a quality, in 1/4096 of the latents' unit. */
void vc_eva_steps(const vc_eva_model *model, uint32_t quality, int32_t *steps);

/* Probabilities, 2 bytes each, of latent k at a quality: that its magnitude is above 0, 1, ..., then that it is below
 * zero. For a prior that does not adapt. */
const uint8_t *vc_eva_probabilities(const vc_eva_model *model, uint32_t quality, uint32_t k);
/* One of them as the range coder takes it. */
uint32_t vc_eva_probability(const uint8_t *probabilities, unsigned decision);

#endif
