/* The settings of a controller: flash, DAC, perhaps a sensor, and the description that HelloResponse gives.
 *
 * The port owns the structures and all that they point to; both must stay valid. The controller calls the functions
 * from the thread that calls it, never from an interrupt. Comments say where a pointer or a function may be NULL; a
 * context may be anything. */
#ifndef VIBROCAST_SETTINGS_H
#define VIBROCAST_SETTINGS_H

#include "output.h"
#include "profile.h"

#define VC_KEY_BYTES 32
#define VC_SIGNED_MESSAGE_BYTES 36
#define VC_TEXT_BYTES 63
#define VC_SERIAL_NUMBER_BYTES 31
#define VC_LEAST_WATCHDOG_MS 50
#define VC_LEAST_RECORD_BYTES 96
#define VC_MOST_WRITE_BYTES 32

#ifdef __cplusplus
extern "C" {
#endif

/* cffi: begin */
/* Decoders that are not in C; only the simulated controller has them. */
struct vc_decoder_callbacks;

/* Flash memory for model images: NOR flash in the address space, read in place. A board may do without: NULL.
 *
 * `record`, `slot`: offsets from `base` of two pieces of record_bytes and of two pieces of slot_bytes. Each piece is a
 * whole number of sectors; record_bytes is 96 or more.
 * `write_bytes`: 1, 2, 4, 8, 16 or 32, the smallest write of the flash; with ECC, the bytes that share a checksum. All
 * offsets and sizes here are multiples of it.
 * `erase` sets bytes to 0xFF; it gets one of these pieces, or several sectors of it. `program` gets bytes in RAM; its
 * offset and length are multiples of write_bytes, and it gets no place twice between two erasures. Both return 0, or
 * another number if the flash failed. They return when they are done, which may take as long as the hardware needs:
 * vc_controller_init and vc_controller_receive call them, and no stream is armed, playing or paused then.
 * The controller also reads places that a power failure left half written or half erased. Any bytes will do, but where
 * the hardware raises a fault for them, the port must handle it. */
typedef struct {
    const uint8_t *base;
    uint32_t record[2], record_bytes;
    uint32_t slot[2], slot_bytes;
    uint32_t write_bytes;
    int (*erase)(void *context, uint32_t offset, uint32_t length);
    int (*program)(void *context, uint32_t offset, const uint8_t *data, uint32_t length);
    void *context;
} vc_flash;

/* Returns the position of the hand, in nanometres from any origin: a sensor on the board. Each
 * vc_controller_advance and vc_controller_receive calls it while a stream is armed, playing or paused. `now_us`: the
 * controller's clock in microseconds. */
typedef int64_t (*vc_position_sensor)(void *context, uint64_t now_us);

/* Verifies the signature of a model image, for a board with a key. Returns 1 if the owner of the key has signed the
 * message, any other number if not or if it cannot tell.
 *
 * `public_key`: 32 bytes. `signature`: 64 bytes, by Ed25519 of RFC 8032: neither Ed25519ctx nor Ed25519ph. `message`:
 * VC_SIGNED_MESSAGE_BYTES, the SHA-256 of the image and its number as u32, which the controller has computed. None of
 * them is secret, so its time may depend on them.
 * It may take as long as the hardware needs: vc_controller_init and vc_controller_receive call it, and no stream is
 * armed, playing or paused then. Where that is longer than the board's watchdog waits, it feeds the watchdog. Its stack
 * comes on top of the controller's. docs/how-to/sign_models.md has an example. */
typedef int (*vc_signature_verifier)(void *context, const uint8_t *public_key, const uint8_t *signature,
                                     const uint8_t *message);

/* Limits that HelloResponse names. */
typedef struct {
    uint8_t channels;
    uint32_t buffer_samples, capture_samples; /* per channel */
    uint32_t profile_samples;                 /* of all channels together */
} vc_sizes;

/* The kind of controller. Texts are UTF-8, end with a zero byte and have at most 63 bytes before it. HelloResponse's
 * other limits are compiled in: sizes.h. */
typedef struct {
    const char *build, *hardware;
    const vc_actuator *actuator;            /* that of an image may take its place, but never lifts its limits */
    const uint8_t *public_key;              /* 32 bytes of Ed25519: images need its signature; NULL: they need none */
    vc_signature_verifier verify_signature; /* NULL only where public_key is */
    void *verify_context;
    uint16_t watchdog_ms; /* longest silence of the host in ms; at least 50 */
    vc_profile *profile;  /* VC_PROFILE_WORDS of int64_t (sizes.h), which one controller uses; NULL: no profiles */
    vc_position_sensor position; /* NULL: the host sends the position */
    void *position_context;
    const vc_sizes *sizes;                        /* smaller limits than sizes.h; NULL: those of sizes.h */
    const struct vc_decoder_callbacks *callbacks; /* NULL: none */
    /* Thousands of Cortex-M4 cycles that decoding a second of a stream may take; heavier streams are rejected. 0: any
     * stream is decoded in time. */
    uint32_t decoding_kilocycles_per_s;
    const char *serial_number; /* of this board, at most 31 bytes; NULL: it has none */
} vc_controller_settings;

/* Counts of the output since the port was started. `gaps`: how often the DAC had no sample while it was away from rest;
 * `late_samples`: for how many of its samples. Of an output by a chip behind a bus, `refused`: values that it did not
 * take; `restarts`: how often the port set it up again. */
typedef struct {
    uint32_t gaps, late_samples, refused, restarts;
} vc_output_counts;

/* The way to the DAC. It plays a sample every 1 / dac_rate_hz seconds. Without codes it holds the last one, which is
 * rest.
 *
 * `play` takes codes, in their order: samples x channels, interleaved, signed, 0 = rest, within the actuator's
 * dac_bits. `samples`: 1 to 32. `channels`: those of the stream. `codes` belong to the controller and are valid during
 * the call. `due_us`: the controller's time at which the first of them was due; a port that plays them some time later
 * never runs out of codes while the next ones are being decoded.
 * `begin` states the length of the packets of the stream that comes next, in microseconds: a controller that keeps up
 * never leaves the port without codes for longer. NULL: no need to know.
 * `drop` throws away the codes that wait to be played, at a Stop: those that follow begin at another level, to which
 * the port fades from that of its output. NULL: none ever wait.
 * `count` fills in the counts, which begin at 0. NULL: they stay 0.
 * `has_failed` returns 1 while the output cannot play: an amplifier reports a fault, is too hot or lacks power. Then a
 * stream under way ends in the state FAULT, by the same ramp to rest as at a Stop. It is called at each
 * vc_controller_advance while a stream plays. NULL: it never fails. */
typedef struct {
    void (*play)(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us);
    void (*begin)(void *context, uint32_t packet_us);
    void (*drop)(void *context);
    void (*count)(void *context, vc_output_counts *counts);
    int (*has_failed)(void *context);
    void *context;
} vc_dac_port;
/* cffi: end */

#ifdef __cplusplus
}
#endif

#endif
