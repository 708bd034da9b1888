/* What a port gives to its controller: flash, a DAC, perhaps a sensor, and the kind of controller that it is. */
#ifndef VIBROCAST_SETTINGS_H
#define VIBROCAST_SETTINGS_H

#include "codec.h"
#include "output.h"
#include "profile.h"

/* cffi: begin */
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
/* cffi: end */

#endif
