/* The three functions of libc that compilers and the core call. */
#include "cortex_m.h"

/* A compiler must not turn these loops into calls of the functions that they are. */
#if defined(__clang__)
#define LOOPS_STAY __attribute__((no_builtin))
#elif defined(__GNUC__)
#define LOOPS_STAY __attribute__((optimize("no-tree-loop-distribute-patterns")))
#else
#define LOOPS_STAY
#endif

/* Copies words if both ends are aligned to words, or can be after the same few bytes. */
LOOPS_STAY void *memcpy(void *destination, const void *source, size_t length)
{
    uint8_t *to = destination;
    const uint8_t *from = source;
    if ((((uintptr_t)to ^ (uintptr_t)from) & 3) == 0) {
        for (; length > 0 && ((uintptr_t)to & 3) != 0; length--)
            *to++ = *from++;
        for (; length >= 4; length -= 4, to += 4, from += 4)
            *(uint32_t *)(void *)to = *(const uint32_t *)(const void *)from;
    }
    for (; length > 0; length--)
        *to++ = *from++;
    return destination;
}

LOOPS_STAY void *memset(void *destination, int value, size_t length)
{
    uint8_t *to = destination;
    uint32_t word = (uint8_t)value * 0x01010101u;
    for (; length > 0 && ((uintptr_t)to & 3) != 0; length--)
        *to++ = (uint8_t)value;
    for (; length >= 4; length -= 4, to += 4)
        *(uint32_t *)(void *)to = word;
    for (; length > 0; length--)
        *to++ = (uint8_t)value;
    return destination;
}

LOOPS_STAY int memcmp(const void *one, const void *other, size_t length)
{
    const uint8_t *a = one, *b = other;
    for (; length > 0; length--, a++, b++)
        if (*a != *b)
            return *a < *b ? -1 : 1;
    return 0;
}
