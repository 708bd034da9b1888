/* The coded packets that wait to be decoded; see vc_packet_buffer.h. */
#include "vc_packet_buffer.h"

#include "../core/vc_common.h"

void vc_packet_buffer_clear(vc_packet_buffer *buffer)
{
    buffer->count = buffer->used = 0;
    memset(buffer->packets, 0, sizeof buffer->packets);
}

uint32_t vc_packet_buffer_room(const vc_packet_buffer *buffer)
{
    return (VC_BUFFER_BYTES - buffer->used) / VC_MAX_PACKET_BYTES;
}

int vc_packet_buffer_add(vc_packet_buffer *buffer, uint64_t number, const uint8_t *packet, size_t length)
{
    vc_buffered_packet *place = &buffer->packets[number % VC_BUFFER_PACKETS];
    if (place->length > 0 || length < 1 || length > VC_MAX_PACKET_BYTES || length > VC_BUFFER_BYTES - buffer->used)
        return 0;
    memcpy(buffer->bytes + buffer->used, packet, length);
    place->offset = buffer->used;
    place->length = (uint32_t)length;
    buffer->used += place->length;
    buffer->count++;
    return 1;
}

const uint8_t *vc_packet_buffer_find(const vc_packet_buffer *buffer, uint64_t number, size_t *length)
{
    const vc_buffered_packet *place = &buffer->packets[number % VC_BUFFER_PACKETS];
    *length = place->length;
    return place->length > 0 ? buffer->bytes + place->offset : NULL;
}

void vc_packet_buffer_remove(vc_packet_buffer *buffer, uint64_t number)
{
    vc_buffered_packet *place = &buffer->packets[number % VC_BUFFER_PACKETS];
    const uint32_t gap = place->length;
    uint32_t to = place->offset, i;
    if (gap == 0)
        return;
    /* Moves later packets down, in pieces that do not overlap their targets. */
    while (to + gap < buffer->used) {
        const uint32_t left = buffer->used - to - gap, piece = left < gap ? left : gap;
        memcpy(buffer->bytes + to, buffer->bytes + to + gap, piece);
        to += piece;
    }
    for (i = 0; i < VC_BUFFER_PACKETS; i++)
        if (buffer->packets[i].length > 0 && buffer->packets[i].offset > place->offset)
            buffer->packets[i].offset -= gap;
    buffer->used -= gap;
    buffer->count--;
    place->length = 0;
}
