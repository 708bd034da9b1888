/* The coded packets that wait to be decoded, each by its number in the stream, in a pool of a fixed number of bytes. */
#ifndef VIBROCAST_PACKET_BUFFER_H
#define VIBROCAST_PACKET_BUFFER_H

#include "vibrocast/sizes.h"

/* Where a packet lies in the pool; a length of 0: it is not there. */
typedef struct {
    uint32_t offset, length;
} vc_buffered_packet;

typedef struct {
    uint32_t count;                                /* packets held */
    uint32_t used;                                 /* bytes of them, without gaps, from the start of `bytes` */
    vc_buffered_packet packets[VC_BUFFER_PACKETS]; /* by number modulo VC_BUFFER_PACKETS */
    uint8_t bytes[VC_BUFFER_BYTES];
} vc_packet_buffer;

void vc_packet_buffer_clear(vc_packet_buffer *buffer);

/* Returns how many more of the longest packets have room. */
uint32_t vc_packet_buffer_room(const vc_packet_buffer *buffer);

/* Keeps a copy of packet `number`, unless it is there already. All numbers held must lie within VC_BUFFER_PACKETS.
 * Returns whether it was kept: not where it is longer than VC_MAX_PACKET_BYTES or has no room. */
int vc_packet_buffer_add(vc_packet_buffer *buffer, uint64_t number, const uint8_t *packet, size_t length);

/* Returns packet `number` where it lies, until the buffer is next changed; NULL where it is not there. */
const uint8_t *vc_packet_buffer_find(const vc_packet_buffer *buffer, uint64_t number, size_t *length);

void vc_packet_buffer_remove(vc_packet_buffer *buffer, uint64_t number);

#endif
