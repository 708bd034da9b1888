/* Targets: frames, messages, stream headers, model images. */
#include <stdlib.h>
#include <string.h>

#include "../src/core/vc_crc.h"
#include "../src/controller/vc_decoders.h"
#include "../src/controller/vc_messages.h"
#include "../src/core/vc_model_image.h"
#include "../src/core/vc_stream_header.h"
#include "targets.h"

static volatile uint8_t seen;

/* Reads all of a piece, for a sanitiser to see. */
static void touch(vc_piece piece)
{
    size_t i;
    for (i = 0; i < piece.length; i++)
        seen ^= piece.bytes[i];
}

static void check_rejection(int code, const vc_rejection *rejection)
{
    uint8_t frame[VC_FRAME_BYTES];
    vc_piece text = {(const uint8_t *)rejection->text, rejection->length};
    vc_frame_writer writer;
    vc_fuzz_check(code == rejection->code && code >= VC_UNKNOWN_MESSAGE && code <= VC_FLASH_FAILED, "no error code");
    vc_fuzz_check(text.length > 0 && vc_is_utf8(text), "an error without a text");
    vc_frame_begin(&writer, frame, sizeof frame);
    vc_write_rejection(&writer, 1, rejection);
    vc_fuzz_check(vc_frame_end(&writer) > 0, "an error that fits no frame");
}

/* Reads a header, and checks a coding of the codec that it names. */
static void read_header(const uint8_t *data, size_t length)
{
    vc_stream_header header;
    vc_coding coding;
    vc_rejection rejection;
    int code = vc_stream_header_read(&header, data, length, &rejection);
    if (code != 0) {
        check_rejection(code, &rejection);
        return;
    }
    vc_fuzz_check(header.output.channels >= 1 && header.output.channels <= VC_STREAM_MAX_CHANNELS &&
                      header.output.rate_hz >= 1 && header.output.rate_hz <= VC_STREAM_MAX_RATE_HZ &&
                      header.output.unit <= VC_UNIT_PROFILE && header.codec >= 1 && header.codec <= 15,
                  "a stream header out of range");
    memset(&coding, 0, sizeof coding);
    coding.codec = header.codec;
    coding.channels = header.output.channels;
    coding.configuration = header.configuration;
    coding.configuration_length = header.configuration_length;
    code = vc_coding_check(&coding, NULL, &rejection);
    if (code != 0)
        check_rejection(code, &rejection);
    else
        vc_fuzz_check(coding.packet_samples > 0, "packets without samples");
}

static void read_packet_head(vc_piece packet)
{
    uint32_t sequence;
    int refresh;
    if (vc_packet_sequence(packet.bytes, packet.length, &sequence, &refresh) == 0)
        vc_fuzz_check(packet.length > 0 && (refresh == 0 || refresh == 1), "a packet without a head");
}

static void read_packets(const vc_stream_data *data)
{
    vc_piece packets = data->packets, packet;
    while (vc_next_item(&packets, &packet)) {
        touch(packet);
        read_packet_head(packet);
    }
}

void vc_fuzz_headers(const uint8_t *data, size_t length)
{
    const vc_piece packet = {data, length};
    read_header(data, length);
    read_packet_head(packet);
}

void vc_fuzz_messages(const uint8_t *data, size_t length)
{
    vc_message message;
    vc_rejection rejection;
    int code;
    if (length > 0 && data[0] >= VC_FIRST_FROM_CONTROLLER)
        return;
    code = vc_message_read(&message, data, length, &rejection);
    if (code != 0)
        check_rejection(code, &rejection);
    else if (message.type == VC_CONFIGURE)
        read_header(message.body.configure.header.bytes, message.body.configure.header.length);
    else if (message.type == VC_STREAM_DATA)
        read_packets(&message.body.stream_data);
    else if (message.type == VC_FLASH_DATA)
        touch(message.body.flash_data.data);
    else if (message.type == VC_FLASH_BEGIN)
        vc_fuzz_check(vc_is_utf8(message.body.flash_begin.hardware), "a text that is not UTF-8");
}

void vc_fuzz_frames(const uint8_t *data, size_t length)
{
    vc_frame_reader *reader = malloc(vc_frame_reader_size());
    uint8_t frame[VC_FRAME_BYTES];
    vc_frame_writer writer;
    vc_piece payload;
    size_t at = 0, piece, taken;
    vc_frame_reader_init(reader);
    while (at < length) {
        piece = 1 + data[at] % 64;
        taken = vc_frame_reader_feed(reader, data + at, piece < length - at ? piece : length - at, &payload);
        vc_fuzz_check(taken > 0 && payload.length <= VC_MAX_PAYLOAD_BYTES, "a reader that takes nothing");
        at += taken;
        if (payload.length == 0)
            continue;
        vc_frame_begin(&writer, frame, sizeof frame);
        vc_frame_write(&writer, payload.bytes, payload.length);
        vc_fuzz_check(vc_frame_end(&writer) > 0, "a payload that was read and cannot be written");
        vc_fuzz_messages(payload.bytes, payload.length);
    }
    free(reader);
}

static void read_image(const uint8_t *data, size_t length)
{
    vc_model_image image;
    vc_rejection rejection;
    int code = vc_model_image_read(&image, data, length, &rejection);
    if (code != 0) {
        check_rejection(code, &rejection);
        return;
    }
    vc_fuzz_check(image.name.length + image.version.length + image.hardware.length + image.payload.length < length,
                  "an image whose parts are longer than it");
    touch(image.payload);
    code = vc_tables_check(NULL, image.codec, image.payload.bytes, image.payload.length, &rejection);
    if (code != 0)
        check_rejection(code, &rejection);
}

void vc_fuzz_images(const uint8_t *data, size_t length)
{
    uint8_t *mended;
    read_image(data, length);
    if (length < 4)
        return;
    mended = malloc(length);
    memcpy(mended, data, length - 4);
    vc_number_bytes(mended + length - 4, vc_crc32(data, length - 4, 0), 4);
    read_image(mended, length);
    free(mended);
}
