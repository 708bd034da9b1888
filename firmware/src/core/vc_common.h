/* Shared by all codecs of the core: libc's two functions, packet heads, adaptive decisions, codes of whole numbers,
 * rounding, random signs. */
#ifndef VIBROCAST_COMMON_H
#define VIBROCAST_COMMON_H

#include <stddef.h>
#include <stdint.h>

#include "vc_range_coder.h"
#include "vibrocast/config.h"
#include "vibrocast/status.h"

/* All of libc that the core needs; declared here because a microcontroller's compiler may come without its headers. */
void *memcpy(void *destination, const void *source, size_t length);
void *memset(void *destination, int value, size_t length);

#define VC_PACKET_HEAD_BYTES 5
#define VC_EVEN_ODDS 32768u
/* Start of an adaptive decision's probability, in 1/65536, if nothing is known. */
#define VC_UNTRAINED 32768u

/* Counts one more, up to the highest number. */
static inline void vc_count_one(uint32_t *count)
{
    if (*count < UINT32_MAX)
        (*count)++;
}

/* Packet head: sequence * 2 + refresh, LEB128. The reader returns the bytes taken, or 0 when there is no valid head;
 * the writer the bytes written, at most VC_PACKET_HEAD_BYTES. */
size_t vc_packet_head_read(const uint8_t *packet, size_t length, uint32_t *sequence, int *refresh);
size_t vc_packet_head_write(uint8_t *packet, uint32_t sequence, int refresh);

/* One decision with a probability of 1 in 1/65536. The probability adapts to the decision by 1/2^shift. */
void vc_adaptive_encode(vc_range_coder *coder, int bit, uint16_t *probability, unsigned shift);
int vc_adaptive_decode(vc_range_coder *coder, uint16_t *probability, unsigned shift);
/* Encodes `bit` if `encoding`, otherwise decodes. Returns the decision. */
int vc_adaptive_code(vc_range_coder *coder, int encoding, int bit, uint16_t *probability, unsigned shift);

/* A number from 0 on: exponential-Golomb code of order 0, each bit with even odds, at most 24 bits behind the prefix.
 */
void vc_golomb_encode(vc_range_coder *coder, uint32_t value);
uint32_t vc_golomb_decode(vc_range_coder *coder);

extern const int32_t vc_cosine[1024]; /* cos(2 pi i / 1024) in 1/2^24 */
/* sqrt(x) + 1.5 at x = 2^25 i, in 1/8, above 12 bits for the rise to the next entry, in 1/8; 0 below 2^30. */
extern const uint32_t vc_root[128];

/* Largest signal value, in 1/256 of a sample's least significant bit; only hostile streams come near. */
#define VC_MAX_VALUE (1 << 30)

static inline int32_t vc_limited(int64_t value)
{
    return (int32_t)(value > VC_MAX_VALUE ? VC_MAX_VALUE : value < -VC_MAX_VALUE ? -VC_MAX_VALUE : value);
}

/* value / 2^24, to the nearest, half up. */
static inline int64_t vc_rounded(int64_t value)
{
    const int64_t one = 1 << 24;
    /* The lower bits are cleared, so that a compiler needs only a shift. */
    return ((value + one / 2) & -one) / one;
}

/* The same, within +-VC_MAX_VALUE. */
static inline int32_t vc_scaled_down(int64_t value)
{
    return vc_limited(vc_rounded(value));
}

/* value * weight / 2^24, rounded; `weight`: at most 2^24 in magnitude. */
static inline int32_t vc_weighted(int32_t value, int32_t weight)
{
    return (int32_t)vc_rounded((int64_t)value * weight);
}

/* The sample of a signal value in 1/256 of its least significant bit. */
static inline int16_t vc_rounded_sample(int64_t value)
{
    const int32_t limited = vc_limited(value); /* far beyond a sample's range */
    const int32_t sample = (limited + (limited < 0 ? -128 : 128)) / 256;
    return (int16_t)(sample > 32767 ? 32767 : sample < -32768 ? -32768 : sample);
}

/* Pseudo-random sign, 1 or -1, from a linear congruential generator (Numerical Recipes' constants) and its state. */
static inline int32_t vc_random_sign(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 31 ? -1 : 1;
}

/* Moves the generator on by `count` signs, in steps of doubled length. */
static inline void vc_random_skip(uint32_t *state, uint32_t count)
{
    uint32_t factor = 1664525u, addend = 1013904223u;
    for (; count > 0; count >>= 1) {
        if (count & 1u)
            *state = *state * factor + addend;
        addend *= factor + 1;
        factor *= factor;
    }
}

/* Floor of the logarithm to base 2; value > 0. */
static inline unsigned vc_floor_log2(uint32_t value)
{
#ifdef __GNUC__
    return 31u - (unsigned)__builtin_clz(value);
#else
    unsigned exponent = 0, step;
    for (step = 16; step > 0; step >>= 1)
        if (value >> (exponent + step) > 0)
            exponent += step;
    return exponent;
#endif
}

#endif
