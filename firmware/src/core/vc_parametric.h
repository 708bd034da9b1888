/* The codec `parametric`: a description of a texture - band levels, their course over time, ridges - and no waveform.
 *
 * Decoder, which synthesises the texture, and the encoder's integer half that mirrors its syntax; the description is
 * found in codec/parametric.py. The layout of streams is in docs/reference/bitstream.md. Statuses are those of
 * vibrocast/status.h. */
#ifndef VIBROCAST_PARAMETRIC_H
#define VIBROCAST_PARAMETRIC_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_parametric_decoder vc_parametric_decoder;
typedef struct vc_parametric_encoder vc_parametric_encoder;

/* Bytes of memory, aligned for int64_t, that the caller provides for each structure. */
size_t vc_parametric_decoder_size(void);
size_t vc_parametric_encoder_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header. Returns VC_OK or
 * VC_BAD_CONFIGURATION. The first packet must be a refresh packet. */
int vc_parametric_decoder_init(vc_parametric_decoder *decoder, const uint8_t *configuration,
                               size_t configuration_length, unsigned channels);

/* Samples per channel in every packet of the stream, and samples per channel by which the output lags the input. */
uint32_t vc_parametric_decoder_packet_samples(const vc_parametric_decoder *decoder);
uint32_t vc_parametric_decoder_delay_samples(const vc_parametric_decoder *decoder);

/* As the functions of `mdct` with these names. */
int vc_parametric_feed(vc_parametric_decoder *decoder, const uint8_t *packet, size_t length);
uint32_t vc_parametric_poll(vc_parametric_decoder *decoder, int16_t *samples);
int vc_parametric_decode(vc_parametric_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Prepares an encoder. `refresh_packets`: packets from one refresh to the next, 0 = only the first packet is one. */
int vc_parametric_encoder_init(vc_parametric_encoder *encoder, const uint8_t *configuration,
                               size_t configuration_length, unsigned channels, uint32_t refresh_packets);

/* Numbers that describe a frame of one channel: the ridges' pitch code (-1 = none), its levels over time, band levels
 * and the ridges' harmonics' levels, as in struct vc_parametric_frame of vc_parametric_frame.h. */
uint32_t vc_parametric_frame_values(const vc_parametric_encoder *encoder);

/* Codes one packet. `frames`: frames x channels x vc_parametric_frame_values() numbers; those outside what the layout
 * has are limited. Returns the bytes written to `packet`, or VC_PACKET_TOO_LARGE. */
int32_t vc_parametric_encode(vc_parametric_encoder *encoder, const int16_t *frames, uint8_t *packet, size_t capacity);
/* cffi: end */

#endif
