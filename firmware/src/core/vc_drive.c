/* The drive: acceleration to displacement, joints of iterations, the DAC's rate, the actuator's inverse. */
#include "vc_output_memory.h"

#define MAX_RATE_HZ 200000u
#define MAX_DAC_RATE_HZ 1000000u
#define MIN_ACCELERATION_RATE_HZ 100u

enum { FULL_SCALE, ACCELERATION, DISPLACEMENT, UNITS };

/* Fraction bits of a drive sample, and of the acceleration's filters. More would overflow: the magnitudes of the
 * impulse response add up to at most 3.7. */
#define DRIVE_BITS 10
#define INTEGRATOR_BITS 14
/* Fraction bits of the numbers in vc_section. */
#define TANGENT_BITS 29
#define DAMPING_BITS 26
#define GAIN_BITS 30
#define WEIGHT_BITS 24

/* Position in vc_resampling_kernel: fraction bits of its index; and its last entry. */
#define KERNEL_BITS 14
#define PART ((1u << KERNEL_BITS) - 1)
#define CROSSING (256u << KERNEL_BITS)
#define KERNEL_END (2048u << KERNEL_BITS)

uint32_t vc_fade_samples(uint32_t rate_hz)
{
    const uint32_t samples = (rate_hz + 100) / 200;
    return samples > 0 ? samples : 1;
}

uint32_t vc_raised_cosine(uint32_t part, uint32_t whole)
{
    const uint32_t position = (part << 18) / whole; /* half a turn is 512 entries of the table, with 9 fraction bits */
    const int32_t *entry = vc_cosine + (position >> 9);
    const int32_t cosine = entry[0] + (int32_t)(((int64_t)(entry[1] - entry[0]) * (position & 511u)) >> 9);
    return (uint32_t)((1 << 24) - cosine) / 2;
}

/* Butterworth high-pass of fourth order at 20 Hz, and double integration, times (2 pi 20 Hz)^2. Numerov's rule
 * integrates (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, III.10):
 *
 *     y[n+1] - 2 y[n] + y[n-1] = T^2 (x[n+1] + 10 x[n] + x[n-1]) / 12
 *
 * Two of the four zeros of the high-pass cancel the rule's double pole at z = 1. Two sections remain: a high-pass, and
 * a low-pass that a part of its high-pass makes Numerov's: (1, 10, 1) / 12 = (1, 2, 1) / 4 - (1, -2, 1) / 6. */
static void prepare_integrator(vc_drive *drive)
{
    /* 1 / Q of the two pairs of poles: 2 cos(pi / 8) and 2 cos(3 pi / 8), in 1/2^30. */
    static const int32_t damping[2] = {1984016189, 821806413};
    /* theta cot(theta) = 1 - theta^2 / 3 - theta^4 / 45 - ..., in 1/2^30 (Abramowitz and Stegun, 4.3.70). */
    static const int32_t series[8] = {1073741824, -357913941, -23860929, -2272469, -227247, -22954, -2324, -235};
    vc_section *section[2] = {&drive->high_pass, &drive->integrator};
    /* theta = pi 20 Hz / rate in 1/2^40, 0.63 at most; its square and theta cot(theta) in 1/2^30. */
    const int64_t theta = (69084353047153 + drive->rate_hz / 2) / drive->rate_hz;
    const int64_t square = ((theta >> 10) * (theta >> 10)) >> 30;
    int64_t ratio = 0, tangent, tangent_square, weight;
    int i;
    for (i = 7; i >= 0; i--)
        ratio = series[i] + ((ratio * square) >> 30);
    tangent = (theta << 19) / ratio;
    tangent_square = (tangent * tangent) >> 28;
    weight = (ratio * ratio) >> (60 - WEIGHT_BITS);
    for (i = 0; i < 2; i++) {
        const int64_t divisor = ((int64_t)1 << 30) + ((tangent * damping[i]) >> 29) + tangent_square;
        section[i]->tangent = (int32_t)tangent;
        section[i]->damping = (int32_t)(((tangent << 1) + damping[i]) >> (30 - DAMPING_BITS));
        section[i]->gain = (int32_t)(((int64_t)1 << 60) / divisor);
    }
    drive->high_pass.weight[0] = 1 << WEIGHT_BITS;
    drive->integrator.weight[0] = (int32_t)-((tangent_square * weight * 2 / 3) >> 30);
    drive->integrator.weight[2] = (int32_t)weight;
}

/* One sample through a section. None of its numbers overflows: see vc_section. */
static int32_t filtered(const vc_section *section, vc_section_state *state, int32_t sample)
{
    const int32_t below = (sample >> section->shift) - (int32_t)(state->low >> TANGENT_BITS);
    const int64_t damping = (int64_t)(int32_t)(state->band >> TANGENT_BITS) * section->damping;
    const int32_t high =
        (int32_t)(((int64_t)(below - (int32_t)(damping >> DAMPING_BITS)) * section->gain) >> GAIN_BITS);
    const int64_t band_step = (int64_t)section->tangent * high, band_sum = state->band + band_step;
    const int32_t band = (int32_t)(band_sum >> TANGENT_BITS);
    const int64_t low_step = (int64_t)section->tangent * band, low_sum = state->low + low_step;
    const int32_t low = (int32_t)(low_sum >> TANGENT_BITS);
    const int64_t sum = (int64_t)section->weight[0] * high + (int64_t)section->weight[1] * band +
                        (int64_t)section->weight[2] * low + (int64_t)section->weight[3] * state->last_band;
    state->band = band_sum + band_step;
    state->low = low_sum + low_step;
    state->last_band = band;
    return vc_limited((sum + (1 << (WEIGHT_BITS - 1))) >> WEIGHT_BITS);
}

static int32_t displacement(vc_drive *drive, vc_drive_channel *channel, int32_t decoded)
{
    const int32_t high = filtered(&drive->high_pass, &channel->high_pass, decoded * (1 << INTEGRATOR_BITS));
    const int32_t low = filtered(&drive->integrator, &channel->integrator, high);
    return (low + (1 << (INTEGRATOR_BITS - DRIVE_BITS - 1))) >> (INTEGRATOR_BITS - DRIVE_BITS);
}

/* Keeps the output steady if a recording that does not close on itself begins again. If the next iteration begins
 * farther from the last value than the largest step within the recording, it fades in from that value: fully from twice
 * that step on, less below. So no step is larger than those within. */
static int32_t joined(const vc_drive *drive, vc_drive_channel *channel, int32_t sample)
{
    const int32_t step = sample > channel->before ? sample - channel->before : channel->before - sample;
    if (drive->joining) {
        const int32_t jump = sample > channel->last ? sample - channel->last : channel->last - sample;
        const int32_t beyond = jump - channel->largest_step;
        channel->held = channel->last;
        channel->held_share = beyond <= 0 ? 0
                              : beyond >= channel->largest_step
                                  ? 1 << 16
                                  : (int32_t)(((int64_t)beyond << 16) / channel->largest_step);
    }
    if (drive->unmeasured == 0 && step > channel->largest_step)
        channel->largest_step = step;
    channel->before = channel->last = sample;
    if (drive->fade_at < drive->fade_samples) {
        const uint32_t fall = (1u << 24) - vc_raised_cosine(drive->fade_at + 1, drive->fade_samples);
        const int64_t share = ((int64_t)fall * channel->held_share) >> 16;
        channel->last += (int32_t)((share * ((int64_t)channel->held - sample)) >> 24);
    }
    return channel->last;
}

/* Moves one sample of all channels (or, for NULL, the last one again) into the resampler's history. */
static void take(vc_drive *drive, const int16_t *decoded)
{
    uint32_t i;
    if (decoded && drive->joining) {
        drive->fade_at = 0;
        drive->unmeasured = 1;
    }
    if (drive->taps > 0)
        drive->newest = (drive->newest > 0 ? drive->newest : drive->taps) - 1;
    for (i = 0; i < drive->channels; i++) {
        vc_drive_channel *channel = &drive->channel[i];
        if (decoded)
            joined(drive, channel,
                   drive->integrates ? displacement(drive, channel, decoded[i]) : decoded[i] * (1 << DRIVE_BITS));
        if (drive->taps > 0) {
            int32_t *history = drive->values + drive->taps * (1 + 2 * i);
            history[drive->newest] = history[drive->newest + drive->taps] = channel->last;
        }
    }
    if (decoded) {
        drive->joining = 0;
        drive->unmeasured -= drive->unmeasured > 0;
        drive->fade_at += drive->fade_at < drive->fade_samples;
    }
}

/* The kernel between two entries of its table. */
static int32_t between(uint32_t index, int32_t part)
{
    const int32_t *entry = vc_resampling_kernel + index;
    return entry[0] + (((entry[1] - entry[0]) * part) >> KERNEL_BITS);
}

/* Writes the kernel at `count` positions, `step` apart, into every `direction`-th tap from `at` on; returns their sum.
 * The last position may lie after the kernel's end, where it is 0. */
static uint32_t fill(int32_t *taps, uint32_t at, uint32_t direction, uint32_t count, uint32_t position, uint32_t step)
{
    const int32_t part = (int32_t)(position & PART);
    uint32_t sum = 0, index = position >> KERNEL_BITS;
    if (step == CROSSING) /* the DAC's rate is higher: all positions are equally far between two entries */
        for (; count > 0; count--, index += CROSSING >> KERNEL_BITS, at += direction)
            sum += (uint32_t)(taps[at] = between(index, part));
    for (; count > 0; count--, position += step, at += direction) {
        taps[at] = position > KERNEL_END ? 0 : between(position >> KERNEL_BITS, (int32_t)(position & PART));
        sum += (uint32_t)taps[at];
    }
    return sum;
}

uint32_t vc_kernel_taps(int32_t *taps, uint32_t half, uint32_t step, uint32_t behind)
{
    return fill(taps, half, 1, half, behind, step) + fill(taps, half - 1, UINT32_MAX, half, step - behind, step);
}

/* Writes the taps for the present phase; returns their sum. */
static uint32_t make_taps(vc_drive *drive)
{
    const uint32_t behind = (uint32_t)((drive->phase * drive->phase_step) >> (52 - 22));
    return vc_kernel_taps(drive->values, drive->delay_samples, drive->tap_step, behind);
}

/* 2^(31 + sum_shift) / sum, from the value at phase 0. The sums differ by at most 1/1000, and a step of Newton's method
 * squares that error. */
static uint32_t reciprocal(const vc_drive *drive, uint32_t sum)
{
    const int64_t missing = ((int64_t)1 << (31 + drive->sum_shift)) - (int64_t)sum * drive->reciprocal;
    return drive->reciprocal + (uint32_t)((drive->reciprocal * (missing >> drive->sum_shift)) >> 31);
}

static int64_t dot_product(const int32_t *taps, const int32_t *history, uint32_t count)
{
    int64_t sum = 0;
    for (; count > 0; count--)
        sum += (int64_t)*taps++ * *history++;
    return sum;
}

/* Writes one drive sample of all channels. */
static void give(vc_drive *drive, int32_t *made)
{
    const uint32_t taps = drive->taps, scale = taps > 0 ? reciprocal(drive, make_taps(drive)) : 0;
    const int32_t *history = drive->values + taps + drive->newest;
    uint32_t i;
    for (i = 0; i < drive->channels; i++, history += 2 * taps) {
        vc_drive_channel *channel = &drive->channel[i];
        int32_t value = channel->last;
        if (taps > 0)
            value =
                (int32_t)(((dot_product(drive->values, history, taps) >> drive->sum_shift) * scale + (1 << 30)) >> 31);
        made[i] = drive->compensation ? filtered(drive->compensation, &channel->compensation, value) : value;
    }
    drive->wait = drive->whole_step;
    drive->phase += drive->part_step;
    if (drive->phase >= drive->dac_rate_hz) {
        drive->phase -= drive->dac_rate_hz;
        drive->wait++;
    }
}

/* Takes decoded samples, as vc_drive_push() does; for NULL, holds the last one `samples` times. */
static uint32_t run(vc_drive *drive, const int16_t *decoded, uint32_t samples, int32_t *made_drive, uint32_t capacity,
                    uint32_t *made)
{
    uint32_t taken = 0, count = 0;
    for (;;) {
        if (drive->wait == 0) {
            if (count == capacity)
                break;
            give(drive, made_drive + (size_t)count++ * drive->channels);
        } else {
            if (taken == samples)
                break;
            take(drive, decoded ? decoded + (size_t)taken * drive->channels : NULL);
            taken++;
            drive->wait--;
        }
    }
    *made = count;
    return taken;
}

static uint32_t delay_samples(uint32_t rate_hz, uint32_t dac_rate_hz)
{
    const uint32_t half = VC_RESAMPLER_TAPS / 2;
    return rate_hz == dac_rate_hz ? 0 : rate_hz < dac_rate_hz ? half : (half * rate_hz + dac_rate_hz - 1) / dac_rate_hz;
}

/* Whether a filter comes to rest without input: 1 / Q is positive, and the gain belongs to it. */
static int is_stable(const vc_section *section)
{
    int64_t divisor, gain, weights = 0;
    uint32_t i;
    if (section->tangent <= 0 || section->damping <= section->tangent >> (TANGENT_BITS - DAMPING_BITS))
        return 0;
    divisor = ((int64_t)1 << DAMPING_BITS) + (((int64_t)section->tangent * section->damping) >> TANGENT_BITS);
    gain = ((int64_t)1 << (DAMPING_BITS + GAIN_BITS)) / divisor;
    for (i = 0; i < 4; i++)
        weights += section->weight[i] < 0 ? -(int64_t)section->weight[i] : section->weight[i];
    return section->gain >= gain - (gain >> 10) && section->gain <= gain + (gain >> 10) &&
           weights < (int64_t)128 << WEIGHT_BITS && section->shift < 32;
}

int vc_actuator_is_usable(const vc_actuator *actuator)
{
    const unsigned bits = actuator->dac_bits;
    const uint32_t infinite = 0x7F800000u; /* numbers from 0 to it, by the bits of their float32, keep their order */
    return actuator->name[sizeof actuator->name - 1] == 0 && actuator->stroke_um > 0 &&
           actuator->stroke_um < infinite && actuator->volts > 0 && actuator->volts < infinite &&
           actuator->lower_hz < actuator->upper_hz && actuator->upper_hz < infinite &&
           actuator->slew_volts_per_second < infinite && actuator->dac_rate_hz > 0 &&
           actuator->dac_rate_hz <= MAX_DAC_RATE_HZ && bits >= 2 && bits <= 16 &&
           actuator->codes_per_um_mantissa >> 30 == 1 && actuator->code_limit >= 0 &&
           actuator->code_limit < 1 << (bits - 1) && actuator->code_step_limit > 0 && actuator->power_limit > 0 &&
           is_stable(&actuator->compensation);
}

size_t vc_drive_size(const vc_actuator *actuator, const vc_output_stream *stream)
{
    const uint32_t rate_hz = stream->rate_hz, dac_rate_hz = actuator->dac_rate_hz;
    uint32_t i;
    if (!vc_actuator_is_usable(actuator) || rate_hz == 0 || rate_hz > MAX_RATE_HZ ||
        rate_hz > VC_RESAMPLER_MAX_RATIO * dac_rate_hz || stream->unit >= UNITS ||
        (stream->unit == ACCELERATION && rate_hz < MIN_ACCELERATION_RATE_HZ) || stream->channels == 0 ||
        stream->channels > VC_MAX_CHANNELS)
        return 0;
    for (i = 0; i < stream->channels; i++)
        if (stream->gain[i] == 0 || stream->gain[i] >= 0x7F80)
            return 0;
    return sizeof(vc_drive) +
           (size_t)2 * delay_samples(rate_hz, dac_rate_hz) * (1u + 2u * stream->channels) * sizeof(int32_t);
}

int vc_drive_init(vc_drive *drive, const vc_actuator *actuator, const vc_output_stream *stream, int compensation,
                  uint32_t decoder_delay_samples)
{
    const size_t size = vc_drive_size(actuator, stream);
    uint32_t sum;
    if (size == 0)
        return VC_BAD_CONFIGURATION;
    memset(drive, 0, size);
    drive->channels = stream->channels;
    drive->rate_hz = stream->rate_hz;
    drive->dac_rate_hz = actuator->dac_rate_hz;
    drive->integrates = stream->unit == ACCELERATION;
    if (drive->integrates)
        prepare_integrator(drive);
    drive->compensation = compensation ? &actuator->compensation : NULL;
    drive->unmeasured = decoder_delay_samples < UINT32_MAX ? decoder_delay_samples + 1 : UINT32_MAX;
    drive->fade_samples = drive->fade_at = vc_fade_samples(stream->rate_hz);
    drive->wait = 1;
    drive->whole_step = stream->rate_hz / actuator->dac_rate_hz;
    drive->part_step = stream->rate_hz % actuator->dac_rate_hz;
    drive->delay_samples = drive->held_samples = delay_samples(drive->rate_hz, drive->dac_rate_hz);
    drive->taps = 2 * drive->delay_samples;
    if (drive->taps > 0) {
        const uint32_t higher_hz = drive->rate_hz > drive->dac_rate_hz ? drive->rate_hz : drive->dac_rate_hz;
        drive->phase_step = ((uint64_t)1 << 52) / higher_hz;
        drive->tap_step = (uint32_t)((((uint64_t)drive->dac_rate_hz << 23) / higher_hz + 1) / 2);
        sum = make_taps(drive);
        drive->sum_shift = vc_floor_log2(sum) - 2;
        drive->reciprocal = (uint32_t)(((uint64_t)1 << (31 + drive->sum_shift)) / sum);
    }
    return VC_OK;
}

uint32_t vc_drive_push(vc_drive *drive, const int16_t *decoded, uint32_t samples, int32_t *made_drive,
                       uint32_t capacity, uint32_t *made)
{
    return run(drive, decoded, samples, made_drive, capacity, made);
}

void vc_drive_join(vc_drive *drive)
{
    drive->joining = 1;
}

uint32_t vc_drive_finish(vc_drive *drive, int32_t *made_drive, uint32_t capacity)
{
    uint32_t made;
    drive->held_samples -= run(drive, NULL, drive->held_samples, made_drive, capacity, &made);
    return made;
}

uint32_t vc_drive_delay_samples(const vc_drive *drive)
{
    return drive->delay_samples;
}

uint32_t vc_drive_samples(const vc_drive *drive, uint32_t decoded_samples)
{
    const uint64_t until = ((uint64_t)decoded_samples + drive->delay_samples) * drive->dac_rate_hz;
    return (uint32_t)((until + drive->rate_hz - 1) / drive->rate_hz);
}
