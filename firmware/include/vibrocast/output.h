/* The way from decoded samples to DAC codes: unit, joints of iterations, rate, compensation; then gain, fades, limits.
 *
 * Integers only, so that every controller and the host that checks it put out the same codes, to the last bit, however
 * the samples are cut into pieces. Portable C99, no allocation, no global state: everything lives in memory that the
 * caller owns, and nothing that is decoded can make it overflow.
 *
 *     decoded int16 -> vc_drive (at the stream's rate, then at the DAC's) -> drive int32 -> vc_dac -> codes int16
 *
 * A drive sample is an int32_t in 1/1024 of a decoded sample's least significant bit: full scale is 2^25, and it is
 * held within +-2^30. An acceleration has become the displacement that belongs to it at 20 Hz, its high-pass: full
 * scale is then gain / (2 pi 20 Hz)^2. All of vc_drive is linear in the signal, and the physical scale comes last, in
 * vc_dac: so neither a weak signal nor a strong gain loses precision.
 *
 * - Samples of several channels are interleaved. Numbers of samples are per channel.
 * - A vc_drive or vc_dac needs no clearing and nothing to close, and no pointer in it leads into itself.
 * - Call one of them from one thread or interrupt at a time; different ones need no lock.
 * - Any decoded samples are safe. Of a vc_actuator, vc_actuator_is_usable() checks all but its compensation's ringing.
 * - `actuator` must stay valid; other pointers are used during the call only.
 */
#ifndef VIBROCAST_OUTPUT_H
#define VIBROCAST_OUTPUT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

/* Highest rate of a stream, in rates of the DAC. */
#define VC_RESAMPLER_MAX_RATIO 128

/* cffi: begin */
typedef struct vc_drive vc_drive;
typedef struct vc_dac vc_dac;

/* A second-order filter as a state variable filter (Zavalishin, The Art of VA Filter Design, 3.10 and 4.4). It adds its
 * weighted high-pass, band-pass s / (s^2 + s / Q + 1) and low-pass, by the bilinear transform.
 * Its input is below twice full scale, 2^26, and is scaled down by 2^shift, so that all numbers stay below 2^31. For
 * high-pass / gain, band-pass and low-pass, the magnitudes of the impulse response add up to at most 12 * 2^shift.
 */
typedef struct {
    int32_t tangent;   /* g = tan(pi corner / rate), in 1/2^29: below 4 */
    int32_t damping;   /* 1 / Q + g, in 1/2^26: below 32 */
    int32_t gain;      /* 1 / (1 + g / Q + g^2), in 1/2^30 */
    int32_t weight[4]; /* of high-pass, band-pass, low-pass and the band-pass one sample before, times 2^shift, in
                          1/2^24: their magnitudes are below 128 in all */
    uint8_t shift;     /* below 32 */
} vc_section;

/* An actuator with its amplifier and DAC: only constants, which a board keeps in flash. `vibrocast actuator FILE --c`
 * writes them. */
typedef struct vc_actuator {
    /* The description in HelloResponse; physical values are the bits of a float32. The name ends with a zero byte. */
    char name[32];
    uint32_t stroke_um, volts, lower_hz, upper_hz, slew_volts_per_second;
    uint32_t dac_rate_hz; /* 1 to 1 000 000 */
    uint8_t dac_bits;     /* 2 to 16: codes reach from -2^(dac_bits - 1) to 2^(dac_bits - 1) - 1 */
    /* DAC codes for a displacement of 1 um: mantissa * 2^exponent, mantissa from 2^30 to below 2^31. */
    int16_t codes_per_um_exponent;
    uint32_t codes_per_um_mantissa;
    /* The highest code (the lowest is its negative, one more at full DAC scale), and the largest difference of two
     * codes in sequence, at least 1: limits on voltage and slew. */
    int32_t code_limit, code_step_limit;
    /* Limit on the mean of the squared drive over any second, in 1/2^30 of full drive; at least 1. Below an eighth it
     * lowers the highest code as well, and more where the slew limit is slow. */
    uint32_t power_limit;
    vc_section compensation; /* inverse of the response, at the DAC's rate */
} vc_actuator;

/* The output's view of a stream; device_protocol/coded_stream.py. */
typedef struct {
    uint32_t rate_hz;
    uint8_t unit;      /* 0: full scale, 1: m/s^2, 2: um; 3, um over position, is rendered to 2 by profile.h */
    uint8_t channels;  /* 1 to 16 */
    uint16_t gain[16]; /* upper half of the float32 physical value of full scale of each channel: positive, finite */
} vc_output_stream;

/* DAC samples of all channels that each limit changed; they stay at 2^32 - 1. */
typedef struct {
    uint32_t compensation_clipped, voltage_limited, slew_limited, power_limited;
} vc_limit_counts;

/* Returns whether the constants are as vc_actuator and vc_section say, and the compensation is stable, as far as that
 * can be seen: all but the sums of impulse responses. */
int vc_actuator_is_usable(const vc_actuator *actuator);

/* Returns the bytes of memory, aligned for int64_t, of the drive of a stream: more for a rate far above the DAC's.
 * Returns 0 for a stream that cannot be driven:
 * - a rate of 0, above 200 000 Hz or above 128 times the DAC's; an acceleration below 100 Hz;
 * - an unknown unit, a number of channels outside 1 to VC_MAX_CHANNELS, an invalid gain;
 * - an actuator that vc_actuator_is_usable() rejects. */
size_t vc_drive_size(const vc_actuator *actuator, const vc_output_stream *stream);

/* Prepares a drive at rest. `drive`: vc_drive_size() bytes, which the caller owns. `compensation`: whether to apply the
 * inverse of the actuator's response. `decoder_delay_samples`: decoded samples before the recording begins. Returns
 * VC_OK, or VC_BAD_CONFIGURATION where vc_drive_size() is 0. */
int vc_drive_init(vc_drive *drive, const vc_actuator *actuator, const vc_output_stream *stream, int compensation,
                  uint32_t decoder_delay_samples);

/* Takes decoded samples and writes the drive samples that they complete, at most `capacity`, 1 or more. Returns how
 * many decoded samples it took; `made`: how many drive samples it wrote. If that is `capacity` there may be more: call
 * again with the remaining decoded samples, if any. */
uint32_t vc_drive_push(vc_drive *drive, const int16_t *decoded, uint32_t samples, int32_t *made_drive,
                       uint32_t capacity, uint32_t *made);

/* States that the next decoded sample begins another iteration. A jump larger than any step within the recording is
 * smoothed within 5 ms. */
void vc_drive_join(vc_drive *drive);

/* After the last push: writes the samples left in the resampler, at most `capacity`, 1 or more. Returns how many; 0: no
 * more. The last value is held, so that nothing jumps at the end. */
uint32_t vc_drive_finish(vc_drive *drive, int32_t *made_drive, uint32_t capacity);

/* Return the decoded samples by which the resampler lags; and the number of drive samples before the one of a decoded
 * sample. */
uint32_t vc_drive_delay_samples(const vc_drive *drive);
uint32_t vc_drive_samples(const vc_drive *drive, uint32_t decoded_samples);

/* Returns the bytes of memory, aligned for int64_t, of a vc_dac. */
size_t vc_dac_size(void);

/* Prepares a DAC at rest: `hold_samples` at rest come first, then the drive fades in within 5 ms. `stream`: one that
 * vc_drive_size() takes. `gain_float_bits`: the bits of a float32 factor, any bits; below 0 it acts as 0, above 65 536
 * as 65 536. `compensation`: if not 0, a code beyond the voltage limit counts as clipped compensation. */
void vc_dac_init(vc_dac *dac, const vc_actuator *actuator, const vc_output_stream *stream, uint32_t gain_float_bits,
                 int compensation, uint32_t hold_samples);

/* Turns drive samples into as many codes, without delay: gain, fade, then the limits on voltage, mean power and slew,
 * which nothing overrides. */
void vc_dac_play(vc_dac *dac, const int32_t *drive, uint32_t samples, int16_t *codes);

/* Moves to another gain, as for vc_dac_init(), along a ramp of 20 ms. */
void vc_dac_set_gain(vc_dac *dac, uint32_t gain_float_bits);

/* Begins the ramp from the last codes to rest, within 5 ms or as the slew limit allows. vc_dac_ramp() writes it, at
 * most `capacity` samples, and returns how many; 0: the output is at rest. vc_dac_play() after it fades in. */
void vc_dac_begin_ramp(vc_dac *dac);
uint32_t vc_dac_ramp(vc_dac *dac, int16_t *codes, uint32_t capacity);

/* Returns whether the last code was 0 in all channels. */
int vc_dac_at_rest(const vc_dac *dac);

/* Returns the DAC samples at rest until the power limit has recovered. Then another stream begins as if none had been
 * before. */
uint32_t vc_dac_recovery_samples(const vc_dac *dac);

/* Returns the counts since vc_dac_init(). They lie in `dac`, and go on with it. */
const vc_limit_counts *vc_dac_counts(const vc_dac *dac);
/* cffi: end */

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
