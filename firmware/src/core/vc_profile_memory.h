/* The state of a profile, for a caller that reserves its memory at compile time; only vc_profile.c uses it. */
#ifndef VIBROCAST_PROFILE_MEMORY_H
#define VIBROCAST_PROFILE_MEMORY_H

#include "vc_output_memory.h"
#include "vibrocast/profile.h"

#define VC_PROFILE_OCTAVES 8
#define VC_KEPT_POSITIONS 64 /* a power of two */

#define VC_OCTAVE_FILTER_TAPS 43 /* the middle one, and those on one side of it */
extern const int32_t vc_octave_filter[VC_OCTAVE_FILTER_TAPS];

/* Places are in 1/2^32 of a sample of the profile. */
typedef struct {
    uint64_t time_us;
    int64_t place;
} vc_hand_position;

struct vc_profile {
    uint32_t samples_per_metre, samples, channels;
    uint32_t loaded;
    uint32_t octave, made;              /* the octave that is being made, and its samples so far */
    uint32_t octaves, period;           /* samples after which the profile repeats */
    uint32_t first[VC_PROFILE_OCTAVES]; /* of each octave, in samples from the first */
    /* The path of the hand. */
    vc_hand_position hand[VC_KEPT_POSITIONS]; /* by number modulo VC_KEPT_POSITIONS */
    uint64_t positions, behind;               /* positions received; number of the last one before now */
    uint64_t rendered_us;                     /* time up to which the path has been followed */
    uint64_t sloped;                          /* `slope` leads from `behind` on where this is one more */
    int64_t slope;                            /* place per microsecond */
    /* The low-passes: places of both, less `origin`, a multiple of the period, so that `place` lies within it. */
    int64_t origin, between, place;
    uint32_t share;           /* part of its distance that each moves in a DAC sample, in 1/2^22 */
    int64_t furthest;         /* distance beyond which it moves no faster */
    int64_t fastest;          /* place per DAC sample at 600 mm/s */
    int anchored;             /* `place` follows the hand; otherwise it is the hand's, and `level` is 0 */
    int32_t level, most_rise; /* fade, in 1/2^16, and its largest change in a DAC sample */
    int16_t heights[];
};

/* The constants of vibrocast/profile.h have room for it. */
typedef char vc_profile_memory_fits[sizeof(struct vc_profile) <= VC_PROFILE_STATE_BYTES &&
                                            VC_PROFILE_OCTAVES * VC_RESAMPLER_TAPS <= VC_PROFILE_END_SAMPLES
                                        ? 1
                                        : -1];

#endif
