/* A controller without any input or output of its own: bytes and time in, bytes and DAC codes out.
 *
 * C99, no allocation, no recursion, no libc but memcpy and memset. The whole controller is one vc_controller that the
 * port owns. docs/reference/protocol.md says how it behaves, docs/how-to/port_the_firmware.md how to port it.
 *
 * - Call a controller from one thread: the main loop or a task, which interrupts reach through rings (ring.h). Two
 *   controllers share nothing.
 * - It calls the functions of settings.h before it returns. They must not call it.
 * - A call takes as long as decoding a block. Only at rest may it take longer: as long as erasing flash, or as
 *   hashing and checking a model image, some 0.4 ms for each kB on a Cortex-M4 at 168 MHz. A Stop then waits, and
 *   there is nothing to stop.
 * - Stack: 5.6 kB hold a controller of one codec and one channel on a Cortex-M4F (docs/benchmarks/firmware.md). More
 *   channels take more.
 */
#ifndef VIBROCAST_CONTROLLER_H
#define VIBROCAST_CONTROLLER_H

#include "settings.h"
#include "status.h"

#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

/* cffi: begin */
typedef struct vc_controller vc_controller;

/* Returns the bytes of memory, aligned for int64_t, of a vc_controller. */
size_t vc_controller_size(void);

/* Returns the bytes of memory, aligned for int64_t, of its vc_profile. */
size_t vc_controller_profile_size(void);

/* Boots: reads the flash and may write its record, and starts the image on trial or the confirmed one. The caller owns
 * `controller`, vc_controller_size() bytes, and `settings`, `flash` and `dac`. All must stay valid and in place.
 * `flash`: NULL: no slots for model images. `now_us`: the controller's clock in microseconds, from any start. A time
 * before the last one counts as that one.
 * Returns VC_OK. Returns VC_BAD_SETTINGS if a setting is none that settings.h allows, and VC_NO_VERIFIER if they have a
 * public key and no verifier. Then it has done nothing: call no other function with this controller. */
int vc_controller_init(vc_controller *controller, const vc_controller_settings *settings, const vc_flash *flash,
                       const vc_dac_port *dac, uint64_t now_us);

/* Takes `length` bytes from the host, all of them, at the time `now_us`. Any bytes are safe, in any pieces. Returns as
 * vc_controller_advance. */
int vc_controller_receive(vc_controller *controller, const uint8_t *data, size_t length, uint64_t now_us);

/* Plays what is due up to `now_us`, and checks the watchdog. A call decodes one block at most, so bytes from the host
 * never wait longer than for one. Returns 1 if work is left: call it again at once, after vc_controller_receive where
 * bytes have come. Else call it every few milliseconds. */
int vc_controller_advance(vc_controller *controller, uint64_t now_us);

/* Moves up to `capacity` bytes for the host into `data`. Returns how many bytes, 0 if none wait. VC_OUTGOING_BYTES
 * (sizes.h) may wait; what finds no room is dropped, and the host repeats its request. */
size_t vc_controller_transmit(vc_controller *controller, uint8_t *data, size_t capacity);
/* cffi: end */

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
