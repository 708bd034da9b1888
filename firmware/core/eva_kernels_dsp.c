/* The inner loops of EVA's synthesis with the DSP instructions of Cortex-M4, M7 and M33; see eva_kernels.h.
 *
 * None of these instructions saturates. A sum of products is exact in 32 bits: of at most 384 products of at most
 * 2^7 * 2^15 it stays below 2^31, and so does each part of it. So the order of additions does not matter, and the
 * results are those of the portable loops. Memory is read and written by words at any address, which these processors
 * do for single loads and stores, not for LDRD and LDM. */
#include "eva_kernels.h"

#ifdef VC_DSP

#include <arm_acle.h>

#include "common.h"

#define MAX_CHANNELS 128

/* Two numbers of 16 bits. */
static uint32_t pair_at(const int16_t *numbers)
{
    uint32_t pair;
    __builtin_memcpy(&pair, numbers, sizeof pair);
    return pair;
}

/* The next four weights as pairs of 16 bits, w[1] w[0] in `lower` and w[3] w[2] in `upper`: SXTB16 widens every other
 * byte, PKH puts the halves in order. */
#define NEXT_WEIGHTS                                                                                                   \
    "ldr %[upper], [%[weights]], #4\n\t"                                                                               \
    "sxtb16 %[first], %[upper]\n\t"                                                                                    \
    "sxtb16 %[upper], %[upper], ror #8\n\t"                                                                            \
    "pkhbt %[lower], %[first], %[upper], lsl #16\n\t"                                                                  \
    "pkhtb %[upper], %[upper], %[first], asr #16\n\t"
/* Adds their products with the next four inputs of a column. Two loads one behind the other take three cycles, two
 * apart four. */
#define ADD_PRODUCTS(inputs, sum)                                                                                      \
    "ldr %[first], [%[" inputs "]], #4\n\t"                                                                            \
    "ldr %[second], [%[" inputs "]], #4\n\t"                                                                           \
    "smlad %[" sum "], %[lower], %[first], %[" sum "]\n\t"                                                             \
    "smlad %[" sum "], %[upper], %[second], %[" sum "]\n\t"

/* One column; returns the weights of the next row. */
static const int8_t *one_sum(const int8_t *weights, uint32_t length, const int16_t *inputs, int32_t *sum)
{
    const int8_t *const end = weights + length;
    uint32_t lower, upper, first, second;
    int32_t a = 0;
    while (end - weights >= 4)
        __asm__(NEXT_WEIGHTS ADD_PRODUCTS("inputs", "a")
                : [weights] "+r"(weights), [inputs] "+r"(inputs), [a] "+r"(a), [lower] "=&r"(lower),
                  [upper] "=&r"(upper), [first] "=&r"(first), [second] "=&r"(second)
                :
                : "memory");
    while (weights != end)
        a += *weights++ * *inputs++;
    *sum = a;
    return end;
}

/* Four columns at once, so that each weight is fetched and widened once for all of them. */
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

static const int8_t *four_sums(const int8_t *weights, uint32_t length, const int16_t *inputs, uint32_t stride,
                               int32_t *sums, uint32_t rows)
{
    const int8_t *const end = weights + length, *const end_of_eights = weights + (length & ~7u);
    const int16_t *second_inputs = inputs + stride, *third_inputs = second_inputs + stride;
    const int16_t *fourth_inputs = third_inputs + stride;
    uint32_t lower, upper, first, second;
    int32_t a = 0, b = 0, c = 0, d = 0;
    while (weights != end_of_eights)
        ADD_TO_FOUR_SUMS(NEXT_PRODUCTS NEXT_PRODUCTS);
    if (length & 4u)
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
    return end;
}

void vc_eva_products(const int8_t *weights, uint32_t rows, uint32_t length, const int16_t *inputs, uint32_t stride,
                     uint32_t columns, int32_t *sums)
{
    uint32_t column, row;
    for (column = 0; column + 4 <= columns; column += 4, inputs += 4 * stride, sums += 4 * rows) {
        const int8_t *next = weights;
        for (row = 0; row < rows; row++)
            next = four_sums(next, length, inputs, stride, sums + row, rows);
    }
    for (; column < columns; column++, inputs += stride, sums += rows) {
        const int8_t *next = weights;
        for (row = 0; row < rows; row++)
            next = one_sum(next, length, inputs, sums + row);
    }
}

static unsigned column_squares(const int16_t *values, uint32_t channels, int16_t *squares)
{
    const uint32_t pairs = channels / 2;
    const int16_t last = channels % 2 == 0 ? 0 : values[channels - 1];
    uint32_t bits = (uint32_t)(last < 0 ? -last : last), i;
    unsigned doubled;
    for (i = 0; i < pairs; i++) {
        const uint32_t pair = pair_at(values + 2 * i), signs = (pair >> 15) & 0x10001u;
        bits |= (pair ^ signs * 0xFFFFu) + signs; /* magnitudes: of 15 bits, so nothing is carried */
    }
    bits = (bits | bits >> 16) & 0x7FFFu;
    doubled = bits == 0 ? 0 : (unsigned)__builtin_clz(bits) - 17;
    for (i = 0; i < pairs; i++) {
        const int32_t pair = (int32_t)pair_at(values + 2 * i);
        const uint32_t lower = (uint32_t)__smulbb(pair, pair) << 2 * doubled;
        const uint32_t upper = (uint32_t)__smultt(pair, pair) << 2 * doubled;
        const uint32_t both = (upper << 1 & 0xFFFF0000u) | (lower >> 15 & 0xFFFFu);
        __builtin_memcpy(squares + 2 * i, &both, sizeof both);
    }
    if (channels % 2 != 0)
        squares[channels - 1] = (int16_t)((uint32_t)(last * last) << 2 * doubled >> 15);
    return doubled;
}

void vc_eva_squares(const int16_t *values, uint32_t channels, uint32_t columns, int16_t *squares, unsigned *doubled)
{
    uint32_t column;
    for (column = 0; column < columns; column++)
        doubled[column] = column_squares(values + column * channels, channels, squares + column * channels);
}

/* Rounded down, from a table of 8 bits by one step of Newton's method, which never ends below the root and here never
 * more than one above it, as trying all energies has shown; of 0 as of 1, to begin with. */
static uint32_t square_root(uint32_t energy)
{
    const unsigned even_shift = (unsigned)__builtin_clz(energy | 1) & ~1u;
    const uint32_t normal = (energy | 1) << even_shift, start = vc_root[(normal >> 24) - 64];
    const uint32_t root = ((start << 7) + (normal >> 9) / start) >> even_shift / 2;
    return root - (root * root > energy);
}

/* Additions saturate at 2^31 - 1, which is above what is left of the energy. */
static uint32_t energy(uint32_t constant, int32_t added)
{
    return __usat(__qadd(added, (int32_t)constant), 30);
}

/* Energies of a column: constants + sums * multipliers / 2^down. */
static void find_energies(const int32_t *sums, const uint32_t *multipliers, const uint32_t *constants,
                          uint32_t channels, unsigned down, uint32_t *energies)
{
    uint32_t i;
    if (down >= 32) {
        for (i = 0; i < channels; i++) {
            const uint64_t product = (uint64_t)(uint32_t)sums[i] * multipliers[i];
            energies[i] = energy(constants[i], (int32_t)((uint32_t)(product >> 32) >> (down - 32)));
        }
    } else {
        for (i = 0; i < channels; i++) {
            const uint64_t product = (uint64_t)(uint32_t)sums[i] * multipliers[i];
            const uint32_t high = (uint32_t)(product >> 32), low = (uint32_t)product;
            const int32_t added = high >> (down - 1) > 0 ? INT32_MAX : (int32_t)(high << (32 - down) | low >> down);
            energies[i] = energy(constants[i], added);
        }
    }
}

void vc_eva_normalise(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                      const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants, unsigned shift,
                      int16_t *normalised)
{
    const int32_t half = (1 << shift) >> 1;
    uint32_t energies[MAX_CHANNELS], column, i;
    for (column = 0; column < columns; column++, sums += channels) {
        find_energies(sums, multipliers, constants, channels, VC_EVA_ENERGY_SHIFT + 2 * doubled[column], energies);
        for (i = 0; i < channels; i++) {
            const int32_t root = (int32_t)square_root(energies[i]), value = *values++;
            const int32_t magnitude = value < 0 ? -value : value;
            const int32_t limited = (int32_t)__usat((magnitude * root + half) >> shift, 15);
            *normalised++ = (int16_t)(value < 0 ? -limited : limited);
        }
    }
}

void vc_eva_scale(const int32_t *sums, const uint32_t *multipliers, uint32_t count, int16_t *scaled)
{
    uint32_t i;
    for (i = 0; i < count; i++) {
        const int32_t sum = *sums++, magnitude = sum < 0 ? -sum : sum; /* below 2^31, as explained above */
        const uint64_t product = (uint64_t)(uint32_t)magnitude * *multipliers++ + (1u << 31);
        const int32_t limited = (int32_t)__usat((int32_t)(product >> 32), 15);
        *scaled++ = (int16_t)(sum < 0 ? -limited : limited);
    }
}

#endif
