/* Messages between host and controller (docs/reference/protocol.md); written by device_protocol/generate.py.
 *
 * Pieces of a message that was read point into its payload. Texts are UTF-8. A sha256 has 32 bytes;
 * NULL writes zeros. Floats are the bits of an IEEE 754 single. A tap, state or code is a number of protocol.h.
 */
#ifndef VIBROCAST_MESSAGES_H
#define VIBROCAST_MESSAGES_H

#include "vc_frames.h"
#include "vibrocast/protocol.h"
#include "../core/vc_rejection.h"

/* cffi: begin */
/* Opens a session, with the host's protocol version. The layout is the same in every version. */
typedef struct {
    uint8_t major;
    uint8_t minor;
} vc_hello;

/* What a controller must know of a stream. `stream`: the host's number for it, 0-255. `packets`: in one iteration, 0 =
 * unknown (live). `first_packet`: the refresh at which playing begins. `loops`: iterations, 0 = until stopped. `gain`:
 * factor on the signal. `header`: the bytes of `coded_stream.StreamHeader`. */
typedef struct {
    uint8_t stream;
    uint8_t compensation;
    uint32_t prebuffer_samples;
    uint32_t packets;
    uint32_t first_packet;
    uint16_t loops;
    uint32_t gain_float_bits;
    vc_piece header;
} vc_configure;

/* Starts the configured stream at a device time; 0 or a past time: as soon as the prebuffer is there. */
typedef struct {
    uint64_t device_time_us;
} vc_start;

/* Sets the iterations of the stream, including those already played; 0 = until stopped. */
typedef struct {
    uint16_t loops;
} vc_loop;

/* Moves the gain to a new factor, along a ramp. */
typedef struct {
    uint32_t gain_float_bits;
} vc_gain;

/* Sets the number of packets of a live stream, so that its end is no underrun. */
typedef struct {
    uint8_t stream;
    uint32_t packets;
} vc_end_stream;

/* Asks for `count` captured samples per channel, from `offset` samples after the start of the stream. */
typedef struct {
    uint8_t tap;
    uint64_t offset;
    uint16_t count;
} vc_capture_read;

/* Announces a model image for a slot. The same image as before goes on where it was cut. */
typedef struct {
    uint8_t slot;
    uint32_t size_bytes;
    const uint8_t *sha256;
    vc_piece hardware;
} vc_flash_begin;

/* Carries a piece of the image. */
typedef struct {
    uint8_t slot;
    uint32_t offset;
    vc_piece data;
} vc_flash_data;

/* Asks the controller to read the slot back and check it. */
typedef struct {
    uint8_t slot;
} vc_flash_verify;

/* Restarts the controller to test a verified slot. Unless confirmed, the next restart reverts it. */
typedef struct {
    uint8_t slot;
} vc_flash_activate;

/* Keeps the slot under test. */
typedef struct {
    uint8_t slot;
} vc_flash_confirm;

/* Empties a slot that neither runs nor is the one to fall back to; since version 2.2. */
typedef struct {
    uint8_t slot;
} vc_flash_erase;

/* Asks for up to `count` bytes of the image in a slot, from `offset` on; since version 2.2. */
typedef struct {
    uint8_t slot;
    uint32_t offset;
    uint16_t count;
} vc_flash_read;

/* Packets of a stream, each as `coded_stream.packet_sequence` reads it; `iteration` counts loops from 0. */
typedef struct {
    uint8_t stream;
    uint32_t iteration;
    vc_piece packets;
} vc_stream_data;

/* Where the hand was at a device time (0 = on arrival), from any origin, for all channels. */
typedef struct {
    uint64_t device_time_us;
    int64_t position_nm;
} vc_position;

/* One packet of iteration 0, in the fewest bytes: what StreamData would carry alone. */
typedef struct {
    uint8_t stream;
    vc_piece packet;
} vc_single_packet;

/* The controller's limits. `watchdog_ms`: longest silence of the host while armed, playing or paused.
 * `profile_samples`: of a height profile, all channels together; 0: no profiles. `packet_samples`: of the longest
 * packet, per channel. `decoding_kilocycles_per_s`: what a second of a stream may take to decode, in thousands of
 * Cortex-M4 cycles; 0: any stream is decoded in time. */
typedef struct {
    uint16_t max_payload_bytes;
    uint16_t max_packet_bytes;
    uint32_t buffer_samples;
    uint32_t capture_samples;
    uint8_t channels;
    uint32_t min_rate_hz;
    uint32_t max_rate_hz;
    uint16_t watchdog_ms;
    uint32_t profile_samples;
    uint32_t packet_samples;
    uint32_t decoding_kilocycles_per_s;
} vc_controller_limits;

/* The actuator with its amplifier and DAC. `stroke_um`: displacement at `volts`. `lower_hz`, `upper_hz`: -3 dB; a lower
 * one of 0: down to rest. `slew_volts_per_second`: 0 = no limit. */
typedef struct {
    uint32_t stroke_um_float_bits;
    uint32_t volts_float_bits;
    uint32_t lower_hz_float_bits;
    uint32_t upper_hz_float_bits;
    uint32_t slew_volts_per_second_float_bits;
    uint8_t dac_bits;
    uint32_t dac_rate_hz;
    vc_piece name;
} vc_actuator_description;

/* A codec that the controller decodes. */
typedef struct {
    uint8_t identifier;
    vc_piece name;
} vc_codec_description;

/* A slot and the model image in it. `sha256`: of the image without its number and signature. `number`: of a signed
 * image, 0 = unsigned. */
typedef struct {
    uint8_t slot;
    uint8_t state;
    const uint8_t *sha256;
    uint32_t number;
    vc_piece name;
    vc_piece version;
} vc_image_description;

/* How a stream is coded. `packet_samples`: per channel in a packet. `delay_samples`: by which the decoder lags. */
typedef struct {
    uint32_t packet_samples;
    uint32_t delay_samples;
} vc_coding_description;

/* The stream behind the one under way: its number, and up to where data of it may be sent, in its positions. */
typedef struct {
    uint8_t stream;
    uint64_t credit_until;
} vc_queued_stream;

/* Faults of the chip behind the controller since Configure. `refused`: values that it did not take. `restarts`: how
 * often it was set up again. */
typedef struct {
    uint32_t refused;
    uint32_t restarts;
} vc_output_faults;

/* Frames with stream data or a position that came out of turn since the controller started. `repeated`: brought again
 * what had come. `reordered`: came after later ones. */
typedef struct {
    uint32_t repeated;
    uint32_t reordered;
} vc_frame_faults;

/* The controller's version, limits, actuator, codecs and model images. `public_key`: of Ed25519; model images need its
 * signature. Empty: they need none. `serial_number`: of the board; empty: it has none. */
typedef struct {
    uint8_t major;
    uint8_t minor;
    vc_piece build;
    vc_piece hardware;
    vc_controller_limits limits;
    vc_actuator_description actuator;
    const vc_codec_description *codecs;
    unsigned codec_count;
    const vc_image_description *images;
    unsigned image_count;
    vc_piece public_key;
    vc_piece serial_number;
} vc_hello_response;

/* State, position, credit and counts: the answer to most requests, and the notification that grants credit. Positions
 * and credit count samples per channel, over all iterations. `credit_until`: the controller takes packets that end at
 * or before this position. `buffered_samples`: received and not yet played. `bad_frames` counts since the controller
 * started, the fields after it since Configure. `output_gaps`: how often the DAC had no sample while it was away from
 * rest; `late_samples`: for how many of its samples. `signed_images`: model images need a signature. `coding`: in the
 * answers to Configure and Queue alone, since version 2.1. `queued`: while a stream is set up behind the one under way,
 * since version 2.2. `output_faults`, `frame_faults`: once there are any, since version 2.2. */
typedef struct {
    uint8_t state;
    uint8_t stream;
    uint64_t device_time_us;
    uint64_t position;
    uint64_t credit_until;
    uint32_t buffered_samples;
    uint32_t bad_frames;
    uint32_t underruns;
    uint32_t lost_packets;
    uint32_t compensation_clipped;
    uint32_t voltage_limited;
    uint32_t slew_limited;
    uint32_t power_limited;
    uint32_t output_gaps;
    uint32_t late_samples;
    uint8_t signed_images;
    const vc_coding_description *coding; /* NULL: none */
    const vc_queued_stream *queued; /* NULL: none */
    const vc_output_faults *output_faults; /* NULL: none */
    const vc_frame_faults *frame_faults; /* NULL: none */
} vc_status_report;

/* Captured samples, int16 little-endian, channels interleaved. `offset`: of the first sample, later than requested if
 * the controller no longer has that one. `end`: samples per channel captured so far. */
typedef struct {
    uint8_t tap;
    uint8_t channels;
    uint64_t offset;
    uint64_t end;
} vc_capture_data;

/* Answers every flash request. `next_offset`: where data must go on. `sha256`: zeros until verified. */
typedef struct {
    uint8_t slot;
    uint8_t state;
    uint32_t next_offset;
    const uint8_t *sha256;
} vc_flash_status;

/* Bytes of the image in a slot, from `offset` on. `size_bytes`: of the whole image. Since version 2.2. */
typedef struct {
    uint8_t slot;
    uint32_t size_bytes;
    uint32_t offset;
    vc_piece data;
} vc_flash_contents;

/* A rejection: an ErrorCode (or a later one) and a text. The layout is the same in every version. */
typedef struct {
    uint16_t code;
    vc_piece text;
} vc_error;

/* A message from the host. `type`: enum vc_message_type, which names the member of `body` that counts, if it has one.
 * `sequence`: VC_NOTIFICATION for stream data. */
typedef struct {
    uint8_t type;
    uint16_t sequence;
    union {
        vc_hello hello;
        vc_configure configure;
        vc_configure queue;
        vc_start start;
        vc_loop loop;
        vc_gain gain;
        vc_end_stream end_stream;
        vc_capture_read capture_read;
        vc_flash_begin flash_begin;
        vc_flash_data flash_data;
        vc_flash_verify flash_verify;
        vc_flash_activate flash_activate;
        vc_flash_confirm flash_confirm;
        vc_flash_erase flash_erase;
        vc_flash_read flash_read;
        vc_stream_data stream_data;
        vc_position position;
        vc_single_packet single_packet;
    } body;
} vc_message;

/* Reads a payload whose type is below VC_FIRST_FROM_CONTROLLER. Returns 0, or the rejection's code: VC_MALFORMED,
 * VC_BAD_VALUE or VC_UNKNOWN_MESSAGE; `sequence` is then the number to answer with (VC_NOTIFICATION where none could be
 * read). Any bytes are safe. */
int vc_message_read(vc_message *message, const uint8_t *payload, size_t length, vc_rejection *rejection);

/* Write a message into a frame that has begun. After a CaptureData the caller writes its samples. */
void vc_write_hello_response(vc_frame_writer *writer, uint16_t sequence, const vc_hello_response *message);
void vc_write_status(vc_frame_writer *writer, uint16_t sequence, const vc_status_report *message);
void vc_write_capture_data(vc_frame_writer *writer, uint16_t sequence, const vc_capture_data *message);
void vc_write_flash_status(vc_frame_writer *writer, uint16_t sequence, const vc_flash_status *message);
void vc_write_flash_contents(vc_frame_writer *writer, uint16_t sequence, const vc_flash_contents *message);
void vc_write_error(vc_frame_writer *writer, uint16_t sequence, const vc_error *message);
void vc_write_rejection(vc_frame_writer *writer, uint16_t sequence, const vc_rejection *rejection);
/* cffi: end */

#endif
