/* The block coder: values of one block to bits and back, by dependent quantisation and the context model of
 * vc_mdct_state.h.
 *
 * A block is the spectrum of `mdct`. */
#ifndef VIBROCAST_BLOCK_CODER_H
#define VIBROCAST_BLOCK_CODER_H

#include "vc_mdct_state.h"

/* The coder's state of one channel. */
typedef struct {
    vc_history history;
    unsigned state; /* of dependent quantisation */
} vc_block_state;

/* The best way into each state of dependent quantisation, for each bin. */
typedef struct {
    uint32_t chosen[VC_MAX_BINS][4]; /* index that leads into a state */
    uint8_t origin[VC_MAX_BINS][4];  /* and the state that it leads from */
    uint32_t indices[VC_MAX_BINS];
    int8_t offsets[VC_MAX_BINS]; /* of their levels, in 1/256 step */
    vc_bin bin[VC_MAX_BINS];
    vc_contexts contexts[VC_MAX_BINS][4]; /* of a bin, after the best way into each state */
    vc_centroid_sums *sums;               /* for the training of centroids; NULL = none wanted */
} vc_block_search;

/* At a refresh. */
void vc_block_reset(vc_block_state *state);

/* Decodes the next block of a channel: levels[0..bins), in quantiser steps, within +-2^26, and what to add to their
 * magnitudes, in 1/256 step. */
void vc_block_decode(vc_range_coder *coder, vc_model *model, vc_block_state *state, uint32_t bins, int32_t *levels,
                     int8_t *offsets);

/* Chooses the levels of a block for the least squared error + lambda * bits, and encodes them. `magnitudes`: in 1/256
 * step, at most 2^30. `values`: their signs are those of the levels. `lambda`: in 1/256 of a squared step. */
void vc_block_encode(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                     uint32_t bins, const uint32_t *magnitudes, const int32_t *values, uint32_t lambda);

/* Encodes the levels that vc_block_decode has returned from the same state; `silent`: as the block was coded. */
void vc_block_write(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                    uint32_t bins, const int32_t *levels, int silent);

#endif
