/* The inner loops of EVA's synthesis in portable C, in forms that compilers can turn into vector instructions; see
 * vc_eva_kernels.h. */
#include "vc_eva_kernels.h"

#define MAX_CHANNELS 128
#define COLUMNS_AT_ONCE 4u

static int32_t product(const int8_t *weights, uint32_t length, const int16_t *inputs)
{
    int32_t sum = 0;
    uint32_t i;
    for (i = 0; i < length; i++)
        sum += weights[i] * inputs[i];
    return sum;
}

/* Four columns at a time, so that each weight is loaded and widened once for all of them. */
static void products_of_four(const int8_t *weights, uint32_t length, const int16_t *inputs, uint32_t stride,
                             int32_t *sums, uint32_t rows)
{
    const int16_t *second = inputs + stride, *third = second + stride, *fourth = third + stride;
    int32_t a = 0, b = 0, c = 0, d = 0;
    uint32_t i;
    for (i = 0; i < length; i++) {
        a += weights[i] * inputs[i];
        b += weights[i] * second[i];
        c += weights[i] * third[i];
        d += weights[i] * fourth[i];
    }
    sums[0] = a;
    sums[rows] = b;
    sums[2 * rows] = c;
    sums[3 * rows] = d;
}

#ifndef VC_DSP
void vc_dot_products(const int8_t *weights, uint32_t rows, uint32_t length, const int16_t *inputs, int32_t *sums)
{
    uint32_t row;
    for (row = 0; row < rows; row++)
        sums[row] = product(weights + row * length, length, inputs);
}
#endif

void vc_eva_products(const int8_t *weights, uint32_t rows, uint32_t taps, const int16_t *inputs, uint32_t channels,
                     uint32_t columns, int32_t *sums)
{
    const uint32_t length = taps * channels;
    uint32_t row, column;
#ifdef VC_DSP
    if (channels % 16 == 0) {
        vc_eva_products_dsp(weights, rows, taps, inputs, channels, columns, sums);
        return;
    }
#endif
    for (row = 0; row < rows; row++, weights += length) {
        for (column = 0; column + COLUMNS_AT_ONCE <= columns; column += COLUMNS_AT_ONCE)
            products_of_four(weights, length, inputs + column * channels, channels, sums + column * rows + row, rows);
        for (; column < columns; column++)
            sums[column * rows + row] = product(weights, length, inputs + column * channels);
    }
}

static unsigned column_squares(const int16_t *values, uint32_t channels, int16_t *squares)
{
    int32_t greatest = 0;
    unsigned doubled = 0;
    uint32_t i;
    for (i = 0; i < channels; i++) {
        int32_t magnitude = values[i] < 0 ? -values[i] : values[i];
        greatest = magnitude > greatest ? magnitude : greatest;
    }
    while (greatest > 0 && greatest << (doubled + 1) <= VC_EVA_MAX_ACTIVATION)
        doubled++;
    for (i = 0; i < channels; i++) {
        int32_t value = values[i] * (1 << doubled);
        squares[i] = (int16_t)((value * value) >> 15);
    }
    return doubled;
}

void vc_eva_squares(const int16_t *values, uint32_t channels, uint32_t columns, int16_t *squares, unsigned *doubled)
{
    uint32_t column;
#ifdef VC_DSP
    if (channels % 16 == 0) {
        vc_eva_squares_dsp(values, channels, columns, squares, doubled);
        return;
    }
#endif
    for (column = 0; column < columns; column++)
        doubled[column] = column_squares(values + column * channels, channels, squares + column * channels);
}

/* Square roots, rounded down, digit by digit and side by side; the energies are used up. */
static void find_roots(uint32_t *energies, uint32_t count, uint32_t *roots)
{
    uint32_t digit, i;
    for (i = 0; i < count; i++)
        roots[i] = 0;
    for (digit = 1u << 28; digit != 0; digit >>= 2)
        for (i = 0; i < count; i++) {
            uint32_t trial = roots[i] + digit;
            uint32_t fits = energies[i] >= trial ? UINT32_MAX : 0;
            energies[i] -= trial & fits;
            roots[i] = (roots[i] >> 1) + (digit & fits);
        }
}

/* The number of columns that fit MAX_CHANNELS values side by side. */
static void normalise_some(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                           const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants,
                           unsigned shift, int16_t *normalised)
{
    uint32_t energies[MAX_CHANNELS], roots[MAX_CHANNELS], column, i;
    const uint32_t half = (1u << shift) >> 1;
    for (column = 0; column < columns; column++) {
        const unsigned down = VC_EVA_ENERGY_SHIFT + 2 * doubled[column];
        for (i = 0; i < channels; i++) {
            uint64_t sum = (uint32_t)sums[column * channels + i];
            uint64_t energy = constants[i] + ((sum * multipliers[i]) >> down);
            energies[column * channels + i] = energy < VC_EVA_MAX_ENERGY ? (uint32_t)energy : VC_EVA_MAX_ENERGY;
        }
    }
    find_roots(energies, columns * channels, roots);
    for (i = 0; i < columns * channels; i++) {
        uint32_t magnitude = (uint32_t)(values[i] < 0 ? -values[i] : values[i]);
        uint32_t scaled = (magnitude * roots[i] + half) >> shift;
        int32_t limited = scaled < VC_EVA_MAX_ACTIVATION ? (int32_t)scaled : VC_EVA_MAX_ACTIVATION;
        normalised[i] = (int16_t)(values[i] < 0 ? -limited : limited);
    }
}

void vc_eva_normalise(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                      const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants, unsigned shift,
                      int16_t *normalised)
{
    const uint32_t most = MAX_CHANNELS / channels;
    uint32_t column, some;
#ifdef VC_DSP
    if (channels % 16 == 0) {
        vc_eva_normalise_dsp(values, channels, columns, sums, doubled, multipliers, constants, shift, normalised);
        return;
    }
#endif
    for (column = 0; column < columns; column += some) {
        const size_t start = (size_t)column * channels;
        some = columns - column < most ? columns - column : most;
        normalise_some(values + start, channels, some, sums + start, doubled + column, multipliers, constants, shift,
                       normalised + start);
    }
}

void vc_eva_scale(const int32_t *sums, const uint32_t *multipliers, uint32_t rows, uint32_t columns, int16_t *scaled,
                  uint32_t stride)
{
    uint32_t column, i;
#ifdef VC_DSP
    if (rows % 16 == 0) {
        vc_eva_scale_dsp(sums, multipliers, rows, columns, scaled, stride);
        return;
    }
#endif
    for (column = 0; column < columns; column++, sums += rows, scaled += stride)
        for (i = 0; i < rows; i++)
            scaled[i] = (int16_t)vc_eva_scaled(sums[i], multipliers[i], VC_EVA_MAX_ACTIVATION);
}
