/* A `read` function for an emulated decoder: a stream that lies in memory. */
#include "vibrocast/decoder.h"

void *memcpy(void *destination, const void *source, size_t length);
size_t vc_array_read(void *context, uint8_t *data, size_t length);

typedef struct {
    const uint8_t *bytes;
    size_t left;
} vc_array;

size_t vc_array_read(void *context, uint8_t *data, size_t length)
{
    vc_array *array = context;
    length = length < array->left ? length : array->left;
    memcpy(data, array->bytes, length);
    array->bytes += length;
    array->left -= length;
    return length;
}
