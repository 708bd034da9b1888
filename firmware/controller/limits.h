/* Sizes that are compiled in; a build sets others with -D. */
#ifndef VIBROCAST_LIMITS_H
#define VIBROCAST_LIMITS_H

/* Longest payload of a frame, both ways. Two frames of it are held. */
#ifndef VC_MAXIMUM_PAYLOAD_BYTES
#define VC_MAXIMUM_PAYLOAD_BYTES 4096
#endif

#endif
