/* A tactor controller without any input or output of its own: bytes and time in, bytes and DAC codes out.
 *
 * C99, no allocation, no recursion, no libc beyond memcpy and memset: the whole controller is one vc_controller that
 * the port owns. What it does is docs/reference/protocol.md; what a port must provide is in firmware/README.md.
 */
#ifndef VIBROCAST_CONTROLLER_H
#define VIBROCAST_CONTROLLER_H

#include "settings.h"

/* cffi: begin */
typedef struct vc_controller vc_controller;

/* Bytes of memory, aligned for int64_t, for a vc_controller. */
size_t vc_controller_size(void);

/* Bytes of memory, aligned for int64_t, for the height profiles of one. */
size_t vc_controller_profile_size(void);

/* Boots: reads the flash, starts the image to be tested or the confirmed one. `settings`, `flash` and `dac_context`
 * must stay valid. `now_us`: the controller's clock, which never goes back. */
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
