/* Consistent overhead byte stuffing; see vc_cobs.h. */
#include "vc_cobs.h"

#define FULL_GROUP 0xFFu /* the code of 254 bytes that no zero follows */

static void write(vc_cobs_encoder *encoder, uint8_t byte)
{
    if (encoder->length < encoder->capacity)
        encoder->encoded[encoder->length++] = byte;
    else
        encoder->length = encoder->capacity + 1;
}

static void open_group(vc_cobs_encoder *encoder)
{
    encoder->code_at = encoder->length;
    encoder->open = 1;
    write(encoder, 0);
}

static void close_group(vc_cobs_encoder *encoder)
{
    encoder->open = 0;
    if (encoder->length <= encoder->capacity)
        encoder->encoded[encoder->code_at] = (uint8_t)(encoder->length - encoder->code_at);
}

void vc_cobs_begin(vc_cobs_encoder *encoder, uint8_t *encoded, size_t capacity)
{
    encoder->encoded = encoded;
    encoder->capacity = capacity;
    encoder->length = 0;
    open_group(encoder);
}

void vc_cobs_put(vc_cobs_encoder *encoder, const uint8_t *data, size_t length)
{
    size_t i;
    for (i = 0; i < length; i++) {
        if (!encoder->open)
            open_group(encoder);
        if (data[i] == 0) {
            close_group(encoder);
            open_group(encoder);
        } else {
            write(encoder, data[i]);
            if (encoder->length - encoder->code_at == FULL_GROUP)
                close_group(encoder);
        }
    }
}

size_t vc_cobs_end(vc_cobs_encoder *encoder)
{
    if (encoder->open)
        close_group(encoder);
    return encoder->length <= encoder->capacity ? encoder->length : 0;
}

int vc_cobs_decode(uint8_t *bytes, size_t length, size_t *decoded)
{
    size_t from = 0, to = 0, end;
    uint8_t code;
    while (from < length) {
        code = bytes[from++];
        if (code == 0 || (size_t)(code - 1) > length - from)
            return -1;
        for (end = from + code - 1; from < end; from++) {
            if (bytes[from] == 0)
                return -1;
            bytes[to++] = bytes[from];
        }
        if (code != FULL_GROUP && from < length)
            bytes[to++] = 0;
    }
    *decoded = to;
    return 0;
}
