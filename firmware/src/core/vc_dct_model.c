/* Reconstruction levels of `dct`, and the adaptive model of its range coding; see vc_dct_model.h. */
#include "vc_dct_model.h"

#define MAX_COEFFICIENT (1 << 28)
#define OCTAVE_BITS 20
#define RANGE_CODE_BITS 8 /* of an octave's fraction in a range code */

/* 2^(exponent / 2^20), rounded, within MAX_COEFFICIENT: a table of 256 steps an octave, with straight lines between. */
static int32_t power_of_two(uint32_t exponent)
{
    const uint32_t octave = exponent >> OCTAVE_BITS;
    const uint32_t step = (exponent >> (OCTAVE_BITS - 8)) & 255u, rest = exponent & 4095u;
    const uint32_t from = vc_dct_exponential[step], to = vc_dct_exponential[step + 1];
    const uint32_t mantissa = from + (uint32_t)(((uint64_t)(to - from) * rest) >> 12);
    if (octave >= 28)
        return MAX_COEFFICIENT;
    return (int32_t)((mantissa + (1u << (29 - octave))) >> (30 - octave));
}

static uint32_t exponent_of(uint32_t range_code)
{
    return range_code << (OCTAVE_BITS - RANGE_CODE_BITS);
}

static int64_t magnitude_of(uint32_t range_code)
{
    return range_code == 0 ? 0 : power_of_two(exponent_of(range_code));
}

void vc_dct_quantiser_init(vc_dct_quantiser *quantiser, int logarithmic, uint32_t levels, unsigned zeros,
                           uint32_t smallest, uint32_t below, uint32_t above)
{
    quantiser->logarithmic = logarithmic;
    quantiser->levels = levels;
    quantiser->zeros = zeros;
    quantiser->bottom = exponent_of(smallest);
    quantiser->left = exponent_of(below);
    quantiser->right = exponent_of(above);
    quantiser->centre = levels / 2;
    if (!logarithmic) {
        /* Equation (2) of the source paper: multiples of (max - min) / (L - 1), from the one nearest min to the one
         * nearest max. If both lie half a step away, there is one level more. */
        const int64_t width = magnitude_of(below) + magnitude_of(above), steps = levels - 1;
        quantiser->width = width;
        quantiser->steps = steps;
        quantiser->centre = (uint32_t)((magnitude_of(below) * steps + width / 2) / width);
        quantiser->levels = quantiser->centre + 1 + (uint32_t)((magnitude_of(above) * steps + width / 2) / width);
    }
}

/* The multiple `count` of the step of linear levels, rounded. */
static int32_t linear_level(const vc_dct_quantiser *quantiser, uint32_t count)
{
    const int64_t magnitude = (quantiser->width * count + quantiser->steps / 2) / quantiser->steps;
    return (int32_t)(magnitude > MAX_COEFFICIENT ? MAX_COEFFICIENT : magnitude);
}

/* Magnitude of the logarithmic level `rank` of `count` on one side; at most the greatest magnitude. */
static int32_t logarithmic_level(uint32_t bottom, uint32_t top, uint32_t rank, uint32_t count)
{
    if (bottom > top)
        bottom = top;
    return power_of_two(bottom + (uint32_t)((uint64_t)(top - bottom) * rank / (count - 1)));
}

int32_t vc_dct_level(const vc_dct_quantiser *quantiser, uint32_t value)
{
    const uint32_t last = quantiser->levels - 1, centre = quantiser->centre;
    const uint32_t shorter_side = centre < last - centre ? centre : last - centre;
    uint32_t level;
    if (value < quantiser->zeros)
        return 0;
    value -= quantiser->zeros;
    if (value > last)
        value = last;
    /* Outwards from the centre, alternating sides, then the rest of the longer side. */
    if (value <= 2 * shorter_side)
        level = value & 1u ? centre - (value + 1) / 2 : centre + value / 2;
    else
        level = centre < last - centre ? value : last - value;
    if (!quantiser->logarithmic)
        return level < centre ? -linear_level(quantiser, centre - level) : linear_level(quantiser, level - centre);
    if (level < centre)
        return -logarithmic_level(quantiser->bottom, quantiser->left, centre - 1 - level, centre);
    return logarithmic_level(quantiser->bottom, quantiser->right, level - centre, last + 1 - centre);
}

uint32_t vc_dct_levels_of(uint32_t code)
{
    const uint64_t mantissa = vc_dct_exponential[(code & 15u) << 4];
    return 1 + (uint32_t)(((3 * mantissa << (code >> 4)) + (1u << 29)) >> 30);
}

uint32_t vc_dct_levels(int logarithmic, uint32_t levels, uint32_t smallest, uint32_t below, uint32_t above,
                       int32_t *output)
{
    vc_dct_quantiser quantiser;
    uint32_t value;
    vc_dct_quantiser_init(&quantiser, logarithmic, levels, 0, smallest, below, above);
    for (value = 0; value < quantiser.levels; value++)
        output[value] = vc_dct_level(&quantiser, value);
    return quantiser.levels;
}

/* Context of an expected rank, in 1/8: two an octave. */
static unsigned context_of(uint32_t expected)
{
    unsigned octave = vc_floor_log2(expected + 1);
    return 2 * octave + ((octave > 0 ? (expected + 1) >> (octave - 1) : 0) & 1u);
}

/* Low bits with even odds, so that about eight decisions remain. */
static unsigned low_bits_of(unsigned context)
{
    return context / 2 > 5 ? context / 2 - 5 : 0;
}

void vc_dct_model_reset(vc_dct_model *model)
{
    unsigned context, decision;
    for (context = 0; context < VC_DCT_ZERO_CONTEXTS; context++)
        model->zero[context] = VC_UNTRAINED;
    for (context = 0; context < VC_DCT_CONTEXTS; context++) {
        /* Assumes that ranks fall geometrically: with mean m, a rank is above n with probability m / (m + 1). */
        uint64_t expected = (2u + (context & 1u)) << (context / 2);
        uint64_t unit = 16u << low_bits_of(context);
        uint16_t probability = (uint16_t)(65536 * expected / (expected + unit));
        for (decision = 0; decision < VC_DCT_UNARY_LIMIT; decision++)
            model->above[context][decision] = probability;
    }
}

void vc_dct_model_next_channel(vc_dct_model *model)
{
    memset(model->ranks, 0, sizeof model->ranks);
    memset(model->zeros, 0, sizeof model->zeros);
}

vc_dct_context vc_dct_context_find(vc_dct_model *model, uint32_t bin, uint32_t block)
{
    const uint16_t *rank = model->ranks + bin;
    const uint8_t *zero = model->zeros + bin;
    const uint32_t first = bin > 0 ? rank[-1] : 0, second = bin > 1 ? rank[-2] : first;
    const uint32_t before = bin > 0 ? model->before : 0;
    const uint32_t expected =
        block == 0 ? 5 * first + 3 * second : 3 * first + second + before + 2u * rank[0] + rank[1];
    const unsigned index = context_of(expected);
    vc_dct_context context;
    context.zero = model->zero + 4 * zero[0] + 2 * (bin > 0 ? zero[-1] : 0) + (bin > 1 ? zero[-2] : 0);
    context.above = model->above[index];
    context.low_bits = low_bits_of(index);
    context.expected = expected / 8;
    return context;
}

void vc_dct_model_set(vc_dct_model *model, uint32_t bin, uint32_t rank, int zero)
{
    model->before = model->ranks[bin];
    model->ranks[bin] = (uint16_t)rank;
    model->zeros[bin] = (uint8_t)zero;
}
