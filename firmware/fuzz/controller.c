/* Target: a whole controller. After any input it must bring its output to rest without a host, and answer one; its
 * codes stay within the limits on voltage, slew and power. */
#include <stdlib.h>
#include <string.h>

#include "vibrocast/actuator_tables.h"
#include "vibrocast/controller.h"
#include "../src/controller/vc_messages.h"
#include "targets.h"

enum { RECORD_BYTES = 256, SLOT_BYTES = 8192, FLASH_BYTES = 2 * RECORD_BYTES + 2 * SLOT_BYTES };
enum { WIRE, PAYLOAD, TIME, KINDS };

#define STEP_US 5000u
#define MAX_TIME_US 5000000u
#define WATCHDOG_MS 1000u
#define REST_US 50000u /* from a Stop, or the end of the watchdog's time, to rest: the ramp, and some steps */
#define MAX_DAC_RATE_HZ 8000u
/* Sequence numbers that requests of the corpus do not have; of two Hellos, one is no copy of an earlier one. */
#define FIRST_HELLO 0x7001
#define SECOND_HELLO 0x7002
#define LAST_STOP 0x7003

typedef struct {
    uint8_t flash[FLASH_BYTES];
    const vc_actuator *actuator;
    vc_controller *controller;
    uint64_t now_us;
    int16_t codes[VC_MAX_CHANNELS]; /* the last ones */
    /* The squared codes of the last second by their time, and their sums; `sample`: the number of the next one. */
    uint32_t squares[VC_MAX_CHANNELS][MAX_DAC_RATE_HZ];
    uint64_t energy[VC_MAX_CHANNELS], sample;
    vc_frame_reader *host;
    unsigned stops_answered;
} bench;

static int erase(void *context, uint32_t offset, uint32_t length)
{
    bench *test = context;
    vc_fuzz_check(offset <= FLASH_BYTES && length <= FLASH_BYTES - offset, "erasing beyond the flash");
    memset(test->flash + offset, 0xFF, length);
    return 0;
}

static int program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    bench *test = context;
    uint32_t i;
    vc_fuzz_check(offset <= FLASH_BYTES && length <= FLASH_BYTES - offset, "programming beyond the flash");
    for (i = 0; i < length; i++)
        test->flash[offset + i] &= data[i];
    return 0;
}

/* Puts a squared code in the place of that of a second before. */
static void take_square(bench *test, unsigned channel, uint64_t sample, uint32_t square)
{
    uint32_t *place = &test->squares[channel][sample % test->actuator->dac_rate_hz];
    test->energy[channel] += square - (uint64_t)*place;
    *place = square;
}

/* Times at which no codes came are at rest. */
static void rest_until(bench *test, uint64_t sample)
{
    unsigned channel;
    for (; test->sample < sample; test->sample++)
        for (channel = 0; channel < VC_MAX_CHANNELS; channel++)
            take_square(test, channel, test->sample, 0);
}

static void take_codes(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    bench *test = context;
    const vc_actuator *actuator = test->actuator;
    const uint64_t most =
        ((uint64_t)actuator->power_limit * actuator->dac_rate_hz) >> (30 - 2 * (actuator->dac_bits - 1));
    uint32_t i;
    unsigned channel;
    vc_fuzz_check(due_us <= test->now_us, "codes ahead of their time");
    vc_fuzz_check(channels >= 1 && channels <= VC_CHANNELS, "codes of no channel");
    rest_until(test, due_us * actuator->dac_rate_hz / 1000000);
    for (i = 0; i < samples; i++)
        for (channel = 0; channel < channels; channel++) {
            int32_t code = codes[i * channels + channel], step = code - test->codes[channel];
            vc_fuzz_check(code <= actuator->code_limit && code >= -actuator->code_limit - 1, "a code beyond its limit");
            vc_fuzz_check(step <= actuator->code_step_limit && step >= -actuator->code_step_limit, "a step too large");
            test->codes[channel] = (int16_t)code;
            take_square(test, channel, test->sample + i, (uint32_t)(code * code));
            vc_fuzz_check(test->energy[channel] <= most, "a second of too much power");
        }
    test->sample += samples;
}

/* Takes the bytes that the controller sends, as a host does. */
static void receive(bench *test)
{
    uint8_t bytes[1000];
    vc_piece payload;
    size_t count, at;
    while ((count = vc_controller_transmit(test->controller, bytes, sizeof bytes)) > 0) {
        vc_fuzz_check(count <= sizeof bytes, "more sent than there was room for");
        for (at = 0; at < count;) {
            at += vc_frame_reader_feed(test->host, bytes + at, count - at, &payload);
            if (payload.length == 0)
                continue;
            vc_fuzz_check(payload.length >= 3 && payload.bytes[0] >= VC_FIRST_FROM_CONTROLLER,
                          "no message of a controller");
            test->stops_answered += payload.bytes[0] == VC_STATUS && vc_number(payload.bytes + 1, 2) == LAST_STOP;
        }
    }
    vc_fuzz_check(vc_frame_reader_bad_frames(test->host) == 0, "a bad frame of the controller");
}

/* Lets the controller take turns until no work is left. */
static void catch_up(bench *test)
{
    while (vc_controller_advance(test->controller, test->now_us)) {
    }
}

static void send(bench *test, const uint8_t *payload, size_t length)
{
    uint8_t frame[VC_FRAME_BYTES + 1] = {0}; /* a zero before it ends earlier bytes */
    vc_frame_writer writer;
    vc_frame_begin(&writer, frame + 1, VC_FRAME_BYTES);
    vc_frame_write(&writer, payload, length);
    if (vc_controller_receive(test->controller, frame, 1 + vc_frame_end(&writer), test->now_us))
        catch_up(test);
    receive(test);
}

static void send_request(bench *test, uint8_t type, uint16_t sequence, const uint8_t *body, size_t length)
{
    uint8_t payload[16] = {type, (uint8_t)sequence, (uint8_t)(sequence >> 8)};
    memcpy(payload + 3, body, length);
    send(test, payload, 3 + length);
}

static void pass_time(bench *test, uint64_t duration_us)
{
    uint64_t end_us = test->now_us + duration_us;
    while (test->now_us < end_us) {
        test->now_us += STEP_US;
        catch_up(test);
        receive(test);
    }
}

static void take_record(bench *test, const uint8_t *record, size_t length)
{
    if (record[0] % KINDS == WIRE) {
        if (vc_controller_receive(test->controller, record + 1, length - 1, test->now_us))
            catch_up(test);
        receive(test);
    } else if (record[0] % KINDS == PAYLOAD && length > 1) {
        send(test, record + 1, length - 1);
    } else if (length > 2 && test->now_us < MAX_TIME_US) {
        pass_time(test, vc_number(record + 1, 2) * 1000 % MAX_TIME_US);
    }
}

static void check_rest(const bench *test)
{
    unsigned channel;
    for (channel = 0; channel < VC_MAX_CHANNELS; channel++)
        vc_fuzz_check(test->codes[channel] == 0, "an output that stays away from rest");
}

static void check_alive(bench *test)
{
    static const uint8_t version[2] = {VC_PROTOCOL_MAJOR, VC_PROTOCOL_MINOR};
    send_request(test, VC_HELLO, FIRST_HELLO, version, sizeof version);
    send_request(test, VC_HELLO, SECOND_HELLO, version, sizeof version);
    test->stops_answered = 0;
    send_request(test, VC_STOP, LAST_STOP, version, 0);
    vc_fuzz_check(test->stops_answered == 1, "a Stop that is not answered once");
    pass_time(test, REST_US);
    check_rest(test);
}

void vc_fuzz_controller(const uint8_t *data, size_t length)
{
    bench *test = calloc(1, sizeof *test);
    vc_flash flash = {
        test->flash, {0, RECORD_BYTES}, RECORD_BYTES, {2 * RECORD_BYTES, 2 * RECORD_BYTES + SLOT_BYTES}, SLOT_BYTES, 1,
        erase,       program,           test};
    const vc_dac_port dac = {.play = take_codes, .context = test};
    vc_controller_settings settings = {.build = "fuzzed", .hardware = "board", .watchdog_ms = WATCHDOG_MS};
    const int without_host = length / 2 % 2;
    uint8_t *record;
    size_t record_length;
    memset(test->flash, 0xFF, FLASH_BYTES);
    test->actuator = length % 2 ? &vc_piezo_stack : &vc_lra;
    test->host = malloc(vc_frame_reader_size());
    test->controller = malloc(vc_controller_size());
    settings.actuator = test->actuator;
    settings.profile = malloc(vc_controller_profile_size());
    vc_frame_reader_init(test->host);
    vc_fuzz_check(vc_controller_init(test->controller, &settings, &flash, &dac, test->now_us) == VC_OK, "no start");
    while (vc_fuzz_record(&data, &length, &record, &record_length)) {
        if (record_length > 0)
            take_record(test, record, record_length);
        free(record);
    }
    if (without_host) {
        pass_time(test, 1000 * WATCHDOG_MS + REST_US);
        check_rest(test);
    }
    check_alive(test);
    free(test->controller);
    free(settings.profile);
    free(test->host);
    free(test);
}
