/* Spectra to samples by a fixed-point inverse MDCT; see vc_mdct_synthesis.h. */
#include "vc_mdct_synthesis.h"
#include "vc_mdct_state.h"

/* A coefficient that is not 0, and 2 k + 1. */
typedef struct {
    int32_t value;
    uint32_t frequency;
} spectral_line;

/* sum_k X[k] cos(angle (2 k + 1)), in 1/2^24, and the same a quarter of a turn later; angles in 1/1024 of a turn. A
 * separate function, so that the whole loop stays in registers. */
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

/* Finds the coefficients of a spectrum that are not 0; returns how many. */
static uint32_t lines_of(const int32_t *spectrum, uint32_t hop, spectral_line *lines)
{
    uint32_t count = 0, k;
    for (k = 0; k < hop; k++)
        if (spectrum[k] != 0) {
            lines[count].value = spectrum[k];
            lines[count++].frequency = 2 * k + 1;
        }
    return count;
}

/* The transform's output without a window, at n (0 <= n < N / 2) and N + n; the first half of all 2 N values is odd
 * about its middle, the second half even. */
static void transform(const spectral_line *lines, uint32_t count, uint32_t hop, uint32_t n, int32_t *first,
                      int32_t *second)
{
    int64_t sums[2];
    cosine_sums(lines, count, (2 * n + 1 + hop) * (128 / hop), sums); /* N divides 128 */
    *first = vc_weighted(vc_scaled_down(sums[0]), norm(hop));
    *second = vc_weighted(vc_scaled_down(sums[1]), norm(hop));
}

void vc_mdct_synthesise(const int32_t *spectrum, int32_t *overlap, uint32_t hop, int16_t *samples, unsigned stride)
{
    spectral_line lines[VC_MAX_BINS];
    const uint32_t count = lines_of(spectrum, hop, lines);
    uint32_t n;
    for (n = 0; n < hop / 2; n++) {
        const uint32_t mirror = hop - 1 - n;
        const int32_t rising = window(hop, n), falling = window(hop, mirror);
        int32_t first, second;
        transform(lines, count, hop, n, &first, &second);
        samples[n * stride] = vc_rounded_sample((int64_t)overlap[n] + vc_weighted(first, rising));
        samples[mirror * stride] = vc_rounded_sample((int64_t)overlap[mirror] - vc_weighted(first, falling));
        overlap[n] = vc_weighted(second, falling);
        overlap[mirror] = vc_weighted(second, rising);
    }
}

/* Value i of a window, in 1/2^24. */
static int32_t learned(const uint8_t *window, uint32_t i)
{
    return (int16_t)(window[2 * i] | window[2 * i + 1] << 8) * (1 << 9);
}

/* After its 2 N values the transform's output repeats with the opposite sign, and the window's second half mirrors its
 * first. */
void vc_lapped_synthesise(const uint8_t *window, const int32_t *spectrum, int32_t *overlap, int32_t *later,
                          uint32_t hop, int16_t *samples, unsigned stride)
{
    spectral_line lines[VC_MAX_BINS];
    const uint32_t count = lines_of(spectrum, hop, lines);
    uint32_t n;
    for (n = 0; n < hop / 2; n++) {
        const uint32_t mirror = hop - 1 - n;
        const int32_t a = learned(window, n), b = learned(window, mirror);
        const int32_t c = learned(window, hop + n), d = learned(window, hop + mirror);
        int32_t first, second;
        transform(lines, count, hop, n, &first, &second);
        samples[n * stride] = vc_rounded_sample((int64_t)overlap[n] + vc_weighted(first, a));
        samples[mirror * stride] = vc_rounded_sample((int64_t)overlap[mirror] - vc_weighted(first, b));
        overlap[n] = vc_limited((int64_t)later[n] + vc_weighted(second, c));
        overlap[mirror] = vc_limited((int64_t)later[mirror] + vc_weighted(second, d));
        later[n] = vc_limited((int64_t)later[hop + n] - vc_weighted(first, d));
        later[mirror] = vc_limited((int64_t)later[hop + mirror] + vc_weighted(first, c));
        later[hop + n] = -vc_weighted(second, b);
        later[hop + mirror] = -vc_weighted(second, a);
    }
}
