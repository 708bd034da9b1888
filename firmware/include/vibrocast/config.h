/* Codecs and channels of a build. Set them by -D, for the library and for each source that includes its headers:
 * VC_DECODER_WORDS and the sizes of a controller follow from them. */
#ifndef VIBROCAST_CONFIG_H
#define VIBROCAST_CONFIG_H

/* 1: with the decoder of this codec, 0: without. A controller offers the codecs that it has to the host, and rejects
 * streams of another. */
#ifndef VC_WITH_MDCT
#define VC_WITH_MDCT 1
#endif
#ifndef VC_WITH_DCT
#define VC_WITH_DCT 1
#endif
#ifndef VC_WITH_SLP
#define VC_WITH_SLP 1
#endif
#ifndef VC_WITH_EVA
#define VC_WITH_EVA 1
#endif
#ifndef VC_WITH_PARAMETRIC
#define VC_WITH_PARAMETRIC 1
#endif

#if !(VC_WITH_MDCT || VC_WITH_DCT || VC_WITH_SLP || VC_WITH_EVA || VC_WITH_PARAMETRIC)
#error "set VC_WITH_MDCT or another VC_WITH_... to 1: there is no codec"
#endif

/* Channels of a stream. A controller with fewer is compiled with fewer: its decoders reject streams of more, and are
 * smaller. */
#ifndef VC_MAX_CHANNELS
#define VC_MAX_CHANNELS 16
#endif
#if VC_MAX_CHANNELS < 1 || VC_MAX_CHANNELS > 16
#error "VC_MAX_CHANNELS: 1 to 16"
#endif

#endif
