/* A surface's height profile, rendered by the position of the hand: the height under it at every DAC sample.
 *
 *     decoded int16 -> vc_profile (loaded once) ; positions of the hand -> heights int16 at the DAC's rate -> vc_drive
 *
 * Integers only, so that every controller and the host that checks it render the same heights, to the last bit.
 * Portable C99, no allocation, no global state. No profile and no position can make it overflow.
 *
 * Octaves. The profile is copied with half, a quarter, ... of its samples, each copy band-limited. The output blends
 * two of them: those whose band, at the hand's present speed, ends below half the DAC's rate. So nothing is aliased at
 * any speed. From rest to 300 mm/s, everything below 0.15 of the DAC's rate is rendered (450 Hz at 3 kHz), as far as
 * the profile holds it: up to 0.34 of its own rate.
 *
 * The hand's way. Positions come with their times, at any intervals and with gaps. The way between them is a straight
 * line in time. Two first-order low-passes of VC_HAND_SMOOTHING_US follow, the critically damped form of a second-order
 * one. Position and speed are continuous at the DAC's rate. A hand at rest leaves the output at rest, to the last bit.
 * Late positions are caught up with at 600 mm/s at most. From 300 mm/s to there the output fades to 0. After a jump of
 * the position it fades out and, at the new place, in: 20 ms each.
 *
 * The ends. The profile repeats in both directions, as it is. Its period is a multiple of vc_profile_least_samples();
 * samples beyond it are left out. A profile shorter than the interpolator's reach repeats too.
 *
 * - Samples of several channels, all under the one hand, are interleaved. Numbers of samples are per channel.
 * - A vc_profile belongs to the caller, and has nothing to close. Pointers are used during the call only.
 * - Call a profile from one thread or interrupt at a time; different ones need no lock.
 * - Any samples and positions are safe. The arguments of vc_profile_init() are not checked.
 */
#ifndef VIBROCAST_PROFILE_H
#define VIBROCAST_PROFILE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

/* Bytes, at compile time, that hold a profile of this many samples, all channels together. */
#define VC_PROFILE_STATE_BYTES 1232
#define VC_PROFILE_END_SAMPLES 128 /* per channel: they continue the ends of the octaves */
#define VC_PROFILE_MEMORY(samples, channels)                                                                           \
    (VC_PROFILE_STATE_BYTES + (2 * (size_t)(samples) + VC_PROFILE_END_SAMPLES * (channels)) * sizeof(int16_t))

/* cffi: begin */
typedef struct vc_profile vc_profile;

/* Time constant of each of the two low-passes: a hand at constant speed is followed twice as late. */
#define VC_HAND_SMOOTHING_US 4000
/* Delay between the time of a host's position and its rendering, so that the next one has arrived by then. */
#define VC_HAND_DELAY_US 20000

/* Returns the least samples that a profile must have to be rendered at up to 300 mm/s: a power of two, at most 128.
 * Returns 0 for a DAC rate below 1000 Hz, and for samples per metre of 0 or above 200 000. */
uint32_t vc_profile_least_samples(uint32_t samples_per_metre, uint32_t dac_rate_hz);

/* Returns the bytes of memory, aligned for int64_t, of a profile of at most 2^20 samples in 1 to VC_MAX_CHANNELS
 * channels (config.h). */
size_t vc_profile_size(uint32_t samples, uint32_t channels);

/* Prepares an empty profile. `profile`: vc_profile_size() bytes; `samples`: at least vc_profile_least_samples(), which
 * is not 0. */
void vc_profile_init(vc_profile *profile, uint32_t samples_per_metre, uint32_t samples, uint32_t channels,
                     uint32_t dac_rate_hz);

/* Takes the next decoded samples; any beyond `samples` are ignored. With the last it begins to make the octaves, 256
 * heights a call, of about 60 multiplications each. Returns nonzero as long as it is making them: call it again, with
 * no samples. */
int vc_profile_load(vc_profile *profile, const int16_t *decoded, uint32_t samples);

/* States that the output is at rest: rendering fades in at the place where the hand then is. */
void vc_profile_begin(vc_profile *profile);

/* Takes the position of the hand at a time, in nanometres from any origin. A position not later than the last, or
 * farther than 2^40 nm (1.1 km) from the origin, is dropped. The last 64 positions are kept. Returns nonzero for one
 * that came too late: the hand has moved since the position before, and was rendered at rest. */
int vc_profile_position(vc_profile *profile, uint64_t time_us, int64_t position_nm);
/* Returns the time of the last position; 0 without one. */
uint64_t vc_profile_newest_us(const vc_profile *profile);

/* Writes one sample of each channel: the heights under the smoothed hand at this time, a DAC sample after the last one.
 * Without a position they are 0. All samples must have been loaded, and the octaves made. */
void vc_profile_render(vc_profile *profile, uint64_t time_us, int16_t *heights);
/* cffi: end */

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
