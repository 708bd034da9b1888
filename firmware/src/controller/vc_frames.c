/* Frames on the wire; see vc_frames.h. */
#include "vc_frames.h"

#include "../core/vc_common.h"
#include "../core/vc_crc.h"

#define DELIMITER 0

size_t vc_frame_reader_size(void)
{
    return sizeof(vc_frame_reader);
}

void vc_frame_reader_init(vc_frame_reader *reader)
{
    reader->bad_frames = 0;
    reader->length = 0;
    reader->taken = 0;
}

/* Decodes `pending` in place; returns the bytes of its payload, 0 for a damaged, empty or too long one. */
static size_t payload_bytes(vc_frame_reader *reader)
{
    size_t decoded, length;
    if (reader->length > VC_ENCODED_BYTES || vc_cobs_decode(reader->pending, reader->length, &decoded) != 0 ||
        decoded <= VC_CRC_BYTES || decoded > VC_MAX_PAYLOAD_BYTES + VC_CRC_BYTES)
        return 0;
    length = decoded - VC_CRC_BYTES;
    if (vc_crc16(reader->pending, length, VC_CRC16_START) != vc_number(reader->pending + length, VC_CRC_BYTES))
        return 0;
    return length;
}

size_t vc_frame_reader_feed(vc_frame_reader *reader, const uint8_t *data, size_t length, vc_piece *payload)
{
    size_t taken;
    payload->bytes = reader->pending;
    payload->length = 0;
    if (reader->taken)
        reader->length = 0;
    reader->taken = 0;
    for (taken = 0; taken < length; taken++) {
        if (data[taken] != DELIMITER) {
            if (reader->length < sizeof reader->pending)
                reader->pending[reader->length++] = data[taken];
        } else if (reader->length > 0) {
            /* Zeros with nothing between them are allowed: a sender may begin with one, to end earlier noise. */
            payload->length = payload_bytes(reader);
            if (payload->length > 0) {
                reader->taken = 1;
                return taken + 1;
            }
            reader->length = 0;
            vc_count_one(&reader->bad_frames);
        }
    }
    return taken;
}

uint32_t vc_frame_reader_bad_frames(const vc_frame_reader *reader)
{
    return reader->bad_frames;
}

void vc_frame_begin(vc_frame_writer *writer, uint8_t *frame, size_t capacity)
{
    vc_cobs_begin(&writer->cobs, frame, capacity);
    writer->payload_bytes = 0;
    writer->crc = VC_CRC16_START;
}

void vc_frame_write(vc_frame_writer *writer, const uint8_t *payload, size_t length)
{
    vc_cobs_put(&writer->cobs, payload, length);
    writer->crc = vc_crc16(payload, length, writer->crc);
    writer->payload_bytes += length;
}

void vc_frame_write_number(vc_frame_writer *writer, uint64_t number, unsigned bytes)
{
    uint8_t packed[sizeof number];
    vc_number_bytes(packed, number, bytes);
    vc_frame_write(writer, packed, bytes);
}

void vc_frame_write_samples(vc_frame_writer *writer, const int16_t *samples, size_t count)
{
    size_t i;
    for (i = 0; i < count; i++)
        vc_frame_write_number(writer, (uint16_t)samples[i], 2);
}

size_t vc_frame_end(vc_frame_writer *writer)
{
    uint8_t crc[VC_CRC_BYTES];
    size_t encoded;
    vc_number_bytes(crc, writer->crc, VC_CRC_BYTES);
    vc_cobs_put(&writer->cobs, crc, VC_CRC_BYTES);
    encoded = vc_cobs_end(&writer->cobs);
    if (encoded == 0 || encoded == writer->cobs.capacity || writer->payload_bytes == 0 ||
        writer->payload_bytes > VC_MAX_PAYLOAD_BYTES)
        return 0;
    writer->cobs.encoded[encoded] = DELIMITER;
    return encoded + 1;
}
