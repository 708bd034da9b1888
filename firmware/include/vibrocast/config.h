/* Sizes of the decoders. A board sets them by -D, for all sources alike. */
#ifndef VIBROCAST_CONFIG_H
#define VIBROCAST_CONFIG_H

/* Channels of a stream. A controller with fewer is compiled with fewer: its decoders reject streams of more, and are
 * smaller. */
#ifndef VC_MAX_CHANNELS
#define VC_MAX_CHANNELS 16
#endif

#endif
