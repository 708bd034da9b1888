/* The three functions of a port, and the loop that runs a controller on them.
 *
 * The port's main() sets up its hardware and calls vc_loop_start() once. It then calls vc_loop_turn() for ever, at
 * least every few milliseconds. docs/how-to/port_the_firmware.md walks through a port.
 *
 * There is one loop and one controller. Call both functions from the same thread, and not from an interrupt. They call
 * the functions of the port before they return. Stack: as for controller.h, and 256 bytes.
 */
#ifndef VIBROCAST_PORT_H
#define VIBROCAST_PORT_H

#include "controller.h"

#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

#define VC_BUILD "vibrocast firmware 0.1.0"
/* The 32 bytes of the key that signs model images: `python -m vibrocast.firmware.build --public-key`. */
#ifndef VC_PUBLIC_KEY
#define VC_PUBLIC_KEY NULL
#endif

/* A port's vc_signature_verifier, settings.h, in a source of `python -m vibrocast.firmware.build --verifier`. */
#ifdef VC_VERIFIER
int vc_port_verify_signature(void *context, const uint8_t *public_key, const uint8_t *signature,
                             const uint8_t *message);
#else
#define vc_port_verify_signature NULL
#endif

/* The board's actuator: that of `python -m vibrocast.firmware.build --actuator`, else the one that the port names. */
#ifdef VC_BOARD_ACTUATOR
extern const vc_actuator board_actuator;
#define VC_ACTUATOR(shipped) board_actuator
#else
#define VC_ACTUATOR(shipped) shipped
#endif

/* Starts the controller, once. The port owns `settings`, `flash` and `dac`, which must stay valid. `flash` may be
 * NULL: the controller then has no slots for model images. A turn hands codes to the DAC after it has decoded a block
 * for them, so they come late by that time. The ramp to rest after a Stop comes at once, about 5 ms ahead of time.
 * Returns as vc_controller_init. After an error, do not call vc_loop_turn(). */
int vc_loop_start(const vc_controller_settings *settings, const vc_flash *flash, const vc_dac_port *dac);

/* Takes bytes from the host, plays the samples that are due, and hands on bytes for the host; a turn decodes one block
 * at most. Returns 0 if no byte moved and no work is left: the port may then wait for the next byte, or for a few
 * milliseconds. */
int vc_loop_turn(void);

/* Copies up to `capacity` bytes from the host into `data`. Returns how many bytes there were, 0 if none. Never waits.
 */
size_t vc_port_read(uint8_t *data, size_t capacity);

/* Takes up to `length` bytes for the host from `data`. Returns how many it took. Never waits. */
size_t vc_port_write(const uint8_t *data, size_t length);

/* Returns a clock in microseconds, from any start. It never goes back, and the same oscillator drives the DAC. */
uint64_t vc_port_now_us(void);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
