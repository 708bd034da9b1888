/* The learned codec `eva`: latents by an entropy coder, samples by a network in integers; layout in
 * docs/reference/bitstream.md.
 *
 * Portable C99, no allocation, no libc beyond memcpy and memset, no global state: everything lives in the structures
 * that the caller owns. A model is read in place, at any address, from flash if it lies there, and never copied.
 * Decoding takes less than 4 KiB of stack.
 */
#ifndef VIBROCAST_EVA_H
#define VIBROCAST_EVA_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_eva_decoder vc_eva_decoder;
typedef struct vc_eva_encoder vc_eva_encoder;

/* Bytes of memory, aligned for int64_t, that the caller provides for each structure, whatever the model. */
size_t vc_eva_decoder_size(void);
size_t vc_eva_encoder_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header, for up to 16 channels (VC_MAX_CHANNELS
 * of vc_common.h). `model`: the payload of a model image; it must stay valid while the decoder is used. Returns VC_OK,
 * VC_BAD_TABLES where that is no model, or VC_BAD_CONFIGURATION. */
int vc_eva_decoder_init(vc_eva_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, const uint8_t *model, size_t model_length);

/* Samples per channel in every packet of the stream, and samples per channel by which the output lags the input. */
uint32_t vc_eva_decoder_packet_samples(const vc_eva_decoder *decoder);
uint32_t vc_eva_decoder_delay_samples(const vc_eva_decoder *decoder);

/* As the functions of `mdct` with these names. A block is four columns of 16 samples of one channel, and takes two
 * polls. No sample is complete before the last channel's blocks. vc_eva_feed returns VC_BAD_TABLES, and takes nothing,
 * where the model has no network in integers. */
int vc_eva_feed(vc_eva_decoder *decoder, const uint8_t *packet, size_t length);
uint32_t vc_eva_poll(vc_eva_decoder *decoder, int16_t *samples);
int vc_eva_decode(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* The last for a synthesis that is done elsewhere: writes the latents, channels x packet_samples / 16 columns x
 * latents, in the model's unit. */
int vc_eva_decode_latents(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, int16_t *latents);

/* Prepares an encoder; configuration, model and result as for a decoder. `refresh_packets`: packets from one refresh to
 * the next, 0 = only the first packet is one. */
int vc_eva_encoder_init(vc_eva_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, const uint8_t *model, size_t model_length, uint32_t refresh_packets);

/* Codes one packet. `levels`: channels x columns x latents, in quantiser steps of the packet, limited to +-2^22.
 * `quantiser_offset`: of a rate-controlled stream, in 1/16 octave by which the steps are larger; other streams ignore
 * it. Returns the bytes written to `packet`, or VC_PACKET_TOO_LARGE; then the encoder must be initialised again. */
int32_t vc_eva_encode(vc_eva_encoder *encoder, const int32_t *levels, int32_t quantiser_offset, uint8_t *packet,
                      size_t capacity);
/* cffi: end */

#endif
