/* Context model of `mdct`: its tables, the magnitudes coded so far, and the contexts that they make. */
#include "vc_mdct_mixing.h"

#define CELLS (VC_KINDS * 2 * VC_INPUTS * VC_CONTEXTS)
#define WEIGHTS (VC_KINDS * 2 * VC_WEIGHT_SETS * VC_INPUTS)
#define CENTROIDS (2 * VC_CENTROID_LEVELS * VC_CENTROID_CLASSES)
#define TABLES_BYTES (VC_CENTROIDS_AT + CENTROIDS)

/* A cell of the tables that nothing was coded with, and the count of all others: few, so that a model adapts to each
 * recording. */
#define LEAST_DECISIONS 4
/* Levels of which fewer were coded in training have no offset. */
#define LEAST_LEVELS 30
#define MEAN_BLOCKS 24u
#define YOUNG_BLOCKS 6u /* until the means are trustworthy */

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

static const uint8_t *read_numbers(int16_t *numbers, unsigned count, const uint8_t *bytes)
{
    for (; count > 0; count--, bytes += 2)
        *numbers++ = (int16_t)(bytes[0] | bytes[1] << 8);
    return bytes;
}

static uint8_t *write_numbers(const int16_t *numbers, unsigned count, uint8_t *bytes)
{
    for (; count > 0; count--, numbers++) {
        *bytes++ = (uint8_t)*numbers;
        *bytes++ = (uint8_t)((uint16_t)*numbers >> 8);
    }
    return bytes;
}

/* Tables: for each cell the stretched probability / 16 (int8), or VC_UNTRAINED_CELL; the weights (int16, little
 * endian); the probabilities of silence / 256 (uint8); then the centroids (int8). */
void vc_model_reset(vc_model *model, const uint8_t *tables)
{
    unsigned i;
    model->tables = tables;
    memset(model->probability, 0, sizeof model->probability);
    tables = read_numbers(&model->weight[0][0][0][0], WEIGHTS, tables + CELLS);
    for (i = 0; i < VC_SILENCE_CONTEXTS; i++)
        model->silence[i] = (uint16_t)(*tables++ * 256 + 128);
}

void vc_model_begin(vc_model *model)
{
    unsigned place;
    for (place = 0; place < CELLS; place++)
        vc_begin_cell(model, place);
}

void vc_model_export(const vc_model *model, uint8_t *tables)
{
    const uint16_t *cells = &model->probability[0][0][0][0];
    const uint8_t *counts = &model->count[0][0][0][0];
    unsigned i;
    for (i = 0; i < CELLS; i++)
        *tables++ = counts[i] < LEAST_DECISIONS ? VC_UNTRAINED_CELL
                                                : (uint8_t)(int8_t)vc_clamped(vc_stretched(cells[i]) / 16, 127);
    tables = write_numbers(&model->weight[0][0][0][0], WEIGHTS, tables);
    for (i = 0; i < VC_SILENCE_CONTEXTS; i++)
        *tables++ = (uint8_t)(model->silence[i] >> 8);
    memcpy(tables, model->tables + VC_CENTROIDS_AT, CENTROIDS);
}

void vc_centroids_export(const vc_centroid_sums *sums, uint8_t *tables)
{
    const int64_t *sum = &sums->sum[0][0][0];
    const uint32_t *count = &sums->count[0][0][0];
    unsigned i;
    tables += VC_CENTROIDS_AT;
    for (i = 0; i < CENTROIDS; i++)
        tables[i] = (uint8_t)(count[i] < LEAST_LEVELS ? 0 : vc_clamped((int32_t)(sum[i] / (int64_t)count[i]), 127));
}

void vc_history_reset(vc_history *history)
{
    memset(history, 0, sizeof *history);
    history->silent_history = 1;
}

void vc_history_next_block(vc_history *history, uint32_t hop)
{
    uint8_t (*const rows)[sizeof history->rows[0]] = history->rows;
    int32_t mean_rate;
    uint32_t k;
    history->block_sum = 0;
    history->blocks += history->blocks < MEAN_BLOCKS;
    mean_rate = vc_mean_rate[history->blocks];
    for (k = 0; k < hop; k++) {
        const uint32_t bin = k + VC_PADDING, magnitude = rows[0][bin];
        uint16_t *average = history->average + bin, *mean = history->mean + bin;
        rows[3][bin] = rows[2][bin];
        rows[2][bin] = rows[1][bin];
        rows[1][bin] = (uint8_t)magnitude;
        rows[0][bin] = 0;
        history->block_sum += magnitude;
        *average = (uint16_t)(*average - (*average >> 3) + magnitude * 32);
        *mean = (uint16_t)(*mean + ((((int32_t)(512 * magnitude) - *mean) * mean_rate + 2048) >> 12));
    }
}

/* The weights of `magnitude` and `loudness` are the most likely ones of the training recordings, where magnitudes have
 * an exponential density of this mean. */
void vc_bin_find(vc_bin *bin, const vc_history *history, uint32_t hop, uint32_t k, uint32_t *means_below)
{
    const uint8_t *last = history->rows[1] + k + VC_PADDING;
    const uint8_t *second = history->rows[2] + k + VC_PADDING;
    const uint8_t *third = history->rows[3] + k + VC_PADDING;
    const uint16_t *average = history->average + k + VC_PADDING, *mean = history->mean + k + VC_PADDING;
    const uint32_t averages = (uint32_t)average[-1] + average[1], means = (uint32_t)mean[-1] + mean[1];
    const uint32_t young = history->blocks < YOUNG_BLOCKS ? 16 : 0;
    bin->magnitude = 263 + 89u * last[0] + 94u * last[1] + 15u * ((uint32_t)last[-1] + last[2] + last[-2]) +
                     22u * second[0] + 7u * ((uint32_t)second[1] + second[-1]) + 9u * third[0] +
                     ((56u * average[0] + 8 * averages) >> 9) + (((37 + young) * mean[0] + 6 * means) >> 9);
    bin->loudness = (195u * mean[0] + 30 * means) >> 9;
    bin->mean_below = (int32_t)vc_sixteenths(*means_below + 512) - 16 * 11;
    *means_below += mean[0];
    bin->mean_class = (uint8_t)vc_at_most(vc_fine_class((mean[0] * 2u + means) >> 7) / 2, 15);
    bin->quarter = (uint8_t)((k >= hop / 4) + (k >= hop / 2) + (k >= hop / 4 * 3));
    bin->set = (uint8_t)(vc_at_most(history->blocks, VC_MAX_AGE) * 4 + bin->quarter);
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
    *probability = (uint16_t)(silent ? *probability + ((65535 - *probability) >> VC_SILENCE_SHIFT)
                                     : *probability - (*probability >> VC_SILENCE_SHIFT));
}
