/* The DAC: gain and fades, then limits on voltage, mean power and slew, which nothing overrides. */
#include "vc_output_memory.h"

/* Exponent of a drive of 1 relative to full scale: 10 fraction bits of a decoded sample, whose full scale has 15. */
#define DRIVE_EXPONENT (-25)
/* 1 um / (1 m/s^2 / (2 pi 20 Hz)^2) = 63.3257...: the displacement that belongs to an acceleration, in 1/2^25. */
#define DISPLACEMENT_MANTISSA 2124859229u
#define DISPLACEMENT_EXPONENT (-25)

#define GAIN_BITS 40
#define MAX_GAIN ((uint64_t)65536 << GAIN_BITS)

/* The power limit weights the past by exp(-t / 1 s), in blocks of 10 ms. It reduces the drive within two knees below
 * the limit. Once a block, mean += share (block - mean). The squared factor of the next block is (limit - knee - mean)
 * / knee, from 0 to 1, so the mean stays below limit - knee. The mean starts at its floor limit - 2 knee, and never
 * falls below: from 0 it would allow full drive for most of the first second. Because mean' >= (drive^2 - mean) / 1 s,
 * the mean of drive^2 over any second is at most the rise of `mean` in it (at most a knee) plus its height (at most
 * limit - knee). Drive below the floor stays unchanged. The factor moves linearly within a block, without clicks. */
#define BLOCKS_PER_SECOND 100
#define MEAN_BITS 46
#define LARGEST_KNEE (((uint64_t)1 << MEAN_BITS) / 20)
#define WHOLE_FACTOR (1 << 16)

static vc_scale scale_of(uint64_t mantissa, int32_t exponent)
{
    const uint32_t high = (uint32_t)(mantissa >> 32);
    const unsigned top = high ? 32 + vc_floor_log2(high) : vc_floor_log2((uint32_t)mantissa | 1);
    vc_scale scale = {0, 0};
    if (mantissa) {
        scale.mantissa = (uint32_t)(top > 30 ? mantissa >> (top - 30) : mantissa << (30 - top));
        scale.exponent = exponent + (int32_t)top - 30;
    }
    return scale;
}

/* Codes for a drive of 1: the header's gain times the codes for the unit. */
static vc_scale channel_scale(const vc_actuator *actuator, const vc_output_stream *stream, uint32_t channel)
{
    const uint32_t bits = stream->gain[channel], exponent = bits >> 7;
    const uint32_t mantissa = (bits & 127u) | (exponent > 0 ? 128u : 0);
    vc_scale unit = {1u << 30, actuator->dac_bits - 1 - 30}, scale;
    if (stream->unit > 0) {
        unit.mantissa = actuator->codes_per_um_mantissa;
        unit.exponent = actuator->codes_per_um_exponent;
    }
    if (stream->unit == 1)
        unit = scale_of((uint64_t)unit.mantissa * DISPLACEMENT_MANTISSA, unit.exponent + DISPLACEMENT_EXPONENT);
    scale = scale_of((uint64_t)unit.mantissa * mantissa, unit.exponent);
    /* A float32 of 8 bits' precision is mantissa * 2^(exponent - 134). */
    scale.exponent += (int32_t)(exponent > 0 ? exponent : 1) - 134 + DRIVE_EXPONENT;
    return scale;
}

/* A float32, by its bits, in 1/2^40. */
static uint64_t gain_of(uint32_t float_bits)
{
    const uint32_t exponent = float_bits >> 23;
    const uint64_t mantissa = (float_bits & 0x7FFFFFu) | (exponent > 0 ? 0x800000u : 0);
    const int32_t up = (int32_t)(exponent > 0 ? exponent : 1) - 150 + GAIN_BITS;
    return float_bits >> 31  ? 0
           : exponent >= 143 ? MAX_GAIN /* 65 536 and above */
           : up >= 0         ? mantissa << up
           : up > -25        ? mantissa >> -up
                             : 0;
}

/* The lowest code: at full DAC scale it is one farther from rest than the highest. */
static int32_t lowest_code(const vc_dac *dac, int32_t highest)
{
    return -highest - (highest == (1 << (dac->actuator->dac_bits - 1)) - 1);
}

/* The factor of the power limit follows the drive by a block, and the slew limit holds back the way to rest. The mean
 * stays below limit - knee nevertheless if a code lasts two and a half blocks, and then the way, in less than a knee.
 * So the highest code is limited: for a low limit on power, or a slow one on slew. */
static int32_t highest_code(const vc_dac *dac)
{
    const vc_actuator *actuator = dac->actuator;
    const unsigned bits = MEAN_BITS - 2 * (actuator->dac_bits - 1u);
    uint32_t highest = 0, bit;
    for (bit = 1u << 15; bit > 0; bit >>= 1) {
        const uint64_t code = highest | bit;
        const uint64_t samples =
            (5 * (uint64_t)dac->block_samples + 1) / 2 + code / (uint32_t)actuator->code_step_limit;
        const int64_t lowest = lowest_code(dac, (int32_t)code);
        if (code <= (uint32_t)actuator->code_limit &&
            ((uint64_t)(lowest * lowest) * samples) << bits <= dac->knee * actuator->dac_rate_hz)
            highest = (uint32_t)code;
    }
    return (int32_t)highest;
}

size_t vc_dac_size(void)
{
    return sizeof(vc_dac);
}

void vc_dac_init(vc_dac *dac, const vc_actuator *actuator, const vc_output_stream *stream, uint32_t gain_float_bits,
                 int compensation, uint32_t hold_samples)
{
    const uint64_t limit = (uint64_t)actuator->power_limit << (MEAN_BITS - 30);
    uint32_t i;
    memset(dac, 0, sizeof *dac);
    dac->actuator = actuator;
    dac->channels = stream->channels;
    dac->compensation = compensation;
    dac->hold_samples = hold_samples;
    dac->fade_samples = vc_fade_samples(actuator->dac_rate_hz);
    dac->gain_now = gain_of(gain_float_bits);
    dac->gain = scale_of(dac->gain_now, -GAIN_BITS);
    dac->block_samples = (actuator->dac_rate_hz + BLOCKS_PER_SECOND / 2) / BLOCKS_PER_SECOND;
    if (dac->block_samples == 0)
        dac->block_samples = 1;
    dac->knee = limit / 5 < LARGEST_KNEE ? limit / 5 : LARGEST_KNEE;
    dac->top = limit - dac->knee;
    dac->floor = dac->top - dac->knee;
    dac->highest = highest_code(dac);
    for (i = 0; i < dac->channels; i++) {
        vc_dac_channel *channel = &dac->channel[i];
        channel->scale = channel_scale(actuator, stream, i);
        channel->factor_from = channel->factor_to = WHOLE_FACTOR;
        channel->mean = dac->floor;
    }
}

static void count(uint32_t *counter)
{
    *counter += *counter < UINT32_MAX;
}

/* The mean at the end of this block if the output is at rest from now on; rounded up. */
static uint64_t next_mean(const vc_dac *dac, const vc_dac_channel *channel)
{
    const uint64_t block = channel->energy << (MEAN_BITS - 2 * (dac->actuator->dac_bits - 1));
    const uint64_t before = channel->mean * dac->block_samples, rate_hz = dac->actuator->dac_rate_hz;
    const uint64_t mean = block > before ? channel->mean + (block - before + rate_hz - 1) / rate_hz
                                         : channel->mean - (before - block) / rate_hz;
    return mean > dac->floor ? mean : dac->floor;
}

/* Square root of value / 2^32, in 1/2^16, rounded down. */
static int32_t root(uint32_t value)
{
    uint32_t result = 0, bit;
    for (bit = 1u << 15; bit > 0; bit >>= 1)
        if ((result | bit) * (result | bit) <= value)
            result |= bit;
    return (int32_t)result;
}

static int32_t power_factor(const vc_dac *dac, uint64_t mean)
{
    /* Both parts fit 32 bits without their lowest 12 bits. */
    if (mean <= dac->floor)
        return WHOLE_FACTOR;
    return mean >= dac->top ? 0 : root((uint32_t)((((dac->top - mean) >> 12) << 32) / ((dac->knee >> 12) + 1)));
}

/* Moves towards a code no faster than the slew limit. */
static int16_t within_slew(vc_dac *dac, vc_dac_channel *channel, int32_t code)
{
    const int32_t most = dac->actuator->code_step_limit, change = code - channel->code;
    if (change > most || change < -most) {
        code = channel->code + (change > 0 ? most : -most);
        count(&dac->counts.slew_limited);
    }
    channel->code = code;
    channel->energy += (uint32_t)(code * code);
    return (int16_t)code;
}

/* At the end of a block. */
static void measure(vc_dac *dac)
{
    uint32_t i;
    dac->measured = 0;
    for (i = 0; i < dac->channels; i++) {
        vc_dac_channel *channel = &dac->channel[i];
        channel->mean = next_mean(dac, channel);
        channel->energy = 0;
        channel->factor_from = channel->factor_to;
        channel->factor_to = power_factor(dac, channel->mean);
    }
}

/* Gain and fade of the next sample. */
static vc_scale next_level(vc_dac *dac)
{
    vc_scale level = dac->gain;
    if (dac->gain_samples > 0) {
        dac->gain_samples--;
        dac->gain_now = dac->gain_samples > 0 ? dac->gain_now + (uint64_t)dac->gain_step : dac->gain_to;
        dac->gain = scale_of(dac->gain_now, -GAIN_BITS);
    }
    if (dac->hold_samples > 0) {
        dac->hold_samples--;
        level.mantissa = 0;
    } else if (dac->fade_at < dac->fade_samples) {
        const uint64_t rise = vc_raised_cosine(++dac->fade_at, dac->fade_samples);
        level.mantissa = (uint32_t)((level.mantissa * rise) >> 24);
    }
    return level;
}

/* The code of a drive sample within the limit on voltage. */
static int32_t within_voltage(vc_dac *dac, int32_t drive, vc_scale scale, vc_scale level)
{
    const int32_t highest = dac->highest, lowest = lowest_code(dac, highest);
    const int64_t product = drive * (int64_t)(((uint64_t)scale.mantissa * level.mantissa) >> 31);
    /* Within 62 bits. Beyond these shifts, a drive exceeds every limit or is below every code. */
    const int32_t shift = -31 - scale.exponent - level.exponent;
    const int32_t down = shift < 1 ? 1 : shift > 62 ? 62 : shift;
    const int64_t code = (product + ((int64_t)1 << (down - 1))) >> down;
    if (code >= lowest && code <= highest)
        return (int32_t)code;
    count(dac->compensation ? &dac->counts.compensation_clipped : &dac->counts.voltage_limited);
    return code < lowest ? lowest : highest;
}

static int32_t within_power(vc_dac *dac, const vc_dac_channel *channel, int32_t code)
{
    const int32_t from = channel->factor_from, rise = channel->factor_to - from;
    const int32_t factor = rise == 0 ? from : from + rise * (int32_t)(dac->measured + 1) / (int32_t)dac->block_samples;
    if (factor == WHOLE_FACTOR || code == 0)
        return code;
    count(&dac->counts.power_limited);
    return (code * factor + WHOLE_FACTOR / 2) >> 16;
}

void vc_dac_play(vc_dac *dac, const int32_t *drive, uint32_t samples, int16_t *codes)
{
    uint32_t n, i;
    for (n = 0; n < samples; n++) {
        const vc_scale level = next_level(dac);
        for (i = 0; i < dac->channels; i++) {
            vc_dac_channel *channel = &dac->channel[i];
            const int32_t code = within_voltage(dac, *drive++, channel->scale, level);
            *codes++ = within_slew(dac, channel, within_power(dac, channel, code));
        }
        if (++dac->measured == dac->block_samples)
            measure(dac);
    }
}

void vc_dac_set_gain(vc_dac *dac, uint32_t gain_float_bits)
{
    const uint32_t samples = (dac->actuator->dac_rate_hz + 25) / 50;
    dac->gain_samples = samples > 0 ? samples : 1;
    dac->gain_to = gain_of(gain_float_bits);
    dac->gain_step = (int64_t)(dac->gain_to - dac->gain_now) / dac->gain_samples;
}

void vc_dac_begin_ramp(vc_dac *dac)
{
    uint32_t i;
    dac->ramp_samples = vc_dac_at_rest(dac) ? 0 : dac->fade_samples;
    for (i = 0; i < dac->channels; i++)
        dac->channel[i].ramp_from = dac->channel[i].code;
    dac->hold_samples = 0;
    dac->fade_at = 0;
}

uint32_t vc_dac_ramp(vc_dac *dac, int16_t *codes, uint32_t capacity)
{
    uint32_t made, i;
    for (made = 0; made < capacity && (dac->ramp_samples > 0 || !vc_dac_at_rest(dac)); made++) {
        dac->ramp_samples -= dac->ramp_samples > 0;
        for (i = 0; i < dac->channels; i++) {
            vc_dac_channel *channel = &dac->channel[i];
            const int64_t share = vc_raised_cosine(dac->ramp_samples, dac->fade_samples);
            *codes++ = within_slew(dac, channel, (int32_t)((share * channel->ramp_from + (1 << 23)) >> 24));
        }
        if (++dac->measured == dac->block_samples)
            measure(dac);
    }
    return made;
}

int vc_dac_at_rest(const vc_dac *dac)
{
    uint32_t i;
    for (i = 0; i < dac->channels; i++)
        if (dac->channel[i].code != 0)
            return 0;
    return 1;
}

uint32_t vc_dac_recovery_samples(const vc_dac *dac)
{
    uint32_t i, longest = 0;
    for (i = 0; i < dac->channels; i++) {
        vc_dac_channel channel = dac->channel[i];
        uint32_t samples = 0;
        if (dac->measured > 0) {
            samples = dac->block_samples - dac->measured;
            channel.mean = next_mean(dac, &channel);
        }
        for (channel.energy = 0; channel.mean > dac->floor; samples += dac->block_samples)
            channel.mean = next_mean(dac, &channel);
        if (samples > longest)
            longest = samples;
    }
    return longest;
}

const vc_limit_counts *vc_dac_counts(const vc_dac *dac)
{
    return &dac->counts;
}
