/* Messages between host and controller; see messages.h. Written by device_protocol/generate.py. */
#include "vc_messages.h"

#define SIGN_BIT 0x80000000u
#define INFINITY_BITS 0x7F800000u

/* Reads tags to the end; `value`, where there is one, becomes that of the last one that is `wanted`, or keeps NULL.
 * Returns whether every length fits. */
static int read_tags(vc_fields *fields, unsigned wanted, vc_piece *value)
{
    while (fields->rest.length > 0) {
        unsigned tag = (unsigned)vc_take_number(fields, 1);
        vc_piece piece = vc_take_piece(fields, (size_t)vc_take_number(fields, 2));
        if (fields->cut)
            return 0;
        if (value != NULL && tag == wanted)
            *value = piece;
    }
    return !fields->cut;
}

/* Takes items up to the end, each after its length. */
static vc_piece take_items(vc_fields *fields)
{
    const vc_piece items = fields->rest;
    while (!fields->cut && fields->rest.length > 0)
        vc_take_piece(fields, (size_t)vc_take_varint(fields, VC_VARINT_BITS));
    return items;
}

static int is_factor(uint32_t float_bits)
{
    return float_bits < INFINITY_BITS || float_bits == SIGN_BIT;
}

int vc_message_read(vc_message *message, const uint8_t *payload, size_t length, vc_rejection *rejection)
{
    vc_fields fields;
    vc_piece *value = NULL;
    unsigned flags = 0, tag = 0;
    vc_fields_begin(&fields, payload, length);
    message->sequence = VC_NOTIFICATION;
    message->type = (uint8_t)vc_take_number(&fields, 1);
    if (message->type < VC_FIRST_UNSEQUENCED)
        message->sequence = (uint16_t)vc_take_number(&fields, 2);
    if (fields.cut)
        return vc_reject_numbers(rejection, VC_MALFORMED, "a message of # bytes, at least 3 are needed", length, 0);
    switch (message->type) {
    case VC_HELLO:
        message->body.hello.major = (uint8_t)vc_take_number(&fields, 1);
        message->body.hello.minor = (uint8_t)vc_take_number(&fields, 1);
        break;
    case VC_STATUS_REQUEST:
        break;
    case VC_CONFIGURE:
        message->body.configure.stream = (uint8_t)vc_take_number(&fields, 1);
        flags = (unsigned)vc_take_number(&fields, 1);
        message->body.configure.compensation = (uint8_t)flags;
        message->body.configure.prebuffer_samples = (uint32_t)vc_take_number(&fields, 4);
        message->body.configure.packets = (uint32_t)vc_take_number(&fields, 4);
        message->body.configure.first_packet = (uint32_t)vc_take_number(&fields, 4);
        message->body.configure.loops = (uint16_t)vc_take_number(&fields, 2);
        message->body.configure.gain_float_bits = (uint32_t)vc_take_number(&fields, 4);
        value = &message->body.configure.header;
        tag = 1;
        break;
    case VC_QUEUE:
        message->body.queue.stream = (uint8_t)vc_take_number(&fields, 1);
        flags = (unsigned)vc_take_number(&fields, 1);
        message->body.queue.compensation = (uint8_t)flags;
        message->body.queue.prebuffer_samples = (uint32_t)vc_take_number(&fields, 4);
        message->body.queue.packets = (uint32_t)vc_take_number(&fields, 4);
        message->body.queue.first_packet = (uint32_t)vc_take_number(&fields, 4);
        message->body.queue.loops = (uint16_t)vc_take_number(&fields, 2);
        message->body.queue.gain_float_bits = (uint32_t)vc_take_number(&fields, 4);
        value = &message->body.queue.header;
        tag = 1;
        break;
    case VC_START:
        message->body.start.device_time_us = vc_take_number(&fields, 8);
        break;
    case VC_PAUSE:
        break;
    case VC_RESUME:
        break;
    case VC_STOP:
        break;
    case VC_LOOP:
        message->body.loop.loops = (uint16_t)vc_take_number(&fields, 2);
        break;
    case VC_GAIN:
        message->body.gain.gain_float_bits = (uint32_t)vc_take_number(&fields, 4);
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
    case VC_FLASH_BEGIN:
        message->body.flash_begin.slot = (uint8_t)vc_take_number(&fields, 1);
        message->body.flash_begin.size_bytes = (uint32_t)vc_take_number(&fields, 4);
        message->body.flash_begin.sha256 = vc_take_piece(&fields, 32).bytes;
        value = &message->body.flash_begin.hardware;
        tag = 1;
        break;
    case VC_FLASH_DATA:
        message->body.flash_data.slot = (uint8_t)vc_take_number(&fields, 1);
        message->body.flash_data.offset = (uint32_t)vc_take_number(&fields, 4);
        message->body.flash_data.data = vc_take_piece(&fields, fields.rest.length);
        break;
    case VC_FLASH_VERIFY:
        message->body.flash_verify.slot = (uint8_t)vc_take_number(&fields, 1);
        break;
    case VC_FLASH_ACTIVATE:
        message->body.flash_activate.slot = (uint8_t)vc_take_number(&fields, 1);
        break;
    case VC_FLASH_CONFIRM:
        message->body.flash_confirm.slot = (uint8_t)vc_take_number(&fields, 1);
        break;
    case VC_FLASH_ERASE:
        message->body.flash_erase.slot = (uint8_t)vc_take_number(&fields, 1);
        break;
    case VC_FLASH_READ:
        message->body.flash_read.slot = (uint8_t)vc_take_number(&fields, 1);
        message->body.flash_read.offset = (uint32_t)vc_take_number(&fields, 4);
        message->body.flash_read.count = (uint16_t)vc_take_number(&fields, 2);
        break;
    case VC_STREAM_DATA:
        message->body.stream_data.stream = (uint8_t)vc_take_number(&fields, 1);
        message->body.stream_data.iteration = (uint32_t)vc_take_varint(&fields, VC_VARINT_BITS);
        message->body.stream_data.packets = take_items(&fields);
        break;
    case VC_POSITION:
        message->body.position.device_time_us = vc_take_number(&fields, 8);
        message->body.position.position_nm = (int64_t)vc_take_number(&fields, 8);
        break;
    case VC_SINGLE_PACKET:
        message->body.single_packet.stream = (uint8_t)vc_take_number(&fields, 1);
        message->body.single_packet.packet = vc_take_piece(&fields, fields.rest.length);
        break;
    default:
        return vc_reject_numbers(rejection, VC_UNKNOWN_MESSAGE,
                                 "message type # is not known to protocol version #: update the controller",
                                 message->type, VC_PROTOCOL_MAJOR);
    }
    if (!fields.cut && flags > 1)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "flags # are set, only # is known", flags, 1);
    if (value != NULL)
        value->bytes = NULL;
    if (!read_tags(&fields, tag, value))
        return vc_reject_numbers(rejection, VC_MALFORMED, "message of type #: a field or tag is cut, or bytes are left over", message->type, 0);
    if (value != NULL && value->bytes == NULL)
        return vc_reject_numbers(rejection, VC_MALFORMED, "message of type #: tag # is missing", message->type, tag);
    switch (message->type) {
    case VC_CONFIGURE:
        if (!is_factor(message->body.configure.gain_float_bits))
            return vc_reject(rejection, VC_BAD_VALUE, "Configure: gain is not a finite factor of at least 0");
        break;
    case VC_QUEUE:
        if (!is_factor(message->body.queue.gain_float_bits))
            return vc_reject(rejection, VC_BAD_VALUE, "Queue: gain is not a finite factor of at least 0");
        break;
    case VC_GAIN:
        if (!is_factor(message->body.gain.gain_float_bits))
            return vc_reject(rejection, VC_BAD_VALUE, "Gain: gain is not a finite factor of at least 0");
        break;
    case VC_CAPTURE_READ:
        if (message->body.capture_read.tap > 1)
            return vc_reject_numbers(rejection, VC_BAD_VALUE, "CaptureRead: tap # is none of 0 to #", message->body.capture_read.tap, 1);
        break;
    case VC_FLASH_BEGIN:
        if (!vc_is_utf8(message->body.flash_begin.hardware))
            return vc_reject(rejection, VC_MALFORMED, "FlashBegin: hardware is not UTF-8");
        break;
    default:
        break;
    }
    return 0;
}

static void write_head(vc_frame_writer *writer, uint8_t type, uint16_t sequence)
{
    vc_frame_write_number(writer, type, 1);
    vc_frame_write_number(writer, sequence, 2);
}

static void write_tag(vc_frame_writer *writer, uint8_t tag, size_t value_bytes)
{
    vc_frame_write_number(writer, tag, 1);
    vc_frame_write_number(writer, value_bytes, 2);
}

static void write_piece(vc_frame_writer *writer, vc_piece piece)
{
    vc_frame_write(writer, piece.bytes, piece.length);
}

static void write_sha256(vc_frame_writer *writer, const uint8_t *sha256)
{
    static const uint8_t zeros[32];
    vc_frame_write(writer, sha256 != NULL ? sha256 : zeros, sizeof zeros);
}

static void write_limits(vc_frame_writer *writer, uint8_t tag, const vc_controller_limits *value)
{
    write_tag(writer, tag, 2 + 2 + 4 + 4 + 1 + 4 + 4 + 2 + 4 + 4 + 4);
    vc_frame_write_number(writer, value->max_payload_bytes, 2);
    vc_frame_write_number(writer, value->max_packet_bytes, 2);
    vc_frame_write_number(writer, value->buffer_samples, 4);
    vc_frame_write_number(writer, value->capture_samples, 4);
    vc_frame_write_number(writer, value->channels, 1);
    vc_frame_write_number(writer, value->min_rate_hz, 4);
    vc_frame_write_number(writer, value->max_rate_hz, 4);
    vc_frame_write_number(writer, value->watchdog_ms, 2);
    vc_frame_write_number(writer, value->profile_samples, 4);
    vc_frame_write_number(writer, value->packet_samples, 4);
    vc_frame_write_number(writer, value->decoding_kilocycles_per_s, 4);
}

static void write_actuator_description(vc_frame_writer *writer, uint8_t tag, const vc_actuator_description *value)
{
    write_tag(writer, tag, 4 + 4 + 4 + 4 + 4 + 1 + 4 + value->name.length);
    vc_frame_write_number(writer, value->stroke_um_float_bits, 4);
    vc_frame_write_number(writer, value->volts_float_bits, 4);
    vc_frame_write_number(writer, value->lower_hz_float_bits, 4);
    vc_frame_write_number(writer, value->upper_hz_float_bits, 4);
    vc_frame_write_number(writer, value->slew_volts_per_second_float_bits, 4);
    vc_frame_write_number(writer, value->dac_bits, 1);
    vc_frame_write_number(writer, value->dac_rate_hz, 4);
    write_piece(writer, value->name);
}

static void write_codec_description(vc_frame_writer *writer, uint8_t tag, const vc_codec_description *value)
{
    write_tag(writer, tag, 1 + value->name.length);
    vc_frame_write_number(writer, value->identifier, 1);
    write_piece(writer, value->name);
}

static void write_image_description(vc_frame_writer *writer, uint8_t tag, const vc_image_description *value)
{
    write_tag(writer, tag, 1 + 1 + 32 + 4 + 1 + value->name.length + value->version.length);
    vc_frame_write_number(writer, value->slot, 1);
    vc_frame_write_number(writer, value->state, 1);
    write_sha256(writer, value->sha256);
    vc_frame_write_number(writer, value->number, 4);
    vc_frame_write_number(writer, value->name.length, 1);
    write_piece(writer, value->name);
    write_piece(writer, value->version);
}

static void write_coding_description(vc_frame_writer *writer, uint8_t tag, const vc_coding_description *value)
{
    write_tag(writer, tag, 4 + 4);
    vc_frame_write_number(writer, value->packet_samples, 4);
    vc_frame_write_number(writer, value->delay_samples, 4);
}

static void write_queued_stream(vc_frame_writer *writer, uint8_t tag, const vc_queued_stream *value)
{
    write_tag(writer, tag, 1 + 8);
    vc_frame_write_number(writer, value->stream, 1);
    vc_frame_write_number(writer, value->credit_until, 8);
}

static void write_output_faults(vc_frame_writer *writer, uint8_t tag, const vc_output_faults *value)
{
    write_tag(writer, tag, 4 + 4);
    vc_frame_write_number(writer, value->refused, 4);
    vc_frame_write_number(writer, value->restarts, 4);
}

static void write_frame_faults(vc_frame_writer *writer, uint8_t tag, const vc_frame_faults *value)
{
    write_tag(writer, tag, 4 + 4);
    vc_frame_write_number(writer, value->repeated, 4);
    vc_frame_write_number(writer, value->reordered, 4);
}

void vc_write_hello_response(vc_frame_writer *writer, uint16_t sequence, const vc_hello_response *message)
{
    unsigned i;
    write_head(writer, VC_HELLO_RESPONSE, sequence);
    vc_frame_write_number(writer, message->major, 1);
    vc_frame_write_number(writer, message->minor, 1);
    write_tag(writer, 1, message->build.length);
    write_piece(writer, message->build);
    write_tag(writer, 2, message->hardware.length);
    write_piece(writer, message->hardware);
    write_limits(writer, 3, &message->limits);
    write_actuator_description(writer, 4, &message->actuator);
    for (i = 0; i < message->codec_count; i++)
        write_codec_description(writer, 5, &message->codecs[i]);
    for (i = 0; i < message->image_count; i++)
        write_image_description(writer, 6, &message->images[i]);
    write_tag(writer, 7, message->public_key.length);
    write_piece(writer, message->public_key);
    write_tag(writer, 8, message->serial_number.length);
    write_piece(writer, message->serial_number);
}

void vc_write_status(vc_frame_writer *writer, uint16_t sequence, const vc_status_report *message)
{
    write_head(writer, VC_STATUS, sequence);
    vc_frame_write_number(writer, message->state, 1);
    vc_frame_write_number(writer, message->stream, 1);
    vc_frame_write_number(writer, message->device_time_us, 8);
    vc_frame_write_number(writer, message->position, 8);
    vc_frame_write_number(writer, message->credit_until, 8);
    vc_frame_write_number(writer, message->buffered_samples, 4);
    vc_frame_write_number(writer, message->bad_frames, 4);
    vc_frame_write_number(writer, message->underruns, 4);
    vc_frame_write_number(writer, message->lost_packets, 4);
    vc_frame_write_number(writer, message->compensation_clipped, 4);
    vc_frame_write_number(writer, message->voltage_limited, 4);
    vc_frame_write_number(writer, message->slew_limited, 4);
    vc_frame_write_number(writer, message->power_limited, 4);
    vc_frame_write_number(writer, message->output_gaps, 4);
    vc_frame_write_number(writer, message->late_samples, 4);
    vc_frame_write_number(writer, message->signed_images, 1);
    if (message->coding != NULL)
        write_coding_description(writer, 1, message->coding);
    if (message->queued != NULL)
        write_queued_stream(writer, 2, message->queued);
    if (message->output_faults != NULL)
        write_output_faults(writer, 3, message->output_faults);
    if (message->frame_faults != NULL)
        write_frame_faults(writer, 4, message->frame_faults);
}

void vc_write_capture_data(vc_frame_writer *writer, uint16_t sequence, const vc_capture_data *message)
{
    write_head(writer, VC_CAPTURE_DATA, sequence);
    vc_frame_write_number(writer, message->tap, 1);
    vc_frame_write_number(writer, message->channels, 1);
    vc_frame_write_number(writer, message->offset, 8);
    vc_frame_write_number(writer, message->end, 8);
}

void vc_write_flash_status(vc_frame_writer *writer, uint16_t sequence, const vc_flash_status *message)
{
    write_head(writer, VC_FLASH_STATUS, sequence);
    vc_frame_write_number(writer, message->slot, 1);
    vc_frame_write_number(writer, message->state, 1);
    vc_frame_write_number(writer, message->next_offset, 4);
    write_sha256(writer, message->sha256);
}

void vc_write_flash_contents(vc_frame_writer *writer, uint16_t sequence, const vc_flash_contents *message)
{
    write_head(writer, VC_FLASH_CONTENTS, sequence);
    vc_frame_write_number(writer, message->slot, 1);
    vc_frame_write_number(writer, message->size_bytes, 4);
    vc_frame_write_number(writer, message->offset, 4);
    write_piece(writer, message->data);
}

void vc_write_error(vc_frame_writer *writer, uint16_t sequence, const vc_error *message)
{
    write_head(writer, VC_ERROR, sequence);
    vc_frame_write_number(writer, message->code, 2);
    write_tag(writer, 1, message->text.length);
    write_piece(writer, message->text);
}

void vc_write_rejection(vc_frame_writer *writer, uint16_t sequence, const vc_rejection *rejection)
{
    const vc_error error = {rejection->code, {(const uint8_t *)rejection->text, rejection->length}};
    vc_write_error(writer, sequence, &error);
}
