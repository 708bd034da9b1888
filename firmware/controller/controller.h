/* A tactor controller without any input or output of its own: bytes and time in, bytes and DAC codes out.
 *
 * C99, no allocation, no recursion, no libc beyond memcpy and memset: the whole controller is one vc_controller that
 * the port owns. What it does is docs/protocol.md; what a port must provide is in firmware/README.md.
 */
#ifndef VIBROCAST_CONTROLLER_H
#define VIBROCAST_CONTROLLER_H

#include <stddef.h>
#include <stdint.h>

#include "codec.h"
#include "output.h"
#include "profile.h"

/* cffi: begin */
typedef struct vc_controller vc_controller;

/* Flash for model images: memory-mapped NOR, read in place. Erasing sets bytes to 0xFF, programming only clears bits.
 * `record` and `slot`: offsets from `base` of two erasable pieces of record_bytes and of two of slot_bytes, each a
 * whole number of sectors. `erase` takes such a piece (or several sectors of it), `program` any bytes. Both return 0
 * when the flash took it, anything else when it did not; they may take as long as the hardware needs. */
typedef struct {
    const uint8_t *base;
    uint32_t record[2], record_bytes;
    uint32_t slot[2], slot_bytes;
    int (*erase)(void *context, uint32_t offset, uint32_t length);
    int (*program)(void *context, uint32_t offset, const uint8_t *data, uint32_t length);
    void *context;
} vc_flash;

/* Returns where the hand is now, in nanometres from any origin: a sensor on the board. Called some hundred times a
 * second, before what is due is rendered. */
typedef int64_t (*vc_position_sensor)(void *context, uint64_t now_us);

/* Limits that hello tells. */
typedef struct {
    uint8_t channels;
    uint32_t buffer_samples, capture_samples; /* per channel */
    uint32_t profile_samples;                 /* of all channels together */
} vc_sizes;

/* What kind of controller this is; must stay valid. Texts end with a zero byte and have at most 63 bytes before it.
 * The other limits that hello tells are compiled in: sizes.h. */
typedef struct {
    const char *build, *hardware;
    const vc_actuator *actuator;
    uint16_t watchdog_ms;        /* at least 50 */
    vc_profile *profile;         /* VC_PROFILE_WORDS of int64_t (sizes.h) for height profiles; NULL: takes none */
    vc_position_sensor position; /* NULL: the host says where the hand is */
    void *position_context;
    const vc_sizes *sizes;                 /* smaller than those of sizes.h; NULL: those */
    const vc_decoder_callbacks *callbacks; /* decode what is not in C (decoders.h); NULL: nothing does */
} vc_controller_settings;

/* Takes DAC codes in the order in which they are due: samples x channels, interleaved, signed, 0 = rest. A port's DAC
 * plays them one each 1 / dac_rate_hz; when there are none it stays where it is, which is at rest. */
typedef void (*vc_dac_sink)(void *context, const int16_t *codes, uint32_t samples, unsigned channels);

/* Bytes of memory, aligned for int64_t, for a vc_controller. */
size_t vc_controller_size(void);

/* Bytes of memory, aligned for int64_t, for the height profiles of one. */
size_t vc_controller_profile_size(void);

/* Boots: reads the flash, starts the image on trial or the confirmed one. `settings`, `flash` and `dac_context` must
 * stay valid. `now_us`: the controller's clock, which never goes back. */
void vc_controller_init(vc_controller *controller, const vc_controller_settings *settings, const vc_flash *flash,
                        vc_dac_sink dac, void *dac_context, uint64_t now_us);

/* Takes bytes from the host. Any bytes are safe. */
void vc_controller_receive(vc_controller *controller, const uint8_t *data, size_t length, uint64_t now_us);

/* Plays what is due up to `now_us`, and watches over the host. To be called every few milliseconds. */
void vc_controller_advance(vc_controller *controller, uint64_t now_us);

/* Moves up to `capacity` bytes for the host into `data`; returns how many. */
size_t vc_controller_transmit(vc_controller *controller, uint8_t *data, size_t capacity);
/* cffi: end */

#endif
