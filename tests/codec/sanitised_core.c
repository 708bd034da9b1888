/* Runs the core over a corpus from stdin, for a build with address and undefined-behaviour sanitisers: `core mdct`,
 * `core dct`, `core slp`, `core eva`, `core parametric` or `core output`.
 *
 * Input: records of one byte kind (0: packet, 1: concealment), two bytes length (little endian), then the bytes. The
 * first record is the configuration, its kind the number of channels; of `eva` and `mdct` the model stands
 * before it, empty where `mdct` is to take its own tables. Every packet is decoded, and its bytes are encoded as
 * coefficients, values or samples.
 *
 * Of `output`, the first record is a vc_actuator, its kind the compensation; the second a vc_output_stream. Then follow
 * records of samples (0), gains (1) and of nothing: a joint (2), the way to rest (3), the end (4). All is done twice,
 * with little room and with much, and must give the same. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/vc_dct.h"
#include "core/vc_eva.h"
#include "vibrocast/output.h"
#include "vibrocast/status.h"
#include "core/vc_parametric.h"
#include "core/vc_slp.h"
#include "core/vc_mdct.h"

#define SLP_MAX_ORDER 16

static int read_record(int *kind, uint8_t **bytes, size_t *length)
{
    uint8_t head[3];
    if (fread(head, 1, 3, stdin) != 3)
        return 0;
    *kind = head[0];
    *length = (size_t)(head[1] | head[2] << 8);
    *bytes = malloc(*length); /* exactly as long as the record, so that reading past it is found */
    return fread(*bytes, 1, *length, stdin) == *length;
}

static int run_mdct(void)
{
    vc_mdct_decoder *decoder = malloc(vc_mdct_decoder_size());
    vc_mdct_encoder *encoder = malloc(vc_mdct_encoder_size());
    uint8_t *model, *bytes, packet[300], *tables = malloc(vc_mdct_tables_size());
    int16_t *samples;
    int32_t *coefficients;
    size_t model_length, length, capacity, block_values, i;
    int kind;
    unsigned channels;
    if (!read_record(&kind, &model, &model_length) || !read_record(&kind, &bytes, &length))
        return 2;
    channels = (unsigned)kind;
    if (model_length == 0) {
        free(model);
        model = NULL;
    }
    if (vc_mdct_decoder_init(decoder, bytes, length, channels, model, model_length) != VC_OK ||
        vc_mdct_encoder_init(encoder, bytes, length, channels, model, model_length, 3, 88) != VC_OK)
        return 0;
    free(bytes);
    block_values = (size_t)vc_mdct_decoder_packet_samples(decoder) * channels;
    samples = malloc(block_values * sizeof *samples);
    coefficients = malloc(block_values * sizeof *coefficients);
    vc_mdct_encoder_follow(encoder, NULL);
    while (read_record(&kind, &bytes, &length)) {
        if (kind == 1 || vc_mdct_decode(decoder, bytes, length, samples) < 0)
            (void)vc_mdct_decode(decoder, NULL, 0, samples);
        for (i = 0; i < block_values; i++) {
            int32_t byte = length > 0 ? bytes[i % length] : 0;
            coefficients[i] = (byte - 128) * (1 << (byte % 22));
        }
        capacity = length % sizeof packet;
        if (vc_mdct_encode(encoder, coefficients, (int32_t)length - 100, packet, capacity) > (int32_t)capacity)
            return 3;
        free(bytes);
    }
    vc_mdct_encoder_tables(encoder, tables);
    free(tables);
    free(model);
    free(samples);
    free(coefficients);
    free(decoder);
    free(encoder);
    puts("done");
    return 0;
}

static int run_dct(void)
{
    vc_dct_decoder *decoder = malloc(vc_dct_decoder_size());
    uint8_t *bytes, packet[300];
    int16_t *samples;
    uint32_t *values, i;
    size_t length;
    int kind;
    if (!read_record(&kind, &bytes, &length))
        return 2;
    if (vc_dct_decoder_init(decoder, bytes, length, (unsigned)kind) != VC_OK)
        return 0;
    free(bytes);
    samples = malloc((size_t)vc_dct_decoder_packet_samples(decoder) * (unsigned)kind * sizeof *samples);
    for (i = 0; i < 231; i++) /* any code of a number of levels */
        if (vc_dct_levels_of((uint32_t)i) < 4 || vc_dct_levels_of((uint32_t)i) > 65535)
            return 3;
    while (read_record(&kind, &bytes, &length)) {
        if (kind == 1 || vc_dct_decode(decoder, bytes, length, samples) < 0)
            (void)vc_dct_decode(decoder, NULL, 0, samples);
        values = malloc(length / 2 * 2 * sizeof *values);
        for (i = 0; i < length / 2 * 2; i++)
            values[i] = (uint32_t)bytes[i] * bytes[(i + 1) % length];
        if (vc_dct_range_encode(values, 2, 1, (uint32_t)length / 2, kind & 1, (int)length & 1, packet,
                                length % sizeof packet) > (int32_t)sizeof packet)
            return 3;
        free(values);
        free(bytes);
    }
    free(samples);
    free(decoder);
    puts("done");
    return 0;
}

static int run_slp(void)
{
    vc_slp_decoder *decoder = malloc(vc_slp_decoder_size());
    vc_slp_encoder *encoder = malloc(vc_slp_encoder_size());
    uint8_t *bytes, packet[3000];
    int8_t *reflections;
    int16_t *samples;
    int32_t *values;
    size_t length, count, i;
    int kind;
    unsigned channels;
    if (!read_record(&kind, &bytes, &length))
        return 2;
    channels = (unsigned)kind;
    if (vc_slp_decoder_init(decoder, bytes, length, channels) != VC_OK ||
        vc_slp_encoder_init(encoder, bytes, length, channels, 3, 98) != VC_OK)
        return 0;
    free(bytes);
    count = (size_t)vc_slp_decoder_packet_samples(decoder) * channels;
    samples = malloc(count * sizeof *samples);
    values = malloc(count * sizeof *values);
    reflections = malloc(count * SLP_MAX_ORDER);
    while (read_record(&kind, &bytes, &length)) {
        size_t capacity = length * 13 % sizeof packet;
        if (kind == 1 || vc_slp_decode(decoder, bytes, length, samples) < 0)
            (void)vc_slp_decode(decoder, NULL, 0, samples);
        for (i = 0; i < count; i++) {
            int32_t byte = length > 0 ? bytes[i % length] : 0;
            values[i] = (byte - 128) * (1 << 16);
        }
        for (i = 0; i < count * SLP_MAX_ORDER; i++)
            reflections[i] = (int8_t)((length > 0 ? bytes[i / 7 % length] : 0) % 31 - 15);
        if (vc_slp_encode(encoder, values, reflections, (int32_t)length - 100, packet, capacity) > (int32_t)capacity)
            return 3;
        free(bytes);
    }
    free(samples);
    free(values);
    free(reflections);
    free(decoder);
    free(encoder);
    puts("done");
    return 0;
}

static int run_eva(void)
{
    vc_eva_decoder *decoder = malloc(vc_eva_decoder_size());
    vc_eva_encoder *encoder = malloc(vc_eva_encoder_size());
    uint8_t *model, *bytes, packet[3000];
    int16_t *samples, *latents;
    int32_t *values;
    size_t model_length, length, count, columns, i;
    int kind;
    unsigned channels;
    if (!read_record(&kind, &model, &model_length) || !read_record(&kind, &bytes, &length))
        return 2;
    channels = (unsigned)kind;
    if (vc_eva_decoder_init(decoder, bytes, length, channels, model, model_length) != VC_OK ||
        vc_eva_encoder_init(encoder, bytes, length, channels, model, model_length, 3) != VC_OK)
        return 0;
    free(bytes);
    count = (size_t)vc_eva_decoder_packet_samples(decoder) * channels;
    columns = count / 16;
    samples = malloc(count * sizeof *samples);
    latents = malloc(columns * model[3] * sizeof *latents);
    values = malloc(columns * model[3] * sizeof *values);
    while (read_record(&kind, &bytes, &length)) {
        size_t capacity = length * 13 % sizeof packet;
        if (kind == 1 || vc_eva_decode(decoder, bytes, length, samples) < 0)
            (void)vc_eva_decode(decoder, NULL, 0, samples);
        if (kind == 1)
            (void)vc_eva_decode_latents(decoder, NULL, 0, latents);
        else
            vc_eva_decode_latents(decoder, bytes, length, latents);
        for (i = 0; i < columns * model[3]; i++) {
            int32_t byte = length > 0 ? bytes[i % length] : 0;
            values[i] = byte == 255 ? INT32_MIN : (byte - 128) * (1 << (byte % 24));
        }
        if (vc_eva_encode(encoder, values, (int32_t)length - 100, packet, capacity) > (int32_t)capacity)
            return 3;
        free(bytes);
    }
    free(samples);
    free(latents);
    free(values);
    free(model);
    free(decoder);
    free(encoder);
    puts("done");
    return 0;
}

static int run_parametric(void)
{
    vc_parametric_decoder *decoder = malloc(vc_parametric_decoder_size());
    vc_parametric_encoder *encoder = malloc(vc_parametric_encoder_size());
    uint8_t *bytes, packet[300];
    int16_t *samples, *frames;
    size_t length, count, values, i;
    int kind;
    unsigned channels;
    if (!read_record(&kind, &bytes, &length))
        return 2;
    channels = (unsigned)kind;
    if (vc_parametric_decoder_init(decoder, bytes, length, channels) != VC_OK ||
        vc_parametric_encoder_init(encoder, bytes, length, channels, 3) != VC_OK)
        return 0;
    count = (size_t)vc_parametric_decoder_packet_samples(decoder) * channels;
    values = (size_t)vc_parametric_frame_values(encoder) * (bytes[3] | (size_t)bytes[4] << 8) * channels;
    free(bytes);
    samples = malloc(count * sizeof *samples);
    frames = malloc(values * sizeof *frames);
    while (read_record(&kind, &bytes, &length)) {
        size_t capacity = length * 13 % sizeof packet;
        if (kind == 1 || vc_parametric_decode(decoder, bytes, length, samples) < 0)
            (void)vc_parametric_decode(decoder, NULL, 0, samples);
        for (i = 0; i < values; i++) {
            int byte = length > 0 ? bytes[i % length] : 0;
            frames[i] = (int16_t)(byte == 255 ? INT16_MAX : byte == 254 ? INT16_MIN : byte - 50);
        }
        if (vc_parametric_encode(encoder, frames, packet, capacity) > (int32_t)capacity)
            return 3;
        free(bytes);
    }
    free(samples);
    free(frames);
    free(decoder);
    free(encoder);
    puts("done");
    return 0;
}

/* A drive, its DAC and all codes so far. */
typedef struct {
    uint32_t room; /* samples of drive at a time */
    vc_drive *drive;
    vc_dac *dac;
    int16_t *codes;
    size_t count;
} output;

static uint32_t put_out(output *out, const int32_t *drive, uint32_t samples, unsigned channels)
{
    out->codes = realloc(out->codes, (out->count + (size_t)samples * channels) * sizeof *out->codes);
    if (drive)
        vc_dac_play(out->dac, drive, samples, out->codes + out->count);
    else
        samples = vc_dac_ramp(out->dac, out->codes + out->count, samples);
    out->count += (size_t)samples * channels;
    return samples;
}

static void run_record(output *out, int kind, const uint8_t *bytes, size_t length, unsigned channels)
{
    int32_t *drive = malloc((size_t)out->room * channels * sizeof *drive);
    int16_t *samples = malloc(length);
    uint32_t left = (uint32_t)(length / 2 / channels), taken = 0, made = out->room, gain;
    memcpy(samples, bytes, length);
    if (kind == 0)
        while (made == out->room) {
            taken +=
                vc_drive_push(out->drive, samples + (size_t)taken * channels, left - taken, drive, out->room, &made);
            put_out(out, drive, made, channels);
        }
    else if (kind == 1 && length == sizeof gain) {
        memcpy(&gain, bytes, sizeof gain);
        vc_dac_set_gain(out->dac, gain);
    } else if (kind == 2)
        vc_drive_join(out->drive);
    else if (kind == 3)
        for (vc_dac_begin_ramp(out->dac); put_out(out, NULL, out->room, channels) > 0;)
            ;
    else if (kind == 4)
        while ((made = vc_drive_finish(out->drive, drive, out->room)) > 0)
            put_out(out, drive, made, channels);
    free(samples);
    free(drive);
}

static int run_output(void)
{
    output outputs[2] = {{3, NULL, NULL, NULL, 0}, {5000, NULL, NULL, NULL, 0}};
    vc_actuator *actuator;
    vc_output_stream *stream;
    uint8_t *bytes;
    size_t length, size;
    int kind, compensation, i;
    if (!read_record(&compensation, (uint8_t **)&actuator, &length) || length != sizeof *actuator ||
        !read_record(&kind, (uint8_t **)&stream, &length) || length != sizeof *stream)
        return 2;
    size = vc_drive_size(actuator, stream);
    for (i = 0; i < 2 && size > 0; i++) {
        outputs[i].drive = malloc(size);
        outputs[i].dac = malloc(vc_dac_size());
        vc_drive_init(outputs[i].drive, actuator, stream, compensation, 5);
        vc_dac_init(outputs[i].dac, actuator, stream, 0x3F800000, compensation, vc_drive_samples(outputs[i].drive, 5));
    }
    while (read_record(&kind, &bytes, &length)) {
        for (i = 0; i < 2 && size > 0; i++)
            run_record(&outputs[i], kind, bytes, length, stream->channels);
        free(bytes);
    }
    if (size > 0 && vc_dac_recovery_samples(outputs[0].dac) != vc_dac_recovery_samples(outputs[1].dac))
        return 3;
    if (outputs[0].count != outputs[1].count)
        return 4;
    if (outputs[0].count > 0 && memcmp(outputs[0].codes, outputs[1].codes, outputs[0].count * sizeof(int16_t)) != 0)
        return 5;
    for (i = 0; i < 2; i++) {
        free(outputs[i].drive);
        free(outputs[i].dac);
        free(outputs[i].codes);
    }
    free(actuator);
    free(stream);
    puts("done");
    return 0;
}

int main(int count, char **arguments)
{
    const char *codec = count == 2 ? arguments[1] : "";
    return strcmp(codec, "dct") == 0          ? run_dct()
           : strcmp(codec, "slp") == 0        ? run_slp()
           : strcmp(codec, "eva") == 0        ? run_eva()
           : strcmp(codec, "parametric") == 0 ? run_parametric()
           : strcmp(codec, "output") == 0     ? run_output()
                                              : run_mdct();
}
