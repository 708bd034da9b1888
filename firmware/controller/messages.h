/* Messages between host and controller: docs/protocol.md, "Messages".
 *
 * Read where they lie: pieces in a vc_message point into the payload that it was read from. Floats are the bits of an
 * IEEE 754 single, for this is all integers.
 */
#ifndef VIBROCAST_MESSAGES_H
#define VIBROCAST_MESSAGES_H

#include "frames.h"
#include "output.h"
#include "refusal.h"

#define VC_PROTOCOL_MAJOR 1
#define VC_PROTOCOL_MINOR 1
#define VC_NOTIFICATION 0 /* the sequence number of what nobody asked for */

/* Payload bytes of a CaptureData before its samples. */
#define VC_CAPTURE_DATA_HEAD_BYTES 21
/* Bytes of an image's name, and of its version, in a HelloResponse: what its other parts leave of a payload when there
 * are two slots and eight codecs, and build, hardware and actuator have the longest names that they may have. */
#define VC_HELLO_REST_BYTES 512
#define VC_IMAGE_TEXT_BYTES ((VC_MAXIMUM_PAYLOAD_BYTES - VC_HELLO_REST_BYTES) / 4)

/* cffi: begin */
enum vc_message_type {
    VC_HELLO = 0x01,
    VC_STATUS_REQUEST = 0x02,
    VC_CONFIGURE = 0x03,
    VC_START = 0x04,
    VC_PAUSE = 0x05,
    VC_RESUME = 0x06,
    VC_STOP = 0x07,
    VC_LOOP = 0x08,
    VC_GAIN = 0x09,
    VC_END_STREAM = 0x0A,
    VC_CAPTURE_READ = 0x0B,
    VC_FLASH_BEGIN = 0x10,
    VC_FLASH_DATA = 0x11,
    VC_FLASH_VERIFY = 0x12,
    VC_FLASH_ACTIVATE = 0x13,
    VC_FLASH_CONFIRM = 0x14,
    VC_STREAM_DATA = 0x40,
    VC_POSITION = 0x41,
    VC_HELLO_RESPONSE = 0x80, /* from here on, what controllers send */
    VC_STATUS = 0x81,
    VC_CAPTURE_DATA = 0x82,
    VC_FLASH_STATUS = 0x83,
    VC_ERROR = 0xFF
};

enum vc_state {
    VC_STATE_IDLE = 0,
    VC_STATE_BUFFERING = 1,
    VC_STATE_ARMED = 2,
    VC_STATE_PLAYING = 3,
    VC_STATE_PAUSED = 4,
    VC_STATE_FINISHED = 5,
    VC_STATE_STOPPED = 6,
    VC_STATE_WATCHDOG = 7,
    VC_STATE_FAULT = 8
};

enum vc_tap { VC_TAP_DECODED = 0, VC_TAP_DAC = 1 };

enum vc_slot_state {
    VC_SLOT_EMPTY = 0,
    VC_SLOT_WRITING = 1,
    VC_SLOT_VERIFIED = 2,
    VC_SLOT_TRIAL = 3,
    VC_SLOT_CONFIRMED = 4
};

typedef struct {
    uint8_t major, minor;
} vc_hello;

typedef struct {
    uint8_t stream;
    uint8_t compensation; /* 0 or 1 */
    uint16_t loops;       /* 0: until stopped */
    uint32_t prebuffer_samples, packets, first_packet;
    uint32_t gain_float_bits; /* finite, at least 0 (perhaps -0) */
    vc_piece header;          /* stream_header.h */
} vc_configure;

typedef struct {
    uint8_t stream;
    uint32_t packets;
} vc_end_stream;

typedef struct {
    uint8_t tap; /* enum vc_tap */
    uint16_t count;
    uint64_t offset;
} vc_capture_read;

typedef struct {
    uint8_t slot;
    uint32_t size_bytes;
    const uint8_t *sha256; /* 32 bytes */
    vc_piece hardware;     /* UTF-8; empty: any */
} vc_flash_begin;

typedef struct {
    uint8_t slot;
    uint32_t offset;
    vc_piece data;
} vc_flash_data;

typedef struct {
    uint8_t stream;
    uint32_t iteration;
    vc_piece packets; /* for vc_next_packet */
} vc_stream_data;

/* Where the hand was. `time_us`: device time; 0: when the message came. */
typedef struct {
    uint64_t time_us;
    int64_t position_nm;
} vc_position;

/* A message from the host. `type`: enum vc_message_type. `sequence`: VC_NOTIFICATION for stream data. Which member of
 * `body` counts, the type says; StatusRequest, Pause, Resume and Stop have none. */
typedef struct {
    uint8_t type;
    uint16_t sequence;
    union {
        vc_hello hello;
        vc_configure configure;
        uint64_t start_us;        /* Start: device time */
        uint16_t loops;           /* Loop */
        uint32_t gain_float_bits; /* Gain: as in vc_configure */
        vc_end_stream end_stream;
        vc_capture_read capture_read;
        vc_flash_begin flash_begin;
        vc_flash_data flash_data;
        uint8_t slot; /* FlashVerify, FlashActivate, FlashConfirm */
        vc_stream_data stream_data;
        vc_position position;
    } body;
} vc_message;

/* Reads a payload whose type is below VC_HELLO_RESPONSE. Returns 0, or the refusal's code: VC_MALFORMED,
 * VC_BAD_VALUE or VC_UNKNOWN_MESSAGE; `sequence` is then the number to answer with (VC_NOTIFICATION where none could be
 * read). Any bytes are safe. */
int vc_message_read(vc_message *message, const uint8_t *payload, size_t length, vc_refusal *refusal);

/* Takes the first packet off the packets of a message that was read; returns 0 when there are no more. */
int vc_next_packet(vc_piece *packets, vc_piece *packet);

typedef struct {
    uint16_t maximum_payload_bytes, maximum_packet_bytes;
    uint32_t buffer_samples, capture_samples;
    uint8_t channels;
    uint32_t minimum_rate_hz, maximum_rate_hz;
    uint16_t watchdog_ms;
    uint32_t profile_samples; /* of all channels together; 0: no profiles */
} vc_controller_limits;

typedef struct {
    const char *name; /* at most 63 bytes */
    uint32_t stroke_um_float_bits, volts_float_bits, lower_hz_float_bits, upper_hz_float_bits;
    uint32_t slew_volts_per_second_float_bits; /* 0: not limited */
    uint8_t dac_bits;
    uint32_t dac_rate_hz;
} vc_actuator_description;

typedef struct {
    uint8_t identifier;
    const char *name;
} vc_codec_description;

/* A slot and the image in it. `sha256`: 32 bytes. */
typedef struct {
    uint8_t slot, state; /* enum vc_slot_state */
    const uint8_t *sha256;
    vc_piece name, version;
} vc_image_description;

/* `build`, `hardware`: at most 63 bytes. */
typedef struct {
    const char *build, *hardware;
    vc_controller_limits limits;
    vc_actuator_description actuator;
    const vc_codec_description *codecs;
    unsigned codec_count;
    const vc_image_description *images;
    unsigned image_count;
} vc_hello_response;

/* Positions and credit count samples of the stream, per channel, over all iterations. */
typedef struct {
    uint8_t state, stream; /* enum vc_state */
    uint64_t device_time_us, position, credit_until;
    uint32_t buffered_samples, bad_frames, underruns, lost_packets;
    vc_limit_counts limited;
} vc_status_report;

/* `sha256`: 32 bytes, or NULL for zeros. */
typedef struct {
    uint8_t slot, state; /* enum vc_slot_state */
    uint32_t next_offset;
    const uint8_t *sha256;
} vc_flash_report;

/* Put a whole message into a frame that has begun. */
void vc_put_hello_response(vc_frame_writer *writer, uint16_t sequence, const vc_hello_response *response);
void vc_put_status(vc_frame_writer *writer, uint16_t sequence, const vc_status_report *status);
void vc_put_flash_status(vc_frame_writer *writer, uint16_t sequence, const vc_flash_report *status);
void vc_put_error(vc_frame_writer *writer, uint16_t sequence, const vc_refusal *refusal);

/* Puts the message up to its samples (VC_CAPTURE_DATA_HEAD_BYTES of payload), which vc_put_samples then puts, in as
 * many runs as they lie in. */
void vc_put_capture_data(vc_frame_writer *writer, uint16_t sequence, uint8_t tap, uint8_t channels, uint64_t offset,
                         uint64_t end);
void vc_put_samples(vc_frame_writer *writer, const int16_t *samples, size_t count);
/* cffi: end */

#endif
