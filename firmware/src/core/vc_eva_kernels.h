/* The inner loops of EVA's synthesis: in portable C (vc_eva_kernels.c), and with the DSP instructions of a Cortex-M4,
 * M7 or M33 (vc_eva_kernels_dsp.c) where columns have a multiple of 16 channels. Both give the same integers.
 *
 * Activations are 16-bit integers within +-32767; no sum here can overflow for layers of at most 128 channels. */
#ifndef VIBROCAST_EVA_KERNELS_H
#define VIBROCAST_EVA_KERNELS_H

#include <stddef.h>
#include <stdint.h>

/* VC_PORTABLE: selects portable C on a processor that has the instructions. */
#if defined __ARM_FEATURE_SIMD32 && !defined VC_PORTABLE
#define VC_DSP
#endif

#define VC_EVA_MAX_ACTIVATION 32767
#define VC_EVA_MAX_ENERGY ((1u << 30) - 1)
#define VC_EVA_ENERGY_SHIFT 24

/* sums[row] = sum over i < length of weights[row * length + i] * inputs[i]; length <= 384. */
void vc_dot_products(const int8_t *weights, uint32_t rows, uint32_t length, const int16_t *inputs, int32_t *sums);

/* sums[column * rows + row] = sum over i < length of weights[row * length + i] * inputs[column * channels + i], where
 * length = taps * channels <= 384. Squares and normalised activations lie in the order of these inputs; within the
 * channels of a column, each kernel chooses its own order. */
void vc_eva_products(const int8_t *weights, uint32_t rows, uint32_t taps, const int16_t *inputs, uint32_t channels,
                     uint32_t columns, int32_t *sums);

/* Squares of columns, x^2 / 2^15. First doubles all values of a column as often as the greatest allows: `doubled`. */
void vc_eva_squares(const int16_t *values, uint32_t channels, uint32_t columns, int16_t *squares, unsigned *doubled);

/* Inverse GDN of columns: values * sqrt(constants + sums * multipliers / 2^(24 + 2 doubled)) / 2^shift, where `sums`
 * are the weighted sums of a column's squares, and `doubled` goes with them; `constants`: VC_EVA_MAX_ENERGY at most.
 * The root is that of at most VC_EVA_MAX_ENERGY, rounded down. */
void vc_eva_normalise(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                      const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants, unsigned shift,
                      int16_t *normalised);

/* value * multiplier / 2^32, to the nearest, half away from zero, within +-limit. */
static inline int32_t vc_eva_scaled(int32_t value, uint32_t multiplier, uint32_t limit)
{
    const uint32_t magnitude = value < 0 ? 0u - (uint32_t)value : (uint32_t)value;
    const uint32_t scaled = (uint32_t)(((uint64_t)magnitude * multiplier + (1u << 31)) >> 32);
    const int32_t limited = (int32_t)(scaled < limit ? scaled : limit);
    return value < 0 ? -limited : limited;
}

/* The same for each sum of columns, within +-VC_EVA_MAX_ACTIVATION, to columns that are `stride` apart. */
void vc_eva_scale(const int32_t *sums, const uint32_t *multipliers, uint32_t rows, uint32_t columns, int16_t *scaled,
                  uint32_t stride);

/* The same four with DSP instructions, for channels or rows of sums in multiples of 16. */
void vc_eva_products_dsp(const int8_t *weights, uint32_t rows, uint32_t taps, const int16_t *inputs, uint32_t channels,
                         uint32_t columns, int32_t *sums);
void vc_eva_squares_dsp(const int16_t *values, uint32_t channels, uint32_t columns, int16_t *squares,
                        unsigned *doubled);
void vc_eva_normalise_dsp(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                          const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants,
                          unsigned shift, int16_t *normalised);
void vc_eva_scale_dsp(const int32_t *sums, const uint32_t *multipliers, uint32_t rows, uint32_t columns,
                      int16_t *scaled, uint32_t stride);

#endif
