/* Messages between host and controller; see messages.h. */
#include "messages.h"

#include "sha256.h"

#define FIRST_UNSEQUENCED 0x40
#define SEQUENCE_BYTES 2
#define COMPENSATION 0x01u
#define HEADER_TAG 1   /* of Configure */
#define HARDWARE_TAG 1 /* of FlashBegin */
#define VARINT_BITS 32
#define SIGN_BIT 0x80000000u
#define INFINITY_BITS 0x7F800000u

/* Tags of HelloResponse and Error. */
enum { BUILD = 1, HARDWARE = 2, LIMITS = 3, ACTUATOR = 4, CODEC = 5, IMAGE = 6, ERROR_TEXT = 1 };
enum { TAG_BYTES = 3, LIMITS_BYTES = 27, ACTUATOR_BYTES = 25, IMAGE_BYTES = 35 };

static int malformed(vc_refusal *refusal, const char *text)
{
    return vc_refuse(refusal, VC_MALFORMED, text);
}

/* Reads tags to the end; `value` becomes that of the last one that is `wanted`, if there is one. Returns whether every
 * length fits. */
static int read_tags(vc_fields *fields, unsigned wanted, vc_piece *value)
{
    while (fields->rest.length > 0) {
        unsigned tag = (unsigned)vc_take_number(fields, 1);
        vc_piece piece = vc_take_piece(fields, (size_t)vc_take_number(fields, 2));
        if (fields->cut)
            return 0;
        if (tag == wanted)
            *value = piece;
    }
    return !fields->cut;
}

static int is_gain(uint32_t float_bits)
{
    return float_bits < INFINITY_BITS || float_bits == SIGN_BIT;
}

static int bad_gain(vc_refusal *refusal)
{
    return vc_refuse(refusal, VC_BAD_VALUE, "the gain is not a finite factor of at least 0");
}

static int read_configure(vc_configure *configure, vc_fields *fields, vc_refusal *refusal)
{
    uint8_t flags;
    configure->stream = (uint8_t)vc_take_number(fields, 1);
    flags = (uint8_t)vc_take_number(fields, 1);
    configure->prebuffer_samples = (uint32_t)vc_take_number(fields, 4);
    configure->packets = (uint32_t)vc_take_number(fields, 4);
    configure->first_packet = (uint32_t)vc_take_number(fields, 4);
    configure->loops = (uint16_t)vc_take_number(fields, 2);
    configure->gain_float_bits = (uint32_t)vc_take_number(fields, 4);
    configure->compensation = flags & COMPENSATION;
    configure->header.bytes = NULL;
    if (!fields->cut && flags & ~COMPENSATION)
        return vc_refuse_numbers(refusal, VC_BAD_VALUE, "Configure: flags # are asked for, only # is known", flags,
                                 COMPENSATION);
    if (!read_tags(fields, HEADER_TAG, &configure->header))
        return malformed(refusal, "Configure: a field or tag is cut");
    if (configure->header.bytes == NULL)
        return malformed(refusal, "Configure: the stream header is missing");
    if (!is_gain(configure->gain_float_bits))
        return bad_gain(refusal);
    return 0;
}

static int read_flash_begin(vc_flash_begin *begin, vc_fields *fields, vc_refusal *refusal)
{
    begin->slot = (uint8_t)vc_take_number(fields, 1);
    begin->size_bytes = (uint32_t)vc_take_number(fields, 4);
    begin->sha256 = vc_take_piece(fields, VC_SHA256_BYTES).bytes;
    begin->hardware.bytes = NULL;
    if (!read_tags(fields, HARDWARE_TAG, &begin->hardware))
        return malformed(refusal, "FlashBegin: a field or tag is cut");
    if (begin->hardware.bytes == NULL)
        return malformed(refusal, "FlashBegin: the hardware is missing");
    if (!vc_is_utf8(begin->hardware))
        return malformed(refusal, "FlashBegin: the hardware is not UTF-8");
    return 0;
}

static int read_flash_data(vc_flash_data *data, vc_fields *fields, vc_refusal *refusal)
{
    data->slot = (uint8_t)vc_take_number(fields, 1);
    data->offset = (uint32_t)vc_take_number(fields, 4);
    data->data = fields->rest;
    return fields->cut ? malformed(refusal, "FlashData: slot or offset is cut") : 0;
}

static int read_stream_data(vc_stream_data *data, vc_fields *fields, vc_refusal *refusal)
{
    data->stream = (uint8_t)vc_take_number(fields, 1);
    data->iteration = (uint32_t)vc_take_varint(fields, VARINT_BITS);
    data->packets = fields->rest;
    while (!fields->cut && fields->rest.length > 0)
        vc_take_piece(fields, (size_t)vc_take_varint(fields, VARINT_BITS));
    return fields->cut ? malformed(refusal, "StreamData: stream, iteration or a packet is cut") : 0;
}

int vc_next_packet(vc_piece *packets, vc_piece *packet)
{
    vc_fields fields = {*packets, 0};
    if (packets->length == 0)
        return 0;
    *packet = vc_take_piece(&fields, (size_t)vc_take_varint(&fields, VARINT_BITS));
    *packets = fields.rest;
    return 1;
}

int vc_message_read(vc_message *message, const uint8_t *payload, size_t length, vc_refusal *refusal)
{
    vc_fields fields;
    vc_piece no_tag;
    vc_fields_begin(&fields, payload, length);
    message->sequence = VC_NOTIFICATION;
    message->type = (uint8_t)vc_take_number(&fields, 1);
    if (message->type < FIRST_UNSEQUENCED)
        message->sequence = (uint16_t)vc_take_number(&fields, SEQUENCE_BYTES);
    if (fields.cut)
        return vc_refuse_numbers(refusal, VC_MALFORMED, "a message of # bytes, at least # are needed", length,
                                 1 + SEQUENCE_BYTES);
    switch (message->type) {
    case VC_CONFIGURE:
        return read_configure(&message->body.configure, &fields, refusal);
    case VC_FLASH_BEGIN:
        return read_flash_begin(&message->body.flash_begin, &fields, refusal);
    case VC_FLASH_DATA:
        return read_flash_data(&message->body.flash_data, &fields, refusal);
    case VC_STREAM_DATA:
        return read_stream_data(&message->body.stream_data, &fields, refusal);
    case VC_STATUS_REQUEST:
    case VC_PAUSE:
    case VC_RESUME:
    case VC_STOP:
        break;
    case VC_HELLO:
        message->body.hello.major = (uint8_t)vc_take_number(&fields, 1);
        message->body.hello.minor = (uint8_t)vc_take_number(&fields, 1);
        break;
    case VC_START:
        message->body.start_us = vc_take_number(&fields, 8);
        break;
    case VC_LOOP:
        message->body.loops = (uint16_t)vc_take_number(&fields, 2);
        break;
    case VC_GAIN:
        message->body.gain_float_bits = (uint32_t)vc_take_number(&fields, 4);
        break;
    case VC_END_STREAM:
        message->body.end_stream.stream = (uint8_t)vc_take_number(&fields, 1);
        message->body.end_stream.packets = (uint32_t)vc_take_number(&fields, 4);
        break;
    case VC_CAPTURE_READ:
        message->body.capture_read.tap = (uint8_t)vc_take_number(&fields, 1);
        message->body.capture_read.offset = vc_take_number(&fields, 8);
        message->body.capture_read.count = (uint16_t)vc_take_number(&fields, 2);
        break;
    case VC_POSITION:
        message->body.position.time_us = vc_take_number(&fields, 8);
        message->body.position.position_nm = (int64_t)vc_take_number(&fields, 8);
        break;
    case VC_FLASH_VERIFY:
    case VC_FLASH_ACTIVATE:
    case VC_FLASH_CONFIRM:
        message->body.slot = (uint8_t)vc_take_number(&fields, 1);
        break;
    default:
        return vc_refuse_numbers(refusal, VC_UNKNOWN_MESSAGE,
                                 "message type # is not known to protocol version #: update the controller",
                                 message->type, VC_PROTOCOL_MAJOR);
    }
    if (!read_tags(&fields, 0, &no_tag))
        return vc_refuse_numbers(refusal, VC_MALFORMED, "message of type #: a field or tag is cut", message->type, 0);
    if (message->type == VC_GAIN && !is_gain(message->body.gain_float_bits))
        return bad_gain(refusal);
    if (message->type == VC_CAPTURE_READ && message->body.capture_read.tap > VC_TAP_DAC)
        return vc_refuse_numbers(refusal, VC_BAD_VALUE, "CaptureRead: there is no tap #; taps are 0 and 1",
                                 message->body.capture_read.tap, 0);
    return 0;
}

static void put_head(vc_frame_writer *writer, uint8_t type, uint16_t sequence)
{
    vc_frame_put_number(writer, type, 1);
    vc_frame_put_number(writer, sequence, SEQUENCE_BYTES);
}

static void put_tag(vc_frame_writer *writer, uint8_t tag, size_t value_bytes)
{
    vc_frame_put_number(writer, tag, 1);
    vc_frame_put_number(writer, value_bytes, 2);
}

static void put_piece(vc_frame_writer *writer, vc_piece text)
{
    vc_frame_put(writer, text.bytes, text.length);
}

static void put_text(vc_frame_writer *writer, uint8_t tag, vc_piece text)
{
    put_tag(writer, tag, text.length);
    put_piece(writer, text);
}

static void put_sha256(vc_frame_writer *writer, const uint8_t *sha256)
{
    static const uint8_t none[VC_SHA256_BYTES];
    vc_frame_put(writer, sha256 != NULL ? sha256 : none, VC_SHA256_BYTES);
}

static void put_limits(vc_frame_writer *writer, const vc_controller_limits *limits)
{
    put_tag(writer, LIMITS, LIMITS_BYTES);
    vc_frame_put_number(writer, limits->maximum_payload_bytes, 2);
    vc_frame_put_number(writer, limits->maximum_packet_bytes, 2);
    vc_frame_put_number(writer, limits->buffer_samples, 4);
    vc_frame_put_number(writer, limits->capture_samples, 4);
    vc_frame_put_number(writer, limits->channels, 1);
    vc_frame_put_number(writer, limits->minimum_rate_hz, 4);
    vc_frame_put_number(writer, limits->maximum_rate_hz, 4);
    vc_frame_put_number(writer, limits->watchdog_ms, 2);
    vc_frame_put_number(writer, limits->profile_samples, 4);
}

static void put_actuator(vc_frame_writer *writer, const vc_actuator_description *actuator)
{
    vc_piece name = vc_text_piece(actuator->name);
    put_tag(writer, ACTUATOR, ACTUATOR_BYTES + name.length);
    vc_frame_put_number(writer, actuator->stroke_um_float_bits, 4);
    vc_frame_put_number(writer, actuator->volts_float_bits, 4);
    vc_frame_put_number(writer, actuator->lower_hz_float_bits, 4);
    vc_frame_put_number(writer, actuator->upper_hz_float_bits, 4);
    vc_frame_put_number(writer, actuator->slew_volts_per_second_float_bits, 4);
    vc_frame_put_number(writer, actuator->dac_bits, 1);
    vc_frame_put_number(writer, actuator->dac_rate_hz, 4);
    put_piece(writer, name);
}

static void put_image(vc_frame_writer *writer, const vc_image_description *image)
{
    vc_piece name = image->name, version = image->version;
    name.length = vc_text_cut(name, VC_IMAGE_TEXT_BYTES);
    version.length = vc_text_cut(version, VC_IMAGE_TEXT_BYTES);
    put_tag(writer, IMAGE, IMAGE_BYTES + name.length + version.length);
    vc_frame_put_number(writer, image->slot, 1);
    vc_frame_put_number(writer, image->state, 1);
    put_sha256(writer, image->sha256);
    vc_frame_put_number(writer, name.length, 1);
    put_piece(writer, name);
    put_piece(writer, version);
}

void vc_put_hello_response(vc_frame_writer *writer, uint16_t sequence, const vc_hello_response *response)
{
    unsigned i;
    put_head(writer, VC_HELLO_RESPONSE, sequence);
    vc_frame_put_number(writer, VC_PROTOCOL_MAJOR, 1);
    vc_frame_put_number(writer, VC_PROTOCOL_MINOR, 1);
    put_text(writer, BUILD, vc_text_piece(response->build));
    put_text(writer, HARDWARE, vc_text_piece(response->hardware));
    put_limits(writer, &response->limits);
    put_actuator(writer, &response->actuator);
    for (i = 0; i < response->codec_count; i++) {
        vc_piece name = vc_text_piece(response->codecs[i].name);
        put_tag(writer, CODEC, 1 + name.length);
        vc_frame_put_number(writer, response->codecs[i].identifier, 1);
        put_piece(writer, name);
    }
    for (i = 0; i < response->image_count; i++)
        put_image(writer, &response->images[i]);
}

void vc_put_status(vc_frame_writer *writer, uint16_t sequence, const vc_status_report *status)
{
    put_head(writer, VC_STATUS, sequence);
    vc_frame_put_number(writer, status->state, 1);
    vc_frame_put_number(writer, status->stream, 1);
    vc_frame_put_number(writer, status->device_time_us, 8);
    vc_frame_put_number(writer, status->position, 8);
    vc_frame_put_number(writer, status->credit_until, 8);
    vc_frame_put_number(writer, status->buffered_samples, 4);
    vc_frame_put_number(writer, status->bad_frames, 4);
    vc_frame_put_number(writer, status->underruns, 4);
    vc_frame_put_number(writer, status->lost_packets, 4);
    vc_frame_put_number(writer, status->limited.compensation_clipped, 4);
    vc_frame_put_number(writer, status->limited.voltage_limited, 4);
    vc_frame_put_number(writer, status->limited.slew_limited, 4);
    vc_frame_put_number(writer, status->limited.power_limited, 4);
}

void vc_put_flash_status(vc_frame_writer *writer, uint16_t sequence, const vc_flash_report *status)
{
    put_head(writer, VC_FLASH_STATUS, sequence);
    vc_frame_put_number(writer, status->slot, 1);
    vc_frame_put_number(writer, status->state, 1);
    vc_frame_put_number(writer, status->next_offset, 4);
    put_sha256(writer, status->sha256);
}

void vc_put_error(vc_frame_writer *writer, uint16_t sequence, const vc_refusal *refusal)
{
    vc_piece text = {(const uint8_t *)refusal->text, refusal->length};
    put_head(writer, VC_ERROR, sequence);
    vc_frame_put_number(writer, refusal->code, 2);
    put_text(writer, ERROR_TEXT, text);
}

void vc_put_capture_data(vc_frame_writer *writer, uint16_t sequence, uint8_t tap, uint8_t channels, uint64_t offset,
                         uint64_t end)
{
    put_head(writer, VC_CAPTURE_DATA, sequence);
    vc_frame_put_number(writer, tap, 1);
    vc_frame_put_number(writer, channels, 1);
    vc_frame_put_number(writer, offset, 8);
    vc_frame_put_number(writer, end, 8);
}

void vc_put_samples(vc_frame_writer *writer, const int16_t *samples, size_t count)
{
    size_t i;
    for (i = 0; i < count; i++)
        vc_frame_put_number(writer, (uint16_t)samples[i], 2);
}
