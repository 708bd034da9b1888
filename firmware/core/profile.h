/* A surface's height profile, rendered by the position of the hand: what is under it at every DAC sample.
 *
 *     decoded int16 -> vc_profile (loaded once) ; positions of the hand -> heights int16 at the DAC's rate -> vc_drive
 *
 * Integers only, so that every controller and the host that checks it render the same heights, to the last bit.
 * Portable C99, no allocation, no global state; nothing that is loaded and no position can make it overflow.
 *
 * Octaves. From the profile, copies are made of half, a quarter, ... of its samples, each band-limited. What is
 * rendered is blended from the two whose band, at the hand's present speed, ends below half the DAC's rate: so nothing
 * is aliased at any speed, and from rest to 300 mm/s all that a surface gives below 0.15 of the DAC's rate is rendered
 * (450 Hz at 3 kHz), as far as the profile has it: up to 0.34 of its own rate.
 *
 * The hand's way. Positions come with their times, at any intervals and with gaps. The way between them is a straight
 * line in time, followed by two first-order low-passes of VC_HAND_SMOOTHING_US each, the critically damped form of a
 * second-order one: position and speed are continuous at the DAC's rate, and a hand at rest leaves the output at rest,
 * to the last bit. What comes late is caught up with no faster than at 600 mm/s. From 300 mm/s to there the output
 * fades to 0; at 0, which a jump of the position leads to, it goes on at the new place and fades in, 20 ms each.
 *
 * The ends. The profile repeats in both directions: a sixteenth of it (at most 4096 samples, and what makes the period
 * a multiple of the coarsest octave's step) is crossfaded from its end to its beginning. So does one that is shorter
 * than what the interpolator reaches.
 *
 * Samples of several channels, all under the one hand, are interleaved. Numbers of samples are per channel.
 */
#ifndef VIBROCAST_PROFILE_H
#define VIBROCAST_PROFILE_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_profile vc_profile;

/* Time constant of each of the two low-passes: a hand at constant speed is followed twice as late. */
#define VC_HAND_SMOOTHING_US 4000
/* By how much later than they were taken positions from a host are rendered, so that the next one has come by then. */
#define VC_HAND_DELAY_US 20000

/* The least samples that a profile must have to be rendered at up to 300 mm/s; 0 where none can be: a DAC rate below
 * 1000 Hz, or samples per metre that are 0 or more than 200 000. */
uint32_t vc_profile_least_samples(uint32_t samples_per_metre, uint32_t dac_rate_hz);

/* Bytes of memory, aligned for int64_t, for a profile of at most 2^20 samples in 1 to 16 channels. */
size_t vc_profile_size(uint32_t samples, uint32_t channels);

/* Prepares an empty profile. `profile`: vc_profile_size() bytes; `samples`: at least vc_profile_least_samples(). */
void vc_profile_init(vc_profile *profile, uint32_t samples_per_metre, uint32_t samples, uint32_t channels,
                     uint32_t dac_rate_hz);

/* Takes the next decoded samples; what is beyond `samples` is left out. After the last of them makes the octaves, which
 * takes as long as some 60 multiplications for each. */
void vc_profile_load(vc_profile *profile, const int16_t *decoded, uint32_t samples);

/* States that the output is at rest: rendering fades in at the place where the hand then is. */
void vc_profile_begin(vc_profile *profile);

/* Takes where the hand was at a time, in nanometres from any origin. One that is not later than the last, or farther
 * than 2^40 nm (1.1 km) from the origin, is dropped; of those ahead of what is rendered the last 64 are kept. Returns
 * nonzero where it came too late: the hand moved on after the position before it, and has been rendered as at rest. */
int vc_profile_position(vc_profile *profile, uint64_t time_us, int64_t position_nm);

/* Writes one sample of each channel: the heights under where the smoothed hand is at this time, a DAC sample after the
 * last one. Without a position they are 0; all samples must have been loaded. */
void vc_profile_render(vc_profile *profile, uint64_t time_us, int16_t *heights);
/* cffi: end */

#endif
