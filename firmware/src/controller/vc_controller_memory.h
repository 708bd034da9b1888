/* The state of a controller, for a port that reserves its memory at compile time. Nothing else reads or writes it.
 */
#ifndef VIBROCAST_CONTROLLER_MEMORY_H
#define VIBROCAST_CONTROLLER_MEMORY_H

#include "vc_image_store.h"
#include "vc_playback.h"

struct vc_controller {
    const vc_controller_settings *settings;
    uint64_t time_us, heard_us; /* the time now, and that of the host's last message */
    uint64_t dac_free_us;       /* time at which another stream may use the DAC */
    vc_image_store images;
    vc_frame_reader reader;
    vc_frame_faults frame_faults;

    /* The session: the sequence numbers of the Hello and of the last request, and the answer to that. */
    int in_session;
    uint16_t opened_by, last_sequence;
    uint32_t answer_bytes;
    uint8_t answer[VC_FRAME_BYTES];

    /* What the last Status said, if there was one. */
    int reported;
    uint8_t last_state, last_stream;
    uint32_t last_underruns;
    uint64_t last_credit_until, last_time_us;
    uint32_t outgoing_at, outgoing_end; /* bytes that wait for the host */
    uint8_t outgoing[VC_OUTGOING_BYTES];

    int configured;                     /* there is a stream, or was one */
    enum vc_state state_without_stream; /* until then */
    vc_playback playback;
};

#endif
