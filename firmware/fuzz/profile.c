/* Target: a height profile under a hand whose positions come from any host. */
#include <stdlib.h>
#include <string.h>

#include "../src/core/vc_fields.h"
#include "vibrocast/profile.h"
#include "targets.h"

enum { RENDER, POSITION, BEGIN, KINDS };

#define MAX_CHANNELS 4u
#define MAX_SAMPLES 1024u
#define MAX_RENDERED 1000u
/* By then the low-passes have reached the last position, and the fade its end. */
#define SETTLED_US 2000000u
/* One input of so many is followed to its rest, which takes longer than all else. */
#define REST_CHECKED 16u

typedef struct {
    vc_profile *profile;
    uint32_t channels, dac_rate_hz;
    uint64_t rendered;  /* DAC samples */
    uint64_t latest_us; /* the time of the latest position */
    int16_t heights[MAX_CHANNELS];
} surface;

static uint64_t time_us_of(const surface *surface)
{
    return surface->rendered * 1000000u / surface->dac_rate_hz;
}

static void render(surface *surface, uint64_t samples)
{
    for (; samples > 0; samples--, surface->rendered++)
        vc_profile_render(surface->profile, time_us_of(surface), surface->heights);
}

/* Loads all samples, in pieces; behind its end the record begins again. */
static void load(surface *surface, uint32_t samples, const uint8_t *record, size_t length)
{
    const uint32_t piece = 1 + (length > 0 ? record[0] : 0);
    int16_t *decoded = malloc((size_t)piece * surface->channels * sizeof *decoded);
    size_t at = 0, i;
    uint32_t loaded;
    for (loaded = 0; loaded < samples; loaded += piece) {
        for (i = 0; i < (size_t)piece * surface->channels; i++, at += 2)
            decoded[i] = length > 1 ? (int16_t)(record[at % length] | record[(at + 1) % length] << 8) : 0;
        (void)vc_profile_load(surface->profile, decoded, piece);
    }
    while (vc_profile_load(surface->profile, NULL, 0)) {
    }
    free(decoded);
}

static void take_record(surface *surface, const uint8_t *record, size_t length)
{
    vc_fields fields;
    uint64_t time_us;
    vc_fields_begin(&fields, record + 1, length - 1);
    switch (record[0] % KINDS) {
    case POSITION:
        time_us = vc_take_number(&fields, 8);
        (void)vc_profile_position(surface->profile, time_us, (int64_t)vc_take_number(&fields, 8));
        surface->latest_us = time_us > surface->latest_us ? time_us : surface->latest_us;
        break;
    case BEGIN:
        vc_profile_begin(surface->profile);
        break;
    default:
        if (surface->rendered < MAX_RENDERED)
            render(surface, vc_take_number(&fields, 2) % 1000);
    }
}

/* A hand that stays leaves the output as it is; one with a position in the future is on its way there. */
static void check_rest(surface *surface)
{
    int16_t heights[MAX_CHANNELS];
    if (surface->latest_us > time_us_of(surface))
        return;
    render(surface, (uint64_t)SETTLED_US * surface->dac_rate_hz / 1000000u);
    memcpy(heights, surface->heights, sizeof heights);
    render(surface, 1);
    vc_fuzz_check(memcmp(heights, surface->heights, surface->channels * sizeof *heights) == 0,
                  "heights that move under a hand at rest");
}

void vc_fuzz_profile(const uint8_t *data, size_t length)
{
    surface surface = {0};
    vc_fields fields;
    uint8_t *record;
    size_t record_length;
    uint32_t pitch, samples, least_samples;
    if (!vc_fuzz_record(&data, &length, &record, &record_length))
        return;
    vc_fields_begin(&fields, record, record_length);
    surface.channels = 1 + (uint32_t)vc_take_number(&fields, 1) % MAX_CHANNELS;
    surface.dac_rate_hz = 500 + (uint32_t)vc_take_number(&fields, 2) % 8000;
    pitch = (uint32_t)vc_take_number(&fields, 3);
    samples = (uint32_t)vc_take_number(&fields, 2);
    free(record);
    least_samples = vc_profile_least_samples(pitch, surface.dac_rate_hz);
    if (least_samples == 0 || least_samples > MAX_SAMPLES)
        return;
    samples = least_samples + samples % (MAX_SAMPLES - least_samples + 1);
    surface.profile = malloc(vc_profile_size(samples, surface.channels));
    vc_profile_init(surface.profile, pitch, samples, surface.channels, surface.dac_rate_hz);
    if (vc_fuzz_record(&data, &length, &record, &record_length)) {
        load(&surface, samples, record, record_length);
        free(record);
        while (vc_fuzz_record(&data, &length, &record, &record_length)) {
            if (record_length > 0)
                take_record(&surface, record, record_length);
            free(record);
        }
        if (samples % REST_CHECKED == 0)
            check_rest(&surface);
    }
    free(surface.profile);
}
