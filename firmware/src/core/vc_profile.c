/* A profile's octaves, the path of the hand over it, and the heights under the hand; see profile.h. */
#include "vibrocast/profile.h"

#include "vc_profile_memory.h"

#define NM_PER_METRE 1000000000
#define US_PER_S 1000000
#define FARTHEST_NM ((int64_t)1 << 40)
#define MAX_SAMPLES_PER_METRE 200000u
#define MIN_DAC_RATE_HZ 1000u
#define FASTEST_MM_PER_S 600u
#define MM_PER_METRE 1000u

#define PLACE_BITS 32
#define WHOLE_PLACE ((int64_t)1 << PLACE_BITS)
#define SHARE_BITS 22
#define LEVEL_BITS 16
#define WHOLE_LEVEL (1 << LEVEL_BITS)
#define FADES_PER_SECOND 50 /* of 20 ms */

/* The kernel of the resampler passes up to 0.7 and stops from 1.13 on, in parts of half the rate of an octave. So
 * content below 2 - 1.13 = 0.87 leaves no images. An octave's band may reach that far, and the filter of the next
 * octave passes that far. */
#define TAPS VC_RESAMPLER_TAPS
#define HALF_TAPS (TAPS / 2)
#define CROSSING_BITS 22
#define BAND_256 223u       /* 0.87 in 1/256 */
#define HEIGHT_BITS 8       /* of interpolated heights */
#define HEIGHTS_A_CALL 256u /* of the octaves */

/* The number of octaves down to the one whose band ends below half the DAC's rate at 600 mm/s. */
static uint32_t octaves_of(uint32_t samples_per_metre, uint32_t dac_rate_hz)
{
    const uint64_t step = (uint64_t)samples_per_metre * FASTEST_MM_PER_S * BAND_256;
    const uint64_t most = (uint64_t)dac_rate_hz * MM_PER_METRE * 256;
    uint32_t octaves = 1;
    while (step > most << (octaves - 1))
        octaves++;
    return octaves;
}

uint32_t vc_profile_least_samples(uint32_t samples_per_metre, uint32_t dac_rate_hz)
{
    if (samples_per_metre == 0 || samples_per_metre > MAX_SAMPLES_PER_METRE || dac_rate_hz < MIN_DAC_RATE_HZ)
        return 0;
    /* A sample of the coarsest octave. */
    return 1u << (octaves_of(samples_per_metre, dac_rate_hz) - 1);
}

size_t vc_profile_size(uint32_t samples, uint32_t channels)
{
    return VC_PROFILE_MEMORY((size_t)samples * channels, channels);
}

void vc_profile_init(vc_profile *profile, uint32_t samples_per_metre, uint32_t samples, uint32_t channels,
                     uint32_t dac_rate_hz)
{
    uint32_t octave;
    memset(profile, 0, sizeof *profile);
    profile->samples_per_metre = samples_per_metre;
    profile->samples = samples;
    profile->channels = channels;
    profile->octaves = octaves_of(samples_per_metre, dac_rate_hz);
    profile->period = samples >> (profile->octaves - 1) << (profile->octaves - 1);
    for (octave = 1; octave < profile->octaves; octave++)
        profile->first[octave] = profile->first[octave - 1] + (profile->period >> (octave - 1)) + TAPS;
    /* A low-pass of 1 / (1 + n) lags a steady motion by n samples. */
    profile->share =
        (uint32_t)(((uint64_t)US_PER_S << SHARE_BITS) / ((uint64_t)dac_rate_hz * VC_HAND_SMOOTHING_US + US_PER_S));
    profile->fastest = (int64_t)(((uint64_t)samples_per_metre * FASTEST_MM_PER_S << PLACE_BITS) /
                                 ((uint64_t)dac_rate_hz * MM_PER_METRE));
    profile->furthest = (profile->fastest << SHARE_BITS) / profile->share;
    profile->most_rise = (int32_t)(((uint32_t)WHOLE_LEVEL * FADES_PER_SECOND + dac_rate_hz - 1) / dac_rate_hz);
}

/* ---- the octaves ---- */

static int16_t limited_sample(int64_t value)
{
    return (int16_t)(value > INT16_MAX ? INT16_MAX : value < INT16_MIN ? INT16_MIN : value);
}

/* Repeats an octave after its end, as far as the interpolator reaches: more than once if that is longer. */
static void continue_end(vc_profile *profile, uint32_t octave)
{
    const size_t count = (size_t)(profile->period >> octave) * profile->channels;
    int16_t *heights = profile->heights + (size_t)profile->first[octave] * profile->channels;
    size_t at;
    for (at = 0; at < (size_t)TAPS * profile->channels; at++)
        heights[count + at] = heights[at];
}

/* Makes the next samples of an octave from the one above it. */
static void decimate(vc_profile *profile, uint32_t octave, uint32_t samples)
{
    const uint32_t channels = profile->channels, length = profile->period >> (octave - 1);
    const int16_t *above = profile->heights + (size_t)profile->first[octave - 1] * channels;
    int16_t *made = profile->heights + (size_t)(profile->first[octave] + profile->made) * channels;
    const uint32_t half = VC_OCTAVE_FILTER_TAPS;
    int64_t whole = vc_octave_filter[0];
    uint32_t at, i, tap;
    for (tap = 1; tap < half; tap++)
        whole += 2 * vc_octave_filter[tap];
    for (at = 2 * profile->made; at < 2 * (profile->made + samples); at += 2)
        for (i = 0; i < channels; i++) {
            uint32_t before = at, behind = at;
            int64_t sum = (int64_t)vc_octave_filter[0] * above[(size_t)at * channels + i];
            for (tap = 1; tap < half; tap++) {
                before = (before > 0 ? before : length) - 1;
                behind = behind + 1 < length ? behind + 1 : 0;
                sum += (int64_t)vc_octave_filter[tap] *
                       (above[(size_t)before * channels + i] + above[(size_t)behind * channels + i]);
            }
            *made++ = limited_sample((sum + (sum < 0 ? -whole : whole) / 2) / whole);
        }
    profile->made += samples;
}

/* Makes the next piece of the octaves. Returns whether more is to be made. */
static int make_octaves(vc_profile *profile)
{
    const uint32_t missing = (profile->period >> profile->octave) - profile->made;
    const uint32_t most = HEIGHTS_A_CALL / profile->channels;
    if (profile->octave > 0)
        decimate(profile, profile->octave, missing < most ? missing : most);
    if (profile->octave == 0 || missing <= most) {
        continue_end(profile, profile->octave++);
        profile->made = 0;
    }
    return profile->octave < profile->octaves;
}

int vc_profile_load(vc_profile *profile, const int16_t *decoded, uint32_t samples)
{
    const uint32_t missing = profile->samples - profile->loaded, channels = profile->channels;
    if (samples > missing)
        samples = missing;
    if (samples > 0)
        memcpy(profile->heights + (size_t)profile->loaded * channels, decoded,
               (size_t)samples * channels * sizeof *decoded);
    profile->loaded += samples;
    return profile->loaded == profile->samples && profile->octave < profile->octaves && make_octaves(profile);
}

/* ---- the path of the hand ---- */

void vc_profile_begin(vc_profile *profile)
{
    profile->anchored = 0;
    profile->level = 0;
}

uint64_t vc_profile_newest_us(const vc_profile *profile)
{
    return profile->positions > 0 ? profile->hand[(profile->positions - 1) % VC_KEPT_POSITIONS].time_us : 0;
}

int vc_profile_position(vc_profile *profile, uint64_t time_us, int64_t position_nm)
{
    const int64_t rate = profile->samples_per_metre;
    vc_hand_position *last = &profile->hand[(profile->positions - 1) % VC_KEPT_POSITIONS];
    vc_hand_position *next = &profile->hand[profile->positions % VC_KEPT_POSITIONS];
    int64_t part;
    if (position_nm > FARTHEST_NM || position_nm < -FARTHEST_NM || (profile->positions > 0 && time_us <= last->time_us))
        return 0;
    part = position_nm % NM_PER_METRE * rate;
    next->time_us = time_us;
    next->place = (position_nm / NM_PER_METRE * rate + part / NM_PER_METRE) * WHOLE_PLACE +
                  part % NM_PER_METRE * WHOLE_PLACE / NM_PER_METRE;
    return profile->positions++ > 0 && profile->rendered_us > last->time_us && next->place != last->place;
}

/* The place of the hand at a time: between the positions before and after it, or at the last one. */
static int64_t place_at(vc_profile *profile, uint64_t time_us)
{
    const vc_hand_position *before, *behind;
    if (profile->positions > profile->behind + VC_KEPT_POSITIONS)
        profile->behind = profile->positions - VC_KEPT_POSITIONS;
    while (profile->behind + 1 < profile->positions &&
           profile->hand[(profile->behind + 1) % VC_KEPT_POSITIONS].time_us <= time_us)
        profile->behind++;
    before = &profile->hand[profile->behind % VC_KEPT_POSITIONS];
    behind = &profile->hand[(profile->behind + 1) % VC_KEPT_POSITIONS];
    if (profile->behind + 1 == profile->positions || time_us <= before->time_us)
        return before->place;
    if (profile->sloped != profile->behind + 1) {
        const uint64_t passed_us = behind->time_us - before->time_us;
        profile->slope = passed_us > INT32_MAX ? 0 : (behind->place - before->place) / (int64_t)passed_us;
        profile->sloped = profile->behind + 1;
    }
    return before->place + profile->slope * (int64_t)(time_us - before->time_us);
}

/* The step of a low-pass towards a target at this distance. It stops a few 1/2^32 of a sample before it. */
static int64_t towards(const vc_profile *profile, int64_t distance)
{
    if (distance > profile->furthest)
        distance = profile->furthest;
    if (distance < -profile->furthest)
        distance = -profile->furthest;
    return (distance * profile->share) >> SHARE_BITS;
}

/* Moves to the place of this DAC sample; returns the magnitude of the step. Until the place is anchored, it is the
 * hand's; it is anchored once the hand goes no faster than 300 mm/s. */
static int64_t follow(vc_profile *profile, int64_t target)
{
    const int64_t period = profile->period * WHOLE_PLACE;
    int64_t step, turn;
    if (!profile->anchored) {
        step = target - profile->origin - profile->place;
        profile->place = profile->between = (target % period + period) % period;
        profile->origin = target - profile->place;
        profile->anchored = step <= profile->fastest / 2 && step >= -profile->fastest / 2;
        return 0;
    }
    profile->between += towards(profile, target - profile->origin - profile->between);
    step = towards(profile, profile->between - profile->place);
    profile->place += step;
    turn = profile->place < 0 ? period : profile->place >= period ? -period : 0;
    profile->place += turn;
    profile->between += turn;
    profile->origin -= turn;
    return step < 0 ? -step : step;
}

/* The fade of this DAC sample, as it moves to the level for this speed; 0 until the place is anchored. A fade that
 * reaches 0 releases the place. */
static void fade(vc_profile *profile, int64_t step)
{
    const int64_t full = profile->fastest / 2;
    int32_t wanted = WHOLE_LEVEL, change;
    if (!profile->anchored)
        return;
    if (step > full)
        wanted = (int32_t)(((profile->fastest - step) << LEVEL_BITS) / (profile->fastest - full));
    if (wanted <= 0) {
        wanted = 0;
        profile->anchored = profile->level > 0;
    }
    change = wanted - profile->level;
    profile->level += change > profile->most_rise    ? profile->most_rise
                      : change < -profile->most_rise ? -profile->most_rise
                                                     : change;
}

/* ---- the heights ---- */

/* Adds the heights of an octave at a place, in 1/2^HEIGHT_BITS, times `weight` in 1/2^LEVEL_BITS. */
static void add_heights(const vc_profile *profile, uint32_t octave, int32_t weight, int64_t *sums)
{
    const uint32_t channels = profile->channels, length = profile->period >> octave;
    const uint64_t place = (uint64_t)profile->place >> octave;
    const uint32_t fraction = (uint32_t)place >> (PLACE_BITS - CROSSING_BITS);
    const uint32_t at = ((uint32_t)(place >> PLACE_BITS) + HALF_TAPS * length - (HALF_TAPS - 1)) % length;
    const int16_t *heights;
    int32_t taps[TAPS];
    const uint32_t whole = vc_kernel_taps(taps, HALF_TAPS, 1u << CROSSING_BITS, (1u << CROSSING_BITS) - fraction);
    const int64_t reciprocal = UINT32_MAX / (whole >> 8); /* 2^40 / whole, to 1/30 000 */
    uint32_t i, tap;
    heights = profile->heights + (size_t)(profile->first[octave] + at) * channels;
    for (i = 0; i < channels; i++) {
        int64_t sum = 0;
        for (tap = 0; tap < TAPS; tap++)
            sum += (int64_t)taps[tap] * heights[(size_t)tap * channels + i];
        sums[i] += (((sum >> 8) * reciprocal) >> (PLACE_BITS - HEIGHT_BITS)) * weight;
    }
}

void vc_profile_render(vc_profile *profile, uint64_t time_us, int16_t *heights)
{
    int64_t sums[VC_MAX_CHANNELS] = {0}, step;
    uint64_t band; /* of the first octave, in halves of the DAC's rate, in 1/2^31 */
    uint32_t octave = 0, i;
    int32_t share = 0; /* of the next octave */
    if (profile->positions == 0) {
        memset(heights, 0, profile->channels * sizeof *heights);
        return;
    }
    profile->rendered_us = time_us;
    step = follow(profile, place_at(profile, time_us));
    fade(profile, step);
    /* With a band that ends at 3/4 of half the DAC's rate or lower, an octave is alone. It has faded out when its band
     * ends at half the DAC's rate. */
    band = ((uint64_t)step * BAND_256) >> 7;
    if (band >> PLACE_BITS > 0) {
        octave = vc_floor_log2((uint32_t)(band >> PLACE_BITS));
        share = 4 * (int32_t)(band >> (octave + 1 + PLACE_BITS - LEVEL_BITS)) - 3 * WHOLE_LEVEL;
    }
    if (share < 0)
        share = 0;
    if (octave + 1 >= profile->octaves) {
        octave = profile->octaves - 1;
        share = 0;
    }
    add_heights(profile, octave, WHOLE_LEVEL - share, sums);
    if (share > 0)
        add_heights(profile, octave + 1, share, sums);
    for (i = 0; i < profile->channels; i++)
        heights[i] = vc_rounded_sample(((sums[i] >> LEVEL_BITS) * profile->level) >> LEVEL_BITS);
}
