/* The transform of an MDCT in fixed point, and spectra to samples by it; see vc_mdct_synthesis.h. */
#include "vc_mdct_synthesis.h"
#include "vc_mdct_state.h"

#define LARGEST_SUM (1 << 30)

/* The place after `place` among `count` numbers, a power of two, in the order of reversed bits. */
static uint32_t next_reversed(uint32_t place, uint32_t count)
{
    uint32_t bit = count / 2;
    for (; place & bit; bit /= 2)
        place -= bit;
    return place + bit;
}

/* Turns a complex number, real part first, clockwise by an angle in 1/1024 of a turn. */
static inline void turn(int32_t *z, uint32_t angle)
{
    const int64_t cosine = vc_cosine[angle], sine = vc_cosine[(angle + 768) & 1023u];
    const int32_t real = (int32_t)vc_rounded(z[0] * cosine + z[1] * sine);
    z[1] = (int32_t)vc_rounded(z[1] * cosine - z[0] * sine);
    z[0] = real;
}

/* Replaces two complex numbers by sum and difference. */
static inline void add_and_subtract(int32_t *low, int32_t *high)
{
    const int32_t real = high[0], imaginary = high[1];
    high[0] = low[0] - real;
    high[1] = low[1] - imaginary;
    low[0] += real;
    low[1] += imaginary;
}

/* sum_k z[k] exp(-2 pi i n k / count) in place of z[n]; before, complex numbers stand in the order of reversed bits. */
static void fourier_transform(int32_t *z, uint32_t count)
{
    int32_t *const end = z + 2 * count, *low;
    uint32_t half, n;
    for (half = 1; half < count; half *= 2)
        for (low = z; low < end; low += 4 * half) {
            add_and_subtract(low, low + 2 * half);
            for (n = 1; n < half; n++) {
                turn(low + 2 * (half + n), n * (512 / half));
                add_and_subtract(low + 2 * n, low + 2 * (half + n));
            }
        }
}

/* By how many bits values must be shifted down, so that no sum of them, each turned somehow, passes LARGEST_SUM: 0, but
 * for hostile streams and near full scale. */
static unsigned shift_for(const int32_t *spectrum, uint32_t hop)
{
    uint64_t sum = 0;
    unsigned shift = 0;
    uint32_t k;
    for (k = 0; k < hop; k++)
        sum += (uint32_t)(spectrum[k] < 0 ? -spectrum[k] : spectrum[k]);
    while (sum >> shift > LARGEST_SUM)
        shift++;
    return shift;
}

unsigned vc_cosine_transform(const int32_t *spectrum, uint32_t hop, int32_t *v)
{
    const uint32_t count = hop / 2, unit = 128 / hop; /* N divides 128 */
    const unsigned shift = shift_for(spectrum, hop);
    uint32_t k, place = 0;
    for (k = 0; k < count; k++, place = next_reversed(place, count)) {
        int32_t *const z = v + 2 * place;
        const int32_t real = spectrum[2 * k], imaginary = spectrum[hop - 1 - 2 * k];
        z[0] = shift ? real / (1 << shift) : real;
        z[1] = shift ? imaginary / (1 << shift) : imaginary;
        turn(z, (4 * k + 1) * unit);
    }
    fourier_transform(v, count);
    for (k = 0; k < count / 2; k++) {
        int32_t *const low = v + 2 * k, *const high = v + hop - 2 - 2 * k;
        int32_t imaginary;
        turn(low, 4 * k * unit);
        turn(high, 4 * (count - 1 - k) * unit);
        imaginary = low[1];
        low[1] = -high[1];
        high[1] = -imaginary;
    }
    return shift;
}

/* value * weight * 2^shift, limited. */
static int32_t weighted(int32_t value, int32_t weight, unsigned shift)
{
    const int64_t result = vc_rounded((int64_t)value * weight);
    return shift ? vc_limited(result * (1 << shift)) : (int32_t)result;
}

void vc_mdct_synthesise(const int32_t *spectrum, int32_t *overlap, uint32_t hop, int16_t *samples, unsigned stride)
{
    int32_t v[VC_MAX_BINS];
    const unsigned shift = vc_cosine_transform(spectrum, hop, v);
    uint32_t n;
    for (n = 0; n < hop / 2; n++) {
        const uint32_t mirror = hop - 1 - n;
        const int32_t first = v[hop / 2 + n], second = -v[hop / 2 - 1 - n];
        const int32_t rising = vc_weighted(vc_window(hop, n), vc_norm(hop));
        const int32_t falling = vc_weighted(vc_window(hop, mirror), vc_norm(hop));
        samples[n * stride] = vc_rounded_sample((int64_t)overlap[n] + weighted(first, rising, shift));
        samples[mirror * stride] = vc_rounded_sample((int64_t)overlap[mirror] - weighted(first, falling, shift));
        overlap[n] = weighted(second, falling, shift);
        overlap[mirror] = weighted(second, rising, shift);
    }
}
