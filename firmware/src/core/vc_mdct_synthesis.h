/* Inverse MDCT in fixed point, of the codecs whose decoders end with it. */
#ifndef VIBROCAST_MDCT_SYNTHESIS_H
#define VIBROCAST_MDCT_SYNTHESIS_H

#include <stdint.h>

/* Writes the next hop samples of a channel, `stride` apart: inverse MDCT of its spectrum, sqrt(2 / N) sum_k X[k] cos(pi
 * / N (n + 1/2 + N/2) (k + 1/2)), windowed and overlap-added (Princen, Johnson and Bradley 1987).
 * `hop`: N, 16, 32, 64 or 128. `spectrum`: hop coefficients in 1/256 of a sample's least significant bit, within
 * +-VC_MAX_VALUE of vc_common.h.
 * `overlap`: hop values in the same unit, the windowed second half of the block before, 0 at the start. The caller
 * keeps them from block to block, and may add to them to add to the samples.
 */
void vc_mdct_synthesise(const int32_t *spectrum, int32_t *overlap, uint32_t hop, int16_t *samples, unsigned stride);

/* The same by the extended lapped transform of overlap 4 (Malvar, "Extended lapped transforms: properties,
 * applications, and fast algorithms", 1992). The transform's output goes on periodically.
 * `window`: the first 2 N of 4 N values, int16 in 1/2^15, little-endian; the others mirror them. `overlap`, `later`:
 * hop and 2 hop values, as above. */
void vc_lapped_synthesise(const uint8_t *window, const int32_t *spectrum, int32_t *overlap, int32_t *later,
                          uint32_t hop, int16_t *samples, unsigned stride);

#endif
