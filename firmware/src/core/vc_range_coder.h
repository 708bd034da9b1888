/* Binary range coder: 32-bit interval, 16-bit probabilities, no carry; bytes past the end of the input read as zero. */
#ifndef VIBROCAST_RANGE_CODER_H
#define VIBROCAST_RANGE_CODER_H

#include <stddef.h>
#include <stdint.h>

typedef struct {
    uint32_t low, high; /* bounds of the interval, both inside it */
    uint32_t value;     /* decoder only: the next 32 bits of the input */
    const uint8_t *input, *input_end;
    uint8_t *output, *output_end; /* encoder only */
    int overflow;                 /* encoder only: output did not fit */
} vc_range_coder;

/* Starts encoding into output[0..capacity) or decoding input[0..length). */
void vc_range_encoder_init(vc_range_coder *coder, uint8_t *output, size_t capacity);
void vc_range_decoder_init(vc_range_coder *coder, const uint8_t *input, size_t length);

/* Codes one decision. `probability`: of `bit` being 1, in 1/65536, 1 to 65535. */
void vc_range_encode(vc_range_coder *coder, int bit, uint32_t probability);
int vc_range_decode(vc_range_coder *coder, uint32_t probability);

/* Decodes decisions of even odds, at most 32; returns them as the bits of a number, the first one highest. */
uint32_t vc_range_decode_bits(vc_range_coder *coder, unsigned count);

/* Ends the packet with as few bytes as identify the interval. `start`: where output began; returns the bytes in use. */
size_t vc_range_encoder_finish(vc_range_coder *coder, const uint8_t *start);

#endif
