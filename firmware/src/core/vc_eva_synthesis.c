/* EVA's synthesis in integers: inverse GDN and transposed convolutions, phase by phase; see vc_eva_synthesis.h. */
#include "vc_eva_synthesis.h"
#include "vc_eva_kernels.h"

#define FIRST_TAPS 3u /* of the first phase; the others have two */
#define OTHER_TAPS 2u
#define SAMPLE_LIMIT (1u << 30)
#define SAMPLE_UNIT 1024 /* the last convolution gives samples in 1/1024 of the level */

/* Numbers of 4 bytes, none above `greatest`. */
static void read_numbers(const uint8_t *bytes, uint32_t count, uint32_t greatest, uint32_t *numbers)
{
    uint32_t i;
    for (i = 0; i < count; i++, bytes += 4) {
        numbers[i] = bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
        numbers[i] = numbers[i] < greatest ? numbers[i] : greatest;
    }
}

/* Normalises work->inputs into work->normalised, after the history. */
static void normalise(const vc_eva_normalisation *part, uint32_t channels, uint32_t columns, vc_eva_work *work)
{
    uint32_t multipliers[VC_EVA_MAX_WIDTH], constants[VC_EVA_MAX_WIDTH];
    int16_t *normalised = work->normalised + VC_EVA_HISTORY * channels;
    unsigned doubled[4 * VC_EVA_COLUMNS];
    read_numbers(part->multipliers, channels, UINT32_MAX, multipliers);
    read_numbers(part->constants, channels, VC_EVA_MAX_ENERGY, constants);
    /* The squares use the output's memory until their sums are ready. */
    vc_eva_squares(work->inputs, channels, columns, normalised, doubled);
    vc_eva_products(part->weights, channels, 1, normalised, channels, columns, work->sums);
    vc_eva_normalise(work->inputs, channels, columns, work->sums, doubled, multipliers, constants, part->shift,
                     normalised);
}

/* Sums of one phase of a transposed convolution over work->normalised into work->sums. Each input column completes one
 * column of each phase; its last taps weigh that input column. Returns the weights of the next phase. */
static const int8_t *phase_sums(const int8_t *weights, uint32_t taps, uint32_t inputs, uint32_t outputs,
                                uint32_t columns, vc_eva_work *work)
{
    const int16_t *first = work->normalised + (FIRST_TAPS - taps) * inputs;
    vc_eva_products(weights, outputs, taps, first, inputs, columns, work->sums);
    return weights + (size_t)outputs * taps * inputs;
}

/* Stride 2: each column of work->normalised becomes two of work->inputs. */
static void convolve(const vc_eva_convolution *part, uint32_t inputs, uint32_t outputs, uint32_t columns,
                     vc_eva_work *work)
{
    uint32_t multipliers[VC_EVA_MAX_WIDTH], phase;
    const int8_t *weights = part->weights;
    read_numbers(part->multipliers, outputs, UINT32_MAX, multipliers);
    for (phase = 0; phase < 2; phase++) {
        weights = phase_sums(weights, phase == 0 ? FIRST_TAPS : OTHER_TAPS, inputs, outputs, columns, work);
        vc_eva_scale(work->sums, multipliers, outputs, columns, work->inputs + phase * outputs, 2 * outputs);
    }
}

/* Stride 4, one output: each column of work->normalised becomes four samples. After the first tap of the first phase
 * come two taps of each phase, all of the same columns. */
static void convolve_to_samples(const vc_eva_convolution *part, uint32_t inputs, uint32_t columns, vc_eva_work *work,
                                int32_t level, int16_t *samples, unsigned stride)
{
    int32_t *const first_taps = work->sums + 4 * columns;
    uint32_t multiplier, i;
    read_numbers(part->multipliers, 1, UINT32_MAX, &multiplier);
    vc_eva_products(part->weights + inputs, 4, OTHER_TAPS, work->normalised + inputs, inputs, columns, work->sums);
    vc_eva_products(part->weights, 1, 1, work->normalised, inputs, columns, first_taps);
    for (i = 0; i < 4 * columns; i++, samples += stride) {
        const int32_t sum = work->sums[i] + (i % 4 == 0 ? first_taps[i / 4] : 0);
        *samples = vc_rounded_sample((int64_t)vc_eva_scaled(sum, multiplier, SAMPLE_LIMIT) * level / SAMPLE_UNIT);
    }
}

void vc_eva_synthesise(const vc_eva_model *model, vc_eva_history *history, vc_eva_work *work, uint32_t columns,
                       int32_t level, int16_t *samples, unsigned stride)
{
    unsigned stage;
    for (stage = 0; stage < VC_EVA_STAGES; stage++, columns *= 2) {
        const uint32_t channels = stage == 0 ? model->latents : model->width;
        const size_t kept = VC_EVA_HISTORY * channels * sizeof(int16_t);
        memcpy(work->normalised, history->columns[stage], kept);
        normalise(&model->normalisations[stage], channels, columns, work);
        memcpy(history->columns[stage], work->normalised + columns * channels, kept);
        if (stage < VC_EVA_STAGES - 1)
            convolve(&model->convolutions[stage], channels, model->width, columns, work);
        else
            convolve_to_samples(&model->convolutions[stage], channels, columns, work, level, samples, stride);
    }
}
