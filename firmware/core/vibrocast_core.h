/* The integer core of vibrocast: the one decoder of `mdct` streams, and the encoder that mirrors it.
 *
 * Portable C99, no allocation, no libc beyond memcpy and memset, no global state: everything lives in the structures
 * that the caller owns. Every function returns a status or cannot fail. The layout of streams is in
 * docs/reference/bitstream.md.
 */
#ifndef VIBROCAST_CORE_H
#define VIBROCAST_CORE_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
enum vc_status {
    VC_OK = 0,
    VC_CONCEALED = 1,          /* the packet could not be played: its time was filled by a fade or by silence */
    VC_BAD_CONFIGURATION = -1, /* configuration bytes or channel count outside the layout */
    VC_BAD_TABLES = -2,        /* tables of another size */
    VC_BAD_PACKET = -3,        /* a malformed packet; nothing was played */
    VC_PACKET_TOO_LARGE = -4,  /* the coded packet does not fit the buffer; the encoder must be initialised again */
    VC_HOST_ONLY = -5          /* a stream that controllers do not decode */
};

typedef struct vc_mdct_decoder vc_mdct_decoder;
typedef struct vc_mdct_encoder vc_mdct_encoder;

/* Bytes of memory, aligned for int64_t, that the caller provides for each structure. */
size_t vc_mdct_decoder_size(void);
size_t vc_mdct_encoder_size(void);

/* Bytes of a set of initial tables (adaptive probabilities and mixer weights at a refresh), and of the network that
 * may follow it. */
size_t vc_mdct_tables_size(void);
size_t vc_mdct_network_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header. `tables`: NULL for the built-in set,
 * else tables, perhaps with a network, that must stay valid while the decoder is used. The first packet must be a
 * refresh packet. */
int vc_mdct_decoder_init(vc_mdct_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                         unsigned channels, const uint8_t *tables, size_t tables_length);

/* Samples per channel in every packet of the stream, and samples per channel by which the output lags the input. */
uint32_t vc_mdct_decoder_packet_samples(const vc_mdct_decoder *decoder);
uint32_t vc_mdct_decoder_delay_samples(const vc_mdct_decoder *decoder);

/* Decodes one packet into packet_samples x channels interleaved samples, 32768 = full scale. Returns VC_OK,
 * VC_CONCEALED when the packet does not follow the last one and is not a refresh, or VC_BAD_PACKET (nothing written). A
 * refresh packet is decoded whatever its number: the caller orders packets and drops those that come late. Any bytes
 * are safe. */
int vc_mdct_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Stands in for one missing packet: writes packet_samples x channels samples, the last sound faded to zero within the
 * packet (or its first eight blocks), then silence for as long as no packet can be decoded. */
void vc_mdct_conceal(vc_mdct_decoder *decoder, int16_t *samples);

/* Prepares an encoder. `refresh_packets`: packets from one refresh to the next, 0 = only the first packet is one.
 * `lambda`: Lagrangian weight of one bit against squared error, in 1/256 of a squared quantiser step. */
int vc_mdct_encoder_init(vc_mdct_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                         unsigned channels, const uint8_t *tables, size_t tables_length, uint32_t refresh_packets,
                         uint32_t lambda);

/* Codes one packet. `coefficients`: MDCT coefficients, blocks x channels x hop, in 1/256 of a sample's least
 * significant bit, limited to +-2^28. `quantiser_offset`: of a rate-controlled stream, in 1/16 octave of the step:
 * told in fours, the nearest one, and the rest moves lambda; other streams ignore it. Returns the bytes written to
 * `packet`, or VC_PACKET_TOO_LARGE. */
int32_t vc_mdct_encode(vc_mdct_encoder *encoder, const int32_t *coefficients, int32_t quantiser_offset, uint8_t *packet,
                       size_t capacity);

/* The built-in tables. */
const uint8_t *vc_mdct_builtin_tables(void);

/* Writes the encoder's adapted state as initial tables (vc_mdct_tables_size() bytes): how tables are trained. */
void vc_mdct_encoder_tables(const vc_mdct_encoder *encoder, uint8_t *tables);

/* How a network is trained: of each coefficient coded from now on, unless its block is silent, a row of
 * vc_mdct_example_values() numbers is written, as long as `capacity` rows have room: the network's inputs in 1/16, the
 * quantiser (0 or 1) and the index, at most 15. The second function returns the rows written. */
size_t vc_mdct_example_values(void);
void vc_mdct_encoder_record(vc_mdct_encoder *encoder, int16_t *rows, size_t capacity);
size_t vc_mdct_encoder_recorded(const vc_mdct_encoder *encoder);
/* cffi: end */

#endif
