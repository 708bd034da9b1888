/* One stream on the controller, and one behind it: packets buffered, decoded and concealed, drive, DAC, and the capture
 * of both ends.
 *
 * docs/reference/protocol.md, "Playing", says how it behaves. Time comes from outside, in microseconds of the
 * controller's clock. Packets are counted over all iterations.
 */
#ifndef VIBROCAST_PLAYBACK_H
#define VIBROCAST_PLAYBACK_H

#include "../core/vc_output_memory.h"
#include "vc_decoders.h"
#include "vc_messages.h"
#include "vc_packet_buffer.h"
#include "vibrocast/settings.h"
#include "../core/vc_stream_header.h"

/* Rates of a stream, in Hz. */
#define VC_MIN_RATE_HZ 100u
#define VC_MAX_RATE_HZ 48000u

/* Samples that are made and put out at a time, and how often in one turn. */
#define VC_PIECE_SAMPLES 32u
#define VC_TURN_PIECES 16u

/* How a packet or a position came, after those before it. */
enum vc_arrival { VC_IN_TURN, VC_REPEATED, VC_REORDERED };

/* The last samples of a signal, by their number since the start. */
typedef struct {
    uint32_t size; /* samples that it keeps */
    uint64_t end;  /* samples so far */
    uint32_t at;   /* where the next one goes */
    int16_t samples[(VC_CAPTURE_SAMPLES > 0 ? VC_CAPTURE_SAMPLES : 1) * VC_CHANNELS];
} vc_capture;

typedef struct {
    /* The stream. */
    vc_stream_header header;
    vc_coding coding;        /* points into the header, and into a model image in flash */
    vc_output_stream output; /* input of the drive; for a profile, the rendered heights */
    uint8_t spatial;         /* a height profile: all of it is loaded, then the hand's position plays it */
    uint8_t stream;
    uint8_t live;
    uint8_t open; /* a live stream whose end is not known yet */
    uint16_t loops;
    uint32_t packets; /* in one iteration, where it is not open */
    uint32_t prebuffer_samples;
    uint32_t buffer_packets; /* that the buffer's samples have room for */
    uint64_t key;            /* of its packet 0 in the buffer */
    int joins;               /* it follows another without a gap */

    /* The stream that follows it, if there is one. Its packets wait behind the last one of the stream under way. */
    int has_next;
    vc_queued_stream queued; /* of the last Status */
    vc_output_faults faults; /* of the last Status */
    vc_stream_header next_header;
    vc_coding next_coding;
    uint32_t next_packets;
    uint16_t next_loops;
    uint64_t next_newest_end; /* its `newest_end` */

    /* Where it is. */
    enum vc_state state;
    uint64_t next;       /* packet to decode */
    uint64_t newest_end; /* one behind the newest packet that came */
    uint64_t position;   /* of the last Status */
    uint64_t start_us, waiting_since_us, rest_from_us;
    uint64_t clock_from_us, clock_samples; /* DAC samples since then */
    int starved;                           /* nothing was buffered for the packet decoded last */
    uint32_t underruns, lost_packets;

    /* Its way to the DAC. */
    vc_packet_buffer buffer;
    vc_decoder decoder;
    int decoding; /* some blocks of the packet below are still to be decoded */
    int polled;   /* this turn has decoded a block */
    int behind;   /* this turn has left work undone */
    uint8_t packet[VC_MAX_PACKET_BYTES];
    int16_t decoded[VC_PACKET_SAMPLES * VC_CHANNELS];
    uint32_t decoded_samples;         /* samples per channel of the packet that are there */
    uint32_t decoded_at, decoded_end; /* those that the drive has yet to take */
    uint64_t decoded_for_drive;       /* with those, all that were decoded for it */
    uint64_t played;                  /* drive samples that the DAC has taken */
    int finishing, drained;           /* the drive is being finished; all of it is made */
    int32_t drive_samples[VC_PIECE_SAMPLES * VC_CHANNELS];
    uint32_t drive_at, drive_end; /* of those, what the DAC has yet to take */
    int ramping;                  /* the way to rest is played before anything else */
    int64_t drive[VC_DRIVE_MEMORY(VC_CHANNELS, VC_RATE_RATIO) / sizeof(int64_t) + 1];
    vc_dac dac;
    vc_capture captures[2]; /* by enum vc_tap */
    vc_sizes sizes;

    vc_profile *profile;    /* memory for one; NULL: none */
    uint32_t hand_delay_us; /* delay between a position's time and its rendering, us */
    const vc_actuator *actuator;
    const vc_dac_port *dac_port;
    vc_output_counts counts_before; /* of the DAC, at Configure */
} vc_playback;

/* The highest rate of a stream for a DAC. */
uint32_t vc_playback_max_rate_hz(const vc_actuator *actuator);

/* The sizes that are compiled in, or those of the settings where they are smaller. */
vc_sizes vc_playback_sizes(const vc_controller_settings *settings);

/* Checks whether a stream can play. Returns 0, or the rejection's code. `coding`: of the header's codec and
 * configuration; the check fills in its packets. */
int vc_playback_check(const vc_configure *configure, const vc_stream_header *header, vc_coding *coding,
                      const vc_controller_settings *settings, const vc_actuator *actuator, vc_rejection *rejection);
/* Sets up a stream that vc_playback_check has accepted, after the former one has stopped. `sizes` and the members after
 * it stay. */
void vc_playback_init(vc_playback *playback, const vc_configure *configure, const vc_stream_header *header,
                      const vc_coding *coding);

/* Sets up a stream that vc_playback_check has accepted behind the one under way. Returns 0, or the rejection's code. */
int vc_playback_queue(vc_playback *playback, const vc_configure *configure, const vc_stream_header *header,
                      const vc_coding *coding, vc_rejection *rejection);

/* Sorts in a packet of a message; drops it if it comes twice, too late, beyond credit or beyond the end. */
enum vc_arrival vc_playback_add(vc_playback *playback, uint8_t stream, uint32_t iteration, vc_piece packet,
                                uint64_t time_us);

/* Takes where the hand was at a time of the controller's clock, at most the present one; 0: now. */
enum vc_arrival vc_playback_position(vc_playback *playback, uint64_t hand_us, int64_t position_nm, uint64_t time_us);

/* Arms: plays from `start_us` on, or as soon as the prebuffer is there if that is later. */
void vc_playback_start(vc_playback *playback, uint64_t start_us, uint64_t time_us);
/* Ramps down and holds the position; fades in where that was. */
void vc_playback_pause(vc_playback *playback);
void vc_playback_resume(vc_playback *playback);
/* Ramps down at once, drops the stream and stays in `state`. The captures remain. */
void vc_playback_stop(vc_playback *playback, enum vc_state state);
/* Sets the iterations, including those played; 0 = until stopped. Returns 0, or the rejection's code. */
int vc_playback_set_loops(vc_playback *playback, uint16_t loops, vc_rejection *rejection);
/* Moves to another gain, along a ramp. */
void vc_playback_set_gain(vc_playback *playback, uint32_t gain_float_bits);
/* Sets the number of packets of the live stream; if more have been decoded, it ends with those. */
void vc_playback_end_live(vc_playback *playback, uint32_t packets);

/* Puts out the codes that are due up to this time, as far as one block of decoding and VC_TURN_PIECES allow. Returns
 * whether work is left. */
int vc_playback_advance(vc_playback *playback, uint64_t time_us);
/* Puts out the rest of the ramp after a stop: the DAC takes all of it now. */
void vc_playback_flush(vc_playback *playback, uint64_t time_us);
/* Returns when the DAC is at rest and its power limit has recovered, if nothing more plays. */
uint64_t vc_playback_free_us(const vc_playback *playback);

/* Samples per channel of the first credit. */
uint32_t vc_playback_capacity_samples(const vc_playback *playback);
/* Fills in a Status, except for device time and bad frames. */
void vc_playback_report(vc_playback *playback, vc_status_report *status);

/* Samples in sequence, of all channels; `count`: per channel. */
typedef struct {
    const int16_t *samples;
    uint32_t count;
} vc_run;

/* Finds the captured samples from `offset` on, at most `count` per channel, in their two runs. If the samples at the
 * offset are gone, it becomes that of the oldest; beyond the end it becomes the end. */
void vc_playback_captured(const vc_playback *playback, enum vc_tap tap, uint64_t *offset, uint32_t count,
                          vc_run runs[2]);

#endif
