/* Logistic mixing: a decision's probability from four contexts and, if a model image brings one, a network. Inline,
 * because decoding spends most of its time here.
 *
 * After M. Mahoney, "Adaptive weighing of context models for lossless data compression", 2005. */
#ifndef VIBROCAST_MDCT_MIXING_H
#define VIBROCAST_MDCT_MIXING_H

#include "mdct.h"

#define VC_MIN_PROBABILITY 32u
#define VC_ADAPTATION_SHIFT 5
#define VC_BIAS_INPUT 256
#define VC_LEARNING_RATE 6
#define VC_LEARNING_SHIFT 18
#define VC_MAX_WEIGHT (8 << 16)

/* One prediction, kept for the update that follows. */
typedef struct {
    uint16_t *cell[VC_INPUTS];
    int32_t *weight;
    int32_t stretched[VC_MIXED];
    int32_t mixed; /* probability of 1 in 1/65536 */
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

static inline uint16_t vc_adapted(uint16_t probability, int bit)
{
    return (uint16_t)(bit ? probability + ((65535 - probability) >> VC_ADAPTATION_SHIFT)
                          : probability - (probability >> VC_ADAPTATION_SHIFT));
}

/* Index into vc_squash, (d + 2048) / 4 rounded down, of d = sum / 65536 rounded towards zero; within the table. */
static inline int32_t vc_squash_index(int64_t sum)
{
    const int64_t one = 1 << 18; /* a step of the table; the lower bits are cleared, so that a shift is enough */
    const int32_t index = (int32_t)(((sum + (sum < 0 ? 65535 : 0) + 512 * one) & -one) / one);
    return index < 0 ? 0 : index > 1023 ? 1023 : index;
}

/* Probability of 1 for decision `decision` (0: not zero; n: magnitude above n). */
static inline uint32_t vc_predict(vc_model *model, const vc_contexts *contexts, unsigned decision, unsigned quantiser,
                                  vc_prediction *prediction)
{
    const unsigned kind = decision < VC_DECISIONS ? decision : VC_DECISIONS - 1;
    int32_t *weight = model->weight[kind][quantiser][contexts->scale];
    int64_t sum = (int64_t)weight[VC_INPUTS + 1] * VC_BIAS_INPUT;
    uint32_t probability;
    unsigned i;
    for (i = 0; i < VC_INPUTS; i++) {
        prediction->cell[i] = &model->probability[kind][quantiser][i][contexts->index[i]];
        prediction->stretched[i] = vc_stretched(*prediction->cell[i]);
    }
    prediction->stretched[VC_INPUTS] = contexts->network[kind];
    prediction->stretched[VC_INPUTS + 1] = VC_BIAS_INPUT;
    for (i = 0; i <= VC_INPUTS; i++)
        sum += (int64_t)weight[i] * prediction->stretched[i];
    probability = vc_squash[vc_squash_index(sum)];
    prediction->weight = weight;
    prediction->mixed = (int32_t)probability;
    return vc_codable(probability);
}

/* Learns from the decision. */
static inline void vc_update(const vc_prediction *prediction, int bit)
{
    const int32_t error = VC_LEARNING_RATE * ((bit ? 65536 : 0) - prediction->mixed);
    unsigned i;
    for (i = 0; i < VC_MIXED; i++) {
        int32_t change;
        if (i == VC_INPUTS && prediction->stretched[i] == 0)
            continue; /* no network: nothing would change */
        change = (error * prediction->stretched[i]) / (1 << VC_LEARNING_SHIFT);
        prediction->weight[i] = vc_clamped(prediction->weight[i] + change, VC_MAX_WEIGHT);
    }
    for (i = 0; i < VC_INPUTS; i++)
        *prediction->cell[i] = vc_adapted(*prediction->cell[i], bit);
}

#endif
