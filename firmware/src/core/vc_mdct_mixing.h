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
/* A cell of the tables that nothing was coded with, and the count of all others: few, so that a model adapts to each
 * recording. */
#define VC_UNTRAINED_CELL 0x80u
#define VC_TRAINED_COUNT 30
#define VC_LEAST_CLASS 28u /* vc_fine_class of the least expected magnitude, 263 */

/* The prediction of one context. */
typedef struct {
    uint16_t *cell;
    uint8_t *count;
    int32_t stretched; /* ln(p / (1 - p)) in 1/256 */
} vc_input;

/* One prediction, kept for the update that follows. */
typedef struct {
    vc_input input[VC_INPUTS];
    int16_t *weight;
    int32_t probability; /* of 1 in 1/65536 */
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

static inline unsigned vc_at_most(unsigned value, unsigned limit)
{
    return value < limit ? value : limit;
}

/* The contexts of bin k of a block. */
static inline void vc_contexts_find(vc_contexts *contexts, const vc_bin *bin, uint32_t k, const vc_below *below)
{
    const uint32_t nearest = below->nearest & 255u, second = below->nearest >> 8 & 255u, third = below->nearest >> 16;
    /* Of the loudness of this block's bins below to their means: sixteenths of an octave from 1/4 on. */
    const int32_t any_ratio = (int32_t)vc_sixteenths(below->sum + 1) - bin->mean_below;
    const uint32_t ratio = any_ratio < 0 ? 0 : any_ratio > 64 ? 64 : (uint32_t)any_ratio;
    const uint32_t magnitude = bin->magnitude + 183 * nearest + 65 * second + 28 * third +
                               (below->sum * vc_share[k] >> 9) + (bin->loudness * vc_ratio[ratio] >> 6);
    const unsigned class = vc_at_most(vc_fine_class(magnitude) - VC_LEAST_CLASS, 63);
    contexts->index[0] = class * 4 + bin->quarter;
    contexts->index[1] = bin->mean_class * 16u + vc_ratio_class[ratio] * 2u + (nearest > 0);
    contexts->set = bin->set;
    contexts->centroid_class = vc_at_most(class / 2, VC_CENTROID_CLASSES - 1);
}

/* The place in vc_squash, and in vc_rate, of a probability stretched, in 1/64. */
static inline uint32_t vc_place_of(int32_t stretched)
{
    const int32_t place = stretched + 512;
    return place < 0 ? 0 : place > 1023 ? 1023 : (uint32_t)place;
}

/* Begins a cell by the tables. */
static inline void vc_begin_cell(vc_model *model, unsigned place)
{
    const uint8_t initial = model->tables[place];
    (&model->probability[0][0][0][0])[place] = initial == VC_UNTRAINED_CELL ? 32768 : vc_initial[initial];
    (&model->count[0][0][0][0])[place] = initial == VC_UNTRAINED_CELL ? 0 : VC_TRAINED_COUNT;
}

/* Where the first input's cells of a decision begin (0: not zero; n: magnitude above n); the second's follow. */
static inline unsigned vc_cells_of(unsigned decision, unsigned quantiser)
{
    return (2 * vc_at_most(decision, VC_KINDS - 1) + quantiser) * (VC_INPUTS * VC_CONTEXTS);
}

/* Begins the cells of a decision that are not used yet. */
static inline void vc_begin_cells(vc_model *model, const vc_contexts *contexts, unsigned decision, unsigned quantiser)
{
    const unsigned cells = vc_cells_of(decision, quantiser);
    const unsigned first = cells + contexts->index[0], second = cells + VC_CONTEXTS + contexts->index[1];
    const uint16_t *const probability = &model->probability[0][0][0][0];
    if (probability[first] == 0)
        vc_begin_cell(model, first);
    if (probability[second] == 0)
        vc_begin_cell(model, second);
}

/* The prediction of a cell. */
static inline void vc_look(vc_model *model, unsigned place, vc_input *input)
{
    input->cell = &model->probability[0][0][0][0] + place;
    input->count = &model->count[0][0][0][0] + place;
    input->stretched = vc_stretched(*input->cell);
}

/* Mixes the predictions of a decision's cells; returns the place of the result. */
static inline uint32_t vc_mix(vc_model *model, const vc_contexts *contexts, unsigned decision, unsigned quantiser,
                              vc_prediction *prediction)
{
    const unsigned cells = vc_cells_of(decision, quantiser);
    int16_t *const weight =
        &model->weight[0][0][0][0] + cells / VC_CONTEXTS * VC_WEIGHT_SETS + contexts->set * VC_INPUTS;
    vc_look(model, cells + contexts->index[0], &prediction->input[0]);
    vc_look(model, cells + VC_CONTEXTS + contexts->index[1], &prediction->input[1]);
    prediction->weight = weight;
    /* From 1/2^22 to 1/64. */
    return vc_place_of((weight[0] * prediction->input[0].stretched + weight[1] * prediction->input[1].stretched) >> 16);
}

/* Probability of 1 for decision `decision`. */
static inline uint32_t vc_predict(vc_model *model, const vc_contexts *contexts, unsigned decision, unsigned quantiser,
                                  vc_prediction *prediction)
{
    prediction->probability = vc_squash[vc_mix(model, contexts, decision, quantiser, prediction)];
    return vc_codable((uint32_t)prediction->probability);
}

/* Lets one context learn from a decision; `error`: of the prediction. */
static inline void vc_learn(const vc_input *input, int16_t *weight, int32_t error, int bit)
{
    const uint32_t cell = *input->cell, count = *input->count, rate = vc_learning[count];
    *weight = (int16_t)vc_clamped(*weight + ((error * input->stretched + (1 << 13)) >> 14), INT16_MAX);
    *input->cell = (uint16_t)(bit ? cell + ((65535u - cell) * rate >> 16) : cell - (cell * rate >> 16));
    *input->count = (uint8_t)(count + (count < VC_MAX_COUNT));
}

/* Learns from the decision. */
static inline void vc_update(const vc_prediction *prediction, int bit)
{
    const int32_t error = ((bit ? 65536 : 0) - prediction->probability) * VC_LEARNING_RATE >> 6;
    vc_learn(&prediction->input[0], &prediction->weight[0], error, bit);
    vc_learn(&prediction->input[1], &prediction->weight[1], error, bit);
}

#endif
