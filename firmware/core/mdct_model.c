/* Context model of `mdct`: decisions on the quantised spectrum, predicted by logistic mixing of four contexts.
 *
 * Logistic mixing follows M. Mahoney, "Adaptive weighing of context models for lossless data compression", 2005.
 */
#include "mdct.h"

#define CELLS (VC_DECISIONS * 2 * VC_INPUTS * VC_CONTEXTS)
#define WEIGHTS (VC_DECISIONS * 2 * VC_SCALES * (VC_INPUTS + 1))
#define TABLES_BYTES (CELLS + 2 * WEIGHTS + VC_SILENCE_CONTEXTS)

#define MAX_MAGNITUDE 126u
#define ADAPTATION_SHIFT 5
#define MAX_STRETCHED 2047
#define BIAS_INPUT 256
#define LEARNING_RATE 6
#define LEARNING_SHIFT 18
#define MAX_WEIGHT (8 << 16)
#define MIN_PROBABILITY 32u

size_t vc_mdct_tables_size(void)
{
    return TABLES_BYTES;
}

const uint8_t *vc_mdct_builtin_tables(void)
{
    return vc_builtin_tables;
}

int vc_model_check_tables(const uint8_t *tables, size_t length)
{
    return tables == NULL || length == TABLES_BYTES ? VC_OK : VC_BAD_TABLES;
}

static int32_t clamp(int32_t value, int32_t limit)
{
    return value > limit ? limit : value < -limit ? -limit : value;
}

static uint32_t squash(int32_t stretched)
{
    return vc_squash[(uint32_t)(clamp(stretched, MAX_STRETCHED) + 2048) >> 2];
}

static int32_t stretch(uint32_t probability)
{
    return vc_stretch[probability >> 5];
}

/* Tables: for each cell the stretched probability / 16 (int8), the weights in 1/4096 (int16, little endian), then the
 * probabilities of silence / 256 (uint8). */
void vc_model_reset(vc_model *model, const uint8_t *tables)
{
    uint16_t *cells = &model->probability[0][0][0][0];
    int32_t *weights = &model->weight[0][0][0][0];
    const uint8_t *source = tables == NULL ? vc_builtin_tables : tables;
    unsigned i;
    for (i = 0; i < CELLS; i++)
        cells[i] = (uint16_t)squash(16 * (int8_t)*source++);
    for (i = 0; i < WEIGHTS; i++, source += 2)
        weights[i] = clamp(16 * (int16_t)(source[0] | source[1] << 8), MAX_WEIGHT);
    for (i = 0; i < VC_SILENCE_CONTEXTS; i++)
        model->silence[i] = (uint16_t)(*source++ * 256 + 128);
}

void vc_model_export(const vc_model *model, uint8_t *tables)
{
    const uint16_t *cells = &model->probability[0][0][0][0];
    const int32_t *weights = &model->weight[0][0][0][0];
    unsigned i;
    for (i = 0; i < CELLS; i++)
        *tables++ = (uint8_t)(int8_t)clamp(stretch(cells[i]) / 16, 127);
    for (i = 0; i < WEIGHTS; i++) {
        uint16_t weight = (uint16_t)(int16_t)clamp(weights[i] / 16, 32767);
        *tables++ = (uint8_t)weight;
        *tables++ = (uint8_t)(weight >> 8);
    }
    for (i = 0; i < VC_SILENCE_CONTEXTS; i++)
        *tables++ = (uint8_t)(model->silence[i] >> 8);
}

void vc_history_reset(vc_history *history)
{
    memset(history, 0, sizeof *history);
    history->silent_history = 1;
}

uint32_t vc_kept_magnitude(uint32_t magnitude)
{
    return magnitude < MAX_MAGNITUDE ? magnitude : MAX_MAGNITUDE;
}

uint32_t vc_history_set(vc_history *history, uint32_t k, uint32_t magnitude)
{
    uint32_t kept = vc_kept_magnitude(magnitude);
    history->rows[0][k + 2] = (uint8_t)kept;
    return kept;
}

void vc_history_next_block(vc_history *history, uint32_t hop)
{
    uint32_t k, row;
    history->block_sum = 0;
    for (k = 2; k < hop + 2; k++) {
        uint32_t magnitude = history->rows[0][k];
        history->block_sum += magnitude;
        history->average[k] = (uint16_t)(history->average[k] - (history->average[k] >> 3) + magnitude * 32);
    }
    for (row = 3; row > 0; row--)
        memcpy(history->rows[row], history->rows[row - 1], sizeof history->rows[0]);
    memset(history->rows[0], 0, sizeof history->rows[0]);
}

/* Number of steps, four an octave from 4 up and one a unit below: a logarithm of x with two bits of mantissa. */
static unsigned fine_class(uint32_t x)
{
    unsigned exponent;
    if (x < 4)
        return x;
    exponent = vc_floor_log2(x);
    return 4 * (exponent - 1) + ((x >> (exponent - 2)) & 3u);
}

/* The same with two steps an octave, of small numbers in quarters, at most 15. */
static unsigned coarse_class(uint32_t quarters)
{
    unsigned steps = fine_class(quarters) / 2;
    return steps < 15 ? steps : 15;
}

/* Expected magnitude of bin k, in 1/64 step: a weighted sum of its neighbours in this block, the last three and the
 * running average. Weights: maximum likelihood under a Laplace density on the training recordings. */
static uint32_t expected_magnitude(const vc_history *history, uint32_t k, uint32_t below, uint32_t second_below)
{
    const uint8_t *last = history->rows[1] + k + 2;
    const uint8_t *second = history->rows[2] + k + 2;
    const uint8_t *third = history->rows[3] + k + 2;
    return (28 * below + 8 * second_below + 21u * last[0] + 18u * last[1] + 6u * last[-1] + 2u * last[2] +
            12u * second[0] + 3u * second[1] + 3u * third[0] + ((26u * history->average[k + 2]) >> 8) + 20) >>
           1;
}

static unsigned first_context(unsigned expected_class, uint32_t hop, uint32_t k)
{
    return (expected_class < 63 ? expected_class : 63) * 4 + k * 4 / hop;
}

unsigned vc_first_context(const vc_history *history, uint32_t hop, uint32_t k, uint32_t below, uint32_t second_below)
{
    return first_context(fine_class(expected_magnitude(history, k, below, second_below)), hop, k);
}

void vc_contexts_find(vc_contexts *contexts, const vc_history *history, uint32_t hop, uint32_t k, uint32_t block_sum)
{
    const uint8_t *current = history->rows[0] + k + 2;
    const uint8_t *last = history->rows[1] + k + 2;
    const uint16_t *average = history->average + k + 2;
    unsigned expected_class = fine_class(expected_magnitude(history, k, current[-1], current[-2]));
    unsigned band = k * 16 / hop;
    unsigned around = 2u * current[-1] + current[-2] + 2u * last[0] + last[1] + last[-1];
    contexts->index[0] = first_context(expected_class, hop, k);
    contexts->index[1] = (expected_class / 2 < 15 ? expected_class / 2 : 15) * 16 + band;
    contexts->index[2] =
        coarse_class(block_sum * 16 / (k + 1)) * 16 + coarse_class((uint32_t)(average[0] + average[1]) >> 3);
    contexts->index[3] = coarse_class((average[-1] + 2u * average[0] + average[1]) >> 4) * 16 + band;
    contexts->scale = coarse_class(4 * around) / 4;
}

uint32_t vc_predict(vc_model *model, const vc_contexts *contexts, unsigned decision, unsigned quantiser,
                    vc_prediction *prediction)
{
    unsigned kind = decision < VC_DECISIONS ? decision : VC_DECISIONS - 1;
    int32_t *weight = model->weight[kind][quantiser][contexts->scale];
    int64_t sum = (int64_t)weight[VC_INPUTS] * BIAS_INPUT;
    uint32_t probability;
    unsigned i;
    for (i = 0; i < VC_INPUTS; i++) {
        prediction->cell[i] = &model->probability[kind][quantiser][i][contexts->index[i]];
        prediction->stretched[i] = stretch(*prediction->cell[i]);
        sum += (int64_t)weight[i] * prediction->stretched[i];
    }
    probability = squash((int32_t)(sum / 65536));
    prediction->weight = weight;
    prediction->mixed = (int32_t)probability;
    return probability < MIN_PROBABILITY           ? MIN_PROBABILITY
           : probability > 65536 - MIN_PROBABILITY ? 65536 - MIN_PROBABILITY
                                                   : probability;
}

static uint16_t adapted(uint16_t probability, int bit)
{
    return (uint16_t)(bit ? probability + ((65535 - probability) >> ADAPTATION_SHIFT)
                          : probability - (probability >> ADAPTATION_SHIFT));
}

void vc_update(vc_prediction *prediction, int bit)
{
    int32_t error = LEARNING_RATE * ((bit ? 65536 : 0) - prediction->mixed);
    unsigned i;
    for (i = 0; i <= VC_INPUTS; i++) {
        int32_t input = i < VC_INPUTS ? prediction->stretched[i] : BIAS_INPUT;
        int32_t change = (error * input) / (1 << LEARNING_SHIFT);
        prediction->weight[i] = clamp(prediction->weight[i] + change, MAX_WEIGHT);
        if (i < VC_INPUTS)
            *prediction->cell[i] = adapted(*prediction->cell[i], bit);
    }
}

static unsigned silence_context(const vc_history *history)
{
    unsigned loudness = (history->block_sum > 0) + (history->block_sum > 8) + (history->block_sum > 32);
    return history->silent_history * 4u + loudness;
}

uint32_t vc_silence_predict(const vc_model *model, const vc_history *history)
{
    uint32_t probability = model->silence[silence_context(history)];
    return probability < MIN_PROBABILITY           ? MIN_PROBABILITY
           : probability > 65536 - MIN_PROBABILITY ? 65536 - MIN_PROBABILITY
                                                   : probability;
}

void vc_silence_update(vc_model *model, const vc_history *history, int silent)
{
    uint16_t *probability = &model->silence[silence_context(history)];
    *probability = adapted(*probability, silent);
}
