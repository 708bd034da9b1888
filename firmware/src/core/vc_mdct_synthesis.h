/* MDCT in fixed point, of the codecs whose decoders end with the inverse. */
#ifndef VIBROCAST_MDCT_SYNTHESIS_H
#define VIBROCAST_MDCT_SYNTHESIS_H

#include "vc_common.h"

/* v[n] = 2^-shift sum_k X[k] cos(pi / N (n + 1/2) (k + 1/2)), 0 <= n < N, by a Fourier transform of N / 2 complex
 * numbers; returns the shift, which is 0 unless values could overflow. `hop`: N, 16, 32, 64 or 128. `spectrum`: N
 * values within +-VC_MAX_VALUE of vc_common.h.
 *
 * Without its norm and window, the inverse MDCT is v[N/2 + n] at n and -v[N/2 - 1 - n] at N + n, for 0 <= n < N / 2.
 * Its first half is odd about its middle, its second half even. */
unsigned vc_cosine_transform(const int32_t *spectrum, uint32_t hop, int32_t *v);

/* sqrt(2 / N), the norm of the transform, in 1/2^24. */
static inline int32_t vc_norm(uint32_t hop)
{
    return hop == 16 ? 5931642 : hop == 32 ? 4194304 : hop == 64 ? 2965821 : 2097152;
}

/* sin(pi (n + 1/2) / (2 N)), 0 <= n < N, the rising half of the window, in 1/2^24. */
static inline int32_t vc_window(uint32_t hop, uint32_t n)
{
    return vc_cosine[((2 * n + 1) * (128 / hop) + 768) & 1023u];
}

/* Writes the next hop samples of a channel, `stride` apart: inverse MDCT of its spectrum, sqrt(2 / N) sum_k X[k] cos(pi
 * / N (n + 1/2 + N/2) (k + 1/2)), windowed and overlap-added (Princen, Johnson and Bradley 1987).
 * `spectrum`: hop coefficients in 1/256 of a sample's least significant bit, within the same limits.
 * `overlap`: hop values in the same unit, the windowed second half of the block before, 0 at the start. The caller
 * keeps them from block to block, and may add to them to add to the samples.
 */
void vc_mdct_synthesise(const int32_t *spectrum, int32_t *overlap, uint32_t hop, int16_t *samples, unsigned stride);

#endif
