/* Decoder of `mdct`, and the encoder that mirrors it.
 *
 * Portable C99, no allocation, no libc but memcpy and memset, no global state. Everything lives in structures that the
 * caller owns. Every function returns a status or cannot fail. docs/reference/bitstream.md has the layout of streams.
 */
#ifndef VIBROCAST_MDCT_H
#define VIBROCAST_MDCT_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_mdct_decoder vc_mdct_decoder;
typedef struct vc_mdct_encoder vc_mdct_encoder;

/* Return the bytes of memory, aligned for int64_t, that the caller provides for each structure. */
size_t vc_mdct_decoder_size(void);
size_t vc_mdct_encoder_size(void);

/* Returns the bytes of a set of initial tables: adaptive probabilities, mixer weights and centroids at a refresh. */
size_t vc_mdct_tables_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header. `tables`: NULL for the built-in set,
 * else tables that must stay valid while the decoder is used. The first packet must be a
 * refresh. Returns VC_OK, VC_BAD_CONFIGURATION or VC_BAD_TABLES. */
int vc_mdct_decoder_init(vc_mdct_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                         unsigned channels, const uint8_t *tables, size_t tables_length);

/* Return the samples per channel in every packet, and the samples per channel by which the output lags the input. */
uint32_t vc_mdct_decoder_packet_samples(const vc_mdct_decoder *decoder);
uint32_t vc_mdct_decoder_delay_samples(const vc_mdct_decoder *decoder);

/* Takes the next packet, NULL where it is missing; its bytes must stay valid until the last block has been polled.
 * Returns VC_OK; VC_CONCEALED for a missing packet, or one that does not follow the last one and is no refresh; or
 * VC_BAD_PACKET, and takes nothing. A refresh is decoded whatever its number: the caller orders packets and drops late
 * ones. Any bytes are safe.
 * A concealed packet fades the last sound to zero within the packet or its first eight blocks. Silence follows until a
 * packet can be decoded. */
int vc_mdct_feed(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length);

/* Decodes the next block of one channel, and returns the samples per channel that are complete, from the packet's first
 * one on: packet_samples of them end it. `samples`: memory for the whole packet, packet_samples x channels interleaved
 * samples, 32768 = full scale, the same in each call of a packet. */
uint32_t vc_mdct_poll(vc_mdct_decoder *decoder, int16_t *samples);

/* Decodes a whole packet: feeds it and polls all its blocks. Returns as vc_mdct_feed; nothing is written for
 * VC_BAD_PACKET. */
int vc_mdct_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Prepares an encoder. `refresh_packets`: packets from one refresh to the next, 0 = only the first packet is one.
 * `lambda`: Lagrangian weight of one bit against squared error, in 1/256 of a squared quantiser step. */
int vc_mdct_encoder_init(vc_mdct_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                         unsigned channels, const uint8_t *tables, size_t tables_length, uint32_t refresh_packets,
                         uint32_t lambda);

/* Windowed forward MDCT of a signal, blocks x channels x hop, in the unit of its samples: (blocks + 1) x hop x
 * channels, within +-2^24, twice full scale. */
void vc_mdct_analyse(const int32_t *samples, uint32_t blocks, unsigned channels, uint32_t hop, int32_t *coefficients);

/* Codes one packet. Returns the bytes written to `packet`, or VC_PACKET_TOO_LARGE.
 * `coefficients`: MDCT coefficients, blocks x channels x hop, in 1/256 of a sample's least significant bit, limited to
 * +-2^28.
 * `quantiser_offset`: of a rate-controlled stream, in 1/16 octave of the step. The packet carries the nearest multiple
 * of four; the remainder adjusts lambda. Other streams ignore it. */
int32_t vc_mdct_encode(vc_mdct_encoder *encoder, const int32_t *coefficients, int32_t quantiser_offset, uint8_t *packet,
                       size_t capacity);

/* Returns the squared error of the coefficients of a channel in all packets so far, noise filling included, in 1/256 of
 * a squared least significant bit. The transform is orthogonal, so the decoded samples have this error, except for
 * their rounding. */
uint64_t vc_mdct_squared_error(const vc_mdct_encoder *encoder, unsigned channel);

/* Re-packing: the same levels in packets of another length. Both functions take a structure that vc_mdct_encoder_init
 * has prepared, with lambda 0. One has the configuration of the packets, the other a configuration of another length.
 *
 * Reads the levels of the next packet, blocks x channels x hop, in quantiser steps. `silent`: blocks x channels, 1 for
 * a block that is coded as silent. `quantiser_offset`: in 1/4 octave, 0 if packets carry none. Returns VC_OK, or
 * VC_BAD_PACKET for another packet than the next one. Any bytes are safe. */
int vc_mdct_read_levels(vc_mdct_encoder *reader, const uint8_t *packet, size_t length, int32_t *levels, uint8_t *silent,
                        int32_t *quantiser_offset);

/* Codes the next packet from levels as read. `refresh`: whether a refresh begins with them. Returns as
 * vc_mdct_encode. */
int32_t vc_mdct_write_levels(vc_mdct_encoder *writer, const int32_t *levels, const uint8_t *silent,
                             int32_t quantiser_offset, int refresh, uint8_t *packet, size_t capacity);

/* The built-in tables. */
const uint8_t *vc_mdct_builtin_tables(void);

/* Writes the encoder's adapted state as initial tables (vc_mdct_tables_size() bytes), for the training of tables. */
void vc_mdct_encoder_tables(const vc_mdct_encoder *encoder, uint8_t *tables);

/* Training: lets the encoder's first packet begin with the adapted state of another encoder, which must stay valid
 * until then; NULL = with the tables. Tables that it writes have the means of the magnitudes that it and those before
 * coded by each level. */
void vc_mdct_encoder_follow(vc_mdct_encoder *encoder, const vc_mdct_encoder *before);
/* cffi: end */

#endif
