/* The inner loops of EVA's synthesis, apart so that a processor's own instructions can take their place.
 *
 * Activations are 16-bit integers within +-32767; no sum here can overflow for layers of at most 128 channels. */
#ifndef VIBROCAST_EVA_KERNELS_H
#define VIBROCAST_EVA_KERNELS_H

#include <stddef.h>
#include <stdint.h>

/* sums[column * rows + row] = sum over i < length of weights[row * length + i] * inputs[column * stride + i];
 * length <= 384. */
void vc_eva_products(const int8_t *weights, uint32_t rows, uint32_t length, const int16_t *inputs, uint32_t stride,
                     uint32_t columns, int32_t *sums);

/* Squares of a column, x^2 / 2^15 after all values have been doubled as often as the greatest can be; returns how
 * often.
 */
unsigned vc_eva_squares(const int16_t *values, uint32_t channels, int16_t *squares);

/* Inverse GDN of columns: values * sqrt(constants + sums * multipliers / 2^(24 + 2 doubled)) / 2^shift, where `sums`
 * are the weighted sums of a column's squares, and `doubled` goes with them. The root is that of at most 2^30 - 1,
 * rounded down. */
void vc_eva_normalise(const int16_t *values, uint32_t channels, uint32_t columns, const int32_t *sums,
                      const unsigned *doubled, const uint32_t *multipliers, const uint32_t *constants, unsigned shift,
                      int16_t *normalised);

/* scaled[i] = sums[i] * multipliers[i] / 2^32, within +-32767. */
void vc_eva_scale(const int32_t *sums, const uint32_t *multipliers, uint32_t count, int16_t *scaled);

extern const uint8_t vc_root[192]; /* sqrt(256 (i + 64.5)), 255 at most */

/* value * multiplier / 2^32, to the nearest, half away from zero, within +-limit. */
int32_t vc_eva_scaled(int32_t value, uint32_t multiplier, uint32_t limit);

#endif
