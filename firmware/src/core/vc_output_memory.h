/* The state of the output, for a caller that reserves its memory at compile time, and declarations that its two halves
 * share.
 *
 * Only vc_drive.c and vc_dac.c read and write it. They rely on right shifts of negative numbers rounding down, as all
 * compilers for their processors do. */
#ifndef VIBROCAST_OUTPUT_MEMORY_H
#define VIBROCAST_OUTPUT_MEMORY_H

#include "vc_common.h"
#include "vibrocast/output.h"

/* Taps of the resampler at the lower of the two rates; twice as many for every doubling of a stream's higher rate. */
#define VC_RESAMPLER_TAPS 16

/* Bytes of a vc_drive for `channels` of a stream whose rate is at most `ratio` (whole, 1 to VC_RESAMPLER_MAX_RATIO)
 * times the DAC's. */
#define VC_DRIVE_MEMORY(channels, ratio)                                                                               \
    (sizeof(struct vc_drive) + VC_RESAMPLER_TAPS * (ratio) * (1 + 2 * (channels)) * sizeof(int32_t))

/* The integrators of a state variable filter, in 1/2^29 of the signal's unit so that rounding does not accumulate, and
 * the band-pass of the last sample. */
typedef struct {
    int64_t band, low;
    int32_t last_band;
} vc_section_state;

typedef struct {
    vc_section_state high_pass, integrator, compensation;
    /* Joints: the last sample before and after them, the held value and its share in 1/2^16, the largest step. */
    int32_t before, last, held, held_share, largest_step;
} vc_drive_channel;

struct vc_drive {
    vc_section high_pass, integrator; /* of an acceleration */
    const vc_section *compensation;   /* NULL: off */
    uint32_t channels;
    uint32_t rate_hz, dac_rate_hz;
    int integrates;
    /* Joints. */
    int joining;                    /* the next sample begins another iteration */
    uint32_t unmeasured;            /* samples to come whose step does not count as the recording's */
    uint32_t fade_samples, fade_at; /* samples of the fade, and of it since the last joint */
    /* Resampler: the next drive sample lies phase / dac_rate_hz samples after the one that is `wait` samples ahead of
     * the newest. */
    uint32_t delay_samples, taps; /* 0 where both rates are the same */
    uint32_t wait, phase;
    uint32_t whole_step, part_step; /* added to both for each drive sample */
    uint32_t held_samples;          /* of the last value, still to be taken by vc_drive_finish() */
    uint32_t tap_step;              /* from tap to tap, in 1/2^22 of a zero crossing's distance */
    uint64_t phase_step;            /* of a phase of 1, in 1/2^52 of it */
    uint32_t reciprocal;            /* 2^(31 + sum_shift) / sum of the taps at phase 0 */
    uint32_t sum_shift;             /* chosen so that the sum is from 4 to 8 times 2^sum_shift */
    uint32_t newest;                /* index of the newest sample; earlier ones follow, in a ring */
    vc_drive_channel channel[VC_MAX_CHANNELS];
    int32_t values[]; /* taps of this drive sample, then as many samples of history, twice, for each channel */
};

/* A positive number: mantissa * 2^exponent, mantissa from 2^30 to below 2^31; or a mantissa of 0. */
typedef struct {
    uint32_t mantissa;
    int32_t exponent;
} vc_scale;

typedef struct {
    vc_scale scale; /* codes for a drive of 1 */
    int32_t code;   /* the last one */
    int32_t ramp_from;
    /* Power limit: factor, in 1/2^16, at the beginning and end of this block; mean of the squared drive, in 1/2^46 of
     * full drive; sum of the squared codes of this block. */
    int32_t factor_from, factor_to;
    uint64_t mean, energy;
} vc_dac_channel;

struct vc_dac {
    const vc_actuator *actuator;
    uint32_t channels;
    int compensation;
    vc_limit_counts counts;
    uint32_t hold_samples;          /* at rest, still to come */
    uint32_t fade_samples, fade_at; /* samples of the fade, and of it since its beginning */
    uint32_t ramp_samples;          /* of the way to rest, still to come */
    /* Gain, in 1/2^40: now, at the end of its ramp, and the change for each sample of the ramp. */
    uint64_t gain_now, gain_to;
    int64_t gain_step;
    uint32_t gain_samples;
    vc_scale gain; /* now */
    /* Power limit. */
    uint32_t block_samples, measured; /* samples of a block, and of it so far */
    uint64_t top, knee, floor;        /* as the mean */
    int32_t highest;                  /* code, within the limit on voltage */
    vc_dac_channel channel[VC_MAX_CHANNELS];
};

/* sinc(0.9 t) times a Kaiser window over |t| < 8, from t = 0 on, in 1/2^23, 256 steps to 1; 0 from 8 on. */
extern const int32_t vc_resampling_kernel[2050];

/* Writes 2 `half` taps of the kernel. They are `step` apart in 1/2^22 of a crossing, with at least 8 crossings on
 * either side. Tap `half` lies `behind`, at most `step`, after the kernel's middle, the later taps farther. Returns
 * their sum. */
uint32_t vc_kernel_taps(int32_t *taps, uint32_t half, uint32_t step, uint32_t behind);

/* Samples of a fade of 5 ms: at least 1. */
uint32_t vc_fade_samples(uint32_t rate_hz);

/* (1 - cos(pi part / whole)) / 2 in 1/2^24; part <= whole < 8192. */
uint32_t vc_raised_cosine(uint32_t part, uint32_t whole);

#endif
