/* Packets to spectra, for codecs whose streams differ from `mdct` only in the synthesis. */
#ifndef VIBROCAST_MDCT_DECODER_H
#define VIBROCAST_MDCT_DECODER_H

#include "vc_decoder_memory.h"

/* Turns a spectrum of a channel into its next hop samples, as many values apart as the stream has channels. */
typedef void (*vc_synthesis)(vc_mdct_decoder *decoder, unsigned channel, const int32_t *spectrum, int16_t *samples);

/* As vc_mdct_feed and vc_mdct_poll. */
int vc_spectra_feed(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length);
uint32_t vc_spectra_poll(vc_mdct_decoder *decoder, vc_synthesis synthesise, int16_t *samples);

/* Cycles for a sample of all channels, as vc_coding has them. */
uint32_t vc_spectra_cycles(const vc_mdct_configuration *configuration);

#endif
