/* The learned part of the context model, where a model image brings one: a small network over magnitudes and contexts.
 *
 * It predicts all decisions of a coefficient at once, and its predictions are mixed with those of the contexts. */
#ifndef VIBROCAST_MDCT_NETWORK_H
#define VIBROCAST_MDCT_NETWORK_H

#include "mdct.h"

#define VC_NETWORK_MAGNITUDES 18
#define VC_NETWORK_DECISIONS 2 /* decisions whose contexts' probabilities are inputs, too */
#define VC_NETWORK_INPUTS (VC_NETWORK_MAGNITUDES + 3 + VC_NETWORK_DECISIONS * VC_INPUTS)
#define VC_NETWORK_EXAMPLE (VC_NETWORK_INPUTS + 2) /* inputs, then the quantiser and the index */
#define VC_NETWORK_FIRST 32
#define VC_NETWORK_SECOND 24

/* Layers, each of weights (int8, in 1/64, row by row) and then biases (int16, little endian, in 1/256): both hidden
 * ones, then the last for each quantiser. */
#define VC_NETWORK_BYTES                                                                                               \
    (VC_NETWORK_FIRST * (VC_NETWORK_INPUTS + 2) + VC_NETWORK_SECOND * (VC_NETWORK_FIRST + 2) +                         \
     2 * VC_DECISIONS * (VC_NETWORK_SECOND + 2))

/* Inputs of bin k, in 1/16. `contexts`: with their indices already found. */
void vc_network_inputs(int16_t *inputs, const vc_model *model, const vc_contexts *contexts, const vc_history *history,
                       const vc_below *below, uint32_t bins, uint32_t k, unsigned quantiser);

/* Runs the network: ln(p / (1 - p)) of each decision, in 1/256. Any bytes are safe. */
void vc_network_run(const uint8_t *network, const int16_t *inputs, unsigned quantiser, int32_t *logits);

#endif
