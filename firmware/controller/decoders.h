/* The codecs that a controller decodes, behind one interface: memory for any of them, chosen by a stream's header. */
#ifndef VIBROCAST_DECODERS_H
#define VIBROCAST_DECODERS_H

#include "decoder_memory.h"
#include "messages.h"

#define VC_CODECS 4

/* Their identifiers in stream headers and model images, and names. */
extern const vc_codec_description vc_codecs[VC_CODECS];

/* What a decoder is made from; the bytes belong to the caller. `tables`: payload of the model image that the stream
 * needs, which must stay valid while the decoder is used; NULL = those built in. */
typedef struct {
    uint8_t codec;
    uint8_t channels;
    const uint8_t *configuration;
    size_t configuration_length;
    const uint8_t *tables;
    size_t tables_length;
} vc_coding;

/* Samples per channel in each packet, and by which the output lags the input. */
typedef struct {
    uint32_t packet_samples, delay_samples;
} vc_packet_shape;

typedef struct {
    uint8_t codec;
    union {
        struct vc_mdct_decoder mdct;
        struct vc_dct_decoder dct;
        struct vc_slp_decoder slp;
        struct vc_eva_decoder eva;
    } of;
} vc_decoder;

/* Returns NULL if the stream can be decoded, and what its packets are; otherwise the reason why not. */
const char *vc_coding_check(const vc_coding *coding, vc_packet_shape *shape);

/* Returns NULL if a codec's decoder takes the payload of a model image, otherwise the reason why not. */
const char *vc_tables_check(uint8_t codec, const uint8_t *tables, size_t length);

/* Makes a fresh decoder of what vc_coding_check has passed. */
void vc_decoder_init(vc_decoder *decoder, const vc_coding *coding);

/* Decodes the next packet into packet_samples x channels interleaved samples. Returns whether that could be done; if
 * not, nothing is written. A packet that does not follow the last one fades to silence. Any bytes are safe. */
int vc_decoder_decode(vc_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Stands in for one missing packet: packet_samples x channels samples, the last sound faded out, then silence. */
void vc_decoder_conceal(vc_decoder *decoder, int16_t *samples);

#endif
