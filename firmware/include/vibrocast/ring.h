/* A ring of bytes between an interrupt and the main loop: one side puts bytes in, the other takes them out.
 *
 * Each side may be an interrupt or the loop, both on one processor core that reads and writes 32 bits at once. The
 * putting side calls vc_ring_put and vc_ring_write, the taking side vc_ring_take and vc_ring_read. No call waits, and
 * none needs a lock. Needs a compiler with GNU assembler statements, such as GCC or Clang. */
#ifndef VIBROCAST_RING_H
#define VIBROCAST_RING_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* An interrupt may run while the flash that holds all other code cannot be read. So these two are a part of it, however
 * a compiler optimises. */
#if defined(__GNUC__)
#define VC_RING_INLINE static inline __attribute__((always_inline))
#else
#define VC_RING_INLINE static inline
#endif

/* `bytes` and its `capacity`, a power of two up to 2^31, belong to the port. It begins with both counts at 0. They run
 * on for ever; only one side writes each. */
typedef struct {
    uint8_t *bytes;
    uint32_t capacity;
    volatile uint32_t put, taken;
} vc_ring;

/* Puts in a byte. Returns 0, and drops the byte, if the ring is full. */
VC_RING_INLINE int vc_ring_put(vc_ring *ring, uint8_t byte)
{
    uint32_t put = ring->put;
    if (put - ring->taken == ring->capacity)
        return 0;
    ring->bytes[put & (ring->capacity - 1)] = byte;
    __asm volatile("" ::: "memory"); /* the byte is there before the count says so */
    ring->put = put + 1;
    return 1;
}

/* Takes out a byte. Returns 0 if the ring is empty. */
VC_RING_INLINE int vc_ring_take(vc_ring *ring, uint8_t *byte)
{
    uint32_t taken = ring->taken;
    if (taken == ring->put)
        return 0;
    *byte = ring->bytes[taken & (ring->capacity - 1)];
    __asm volatile("" ::: "memory"); /* the byte is read before its place is free */
    ring->taken = taken + 1;
    return 1;
}

/* Takes out up to `capacity` bytes. Returns how many there were. */
static inline size_t vc_ring_read(vc_ring *ring, uint8_t *data, size_t capacity)
{
    size_t length = 0;
    while (length < capacity && vc_ring_take(ring, data + length))
        length++;
    return length;
}

/* Puts in up to `length` bytes. Returns how many had room. */
static inline size_t vc_ring_write(vc_ring *ring, const uint8_t *data, size_t length)
{
    size_t taken = 0;
    while (taken < length && vc_ring_put(ring, data[taken]))
        taken++;
    return taken;
}

#ifdef __cplusplus
}
#endif

#endif
