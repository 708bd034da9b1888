/* Target: the way from decoded samples to DAC codes, whose limits nothing may override. */
#include <stdlib.h>
#include <string.h>

#include "vibrocast/actuator_tables.h"
#include "../src/core/vc_fields.h"
#include "vibrocast/output.h"
#include "targets.h"

enum { SAMPLES, WAVE, GAIN, JOIN, RAMP, RESTART, KINDS };

/* Drive samples at a time, in the two runs of an input, which must give the same codes. */
static const uint32_t rooms[2] = {64, 7};
#define MAX_CODES 5000u
/* Beyond this, a controller takes no stream: in rates of the DAC. */
#define MAX_RATIO 16u

typedef struct {
    vc_actuator actuator;
    vc_output_stream stream;
    uint32_t gain_float_bits, delay_samples;
    int compensation;
} setting;

typedef struct {
    setting setting;
    uint32_t room;
    vc_drive *drive;
    vc_dac *dac;
    int16_t *codes;                   /* all so far */
    uint32_t count;                   /* per channel */
    uint64_t energy[VC_MAX_CHANNELS]; /* sum of the squared codes of the last second */
} output;

static setting take_setting(const uint8_t *bytes, size_t length)
{
    static const vc_actuator *const actuators[] = {&vc_piezo_stack, &vc_piezo_stack_12_bits, &vc_lra, &vc_voice_coil};
    setting taken;
    vc_fields fields;
    unsigned i, kind;
    memset(&taken, 0, sizeof taken);
    vc_fields_begin(&fields, bytes, length);
    kind = (unsigned)vc_take_number(&fields, 1);
    taken.actuator = *actuators[kind % 4];
    taken.compensation = kind >> 7;
    taken.stream.unit = (uint8_t)(vc_take_number(&fields, 1) % 3);
    taken.stream.channels = (uint8_t)(1 + vc_take_number(&fields, 1) % VC_MAX_CHANNELS);
    taken.stream.rate_hz = (uint32_t)vc_take_number(&fields, 3);
    for (i = 0; i < taken.stream.channels; i++)
        taken.stream.gain[i] = (uint16_t)vc_take_number(&fields, 2);
    taken.gain_float_bits = (uint32_t)vc_take_number(&fields, 4);
    taken.delay_samples = (uint32_t)vc_take_number(&fields, 2);
    if (kind & 4) { /* another actuator */
        const uint32_t rate_hz = (uint32_t)vc_take_number(&fields, 3);
        taken.actuator.dac_rate_hz = 100 + rate_hz % 200000;
        taken.actuator.dac_bits = (uint8_t)(2 + vc_take_number(&fields, 1) % 15);
        taken.actuator.code_limit =
            1 + (int32_t)vc_take_number(&fields, 2) % ((1 << (taken.actuator.dac_bits - 1)) - 1);
        taken.actuator.code_step_limit = 1 + (int32_t)vc_take_number(&fields, 2);
        taken.actuator.power_limit = 1 + (uint32_t)vc_take_number(&fields, 4) % (1u << 30);
        taken.actuator.codes_per_um_exponent = (int16_t)vc_take_number(&fields, 1) - 128;
    }
    return taken;
}

/* Checks a code of each channel against all limits. */
static void check_codes(output *out, const int16_t *codes)
{
    const vc_actuator *actuator = &out->setting.actuator;
    const unsigned channels = out->setting.stream.channels, full_bits = 2u * (actuator->dac_bits - 1u);
    const int32_t lowest =
        -actuator->code_limit - (actuator->code_limit == (1 << (actuator->dac_bits - 1)) - 1 ? 1 : 0);
    unsigned channel;
    for (channel = 0; channel < channels; channel++) {
        const int32_t code = codes[channel], last = out->count > 0 ? codes[(int)channel - (int)channels] : 0;
        const int32_t step = code > last ? code - last : last - code;
        uint64_t *energy = &out->energy[channel];
        vc_fuzz_check(code >= lowest && code <= actuator->code_limit, "a code beyond its limit");
        vc_fuzz_check(step <= actuator->code_step_limit, "a step too large");
        *energy += (uint64_t)((int64_t)code * code);
        if (out->count >= actuator->dac_rate_hz) {
            const int64_t past = out->codes[(size_t)(out->count - actuator->dac_rate_hz) * channels + channel];
            *energy -= (uint64_t)(past * past);
        }
        vc_fuzz_check(*energy << (30u - full_bits) <= (uint64_t)actuator->power_limit * actuator->dac_rate_hz,
                      "more power than its limit");
    }
}

/* Plays drive samples; NULL: the way to rest. Returns how many codes it gave. */
static uint32_t put_out(output *out, const int32_t *drive, uint32_t samples)
{
    const unsigned channels = out->setting.stream.channels;
    int16_t *codes = out->codes + (size_t)out->count * channels;
    uint32_t i;
    samples = samples < MAX_CODES - out->count ? samples : MAX_CODES - out->count;
    if (drive != NULL)
        vc_dac_play(out->dac, drive, samples, codes);
    else
        samples = vc_dac_ramp(out->dac, codes, samples);
    for (i = 0; i < samples; i++, out->count++)
        check_codes(out, codes + (size_t)i * channels);
    return samples;
}

/* Pushes the same samples again and again: `rounds` times. */
static void push(output *out, const int16_t *samples, uint32_t count, uint32_t rounds)
{
    const unsigned channels = out->setting.stream.channels;
    int32_t *drive = malloc((size_t)out->room * channels * sizeof *drive);
    for (; rounds > 0 && out->count < MAX_CODES; rounds--) {
        uint32_t taken = 0, made = out->room;
        while (made == out->room || taken < count) {
            taken +=
                vc_drive_push(out->drive, samples + (size_t)taken * channels, count - taken, drive, out->room, &made);
            vc_fuzz_check(taken <= count && made <= out->room, "more drive than there was room for");
            (void)put_out(out, drive, made);
        }
    }
    free(drive);
}

static void finish(output *out)
{
    int32_t *drive = malloc((size_t)out->room * out->setting.stream.channels * sizeof *drive);
    uint32_t made;
    while ((made = vc_drive_finish(out->drive, drive, out->room)) > 0)
        (void)put_out(out, drive, made);
    free(drive);
}

/* Goes to rest, at most `samples` of the way. */
static void ramp(output *out, uint32_t samples)
{
    uint32_t made = 1;
    vc_dac_begin_ramp(out->dac);
    while (samples > 0 && made > 0) {
        made = put_out(out, NULL, samples < out->room ? samples : out->room);
        samples -= made;
    }
}

static void begin(output *out)
{
    const setting *setting = &out->setting;
    uint32_t hold_samples;
    vc_fuzz_check(vc_drive_init(out->drive, &setting->actuator, &setting->stream, setting->compensation,
                                setting->delay_samples) == 0,
                  "a drive that has a size and cannot begin");
    hold_samples = vc_drive_samples(out->drive, setting->delay_samples);
    vc_dac_init(out->dac, &setting->actuator, &setting->stream, setting->gain_float_bits, setting->compensation,
                hold_samples);
}

/* Another stream: after the way to rest, and the time at rest until the power limit has recovered. */
static void restart(output *out)
{
    uint32_t rest;
    finish(out);
    ramp(out, MAX_CODES);
    rest = vc_dac_recovery_samples(out->dac);
    while (rest-- > 0 && out->count < MAX_CODES) {
        int16_t *codes = out->codes + (size_t)out->count * out->setting.stream.channels;
        memset(codes, 0, out->setting.stream.channels * sizeof *codes);
        check_codes(out, codes);
        out->count++;
    }
    if (out->count < MAX_CODES) {
        vc_fuzz_check(vc_dac_at_rest(out->dac), "a way to rest that ends elsewhere");
        begin(out);
    }
}

static void take_record(output *out, const uint8_t *record, size_t length)
{
    const unsigned channels = out->setting.stream.channels;
    vc_fields fields;
    uint32_t i, values = (uint32_t)(length - 1) / 2, rounds = 1;
    int16_t *samples;
    vc_fields_begin(&fields, record + 1, length - 1);
    switch (record[0] % KINDS) {
    case WAVE:
        rounds = (uint32_t)vc_take_number(&fields, 2);
        values = (uint32_t)fields.rest.length / 2;
        /* fall through */
    case SAMPLES:
        samples = malloc(values * sizeof *samples + 1);
        for (i = 0; i < values; i++)
            samples[i] = (int16_t)vc_take_number(&fields, 2);
        if (values >= channels)
            push(out, samples, values / channels, rounds);
        free(samples);
        break;
    case GAIN:
        vc_dac_set_gain(out->dac, (uint32_t)vc_take_number(&fields, 4));
        break;
    case JOIN:
        vc_drive_join(out->drive);
        break;
    case RAMP:
        ramp(out, (uint32_t)vc_take_number(&fields, 2));
        break;
    default:
        restart(out);
    }
}

static void run(output *out, const uint8_t *data, size_t length)
{
    uint8_t *record;
    size_t record_length;
    begin(out);
    while (out->count < MAX_CODES && vc_fuzz_record(&data, &length, &record, &record_length)) {
        if (record_length > 0)
            take_record(out, record, record_length);
        free(record);
    }
    finish(out);
    ramp(out, MAX_CODES);
    vc_fuzz_check(out->count == MAX_CODES || vc_dac_at_rest(out->dac), "an output that stays away from rest");
}

void vc_fuzz_output(const uint8_t *data, size_t length)
{
    output outputs[2];
    uint8_t *record;
    size_t record_length, size, bytes;
    unsigned i;
    if (!vc_fuzz_record(&data, &length, &record, &record_length))
        return;
    memset(outputs, 0, sizeof outputs);
    outputs[0].setting = take_setting(record, record_length);
    free(record);
    size = vc_drive_size(&outputs[0].setting.actuator, &outputs[0].setting.stream);
    if (size == 0 || outputs[0].setting.stream.rate_hz / MAX_RATIO > outputs[0].setting.actuator.dac_rate_hz)
        return;
    bytes = (size_t)MAX_CODES * outputs[0].setting.stream.channels * sizeof(int16_t);
    for (i = 0; i < 2; i++) {
        outputs[i].setting = outputs[0].setting;
        outputs[i].room = rooms[i];
        outputs[i].drive = malloc(size);
        outputs[i].dac = malloc(vc_dac_size());
        outputs[i].codes = malloc(bytes);
        run(&outputs[i], data, length);
    }
    vc_fuzz_check(outputs[0].count == outputs[1].count &&
                      memcmp(outputs[0].codes, outputs[1].codes,
                             (size_t)outputs[0].count * outputs[0].setting.stream.channels * sizeof(int16_t)) == 0,
                  "codes that depend on the pieces of the drive");
    for (i = 0; i < 2; i++) {
        free(outputs[i].drive);
        free(outputs[i].dac);
        free(outputs[i].codes);
    }
}
