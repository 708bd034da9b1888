/* The codecs that a controller decodes, behind one interface: memory for any of them, chosen by a stream's header. */
#ifndef VIBROCAST_DECODERS_H
#define VIBROCAST_DECODERS_H

#include "decoder_memory.h"
#include "messages.h"

#define VC_CODECS 5

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
    /* What vc_coding_check finds: samples per channel in each packet, and by which the output lags the input. */
    uint32_t packet_samples, delay_samples;
} vc_coding;

typedef struct {
    uint8_t codec;
    union {
        struct vc_mdct_decoder mdct;
        struct vc_dct_decoder dct;
        struct vc_slp_decoder slp;
        struct vc_eva_decoder eva;
        struct vc_parametric_decoder parametric;
    } of;
} vc_decoder;

/* Finds what the packets of a stream are. Returns 0, or the refusal's code, VC_UNKNOWN_CODEC, where it cannot be
 * decoded. Any bytes are safe. */
int vc_coding_check(vc_coding *coding, vc_refusal *refusal);

/* Returns 0 if a codec's decoder takes the payload of a model image, or the refusal's code, VC_IMAGE_REFUSED. Any bytes
 * are safe. */
int vc_tables_check(uint8_t codec, const uint8_t *tables, size_t length, vc_refusal *refusal);

/* Makes a fresh decoder of what vc_coding_check has passed. */
void vc_decoder_init(vc_decoder *decoder, const vc_coding *coding);

/* Decodes the next packet into packet_samples x channels interleaved samples. Returns whether that could be done; if
 * not, nothing is written. A packet that does not follow the last one fades to silence. Any bytes are safe. */
int vc_decoder_decode(vc_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Stands in for one missing packet: packet_samples x channels samples, the last sound faded out, then silence. */
void vc_decoder_conceal(vc_decoder *decoder, int16_t *samples);

#endif
