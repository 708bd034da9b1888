/* Constants of messages, streams and model images; written by device_protocol/generate.py. */
#ifndef VIBROCAST_PROTOCOL_H
#define VIBROCAST_PROTOCOL_H

#define VC_PROTOCOL_MAJOR 2
#define VC_PROTOCOL_MINOR 2
#define VC_NOTIFICATION 0 /* the sequence number of a message that answers no request */
#define VC_FIRST_UNSEQUENCED 0x40 /* types from here on have no sequence number */
#define VC_FIRST_FROM_CONTROLLER 0x80
#define VC_VARINT_BITS 32
#define VC_PROTOCOL_MAX_PAYLOAD_BYTES 4096 /* at most, of any board */
#define VC_PACKET_OVERHEAD_BYTES 12 /* of a payload, before its first packet */
#define VC_CAPTURE_DATA_HEAD_BYTES 21
#define VC_FLASH_CONTENTS_HEAD_BYTES 12
#define VC_STREAM_MAGIC 0xD3u
#define VC_STREAM_FORMAT 3
#define VC_STREAM_LONG_CONFIGURATION 15 /* a byte with the length stands before it */
#define VC_STREAM_ROUND_RATE_HZ 100u
#define VC_STREAM_RATE_BITS 32
#define VC_STREAM_MAX_CHANNELS 16
#define VC_STREAM_MAX_RATE_HZ 200000u
#define VC_STREAM_UNIT_BITS 0x03u
#define VC_STREAM_HAS_IMAGE_HASH 0x04u
#define VC_STREAM_ONE_PACKET 0x08u
#define VC_STREAM_VARINT_BITS 63
#define VC_PACKET_SEQUENCE_BITS 32
#define VC_UNIT_PROFILE 3u
#define VC_IMAGE_HASH_BYTES 4
#define VC_IMAGE_MAGIC "VCMI"
#define VC_IMAGE_LAYOUT_VERSION 1
/* In place of a codec: the image holds an actuator. */
#define VC_IMAGE_OF_ACTUATOR 0xFEu
#define VC_IMAGE_SIGNED_BYTES 68 /* number and signature behind a signed image */

/* cffi: begin */
enum vc_message_type {
    VC_HELLO = 1,
    VC_STATUS_REQUEST = 2,
    VC_CONFIGURE = 3,
    VC_QUEUE = 12,
    VC_START = 4,
    VC_PAUSE = 5,
    VC_RESUME = 6,
    VC_STOP = 7,
    VC_LOOP = 8,
    VC_GAIN = 9,
    VC_END_STREAM = 10,
    VC_CAPTURE_READ = 11,
    VC_FLASH_BEGIN = 16,
    VC_FLASH_DATA = 17,
    VC_FLASH_VERIFY = 18,
    VC_FLASH_ACTIVATE = 19,
    VC_FLASH_CONFIRM = 20,
    VC_FLASH_ERASE = 21,
    VC_FLASH_READ = 22,
    VC_STREAM_DATA = 64,
    VC_POSITION = 65,
    VC_SINGLE_PACKET = 66,
    VC_HELLO_RESPONSE = 128,
    VC_STATUS = 129,
    VC_CAPTURE_DATA = 130,
    VC_FLASH_STATUS = 131,
    VC_FLASH_CONTENTS = 132,
    VC_ERROR = 255
};

enum vc_error_code {
    VC_UNKNOWN_MESSAGE = 1,
    VC_MALFORMED = 2,
    VC_UNSUPPORTED_VERSION = 3,
    VC_HELLO_FIRST = 4,
    VC_WRONG_STATE = 5,
    VC_BAD_VALUE = 6,
    VC_UNKNOWN_CODEC = 7,
    VC_UNKNOWN_IMAGE = 8,
    VC_BEYOND_LIMITS = 9,
    VC_NO_SUCH_SLOT = 10,
    VC_WRONG_HARDWARE = 11,
    VC_IMAGE_REJECTED = 12,
    VC_FLASH_FAILED = 13
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

enum vc_tap {
    VC_TAP_DECODED = 0,
    VC_TAP_DAC = 1
};

enum vc_slot_state {
    VC_SLOT_EMPTY = 0,
    VC_SLOT_WRITING = 1,
    VC_SLOT_VERIFIED = 2,
    VC_SLOT_TESTING = 3,
    VC_SLOT_CONFIRMED = 4
};

/* cffi: end */

#endif
