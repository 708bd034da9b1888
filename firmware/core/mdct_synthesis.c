/* Spectra to samples by a fixed-point inverse MDCT; see mdct_synthesis.h. */
#include "mdct_synthesis.h"
#include "mdct.h"

/* A coefficient that is not 0, and 2 k + 1. */
typedef struct {
    int32_t value;
    uint32_t frequency;
} spectral_line;

/* sum_k X[k] cos(angle (2 k + 1)), in 1/2^24, and the same a quarter of a turn later; angles in 1/1024 of a turn. By
 * itself, so that all of the loop stays in registers. */
__attribute__((noinline)) static void cosine_sums(const spectral_line *lines, uint32_t count, uint32_t angle,
                                                  int64_t *sums)
{
    const spectral_line *const end = lines + count;
    int64_t first = 0, second = 0;
    for (; lines != end; lines++) {
        const uint32_t turned = angle * lines->frequency;
        first += (int64_t)lines->value * vc_cosine[turned & 1023u];
        second += (int64_t)lines->value * vc_cosine[(turned + 256 * lines->frequency) & 1023u];
    }
    sums[0] = first;
    sums[1] = second;
}

/* sqrt(2 / N) in 1/2^24. */
static int32_t norm(uint32_t hop)
{
    return hop == 16 ? 5931642 : hop == 32 ? 4194304 : hop == 64 ? 2965821 : 2097152;
}

/* sin(pi (n + 1/2) / (2 N)) in 1/2^24, 0 <= n < N: the rising half of the sine window. */
static int32_t window(uint32_t hop, uint32_t n)
{
    return vc_cosine[((2 * n + 1) * (128 / hop) + 768) & 1023u];
}

/* The first half of the transform's output is odd about its middle, the second half even. */
void vc_mdct_synthesise(const int32_t *spectrum, int32_t *overlap, uint32_t hop, int16_t *samples, unsigned stride)
{
    spectral_line lines[VC_MAX_BINS];
    uint32_t count = 0, k, n;
    for (k = 0; k < hop; k++)
        if (spectrum[k] != 0) {
            lines[count].value = spectrum[k];
            lines[count++].frequency = 2 * k + 1;
        }
    for (n = 0; n < hop / 2; n++) {
        const uint32_t mirror = hop - 1 - n;
        const int32_t rising = window(hop, n), falling = window(hop, mirror);
        int64_t sums[2]; /* of samples n and N + n */
        int32_t first, second;
        cosine_sums(lines, count, (2 * n + 1 + hop) * (128 / hop), sums); /* N divides 128 */
        first = vc_weighted(vc_scaled_down(sums[0]), norm(hop));
        second = vc_weighted(vc_scaled_down(sums[1]), norm(hop));
        samples[n * stride] = vc_rounded_sample((int64_t)overlap[n] + vc_weighted(first, rising));
        samples[mirror * stride] = vc_rounded_sample((int64_t)overlap[mirror] - vc_weighted(first, falling));
        overlap[n] = vc_weighted(second, falling);
        overlap[mirror] = vc_weighted(second, rising);
    }
}
