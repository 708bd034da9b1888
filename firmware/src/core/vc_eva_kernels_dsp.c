/* The inner loops of EVA's synthesis with the DSP instructions of Cortex-M4, M7 and M33, for columns of a multiple of
 * 16 channels; see vc_eva_kernels.h.
 *
 * A sum of products is exact in 32 bits: of at most 384 products of at most 2^7 * 2^15 it stays below 2^31, and so does
 * each part of it. So the order of additions does not matter, and the results are those of the portable loops.
 *
 * Memory is read and written by words at any address. These processors allow that for single loads and stores, but not
 * for LDRD and LDM, unless UNALIGN_TRP of the Configuration and Control Register is set; it is not after reset.
 *
 * Squares and normalised activations lie in groups of four in the order 0, 2, 1, 3: SXTB16, which widens every other
 * byte, gives weights in this order. */
#include "vc_eva_kernels.h"

#ifdef VC_DSP

#include <arm_acle.h>

#ifndef __clang__ /* GCC 12 lacks these, and makes one instruction of each */
#define __clz(number) ((number) == 0 ? 32u : (unsigned)__builtin_clz(number))
#define __ror(word, bits) ((word) >> (bits) | (word) << (32 - (bits)))
#define __smulbb(a, b) ((int16_t)(a) * (int16_t)(b))
#define __smultb(a, b) (((a) >> 16) * (int16_t)(b))
#define __smultt(a, b) (((a) >> 16) * ((b) >> 16))
#endif

#include "vc_common.h"

#define MAX_CHANNELS 128
#define TWO_ONES 0x10001

/* Two numbers of 16 bits. */
static int32_t pair_at(const int16_t *numbers)
{
    int32_t pair;
    __builtin_memcpy(&pair, numbers, sizeof pair);
    return pair;
}

static uint32_t four_at(const int8_t *weights)
{
    uint32_t four;
    __builtin_memcpy(&four, weights, sizeof four);
    return four;
}

static void put_pair(int16_t *numbers, uint32_t pair)
{
    __builtin_memcpy(numbers, &pair, sizeof pair);
}

static uint32_t pair_of(uint32_t lower, uint32_t upper)
{
    return (lower & 0xFFFFu) | upper << 16;
}

/* Two numbers within +-VC_EVA_MAX_ACTIVATION. Subtraction saturates, so that -2^15 becomes -2^15 + 1. */
static uint32_t limited_pair(int32_t lower, int32_t upper)
{
    const uint32_t pair = pair_of((uint32_t)__ssat(lower, 16), (uint32_t)__ssat(upper, 16));
    return (uint32_t)__sadd16(__qsub16((int16x2_t)pair, TWO_ONES), TWO_ONES);
}

/* PKH puts the weights in the order of the inputs. */
static int32_t sum_of_products(const int8_t *weights, uint32_t length, const int16_t *inputs)
{
    int32_t sum = 0;
    for (; length >= 4; length -= 4, weights += 4, inputs += 4) {
        const uint32_t four = four_at(weights);
        const uint32_t even = (uint32_t)__sxtb16(four), odd = (uint32_t)__sxtb16(__ror(four, 8));
        sum = __smlad((int16x2_t)pair_of(even, odd), pair_at(inputs), sum);
        sum = __smlad((int16x2_t)((odd & 0xFFFF0000u) | even >> 16), pair_at(inputs + 2), sum);
    }
    while (length-- > 0)
        sum += *weights++ * *inputs++;
    return sum;
}

void vc_dot_products(const int8_t *weights, uint32_t rows, uint32_t length, const int16_t *inputs, int32_t *sums)
{
    uint32_t row;
    for (row = 0; row < rows; row++, weights += length)
        sums[row] = sum_of_products(weights, length, inputs);
}

/* Adds to four sums the products of four weights of two rows with four inputs of two columns. In assembler, because
 * compilers run out of registers. Two loads in sequence take three cycles, two apart take four. */
#define ADD_PRODUCTS                                                                                                   \
    "ldr %[row], [%[weights]], #4\n\t"                                                                                 \
    "ldr %[next_row], [%[next_weights]], #4\n\t"                                                                       \
    "ldr %[column], [%[inputs]], #4\n\t"                                                                               \
    "ldr %[next_column], [%[next_inputs]], #4\n\t"                                                                     \
    "sxtb16 %[pair], %[row]\n\t"                                                                                       \
    "smlad %[a], %[pair], %[column], %[a]\n\t"                                                                         \
    "smlad %[c], %[pair], %[next_column], %[c]\n\t"                                                                    \
    "sxtb16 %[pair], %[next_row]\n\t"                                                                                  \
    "smlad %[b], %[pair], %[column], %[b]\n\t"                                                                         \
    "smlad %[d], %[pair], %[next_column], %[d]\n\t"                                                                    \
    "ldr %[column], [%[inputs]], #4\n\t"                                                                               \
    "ldr %[next_column], [%[next_inputs]], #4\n\t"                                                                     \
    "sxtb16 %[row], %[row], ror #8\n\t"                                                                                \
    "sxtb16 %[next_row], %[next_row], ror #8\n\t"                                                                      \
    "smlad %[a], %[row], %[column], %[a]\n\t"                                                                          \
    "smlad %[c], %[row], %[next_column], %[c]\n\t"                                                                     \
    "smlad %[b], %[next_row], %[column], %[b]\n\t"                                                                     \
    "smlad %[d], %[next_row], %[next_column], %[d]\n\t"

/* Sums of an even number of rows and two columns. Every operand is written before others are read for the last time, so
 * no two may share a register. The compiler does not follow the pointers through which memory is read. */
static void products_of_two(const int8_t *weights, uint32_t even_rows, uint32_t length, const int16_t *inputs,
                            uint32_t to_next_column, int32_t *sums, uint32_t to_next_sums)
{
    const int8_t *next_weights = weights + length;
    const int16_t *next_inputs = inputs + to_next_column;
    int32_t *const last_sum = sums + even_rows;
    for (; sums != last_sum; sums += 2) {
        const int8_t *const end = weights + length;
        uint32_t row, next_row, column, next_column, pair;
        int32_t a = 0, b = 0, c = 0, d = 0;
        do
            __asm__(ADD_PRODUCTS ADD_PRODUCTS ADD_PRODUCTS ADD_PRODUCTS
                    : [weights] "+r"(weights), [next_weights] "+r"(next_weights), [inputs] "+r"(inputs),
                      [next_inputs] "+r"(next_inputs), [a] "+r"(a), [b] "+r"(b), [c] "+r"(c), [d] "+r"(d),
                      [row] "=&r"(row), [next_row] "=&r"(next_row), [column] "=&r"(column),
                      [next_column] "=&r"(next_column), [pair] "=&r"(pair)
                    :
                    : "memory");
        while (weights != end);
        sums[0] = a;
        sums[1] = b;
        sums[to_next_sums] = c;
        sums[to_next_sums + 1] = d;
        inputs -= length;
        next_inputs -= length;
        weights = next_weights;
        next_weights += length;
    }
}

static int32_t one_sum(const int8_t *weights, uint32_t length, const int16_t *inputs)
{
    const int8_t *const end = weights + length;
    int32_t sum = 0;
    for (; weights != end; weights += 4, inputs += 4) {
        const uint32_t four = four_at(weights);
        sum = __smlad(__sxtb16(four), pair_at(inputs), sum);
        sum = __smlad(__sxtb16(__ror(four, 8)), pair_at(inputs + 2), sum);
    }
    return sum;
}

void vc_eva_products_dsp(const int8_t *weights, uint32_t rows, uint32_t taps, const int16_t *inputs, uint32_t channels,
                         uint32_t columns, int32_t *sums)
{
    const uint32_t length = taps * channels, even_rows = rows & ~1u, even_columns = columns & ~1u;
    uint32_t column, row;
    for (column = 0; column < even_columns; column += 2)
        products_of_two(weights, even_rows, length, inputs + column * channels, channels, sums + column * rows, rows);
    /* The last row and the last column, where they are odd. */
    for (column = even_rows == rows ? even_columns : 0; column < columns; column++)
        for (row = column < even_columns ? even_rows : 0; row < rows; row++)
            sums[column * rows + row] = one_sum(weights + row * length, length, inputs + column * channels);
}

/* Magnitudes of two numbers: the difference records for SEL which of them is not below 0. */
static uint32_t magnitudes(int32_t pair)
{
    const int16x2_t negative = __ssub16(0, pair);
    return (uint32_t)__sel((uint8x4_t)negative, (uint8x4_t)pair);
}

static unsigned column_squares(const int16_t *values, uint32_t channels, int16_t *squares)
{
    const int16_t *const end = values + channels;
    const int16_t *value;
    uint32_t bits = 0, i;
    unsigned doubled;
    for (value = values; value != end; value += 16)
        for (i = 0; i < 16; i += 2)
            bits |= magnitudes(pair_at(value + i));
    bits = (bits | bits >> 16) & 0x7FFFu;
    doubled = bits == 0 ? 0 : (unsigned)__builtin_clz(bits) - 17;
    for (value = values; value != end; value += 16)
        for (i = 0; i < 16; i += 4, squares += 4) {
            const int32_t first = pair_at(value + i), second = pair_at(value + i + 2);
            put_pair(squares, pair_of((uint32_t)__smulbb(first, first) << 2 * doubled >> 15,
                                      (uint32_t)__smulbb(second, second) << 2 * doubled >> 15));
            put_pair(squares + 2, pair_of((uint32_t)__smultt(first, first) << 2 * doubled >> 15,
                                          (uint32_t)__smultt(second, second) << 2 * doubled >> 15));
        }
    return doubled;
}

void vc_eva_squares_dsp(const int16_t *values, uint32_t channels, uint32_t columns, int16_t *squares, unsigned *doubled)
{
    for (; columns > 0; columns--, values += channels, squares += channels)
        *doubled++ = column_squares(values, channels, squares);
}

/* Energies of a column: constants + sums * multipliers / 2^down, at most VC_EVA_MAX_ENERGY. No addition overflows: a
 * sum is below 2^29, and so a product below 2^61; constants are VC_EVA_MAX_ENERGY at most. */
static void find_energies(const int32_t *sums, const uint32_t *multipliers, const uint32_t *constants,
                          uint32_t channels, unsigned down, uint32_t *energies)
{
    uint32_t i;
    if (down >= 32) {
        for (i = 0; i < channels; i++) {
            const uint64_t product = (uint64_t)(uint32_t)sums[i] * multipliers[i];
            energies[i] = __usat((int32_t)(constants[i] + ((uint32_t)(product >> 32) >> (down - 32))), 30);
        }
    } else {
        const uint32_t most = 1u << (down - 2); /* at which the energy exceeds its limit */
        const unsigned up = 32 - down;
        for (i = 0; i < channels; i++) {
            const uint64_t product = (uint64_t)(uint32_t)sums[i] * multipliers[i];
            const uint32_t high = (uint32_t)(product >> 32), limited = high < most ? high : most;
            const uint32_t weighted = __usat((int32_t)((limited << up) + ((uint32_t)product >> down)), 30);
            energies[i] = __usat((int32_t)(constants[i] + weighted), 30);
        }
    }
}

/* Rounded down: a straight line of vc_root never ends below the root and never more than one above it, as a test of all
 * energies has shown. */
static int32_t square_root(uint32_t energy)
{
    const unsigned zeros = __clz(energy);
    const uint32_t normal = energy << (zeros & 30), line = vc_root[normal >> 25];
    const uint32_t root = ((line & 4095u) * (normal >> 13 & 4095u) + line) >> (15 + zeros / 2);
    return (int32_t)root + ((int32_t)(energy - root * root) >> 31);
}

void vc_eva_normalise_dsp(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                          const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants,
                          unsigned shift, int16_t *normalised)
{
    /* Added to a product before the shift rounds it down: half away from zero is up, or down if negative. */
    const int32_t half = (1 << shift) >> 1, for_negative = shift > 0 ? -1 : 0;
    uint32_t energies[MAX_CHANNELS], i, k;
    for (; columns > 0; columns--, sums += channels) {
        find_energies(sums, multipliers, constants, channels, VC_EVA_ENERGY_SHIFT + 2 * *doubled++, energies);
        for (i = 0; i < channels; i += 4, values += 4, normalised += 4) {
            const int32_t first = pair_at(values), second = pair_at(values + 2);
            int32_t products[4];
            products[0] = __smulbb(first, square_root(energies[i]));
            products[1] = __smultb(first, square_root(energies[i + 1]));
            products[2] = __smulbb(second, square_root(energies[i + 2]));
            products[3] = __smultb(second, square_root(energies[i + 3]));
            for (k = 0; k < 4; k++)
                products[k] = (products[k] + half + (products[k] >> 31 & for_negative)) >> shift;
            put_pair(normalised, limited_pair(products[0], products[2]));
            put_pair(normalised + 2, limited_pair(products[1], products[3]));
        }
    }
}

/* sum * multiplier / 2^32, to the nearest, half away from zero. SMLAL takes the multiplier as a signed number: if its
 * highest bit is set, 2^32 sum are missing. */
static int32_t scaled_sum(int32_t sum, uint32_t multiplier)
{
    uint32_t low = (1u << 31) + (uint32_t)(sum >> 31);
    int32_t high = sum & (int32_t)multiplier >> 31;
    __asm__("smlal %[low], %[high], %[sum], %[multiplier]"
            : [low] "+r"(low), [high] "+r"(high)
            : [sum] "r"(sum), [multiplier] "r"(multiplier));
    return high;
}

void vc_eva_scale_dsp(const int32_t *sums, const uint32_t *multipliers, uint32_t rows, uint32_t columns,
                      int16_t *scaled, uint32_t stride)
{
    uint32_t column, i;
    for (column = 0; column < columns; column++, sums += rows, scaled += stride)
        for (i = 0; i < rows; i += 2)
            put_pair(scaled + i,
                     limited_pair(scaled_sum(sums[i], multipliers[i]), scaled_sum(sums[i + 1], multipliers[i + 1])));
}

#endif
