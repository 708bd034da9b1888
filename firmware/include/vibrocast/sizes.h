/* Sizes of a controller. A board sets them by -D, for all sources alike. The defaults suit a computer and the simulated
 * controller. RAM grows with each: `python -m vibrocast.firmware.build --sizes` prints it. */
#ifndef VIBROCAST_SIZES_H
#define VIBROCAST_SIZES_H

#include "config.h"
#include "output.h"
#include "profile.h"
#include "protocol.h"

/* Channels of a stream, at most VC_MAX_CHANNELS (config.h), for which decoders reserve memory. */
#ifndef VC_CHANNELS
#if VC_MAX_CHANNELS < 8
#define VC_CHANNELS VC_MAX_CHANNELS
#else
#define VC_CHANNELS 8
#endif
#endif

/* The buffer of a stream: samples per channel, packets, and bytes of coded packets; each at least 1. */
#ifndef VC_BUFFER_SAMPLES
#define VC_BUFFER_SAMPLES 32768
#endif
#ifndef VC_BUFFER_PACKETS
#define VC_BUFFER_PACKETS 1024
#endif
#ifndef VC_BUFFER_BYTES
#define VC_BUFFER_BYTES (VC_BUFFER_PACKETS * VC_MAX_PACKET_BYTES)
#endif

/* Samples per channel of the longest packet: one packet is decoded at a time. */
#ifndef VC_PACKET_SAMPLES
#define VC_PACKET_SAMPLES VC_BUFFER_SAMPLES
#endif

/* Samples of a height profile, all channels together; 0: leave `profile` out of the settings. */
#ifndef VC_PROFILE_SAMPLES
#define VC_PROFILE_SAMPLES 65536
#endif
#define VC_PROFILE_WORDS (VC_PROFILE_MEMORY(VC_PROFILE_SAMPLES, VC_CHANNELS) / sizeof(int64_t) + 1)

/* Samples per channel that each capture keeps; 0: no captures. */
#ifndef VC_CAPTURE_SAMPLES
#define VC_CAPTURE_SAMPLES 524288
#endif

/* Bytes of a frame's payload in both directions: 640 to 4096. HelloResponse needs 640. */
#ifndef VC_MAX_PAYLOAD_BYTES
#define VC_MAX_PAYLOAD_BYTES VC_PROTOCOL_MAX_PAYLOAD_BYTES
#endif
#define VC_MAX_PACKET_BYTES (VC_MAX_PAYLOAD_BYTES - VC_PACKET_OVERHEAD_BYTES)
/* Bytes of an image's name, and of its version, in HelloResponse. The other parts leave this room with two slots, eight
 * codecs, and the longest build, hardware id and name of an actuator. */
#define VC_IMAGE_TEXT_BYTES ((VC_MAX_PAYLOAD_BYTES - 576) / 4)

/* Bytes that wait for the host: a few answers, and at least one with the frame around it. A lost answer comes again
 * when the host repeats its request. */
#ifndef VC_OUTGOING_BYTES
#define VC_OUTGOING_BYTES (4 * VC_MAX_PAYLOAD_BYTES)
#endif

/* Highest rate of a stream in multiples of the DAC's rate: the resampler has memory for it. */
#ifndef VC_RATE_RATIO
#define VC_RATE_RATIO 16
#endif

#if VC_CHANNELS < 1 || VC_CHANNELS > VC_MAX_CHANNELS
#error "VC_CHANNELS: 1 to VC_MAX_CHANNELS"
#endif
#if VC_MAX_PAYLOAD_BYTES < 640 || VC_MAX_PAYLOAD_BYTES > VC_PROTOCOL_MAX_PAYLOAD_BYTES
#error "VC_MAX_PAYLOAD_BYTES: 640 to VC_PROTOCOL_MAX_PAYLOAD_BYTES"
#endif
#if VC_BUFFER_BYTES < 4 * VC_MAX_PACKET_BYTES
#error "VC_BUFFER_BYTES: room for four of the longest packets, or a host is kept waiting"
#endif
#if VC_RATE_RATIO < 1 || VC_RATE_RATIO > VC_RESAMPLER_MAX_RATIO
#error "VC_RATE_RATIO: 1 to VC_RESAMPLER_MAX_RATIO"
#endif

#endif
