/* Context model of `mdct`: its tables, the magnitudes coded so far, and the contexts that they make. */
#include "mdct_mixing.h"
#include "mdct_network.h"

#define CELLS (VC_DECISIONS * 2 * VC_INPUTS * VC_CONTEXTS)
#define WEIGHT_SETS (VC_DECISIONS * 2 * VC_SCALES)
#define WEIGHTS (WEIGHT_SETS * VC_MIXED)
#define TABLES_BYTES (CELLS + 2 * WEIGHT_SETS * (VC_INPUTS + 1) + VC_SILENCE_CONTEXTS)

#define NETWORK_WEIGHT (1 << 16)
#define MEAN_BLOCKS 24u

size_t vc_mdct_tables_size(void)
{
    return TABLES_BYTES;
}

size_t vc_mdct_network_size(void)
{
    return VC_NETWORK_BYTES;
}

const uint8_t *vc_mdct_builtin_tables(void)
{
    return vc_builtin_tables;
}

int vc_model_check_tables(const uint8_t *tables, size_t length)
{
    return tables == NULL || length == TABLES_BYTES || length == TABLES_BYTES + VC_NETWORK_BYTES ? VC_OK
                                                                                                 : VC_BAD_TABLES;
}

const uint8_t *vc_model_network(const uint8_t *tables, size_t length)
{
    return tables != NULL && length > TABLES_BYTES ? tables + TABLES_BYTES : NULL;
}

/* Tables: for each cell the stretched probability / 16 (int8), the weights in 1/4096 (int16, little endian), then the
 * probabilities of silence / 256 (uint8). The weight of the network is not among them. */
void vc_model_reset(vc_model *model, const uint8_t *tables)
{
    uint16_t *cells = &model->probability[0][0][0][0];
    int32_t *weights = &model->weight[0][0][0][0];
    unsigned i;
    for (i = 0; i < CELLS; i += 4, cells += 4, tables += 4) { /* reads first: the compiler may not move them */
        const uint16_t first = vc_initial[tables[0]], second = vc_initial[tables[1]];
        const uint16_t third = vc_initial[tables[2]], fourth = vc_initial[tables[3]];
        cells[0] = first;
        cells[1] = second;
        cells[2] = third;
        cells[3] = fourth;
    }
    for (i = 0; i < WEIGHTS; i++)
        if (i % VC_MIXED == VC_INPUTS) {
            weights[i] = NETWORK_WEIGHT;
        } else {
            weights[i] = vc_clamped(16 * (int16_t)(tables[0] | tables[1] << 8), VC_MAX_WEIGHT);
            tables += 2;
        }
    for (i = 0; i < VC_SILENCE_CONTEXTS; i++)
        model->silence[i] = (uint16_t)(*tables++ * 256 + 128);
}

void vc_model_export(const vc_model *model, uint8_t *tables)
{
    const uint16_t *cells = &model->probability[0][0][0][0];
    const int32_t *weights = &model->weight[0][0][0][0];
    unsigned i;
    for (i = 0; i < CELLS; i++)
        *tables++ = (uint8_t)(int8_t)vc_clamped(vc_stretched(cells[i]) / 16, 127);
    for (i = 0; i < WEIGHTS; i++)
        if (i % VC_MIXED != VC_INPUTS) {
            uint16_t weight = (uint16_t)(int16_t)vc_clamped(weights[i] / 16, 32767);
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

void vc_history_next_block(vc_history *history, uint32_t hop)
{
    uint8_t (*const rows)[sizeof history->rows[0]] = history->rows;
    uint32_t k;
    history->block_sum = history->mean_sum = 0;
    history->blocks += history->blocks < MEAN_BLOCKS;
    for (k = 0; k < hop; k++) {
        const uint32_t bin = k + VC_PADDING, magnitude = rows[0][bin];
        uint16_t *average = history->average + bin, *mean = history->mean + bin;
        rows[3][bin] = rows[2][bin];
        rows[2][bin] = rows[1][bin];
        rows[1][bin] = (uint8_t)magnitude;
        rows[0][bin] = 0;
        history->block_sum += magnitude;
        *average = (uint16_t)(*average - (*average >> 3) + magnitude * 32);
        *mean = (uint16_t)((*mean * (history->blocks - 1) + 512 * magnitude + history->blocks / 2) / history->blocks);
        history->mean_sum += *mean;
    }
}

/* The same with two steps an octave, of small numbers in quarters, at most 15. */
static unsigned coarse_class(uint32_t quarters)
{
    unsigned steps = vc_fine_class(quarters) / 2;
    return steps < 15 ? steps : 15;
}

/* Expected magnitude of bin k, in 1/64 step: a weighted sum of its neighbours in this block, the last three and the
 * running average. Weights: maximum likelihood under a Laplace density on the training recordings. */
static uint32_t expected_magnitude(const vc_history *history, uint32_t k, const vc_below *below)
{
    const uint8_t *last = history->rows[1] + k + VC_PADDING;
    const uint8_t *second = history->rows[2] + k + VC_PADDING;
    const uint8_t *third = history->rows[3] + k + VC_PADDING;
    return (28 * below->nearest[0] + 8 * below->nearest[1] + 21u * last[0] + 18u * last[1] + 6u * last[-1] +
            2u * last[2] + 12u * second[0] + 3u * second[1] + 3u * third[0] +
            ((26u * history->average[k + VC_PADDING]) >> 8) + 20) >>
           1;
}

static unsigned first_context(unsigned expected_class, uint32_t hop, uint32_t k)
{
    return (expected_class < 63 ? expected_class : 63) * 4 + k * 4 / hop;
}

unsigned vc_first_context(const vc_history *history, uint32_t hop, uint32_t k, const vc_below *below)
{
    return first_context(vc_fine_class(expected_magnitude(history, k, below)), hop, k);
}

void vc_contexts_find(vc_contexts *contexts, const vc_model *model, const vc_history *history, uint32_t hop, uint32_t k,
                      const vc_below *below, unsigned quantiser)
{
    const uint8_t *last = history->rows[1] + k + VC_PADDING;
    const uint16_t *average = history->average + k + VC_PADDING;
    unsigned expected_class = vc_fine_class(expected_magnitude(history, k, below));
    unsigned band = k * 16 / hop;
    unsigned around = 2u * below->nearest[0] + below->nearest[1] + 2u * last[0] + last[1] + last[-1];
    contexts->index[0] = first_context(expected_class, hop, k);
    contexts->index[1] = (expected_class / 2 < 15 ? expected_class / 2 : 15) * 16 + band;
    contexts->index[2] =
        coarse_class(below->sum * 16 / (k + 1)) * 16 + coarse_class((uint32_t)(average[0] + average[1]) >> 3);
    contexts->index[3] = coarse_class((average[-1] + 2u * average[0] + average[1]) >> 4) * 16 + band;
    contexts->scale = coarse_class(4 * around) / 4;
    if (model->network != NULL) {
        int16_t inputs[VC_NETWORK_INPUTS];
        vc_network_inputs(inputs, model, contexts, history, below, hop, k, quantiser);
        vc_network_run(model->network, inputs, quantiser, contexts->network);
    }
}

static unsigned silence_context(const vc_history *history)
{
    unsigned loudness = (history->block_sum > 0) + (history->block_sum > 8) + (history->block_sum > 32);
    return history->silent_history * 4u + loudness;
}

uint32_t vc_silence_predict(const vc_model *model, const vc_history *history)
{
    return vc_codable(model->silence[silence_context(history)]);
}

void vc_silence_update(vc_model *model, const vc_history *history, int silent)
{
    uint16_t *probability = &model->silence[silence_context(history)];
    *probability = vc_adapted(*probability, silent);
}
