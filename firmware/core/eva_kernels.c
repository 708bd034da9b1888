/* The inner loops of EVA's synthesis in portable C, in forms that compilers turn into vector instructions; see
 * eva_kernels.h. */
#include "eva_kernels.h"

#if defined __ARM_FEATURE_SIMD32 && !defined VC_PORTABLE
#include <arm_acle.h>
#define VC_DSP
#endif

#define MAX_CHANNELS 128
#define MAX_ACTIVATION 32767
#define MAX_ENERGY ((1u << 30) - 1)
#define ENERGY_SHIFT 24
#define COLUMNS_AT_ONCE 4u

#ifdef VC_DSP

/* The next four weights as pairs of 16 bits, w[1] w[0] in `lower` and w[3] w[2] in `upper`: SXTB16 widens every other
 * byte, PKH puts the halves in order. */
#define NEXT_WEIGHTS                                                                                                   \
    "ldr %[upper], [%[weights]], #4\n\t"                                                                               \
    "sxtb16 %[first], %[upper]\n\t"                                                                                    \
    "sxtb16 %[upper], %[upper], ror #8\n\t"                                                                            \
    "pkhbt %[lower], %[first], %[upper], lsl #16\n\t"                                                                  \
    "pkhtb %[upper], %[upper], %[first], asr #16\n\t"
/* Adds their products with the next four inputs of a column. */
#define ADD_PRODUCTS(inputs, sum)                                                                                      \
    "ldr %[first], [%[" inputs "]], #4\n\t"                                                                            \
    "ldr %[second], [%[" inputs "]], #4\n\t"                                                                           \
    "smlad %[" sum "], %[lower], %[first], %[" sum "]\n\t"                                                             \
    "smlad %[" sum "], %[upper], %[second], %[" sum "]\n\t"
#define NEXT_PRODUCTS                                                                                                  \
    NEXT_WEIGHTS ADD_PRODUCTS("inputs", "a") ADD_PRODUCTS("second_inputs", "b") ADD_PRODUCTS("third_inputs", "c")      \
        ADD_PRODUCTS("fourth_inputs", "d")
#define ADD_TO_FOUR_SUMS(instructions)                                                                                 \
    __asm__(instructions                                                                                               \
            : [weights] "+r"(weights), [inputs] "+r"(inputs), [second_inputs] "+r"(second_inputs),                     \
              [third_inputs] "+r"(third_inputs), [fourth_inputs] "+r"(fourth_inputs), [a] "+r"(a), [b] "+r"(b),        \
              [c] "+r"(c), [d] "+r"(d), [lower] "=&r"(lower), [upper] "=&r"(upper), [first] "=&r"(first),              \
              [second] "=&r"(second)                                                                                   \
            :                                                                                                          \
            : "memory")

static int32_t product(const int8_t *weights, uint32_t length, const int16_t *inputs)
{
    const int8_t *const end = weights + length;
    uint32_t lower, upper, first, second;
    int32_t sum = 0;
    while (end - weights >= 4)
        __asm__(NEXT_WEIGHTS ADD_PRODUCTS("inputs", "sum")
                : [weights] "+r"(weights), [inputs] "+r"(inputs), [sum] "+r"(sum), [lower] "=&r"(lower),
                  [upper] "=&r"(upper), [first] "=&r"(first), [second] "=&r"(second)
                :
                : "memory");
    while (weights != end)
        sum += *weights++ * *inputs++;
    return sum;
}

static void products_of_four(const int8_t *weights, uint32_t length, const int16_t *inputs, uint32_t stride,
                             int32_t *sums, uint32_t rows)
{
    const int8_t *const end = weights + length;
    const int16_t *second_inputs = inputs + stride, *third_inputs = second_inputs + stride;
    const int16_t *fourth_inputs = third_inputs + stride;
    uint32_t lower, upper, first, second;
    int32_t a = 0, b = 0, c = 0, d = 0;
    while (end - weights >= 8)
        ADD_TO_FOUR_SUMS(NEXT_PRODUCTS NEXT_PRODUCTS);
    if (end - weights >= 4)
        ADD_TO_FOUR_SUMS(NEXT_PRODUCTS);
    while (weights != end) {
        a += *weights * *inputs++;
        b += *weights * *second_inputs++;
        c += *weights * *third_inputs++;
        d += *weights++ * *fourth_inputs++;
    }
    sums[0] = a;
    sums[rows] = b;
    sums[2 * rows] = c;
    sums[3 * rows] = d;
}

/* Square roots, rounded down, from a table of 8 bits by one step of Newton's method, which never ends below the root
 * and here never more than one above it. */
static void find_roots(uint32_t *energies, uint32_t count, uint32_t *roots)
{
    uint32_t i;
    for (i = 0; i < count; i++) {
        const uint32_t energy = energies[i] | (energies[i] == 0);
        const unsigned even_shift = (unsigned)__builtin_clz(energy) & ~1u;
        const uint32_t normal = energy << even_shift, start = vc_root[(normal >> 24) - 64];
        const uint32_t root = ((start << 7) + (normal >> 9) / start) >> even_shift / 2;
        roots[i] = root - (root * root > energies[i]);
    }
}

#else

static int32_t product(const int8_t *weights, uint32_t length, const int16_t *inputs)
{
    int32_t sum = 0;
    uint32_t i;
    for (i = 0; i < length; i++)
        sum += weights[i] * inputs[i];
    return sum;
}

/* Four columns at a time, so that each weight is fetched and widened once for all of them. */
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

#endif

void vc_eva_products(const int8_t *weights, uint32_t rows, uint32_t length, const int16_t *inputs, uint32_t stride,
                     uint32_t columns, int32_t *sums)
{
    uint32_t row, column;
    for (row = 0; row < rows; row++, weights += length) {
        for (column = 0; column + COLUMNS_AT_ONCE <= columns; column += COLUMNS_AT_ONCE)
            products_of_four(weights, length, inputs + column * stride, stride, sums + column * rows + row, rows);
        for (; column < columns; column++)
            sums[column * rows + row] = product(weights, length, inputs + column * stride);
    }
}

unsigned vc_eva_squares(const int16_t *values, uint32_t channels, int16_t *squares)
{
    int32_t greatest = 0;
    unsigned doubled = 0;
    uint32_t i;
    for (i = 0; i < channels; i++) {
        int32_t magnitude = values[i] < 0 ? -values[i] : values[i];
        greatest = magnitude > greatest ? magnitude : greatest;
    }
    while (greatest > 0 && greatest << (doubled + 1) <= MAX_ACTIVATION)
        doubled++;
    for (i = 0; i < channels; i++) {
        int32_t value = values[i] * (1 << doubled);
        squares[i] = (int16_t)((value * value) >> 15);
    }
    return doubled;
}

/* As many columns as fit MAX_CHANNELS values side by side. */
static void normalise_some(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                           const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants,
                           unsigned shift, int16_t *normalised)
{
    uint32_t energies[MAX_CHANNELS], roots[MAX_CHANNELS], column, i;
    const uint32_t half = (1u << shift) >> 1;
    for (column = 0; column < columns; column++) {
        const unsigned down = ENERGY_SHIFT + 2 * doubled[column];
        for (i = 0; i < channels; i++) {
            uint64_t sum = (uint32_t)sums[column * channels + i];
            uint64_t energy = constants[i] + ((sum * multipliers[i]) >> down);
            energies[column * channels + i] = energy < MAX_ENERGY ? (uint32_t)energy : MAX_ENERGY;
        }
    }
    find_roots(energies, columns * channels, roots);
    for (i = 0; i < columns * channels; i++) {
        uint32_t magnitude = (uint32_t)(values[i] < 0 ? -values[i] : values[i]);
        uint32_t scaled = (magnitude * roots[i] + half) >> shift;
        int32_t limited = scaled < MAX_ACTIVATION ? (int32_t)scaled : MAX_ACTIVATION;
        normalised[i] = (int16_t)(values[i] < 0 ? -limited : limited);
    }
}

void vc_eva_normalise(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                      const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants, unsigned shift,
                      int16_t *normalised)
{
    const uint32_t most = MAX_CHANNELS / channels;
    uint32_t column, some;
    for (column = 0; column < columns; column += some) {
        const size_t start = (size_t)column * channels;
        some = columns - column < most ? columns - column : most;
        normalise_some(values + start, channels, some, sums + start, doubled + column, multipliers, constants, shift,
                       normalised + start);
    }
}

int32_t vc_eva_scaled(int32_t value, uint32_t multiplier, uint32_t limit)
{
    uint32_t magnitude = value < 0 ? 0u - (uint32_t)value : (uint32_t)value;
    uint32_t scaled = (uint32_t)(((uint64_t)magnitude * multiplier + (1u << 31)) >> 32);
    int32_t limited = (int32_t)(scaled < limit ? scaled : limit);
    return value < 0 ? -limited : limited;
}

void vc_eva_scale(const int32_t *sums, const uint32_t *multipliers, uint32_t count, int16_t *scaled)
{
    uint32_t i;
    for (i = 0; i < count; i++)
        scaled[i] = (int16_t)vc_eva_scaled(sums[i], multipliers[i], MAX_ACTIVATION);
}
