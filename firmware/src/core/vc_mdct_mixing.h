/* Logistic mixing: a decision's probability from two contexts. Inline, because decoding spends most of its time here.
 *
 * After M. Mahoney, "Adaptive weighing of context models for lossless data compression", 2005. */
#ifndef VIBROCAST_MDCT_MIXING_H
#define VIBROCAST_MDCT_MIXING_H

#include "vc_mdct_state.h"

#define VC_MIN_PROBABILITY 32u
#define VC_SILENCE_SHIFT 5
#define VC_LEARNING_RATE 6
#define VC_MAX_COUNT 255

/* One prediction, kept for the update that follows. */
typedef struct {
    uint16_t *cell[VC_INPUTS];
    uint8_t *count[VC_INPUTS];
    int16_t *weight;
    int32_t input[VC_INPUTS]; /* ln(p / (1 - p)) in 1/256 */
    int32_t probability;      /* of 1 in 1/65536 */
} vc_prediction;

/* ln(p / (1 - p)) in 1/256, of a probability in 1/65536. */
static inline int32_t vc_stretched(uint32_t probability)
{
    return vc_stretch[probability >> 5];
}

/* A probability within the range coder's limits. */
static inline uint32_t vc_codable(uint32_t probability)
{
    return probability < VC_MIN_PROBABILITY           ? VC_MIN_PROBABILITY
           : probability > 65536 - VC_MIN_PROBABILITY ? 65536 - VC_MIN_PROBABILITY
                                                      : probability;
}

/* Probability of 1 for decision `decision` (0: not zero; n: magnitude above n). */
static inline uint32_t vc_predict(vc_model *model, const vc_contexts *contexts, unsigned decision, unsigned quantiser,
                                  vc_prediction *prediction)
{
    const unsigned kind = decision < VC_KINDS ? decision : VC_KINDS - 1;
    int16_t *weight = model->weight[kind][quantiser][contexts->set];
    int32_t sum = 0, index;
    unsigned i;
    for (i = 0; i < VC_INPUTS; i++) {
        prediction->cell[i] = &model->probability[kind][quantiser][i][contexts->index[i]];
        prediction->count[i] = &model->count[kind][quantiser][i][contexts->index[i]];
        prediction->input[i] = vc_stretched(*prediction->cell[i]);
        sum += weight[i] * prediction->input[i];
    }
    index = sum / (1 << 16) + 512; /* from 1/2^22 to the table's steps of 1/64 */
    prediction->weight = weight;
    prediction->probability = vc_squash[index < 0 ? 0 : index > 1023 ? 1023 : index];
    return vc_codable((uint32_t)prediction->probability);
}

/* Learns from the decision. */
static inline void vc_update(const vc_prediction *prediction, int bit)
{
    const int32_t error = ((bit ? 65536 : 0) - prediction->probability) * VC_LEARNING_RATE / 64;
    unsigned i;
    for (i = 0; i < VC_INPUTS; i++) {
        const int32_t weight = prediction->weight[i] + ((error * prediction->input[i] + (1 << 13)) >> 14);
        uint16_t *cell = prediction->cell[i];
        uint8_t *count = prediction->count[i];
        const uint32_t rate = vc_learning[*count];
        prediction->weight[i] = (int16_t)vc_clamped(weight, INT16_MAX);
        *cell = (uint16_t)(bit ? *cell + ((65535u - *cell) * rate >> 16) : *cell - (*cell * rate >> 16));
        *count = (uint8_t)(*count + (*count < VC_MAX_COUNT));
    }
}

#endif
